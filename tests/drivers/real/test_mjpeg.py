"""An MJPEG camera on the network: reached, refused, lost and found again."""

import re
import socket
import threading
import time
from contextlib import contextmanager, suppress

import cv2
import numpy as np
import pytest

from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.real import mjpeg
from drivers.real.mjpeg import MjpegSource
from tests.drivers.real.cameras import HEIGHT, WIDTH, counting, jpeg, number_of, numbered


@pytest.fixture(autouse=True)
def no_thread_is_left_running():
    yield
    left = [t.name for t in threading.enumerate() if {"frames", "mjpeg"} & set(t.name.split())]
    assert not left


@contextmanager
def source(address, **told):
    made = MjpegSource("finger", address, **{"rate": 30.0, **told})
    try:
        yield made
    finally:
        made.close()


def next_frame(camera, patience=100):
    for _ in range(patience):
        frame = camera.take()
        if frame is not None:
            return frame
    raise AssertionError("no frame")


@contextmanager
def server(*says, hold=True):
    """Accepts one client and says what it is told to, byte strings, one after the other."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        done = threading.Event()

        def serve():
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                for word in says:
                    connection.sendall(word)
                if hold:
                    done.wait(30)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/stream"
        done.set()
        thread.join(5)


def refused(address, timeout=1.0):
    with source(address) as camera, pytest.raises(DriverError) as caught:
        camera.open(timeout)
    assert caught.value.device == "finger" and address in str(caught.value) and caught.value.remedy
    return caught.value


# -- what comes --------------------------------------------------------------------------------------------------------


def test_pictures_come_in_order_with_the_time_that_the_camera_tells():
    with MjpegCamera(counting(), 60) as emulator, source(emulator.address, rate=60.0) as camera:
        before = time.time_ns()
        camera.open(2.0)
        frames = [next_frame(camera) for _ in range(5)]
    shown = [number_of(frame.picture(False)) for frame in frames]
    assert shown == sorted(set(shown))
    assert [frame.number for frame in frames] == sorted({frame.number for frame in frames})
    assert all(before < frame.capture_ns < frame.arrival_ns < time.time_ns() for frame in frames)


def test_a_slow_reader_gets_the_newest_picture():
    with MjpegCamera(counting(), 120) as emulator, source(emulator.address, rate=120.0) as camera:
        camera.open(2.0)
        last = number_of(next_frame(camera).picture(False))
        for _ in range(4):
            assert emulator.await_count(last + 60)
            made = emulator.count
            frame = next_frame(camera)
            last = number_of(frame.picture(False))
            assert last > made - 20  # of 60 that came meanwhile; test_frames counts exactly


@pytest.mark.parametrize("fault", ["garbage", "bare", "slow"])
def test_what_a_camera_may_do_oddly_is_read_all_the_same(fault):
    with MjpegCamera(counting(), 60) as emulator, source(emulator.address, rate=60.0) as camera:
        emulator.fault = fault
        camera.open(2.0)
        shown = [number_of(next_frame(camera).picture(False)) for _ in range(5)]
    assert shown == sorted(set(shown)) and shown[0] > 0


def test_a_server_that_answers_in_chunks_is_read_to_the_last_pixel():
    """Chunks of 4096 bytes, in the midst of pictures and headers."""
    noise = np.random.default_rng(0).integers(0, 40, (HEIGHT, WIDTH, 3), np.uint8)
    jpegs = [jpeg(numbered(n) + noise, 95) for n in (7, 8)]  # two wait for a reader, of more the newest
    body = b"".join(b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg + b"\r\n" for jpeg in (*jpegs, jpegs[-1]))
    chunks = [body[i : i + 4096] for i in range(0, len(body), 4096)]
    head = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n"
    head += b"Transfer-Encoding: chunked\r\n\r\n"
    with (
        server(head, *(b"%x\r\n%s\r\n" % (len(c), c) for c in chunks)) as address,
        source(address, rate=1e6) as camera,
    ):
        camera.open(2.0)
        pictures = [next_frame(camera).picture(False) for _ in jpegs]
    for picture, sent in zip(pictures, jpegs, strict=True):
        np.testing.assert_array_equal(picture, cv2.imdecode(np.frombuffer(sent, np.uint8), cv2.IMREAD_COLOR))


def test_user_and_password_go_to_the_camera_and_into_no_message():
    heard = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            connection, _ = listener.accept()
            with connection:
                heard.append(connection.recv(4096))
                connection.sendall(b"HTTP/1.0 401 Unauthorized\r\n\r\n")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        address = f"http://me:s%40cret@127.0.0.1:{listener.getsockname()[1]}/x"
        with source(address) as camera, pytest.raises(NotConnected, match="401") as caught:
            camera.open(1.0)
        thread.join(5)
    assert b"Authorization: Basic bWU6c0BjcmV0\r\n" in heard[0]
    assert "cret" not in str(caught.value) and "127.0.0.1" in str(caught.value)


# -- what does not come ------------------------------------------------------------------------------------------------


def test_a_port_where_nobody_listens_is_not_connected():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    error = refused(f"http://127.0.0.1:{port}/stream")
    assert isinstance(error, NotConnected) and "refused" in str(error)


def test_a_wrong_ip_ends_in_not_connected_within_the_time_out():
    # of the block that nobody has (RFC 5737): no answer, or no way there
    assert isinstance(refused("http://192.0.2.1/stream", 0.3), NotConnected)


def test_a_name_that_nobody_knows_is_not_connected(monkeypatch):
    def unknown(*_):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(mjpeg.socket, "getaddrinfo", unknown)
    error = refused("http://camera.lab/stream")
    assert isinstance(error, NotConnected) and "'camera.lab'" in str(error)


def test_a_resolver_that_hangs_is_not_waited_for(monkeypatch):
    hung = threading.Event()
    monkeypatch.setattr(mjpeg.socket, "getaddrinfo", lambda *_: hung.wait(30))
    try:
        assert isinstance(refused("http://camera.lab/stream", 0.2), NotConnected)
    finally:
        hung.set()


def test_a_server_that_says_nothing_is_a_time_out():
    with server() as address:
        assert isinstance(refused(address, 0.3), DeviceTimeout)


def test_a_header_without_end_is_no_hang():
    with server(b"HTTP/1.0 200 OK\r\n", *[b"X: y\r\n"] * 20_000, hold=False) as address:
        assert isinstance(refused(address, 5.0), ProtocolError)


@pytest.mark.parametrize(
    ("fault", "kind", "said"),
    [
        ("http_500", NotConnected, "HTTP 500 Internal Server Error. The camera's own server is in trouble"),
        ("no_http", ProtocolError, "no HTTP"),
        ("single", ProtocolError, "a single picture. Name the stream itself"),
    ],
)
def test_an_answer_that_is_no_stream_says_what_it_is(fault, kind, said):
    with MjpegCamera(counting()) as emulator:
        emulator.fault = fault
        error = refused(emulator.address)
    assert isinstance(error, kind) and said in str(error)


def test_a_path_that_is_not_there_is_told_with_usual_ones():
    with MjpegCamera(counting()) as emulator:
        assert "/?action=stream" in str(refused(emulator.address + "s"))


# -- what breaks off ---------------------------------------------------------------------------------------------------

LOST = {
    "cut": (DeviceFault, "in the middle of a picture"),
    "stop": (DeviceTimeout, r"no frame for 0\.5 s"),
    "silence": (DeviceTimeout, r"no frame for 0\.5 s"),
    "oversized": (ProtocolError, "1073741824 bytes"),
    "endless": (ProtocolError, "more than"),
}


@pytest.mark.parametrize("fault", LOST)
def test_a_stream_that_breaks_off_is_a_typed_error_and_comes_back_after_reopening(fault):
    kind, said = LOST[fault]
    with MjpegCamera(counting(), 60) as emulator, source(emulator.address, silence=0.5) as camera:
        camera.open(2.0)
        before = next_frame(camera)
        emulator.fault = fault
        with pytest.raises(kind, match=said) as caught:
            while True:
                next_frame(camera)
        assert caught.value.device == "finger" and emulator.address in str(caught.value)
        emulator.fault = None
        camera.open(2.0)
        after = next_frame(camera)
    assert after.number > before.number and number_of(after.picture(False)) > number_of(before.picture(False))


def test_a_camera_that_is_switched_off_and_on_is_found_again():
    emulator = MjpegCamera(counting(), 60)
    with source_of(emulator) as camera:
        with emulator:
            camera.open(2.0)
            next_frame(camera)
        with pytest.raises(DriverError):
            while True:
                next_frame(camera)
        with pytest.raises(NotConnected):
            camera.open(1.0)
        with emulator:
            camera.open(2.0)
            next_frame(camera)


@contextmanager
def source_of(emulator):
    with emulator:
        address = emulator.address
    with source(address, silence=0.5) as camera:
        yield camera


def test_a_damaged_picture_is_a_protocol_error_and_the_next_one_is_whole():
    with MjpegCamera(counting(), 60) as emulator, source(emulator.address) as camera:
        camera.open(2.0)
        next_frame(camera)
        emulator.fault = "damaged"
        with pytest.raises(ProtocolError, match=re.escape("finger: read a picture: a picture whose end is missing")):
            while True:
                next_frame(camera).picture(False)
        emulator.fault = None
        frames = [next_frame(camera) for _ in range(10)]
        assert number_of(frames[-1].picture(False)) > 0


def test_closing_twice_is_harmless():
    with MjpegCamera(counting()) as emulator, source(emulator.address) as camera:
        camera.open(2.0)
        camera.close()
        camera.close()
