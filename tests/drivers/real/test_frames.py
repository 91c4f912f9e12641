"""Which frames a source hands on, with which numbers and times; by a clock that is turned by hand."""

import re
from itertools import pairwise

import pytest

from drivers.errors import DeviceTimeout, NotConnected
from drivers.real import frames
from drivers.real.frames import FrameSource, frame_source, known_address
from tests.drivers.by_hand import Time
from tests.drivers.real.cameras import number_of, numbered


class ByHand(FrameSource):
    """A camera whose frames come when the test says so."""

    def _reach(self, timeout):
        self.frames = 0

    def _drain(self):
        raise AssertionError

    def _detach(self):
        return lambda: None

    def open(self, timeout=1.0):
        super().open(timeout)
        assert self._session is not None
        self._session.closing.set()

    def send(self, exposed_ns=None, missed=0):
        self.frames += 1
        shown = self.frames
        self._offer(lambda: lambda grey: numbered(shown), exposed_ns, missed)


@pytest.fixture
def clock(monkeypatch):
    clock = Time()
    monkeypatch.setattr(frames, "time", clock)
    return clock


@pytest.fixture
def camera(clock, monkeypatch):
    monkeypatch.setattr(ByHand, "_run", lambda self, session: session.over())
    camera = ByHand("finger", "by hand", rate=30.0, delay=0.01)
    camera.open()
    yield camera
    camera.close()


def taken(camera):
    frame = camera.take(0.0)
    return None if frame is None else (frame.number, number_of(frame.picture(False)))


def test_every_frame_is_handed_on_with_its_number(camera, clock):
    for n in range(60):
        clock.now += 1 / 30
        camera.send()
        assert taken(camera) == (n, n + 1)
    assert taken(camera) is None
    assert camera.rate == pytest.approx(30.0)


def test_a_reader_held_up_for_a_moment_loses_nothing(camera, clock):
    for _ in range(2):
        clock.now += 1 / 30
        camera.send()
    assert [taken(camera), taken(camera)] == [(0, 1), (1, 2)]


def test_a_reader_that_is_slow_gets_the_newest_and_sees_by_the_number_what_it_missed(camera, clock):
    for _ in range(100):
        clock.now += 1 / 30
        camera.send()
    clock.now += 0.5 / 30
    frame = camera.take(0.0)
    assert (frame.number, number_of(frame.picture(False))) == (99, 100)
    assert clock.time_ns() - frame.capture_ns < 2e9 / 30
    assert taken(camera) is None


@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0])
def test_of_a_camera_that_is_faster_as_many_are_read_as_asked_for_and_none_counts_as_lost(camera, clock, rate):
    seen = []
    for _ in range(int(rate * 20)):
        clock.now += 1 / rate
        camera.send()
        if (frame := taken(camera)) is not None:
            seen.append(frame[0])
    assert seen == list(range(len(seen)))
    assert 600 <= len(seen) <= 630


def test_what_comes_late_in_a_burst_is_not_thinned(camera, clock):
    for _ in range(30):
        clock.now += 1 / 30
        camera.send()
        camera.take(0.0)
    exposed = [clock.time_ns() + round((n + 1) / 30 * 1e9) for n in range(3)]
    clock.now += 0.1
    for instant in exposed:
        camera.send(exposed_ns=instant)
    assert camera.take(0.0).number == 32  # two behind: the newest


def test_the_cameras_own_time_is_believed_where_it_is_plausible(camera, clock):
    clock.now += 1.0
    camera.send(exposed_ns=clock.time_ns() - 30_000_000)
    frame = camera.take(0.0)
    assert (frame.arrival_ns, frame.capture_ns) == (clock.time_ns(), clock.time_ns() - 30_000_000)


@pytest.mark.parametrize("off", [5.0, -3.0, -1.7e9], ids=["future", "old", "since the camera was switched on"])
def test_a_time_that_cannot_be_is_not_believed(camera, clock, off):
    clock.now += 1.0
    camera.send(exposed_ns=clock.time_ns() + round(off * 1e9))
    frame = camera.take(0.0)
    assert frame.capture_ns == clock.time_ns() - 10_000_000  # the arrival less the delay


def test_capture_times_rise_and_lie_before_the_arrival_whatever_the_cameras_clock_does(camera, clock):
    seen = []
    for off in (0.0, 0.015, -0.9, -0.1, 0.0):
        clock.now += 1 / 30
        camera.send(exposed_ns=clock.time_ns() + round(off * 1e9))
        seen.append(camera.take(0.0))
    captures = [frame.capture_ns for frame in seen]
    assert all(a < b for a, b in pairwise(captures))
    assert all(frame.arrival_ns >= frame.capture_ns for frame in seen)


def test_after_the_camera_had_gone_the_numbers_tell_what_it_would_have_sent(camera, clock):
    for _ in range(40):
        clock.now += 1 / 20  # slower than asked for
        camera.send()
        camera.take(0.0)
    camera.close()
    clock.now += 2.0
    camera.open()
    clock.now += 1 / 20
    camera.send()
    assert taken(camera) == (40 + 40, 1)


def test_a_picture_that_a_server_had_kept_is_none_of_the_new_stream(camera, clock):
    kept = clock.time_ns() - 200_000_000
    camera.send(exposed_ns=kept)
    assert taken(camera) is None
    clock.now += 1 / 30
    camera.send(exposed_ns=clock.time_ns())
    assert taken(camera) == (0, 2)


def test_what_a_camera_says_it_lost_is_missing_from_the_numbers(camera, clock):
    for missed in (0, 0, 3, 0):
        clock.now += 1 / 30
        camera.send(missed=missed)
        last = taken(camera)
        clock.now += missed / 30
    assert last == (6, 4)


def test_silence_is_a_time_out_that_names_device_address_and_remedy(camera, clock):
    camera.send()
    camera.take(0.0)
    clock.now += 2.1
    with pytest.raises(DeviceTimeout, match=r"^finger: read by hand: no frame for 2 s\. See"):
        camera.take(0.0)


@pytest.mark.parametrize(
    "address",
    [
        "http://10.0.0.7/stream", "http://user:pass@camera.lab:8080/?action=stream", "usb:0", "usb:/dev/v4l/by-id/x",
        "/dev/video2", "realsense:", "realsense:0123",
    ],
)  # fmt: skip
def test_an_address_chooses_the_kind_of_camera(address):
    assert known_address(address)
    source = frame_source("finger", address, rate=30.0, size=(640, 480))
    kind = "Usb" if address.startswith(("usb", "/dev")) else "Realsense" if "realsense" in address else "Mjpeg"
    assert type(source).__name__ == f"{kind}Source"
    assert source.address == re.sub("user:pass@", "", address)


@pytest.mark.parametrize("address", ["", "https://10.0.0.7/", "rtsp://x/y", "usb:", "usb:front", "http://", "video0"])
def test_an_address_of_no_known_kind_is_refused(address):
    assert not known_address(address)
    with pytest.raises(NotConnected, match="http://host:port/path"):
        frame_source("finger", address, rate=30.0, size=(640, 480))
