"""A device that is read by a thread of its own: who needs its readings, and what becomes of those that nobody needs."""

import threading
import time
from queue import Empty, SimpleQueue

import pytest

from drivers.errors import DeviceFault, DeviceTimeout
from drivers.interfaces import Description
from drivers.streaming import StreamingImager
from mechanics.readings import GripperReading, Stamp


class Camera(StreamingImager):
    """Makes a reading of each number that it is fed, where somebody needs it; an error is raised instead."""

    def __init__(self):
        super().__init__("camera")
        self.fed: SimpleQueue = SimpleQueue()
        self.begun = 0

    def describe(self):
        return Description("camera", "tag_camera", "fed by hand", "real", "1", "camera")

    def _begin(self, timeout):
        self.begun += 1

    def _poll(self):
        try:
            fed = self.fed.get(timeout=0.05)
        except Empty:
            return
        if isinstance(fed, Exception):
            raise fed
        if isinstance(fed, threading.Event):
            fed.set()
        elif self._needed:
            now = time.time_ns()
            self._push(GripperReading(Stamp(now, now, fed, "camera"), 0.0, 0.0, False))
        else:
            self._pass_by(fed)

    def _end(self):
        pass

    def feed(self, *numbers):
        """Return when all of it was taken."""
        for number in numbers:
            self.fed.put(number)
        taken = threading.Event()
        self.fed.put(taken)
        assert taken.wait(5)


@pytest.fixture
def camera():
    with Camera() as camera:
        yield camera


def numbers(camera):
    return [reading.stamp.sequence for reading in camera.since(0)]


def test_what_nobody_takes_is_not_made_and_not_lost(camera):
    camera.feed(0, 1)
    camera.wanted = lambda: False
    camera.feed(2, 3, 4)
    camera.wanted = lambda: True
    camera.feed(5)
    assert numbers(camera) == [0, 1, 5]
    assert camera.gaps == 0


def test_who_asks_for_a_frame_gets_one_whoever_takes_the_stream(camera):
    camera.wanted = lambda: False
    found = []
    asking = threading.Thread(target=lambda: found.append(camera.capture(timeout=5)))
    asking.start()
    deadline = time.monotonic() + 5
    while not camera._needed and time.monotonic() < deadline:
        asking.join(0.005)
    camera.feed(7)
    asking.join(5)
    assert found[0].stamp.sequence == 7
    camera.feed(8)
    assert numbers(camera) == [7]


def test_a_frame_that_does_not_come_is_a_time_out_that_names_the_device(camera):
    with pytest.raises(DeviceTimeout, match="camera: capture"):
        camera.capture(timeout=0.05)


def test_trouble_is_told_until_the_device_is_reached_again(camera):
    camera.feed(0)
    camera.fed.put(DeviceFault("camera", "read", "its cable is out", "Put it in"))
    with pytest.raises(DeviceFault, match="its cable is out"):
        camera.capture(timeout=5)
    camera.feed(1)  # taken once it has been reached again
    assert camera.begun == 2 and camera.reconnections == 1
    assert numbers(camera) == [0, 1]


def test_a_defect_in_a_backend_is_told_and_ends_no_thread(camera):
    camera.fed.put(ZeroDivisionError("division by zero"))
    with pytest.raises(DeviceFault, match="This is a defect"):
        camera.capture(timeout=5)
    camera.feed(1)
    assert numbers(camera) == [1]
