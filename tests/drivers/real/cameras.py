"""Pictures that say which one they are, and cameras that do as they are told."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 320, 240
_BITS = 16


def numbered(number: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """A picture (h, w, 3) with ``number`` in it as bars, so wide that JPEG does them no harm."""
    bits = [number >> i & 1 for i in range(_BITS)]
    bars = np.repeat(np.where(bits, 215, 40).astype(np.uint8), width // _BITS)
    return np.ascontiguousarray(np.broadcast_to(bars[None, :, None], (height, width, 3)))


def number_of(picture: NDArray[np.uint8] | NDArray[np.uint16]) -> int:
    grey = picture.reshape(*picture.shape[:2], -1).mean(axis=(0, 2))
    return sum(int(bar > 128) << i for i, bar in enumerate(grey.reshape(_BITS, -1).mean(axis=1)))


def counting(width: int = WIDTH, height: int = HEIGHT) -> Callable[[], NDArray[np.uint8]]:
    """Pictures 1, 2, 3 and so on, as `MjpegCamera.count` counts them."""
    numbers = itertools.count(1)
    return lambda: numbered(next(numbers), width, height)


def jpeg(picture: NDArray[np.uint8], quality: int = 90) -> bytes:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


class UsbCamera:
    """Stands for `cv2.VideoCapture`: like it, it says that it is open for ever."""

    def __init__(self, period: float = 0.002):
        self.plugged = True
        self.hung: threading.Event | None = None
        self.released = threading.Event()
        self.grabs = 0
        self.asked: dict[int, float] = {}
        self._period = threading.Event(), period
        self.in_use = threading.Lock()

    def isOpened(self) -> bool:
        return True

    def set(self, propId: int, value: float, /) -> bool:
        self.asked[propId] = value
        return True

    def grab(self) -> bool:
        with self.in_use:
            if self.hung is not None:
                self.hung.wait(30)
                return False
            event, period = self._period
            event.wait(period)
            self.grabs += self.plugged
            return self.plugged

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        return True, numbered(self.grabs)

    def release(self) -> None:
        assert self.in_use.acquire(blocking=False), "released in the midst of a call, which crashes OpenCV"
        self.in_use.release()
        self.released.set()
