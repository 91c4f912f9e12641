"""Frames from a USB camera, through OpenCV."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, ProtocolError
from drivers.real.frames import FrameSource
from drivers.real.guarded import guarded

#: after so many grabs in a row that fail the camera has gone: OpenCV itself says that it is open for ever
_FAILURES = 3


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool:
        """Whether it was opened once."""
        ...

    def set(self, propId: int, value: float, /) -> bool:
        """Ask for a property."""
        ...

    def grab(self) -> bool:
        """Wait for the next frame."""
        ...

    def retrieve(self) -> Any:
        """Whether that succeeded, and the frame that was grabbed."""
        ...

    def release(self) -> None:
        """Close it."""
        ...


def opened(camera: str) -> Capture:
    """OpenCV's own: ``camera`` is an index or a path, through Video4Linux where there is one."""
    backend = cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY
    return cast("Capture", cv2.VideoCapture(int(camera) if camera.isdigit() else camera, backend))


class UsbSource(FrameSource):
    """A USB camera by index (``0``) or path (``/dev/video0``, or better ``/dev/v4l/by-id/…``, which stays the same).

    It is asked for MJPEG at ``size`` (width, height) [px] and ``rate`` [Hz]; what it sends instead shows in the frames,
    for what a driver says of itself is not to be relied on. The rate is measured.
    """

    def __init__(
        self,
        name: str,
        camera: str,
        address: str,
        *,
        rate: float,
        size: tuple[int, int],
        delay: float = 0.0,
        silence: float = 2.0,
        open_camera: Callable[[str], Capture] = opened,
    ):
        super().__init__(name, address, rate=rate, delay=delay, silence=silence)
        self._camera, self._size, self._open_camera = camera, size, open_camera
        self._capture: Capture | None = None
        self._failed = 0

    def _reach(self, timeout: float) -> None:
        path = Path(f"/dev/video{self._camera}" if self._camera.isdigit() else self._camera)
        if self._open_camera is opened and sys.platform == "linux" and not path.exists():
            there = ", ".join(sorted(str(p) for p in Path("/dev").glob("video*"))) or "none"
            raise self._not_reached(f"there is no {path}", f"Plug it in. Cameras of this machine: {there}")
        try:
            self._capture = guarded(self._prepared, timeout, lambda late: late.release())
        except TimeoutError:
            raise self._not_reached(
                f"it does not open within {timeout:.3g} s", "Unplug it and plug it in again"
            ) from None
        except cv2.error as error:
            raise self._not_reached(str(error), "See whether it is a camera") from error
        if not self._capture.isOpened():
            raise self._not_reached(
                "it does not open", "See whether another program uses it, and whether you may read it (group video)"
            )
        self._failed = 0

    def _prepared(self) -> Capture:
        capture = self._open_camera(self._camera)
        if capture.isOpened():
            width, height = self._size
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
            capture.set(cv2.CAP_PROP_FPS, self._rate)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        return capture

    def _drain(self) -> None:
        capture = self._capture
        assert capture is not None
        if capture.grab():
            self._failed = 0
            self._offer(partial(self._picture, capture))
            return
        self._failed += 1
        if self._failed >= _FAILURES:
            raise DeviceFault(
                self.name, f"read {self.address}", "it gives no more frames", "See to its plug; it is tried again", True
            )
        time.sleep(0.01)  # a grab that fails returns at once, and tells nothing of when the next one may not

    def _picture(self, capture: Capture) -> Callable[[bool], NDArray[np.uint8]]:
        good, image = capture.retrieve()  # now: the next grab takes its place
        return partial(_told, self.name, image if good else None)

    def _detach(self) -> Callable[[], object]:
        capture, self._capture = self._capture, None
        return (lambda: None) if capture is None else capture.release


def _told(name: str, image: Any, grey: bool) -> NDArray[np.uint8]:
    if image is None or image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ProtocolError(name, "read a picture", "a frame that cannot be decoded", "See to the camera's cable")
    if grey:
        return image if image.ndim == 2 else cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return image if image.ndim == 3 else cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
