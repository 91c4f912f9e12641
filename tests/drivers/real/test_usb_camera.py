"""A USB camera through OpenCV, which neither times out nor notices that a camera has gone."""

import threading

import cv2
import pytest

from drivers.errors import DeviceFault, DeviceTimeout, NotConnected
from drivers.real.frames import frame_source
from drivers.real.usb_camera import UsbSource
from tests.drivers.real.cameras import UsbCamera, number_of, numbered


@pytest.fixture
def plugged():
    return UsbCamera()


@pytest.fixture
def camera(plugged):
    made = UsbSource("tags", "0", "usb:0", rate=500.0, size=(320, 240), silence=0.3, open_camera=lambda _: plugged)
    yield made
    made.close()


def next_frame(camera):
    while (frame := camera.take()) is None:
        pass
    return frame


def test_frames_come_and_their_rate_is_measured(camera, plugged):
    camera.open(1.0)
    frames = [next_frame(camera) for _ in range(40)]
    assert [number_of(f.picture(False)) for f in frames] == sorted({number_of(f.picture(False)) for f in frames})
    assert frames[0].picture(True).shape == (240, 320)
    spacing = (frames[-1].capture_ns - frames[0].capture_ns) / (frames[-1].number - frames[0].number)
    assert camera.rate == pytest.approx(1e9 / spacing, rel=0.8)  # of times that a crowded machine makes uneven


def test_it_is_asked_for_what_the_station_file_says(camera, plugged):
    camera.open(1.0)
    assert plugged.asked == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH: 320,
        cv2.CAP_PROP_FRAME_HEIGHT: 240,
        cv2.CAP_PROP_FPS: 500.0,
        cv2.CAP_PROP_BUFFERSIZE: 1,
    }


def test_a_camera_that_is_pulled_out_is_a_fault_though_opencv_calls_it_open(camera, plugged):
    camera.open(1.0)
    next_frame(camera)
    plugged.plugged = False
    with pytest.raises(DeviceFault, match=r"^tags: read usb:0: it gives no more frames"):
        while True:
            next_frame(camera)
    assert plugged.isOpened()
    camera.close()
    assert plugged.released.is_set()
    plugged.plugged = True
    camera.open(1.0)
    next_frame(camera)


def test_a_grab_that_hangs_is_a_time_out_and_the_camera_is_let_go_only_after_it(camera, plugged):
    camera.open(1.0)
    next_frame(camera)
    plugged.hung = threading.Event()
    with pytest.raises(DeviceTimeout, match="usb:0"):
        while True:
            next_frame(camera)
    camera.close()
    assert not plugged.released.is_set()
    plugged.hung.set()
    assert plugged.released.wait(10)


def test_an_opening_that_hangs_is_not_connected_and_what_it_brings_late_is_let_go():
    late, camera = threading.Event(), UsbCamera()

    def slow(_):
        late.wait(30)
        return camera

    source = UsbSource("tags", "0", "usb:0", rate=30.0, size=(320, 240), open_camera=slow)
    with pytest.raises(NotConnected, match="does not open within"):
        source.open(0.1)
    late.set()
    assert camera.released.wait(10)


def test_a_camera_that_is_not_there_is_named_with_those_that_are():
    source = frame_source("tags", "/dev/video97", rate=30.0, size=(320, 240))
    with pytest.raises(NotConnected, match=r"^tags: connect to /dev/video97: there is no /dev/video97\. Plug it in"):
        source.open(1.0)


def test_what_opencv_does_not_open_is_not_connected(tmp_path):
    (tmp_path / "no_camera").write_bytes(b"")
    source = frame_source("tags", f"usb:{tmp_path}/no_camera", rate=30.0, size=(320, 240))
    with pytest.raises(NotConnected, match="whether another program uses it"):
        source.open(5.0)


def test_opencvs_own_capture_is_read_to_its_end(tmp_path):
    file = str(tmp_path / "film.avi")
    writer = cv2.VideoWriter(file, cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    for n in range(1, 4):
        writer.write(numbered(n))
    writer.release()
    source = UsbSource(
        "tags", file, file, rate=30.0, size=(320, 240), open_camera=lambda f: cv2.VideoCapture(f, cv2.CAP_OPENCV_MJPEG)
    )
    try:
        source.open(5.0)
        shown = []
        with pytest.raises(DeviceFault, match="no more frames"):
            while True:
                shown.append(number_of(next_frame(source).picture(False)))
        assert shown and set(shown) <= {1, 2, 3}
    finally:
        source.close()
