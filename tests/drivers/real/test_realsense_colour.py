"""Colour of a RealSense: Intel's own library plays back a recording that it made of a camera in software."""

import itertools
import sys
import threading

import numpy as np
import pytest

from drivers.errors import DeviceTimeout, NotConnected
from drivers.real import realsense
from drivers.real.frames import frame_source
from tests.drivers.real.cameras import HEIGHT, WIDTH, number_of, numbered

COUNT = 20


@pytest.fixture
def rs():
    return pytest.importorskip("pyrealsense2", exc_type=ImportError, reason="pyrealsense2, or libusb, is not installed")


@pytest.fixture
def recording(rs, tmp_path):
    """Pictures 1 to 20, redder than blue, as rgb8 at 30 Hz."""
    path = str(tmp_path / "colour.db3")
    camera = rs.software_device()
    camera.register_info(rs.camera_info.serial_number, "0123456789")
    camera.register_info(rs.camera_info.name, "a camera in software")
    sensor, stream, lens = camera.add_sensor("Colour"), rs.video_stream(), rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy = WIDTH, HEIGHT, 300, 300
    stream.type, stream.fmt, stream.intrinsics = rs.stream.color, rs.format.rgb8, lens
    stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, 30, 3
    profile = sensor.add_video_stream(stream)
    recorder = rs.recorder(path, camera)
    recorded = recorder.query_sensors()[0]
    recorded.open(recorded.get_stream_profiles()[0])
    arrived, everything, pace = itertools.count(1), threading.Event(), threading.Event()

    def count(_):
        if next(arrived) == COUNT:
            everything.set()

    recorded.start(count)
    for n in range(1, COUNT + 1):
        frame = rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(numbered(n) + np.array([20, 0, 0], np.uint8))
        frame.stride, frame.bpp, frame.profile = WIDTH * 3, 3, profile.as_video_stream_profile()
        frame.timestamp, frame.domain, frame.frame_number = 1e12 + n * 1e3 / 30, rs.timestamp_domain.system_time, n
        sensor.on_video_frame(frame)
        pace.wait(1 / 30)  # the recording is played back as it was made
    assert everything.wait(20)
    recorded.stop()
    recorded.close()
    del recorder, recorded
    return path


def test_the_librarys_frames_come_with_their_numbers_and_colours(recording):
    camera = frame_source("tags", f"realsense:{recording}", rate=30.0, size=(WIDTH, HEIGHT), silence=0.5)
    frames = []
    try:
        camera.open(10.0)
        assert camera.serial == "0123456789"
        with pytest.raises(DeviceTimeout, match=r"^tags: read realsense:.*colour\.db3: no frame for 0\.5 s"):
            while True:  # to the recording's end
                frame = camera.take()
                frames += [] if frame is None else [frame]
    finally:
        camera.close()
    shown = [number_of(frame.picture(False)) for frame in frames]
    assert len(shown) > COUNT / 2 and shown == sorted(set(shown)) and shown[-1] <= COUNT
    blue, green, red = np.moveaxis(frames[0].picture(False).astype(int), -1, 0)
    np.testing.assert_array_equal(red - blue, 20)
    np.testing.assert_array_equal(green, blue)
    assert frames[0].picture(True).shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("serial", ["", "0123"])
def test_a_camera_that_is_not_there_is_not_connected_at_once(rs, serial):
    camera = frame_source("tags", f"realsense:{serial}", rate=30.0, size=(640, 480))
    with pytest.raises(NotConnected, match=f"^tags: connect to realsense:{serial}: no RealSense"):
        camera.open(5.0)


def test_a_recording_that_is_not_there_is_not_connected(rs, tmp_path):
    camera = frame_source("tags", f"realsense:{tmp_path}/none.db3", rate=30.0, size=(640, 480))
    with pytest.raises(NotConnected, match=r"none\.db3"):
        camera.open(5.0)


def test_a_missing_package_names_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(NotConnected, match=r"^tags: connect: .* is missing\. pip install 'extrinsic\[realsense\]'$"):
        realsense.library("tags", "connect")


def test_a_package_that_lacks_a_library_of_the_system_says_which(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(NotConnected, match=r"cannot be loaded: libusb-1\.0\.so\.0: .*\. On Debian: apt install libusb"):
        realsense.library("tags", "connect")


def test_a_library_that_hangs_is_not_waited_for():
    hung = threading.Event()

    class Context:
        def query_devices(self):
            return hung.wait(30)

    class Library:
        context = Context

    try:
        with pytest.raises(NotConnected, match="no list of cameras within"):
            realsense.chosen(Library, "tags", "connect", "", 0.1)
    finally:
        hung.set()
