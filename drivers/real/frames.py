"""Where colour frames come from: cameras that send by themselves, each drained by a thread that keeps the newest.

A reader that is slow never falls behind: it gets the newest frame, and sees by the numbers what it has missed.
"""

from __future__ import annotations

import re
import statistics
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected
from drivers.streaming import POLL

#: a camera's own time of exposure is believed where it lies so far before the arrival, or after it [s]
_OLDEST, _AHEAD = 1.0, 0.02
#: so many frames wait at most: a reader that is held up for a moment loses none
_BACKLOG = 3
#: a camera may be so much faster than it is asked for [share], and catch up on so much after a pause [s]
_HASTE, _CATCH_UP = 1.05, 0.5
#: how long a call of a library that hangs is waited for [s]
_JOIN = 2.0

_HTTP = re.compile(r"http://(?:[^/@\s]+@)?[^/@\s:]+(?::\d{1,5})?(?:/\S*)?")
_USB = re.compile(r"usb:(\d+|/\S+)|(/dev/\S+)")
_REALSENSE = re.compile(r"realsense:(\S*)")
ADDRESSES = "http://host:port/path, usb:0, /dev/video0 or realsense:SERIAL"


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame on its way: its ``number`` among those that were due, and its times [ns, Unix time].

    ``picture(grey)`` gives it as (h, w, 3) uint8, blue first, or (h, w) where ``grey``. Raises ProtocolError where it
    came damaged.
    """

    number: int
    capture_ns: int
    arrival_ns: int
    picture: Callable[[bool], NDArray[np.uint8]]


class _Session:
    """The thread that drains a camera, from opening to closing."""

    def __init__(self) -> None:
        self.closing = threading.Event()
        self.thread: threading.Thread | None = None
        self._turn = threading.Lock()
        self._over = False
        self._release: Callable[[], object] | None = None

    def close(self, detach: Callable[[], Callable[[], object]]) -> None:
        """End the thread, and let go of the camera: the thread itself does where a call holds it up for too long."""
        self.closing.set()
        if self.thread is not None:
            self.thread.join(timeout=_JOIN)
        release = detach()
        with self._turn:
            if not self._over:
                self._release = release
                return
        _released(release)

    def over(self) -> None:
        """The thread ends."""
        with self._turn:
            self._over = True
            release, self._release = self._release, None
        if release is not None:
            _released(release)


def _released(release: Callable[[], object]) -> None:
    """Let go of what may have gone."""
    with suppress(Exception):
        release()


class FrameSource(ABC):
    """A camera that sends frames, and a thread that takes each as it comes and keeps the newest that are due.

    ``rate`` [Hz] is how many frames are wanted; what a faster camera sends beyond that is left out, and missing from no
    count. Numbers skip where a frame was due and nobody took it before the next, and, after the camera had gone, by
    what it would have sent meanwhile. ``delay`` [s] is from exposure to arrival, where the camera does not tell when it
    exposed. A camera that sends nothing for ``silence`` [s] counts as gone.
    """

    #: the camera's own serial number, where it has told one
    serial = ""

    def __init__(self, name: str, address: str, *, rate: float, delay: float = 0.0, silence: float = 2.0):
        self.name, self.address, self.delay, self.silence = name, address, delay, silence
        self._rate = rate
        self._news = threading.Condition()
        self._waiting: deque[Frame] = deque(maxlen=_BACKLOG)
        self._failure: DriverError | None = None
        self._session: _Session | None = None
        self._times: deque[int] = deque(maxlen=31)  # capture times of frames that were due
        self._number = self._missed = 0
        self._last_ns: int | None = None
        self._first_ns: int | None = None
        self._away = False
        self._allowed, self._allowed_at = 1.0, 0
        self._heard = 0.0  # when the camera last sent anything, monotonic

    # -- a camera's own --------------------------------------------------------------------------------------------

    @abstractmethod
    def _reach(self, timeout: float) -> None:
        """Open the camera. Raises DriverError within ``timeout`` [s]."""

    @abstractmethod
    def _drain(self) -> None:
        """Wait for `POLL` at most, and `_offer` each frame that has come. Raises DriverError when the camera's gone."""

    @abstractmethod
    def _detach(self) -> Callable[[], object]:
        """Forget the camera, however it is, and return the way to let go of it."""

    # ----------------------------------------------------------------------------------------------------------------

    def open(self, timeout: float) -> None:
        """Reach the camera within ``timeout`` [s] and begin to drain it; numbers go on from where they were."""
        self.close()
        self._failure, opened = None, time.time_ns()
        try:
            self._reach(timeout)
        except BaseException:
            _released(self._detach())
            raise
        self._heard = time.monotonic()
        self._allowed, self._allowed_at = 1.0, time.time_ns()
        self._first_ns = opened
        self._session = session = _Session()
        session.thread = threading.Thread(target=self._run, args=(session,), name=f"{self.name} frames", daemon=True)
        session.thread.start()

    def close(self) -> None:
        """Let go of the camera; idempotent."""
        session, self._session = self._session, None
        if session is None:
            _released(self._detach())
        else:
            session.close(self._detach)
        with self._news:
            self._waiting.clear()
            self._away = True

    def take(self, timeout: float = POLL) -> Frame | None:
        """The next frame; the newest, without those before it, for who is two behind. None after ``timeout`` [s].

        Raises DriverError where the camera has gone, DeviceTimeout where it is silent.
        """
        deadline = time.monotonic() + timeout
        with self._news:
            while not self._waiting:
                if self._failure is not None:
                    raise self._failure
                now = time.monotonic()
                if now - self._heard > self.silence:
                    raise DeviceTimeout(
                        self.name,
                        f"read {self.address}",
                        f"no frame for {self.silence:g} s",
                        "See whether the camera's server still runs and its network or cable is well",
                    )
                if now >= deadline:
                    return None
                self._news.wait(min(deadline - now, POLL))
            if len(self._waiting) < _BACKLOG:
                return self._waiting.popleft()
            newest = self._waiting.pop()
            self._waiting.clear()
            return newest

    @property
    def rate(self) -> float:
        """Frames per second that are due, as measured over the last thirty; 0 before the second."""
        with self._news:
            times = list(self._times)
        if len(times) < 2:
            return 0.0
        return 1e9 / max(statistics.median(np.diff(times).tolist()), 1.0)

    def _run(self, session: _Session) -> None:
        try:
            while not session.closing.is_set():
                self._drain()
        except DriverError as error:
            self._fail(error)
        except Exception as error:  # a defect is told, like a camera's
            what = f"{type(error).__name__}: {error}"
            self._fail(DeviceFault(self.name, f"read {self.address}", what, "This is a defect; report it"))
        finally:
            session.over()

    def _fail(self, error: DriverError) -> None:
        with self._news:
            self._failure = error
            self._news.notify_all()

    def _offer(
        self,
        picture: Callable[[], Callable[[bool], NDArray[np.uint8]]],
        exposed_ns: int | None = None,
        missed: int = 0,
    ) -> None:
        """A frame has come; ``exposed_ns`` is when by the camera's clock, ``missed`` how many were lost before it.

        ``picture`` is asked, at once, for the way to the picture, and only where the frame is due.
        """
        arrival = time.time_ns()
        capture = arrival - round(self.delay * 1e9)
        if exposed_ns is not None and -_AHEAD * 1e9 <= arrival - exposed_ns <= _OLDEST * 1e9:
            capture = min(exposed_ns, arrival)
        self._heard = time.monotonic()
        self._missed += missed
        first, self._first_ns = self._first_ns, None
        if (first is not None and capture < first) or not self._due(capture):
            return  # a server may begin with a picture that it has kept
        decode = picture()
        rate = self.rate
        with self._news:
            missed, self._missed = self._missed, 0
            if self._last_ns is not None:
                if self._away:
                    asked = min(rate, self._rate) if rate else self._rate
                    missed = max(missed, round((capture - self._last_ns) * 1e-9 * asked) - 1)
                    self._times.clear()
                self._number += missed
                capture = max(capture, self._last_ns + 1)
            self._away, self._last_ns = False, capture
            self._times.append(capture)
            self._waiting.append(Frame(self._number, capture, max(arrival, capture), decode))
            self._number += 1
            self._news.notify_all()

    def _due(self, capture_ns: int) -> bool:
        """Whether a frame is among those that are wanted: as many as the rate allows, in the long run."""
        most = max(2.0, _CATCH_UP * self._rate)
        passed, self._allowed_at = (capture_ns - self._allowed_at) * 1e-9, capture_ns
        # a clock that was set back tells nothing
        self._allowed = max(self._allowed, 1.0) if passed < 0 else self._allowed + passed * self._rate * _HASTE
        self._allowed = min(most, self._allowed)
        if self._allowed < 1.0:
            return False
        self._allowed -= 1.0
        return True

    def _not_reached(self, got: str, remedy: str) -> NotConnected:
        return NotConnected(self.name, f"connect to {self.address}", got, remedy)


def known_address(address: str) -> bool:
    """Whether an address is of a kind that `frame_source` knows."""
    return any(form.fullmatch(address) for form in (_HTTP, _USB, _REALSENSE))


def frame_source(
    name: str, address: str, *, rate: float, size: tuple[int, int], delay: float = 0.0, silence: float = 2.0
) -> FrameSource:
    """The source for an ``address``: `ADDRESSES`. ``size`` (width, height) [px] is asked of cameras that can be asked.

    Raises NotConnected for an address of no known kind.
    """
    if _HTTP.fullmatch(address):
        from drivers.real.mjpeg import MjpegSource

        return MjpegSource(name, address, rate=rate, delay=delay, silence=silence)
    if found := _USB.fullmatch(address):
        from drivers.real.usb_camera import UsbSource

        camera = found.group(1) or found.group(2)
        return UsbSource(name, camera, address, rate=rate, size=size, delay=delay, silence=silence)
    if found := _REALSENSE.fullmatch(address):
        from drivers.real.realsense_colour import RealsenseSource

        return RealsenseSource(name, found.group(1), address, rate=rate, size=size, delay=delay, silence=silence)
    raise NotConnected(name, f"connect to {address}", "no such kind of address", f"Known are {ADDRESSES}")
