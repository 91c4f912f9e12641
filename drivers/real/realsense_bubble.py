"""A Soft Bubble tactile finger: the RealSense depth camera under its membrane, live or from a recording."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceTimeout
from drivers.finger_frames import DEPTH_UNIT, X_EE_FINGER
from drivers.interfaces import Description, freshness
from drivers.real.bubble_config import DepthLens, RealSenseBubbleConfig
from drivers.real.depth_stream import DepthFrame, DepthStream
from drivers.real.frame_clock import FrameClock
from drivers.real.reference import KEPT, ReferencedFinger
from drivers.registry import Driver
from drivers.streaming import POLL, StreamingImager
from mechanics.readings import ImageReading, Stamp, Status

__all__ = ["DRIVER", "DepthLens", "RealSenseBubble", "RealSenseBubbleConfig"]

Depth = NDArray[np.uint16]

#: a reference's halves may differ by more than so much [steps of depth] in so large a share of the pixels
_STILL, _RESTLESS = 5.0, 0.05
#: and so large a share of its pixels has to have a depth
_SEEN = 0.1


class RealSenseBubble(StreamingImager[ImageReading], ReferencedFinger[Depth]):
    """One Soft Bubble finger; its readings are 16UC1 depth in tenths of a millimetre, 0: none.

    Its frame is as in the simulated one: the origin is the unpressed dome's apex, x and y are as one sees the object
    from the finger, z points into the finger (`drivers.finger_frames`). A picture without any depth is INVALID.

    Sequence numbers are the library's frame numbers, less the first: what the camera, the cable or the library has
    dropped is a gap. After a reconnection, the gap is what would have come meanwhile; where a recording begins again
    there is none. Capture times are the library's where it puts them into Unix time (its domains *global* and *system*
    time), and those of `FrameClock` for the camera's own clock and for recordings.
    """

    def __init__(self, name: str, config: RealSenseBubbleConfig):
        super().__init__(name, KEPT)
        self._config = config
        self._stream = DepthStream(name, config)
        self._first: DepthFrame | None = None
        self._restart()

    def _restart(self) -> None:
        self._clock = FrameClock(self._config.delay)
        self._number: int | None = None  # the library's, of the last frame; None after it had gone
        self._sequence, self._last_ns = -1, 0
        self._heard = 0.0  # when the last frame came, monotonic
        self._over = False  # the recording has ended

    def describe(self) -> Description:
        """``range`` and ``resolution`` are depths [m].

        ``extra``: ``camera`` is its CameraModel, whose world is the finger's frame, ``X_ee_finger`` (4, 4) that frame
        in the ee; its place along the ee's Y is the gripper's and left at zero. ``dome`` has the unpressed membrane's
        semi-axes along the camera's x and y, its height and the apex's depth.
        """
        config = self._config
        a, b, height = config.dome
        return Description(
            name=self.name,
            kind="tactile",
            model="Soft Bubble with a RealSense",
            backend="real",
            serial=config.serial or Path(config.recording).name or "the only RealSense",
            frame=self.name,
            rate=config.rate,
            range=(round(config.distance - height, 9), config.distance),
            resolution=(DEPTH_UNIT,),
            extra={
                "sensor": "soft_bubble",
                "finger": config.finger,
                "encoding": "16UC1",
                "width": config.width,
                "height": config.height,
                "depth_unit": DEPTH_UNIT,
                "indentation_mm": 1e3 * config.indentation,
                "camera": config.optics.as_dict(),
                "X_ee_finger": [list(row) for row in X_EE_FINGER[config.finger]],
                "dome": {"a": a, "b": b, "height": height, "apex_depth": config.distance},
                "reference": bool(config.reference),
            },
        )

    # -- ReferencedFinger ------------------------------------------------------------------------------------------

    @property
    def _reference_named(self) -> str:
        return self._config.reference

    @property
    def _reference_like(self) -> tuple[tuple[int, ...], type[np.uint16]]:
        return (self._config.height, self._config.width), np.uint16

    def _mean(self, frames: Depth) -> Depth:
        half = len(frames) // 2
        (early, seen), (late, too) = _mean_depth(frames[:half]), _mean_depth(frames[half:])
        both = seen & too
        if both.mean() < _SEEN:
            raise ValueError(f"there is a depth in {both.mean():.0%} of its pixels only")
        restless = float((np.abs(early - late)[both] > _STILL).mean())
        if restless > _RESTLESS:
            raise ValueError(f"{restless:.0%} of the picture changes, by more than {_STILL * DEPTH_UNIT * 1e3:g} mm")
        mean, known = _mean_depth(frames)
        return np.where(known, np.rint(mean), 0).astype(np.uint16)

    # -- StreamingSensor -------------------------------------------------------------------------------------------

    def _open(self, timeout: float) -> None:
        self._restart()
        self.max_age = freshness(self._config.rate)
        super()._open(timeout)

    def _begin(self, timeout: float) -> None:
        if self._over:  # a recording begins anew for who opens it anew
            raise self._stream.ended()
        deadline = time.monotonic() + timeout
        self._stream.open(timeout)
        self._clock.restart()
        self._number, self._heard = None, time.monotonic()
        while (left := deadline - time.monotonic()) > 0:
            self._first = self._stream.take(min(POLL, left))
            if self._first is not None:
                return
        raise DeviceTimeout(
            self.name, self._stream.asked, f"it started, and sent no frame within {timeout:.3g} s", "Plug it in again"
        )

    def _poll(self) -> None:
        first, self._first = self._first, None
        try:
            frame = first or self._stream.take(POLL)
        except DeviceTimeout:
            self._over = True
            raise
        now = time.monotonic()
        if frame is not None:
            self._heard = now
            self._push(self._reading(frame))
        elif now - self._heard > self._config.silence and not self._config.recording:
            raise DeviceTimeout(
                self.name,
                "read",
                f"no frame for {self._config.silence:g} s",
                "See to its cable and its USB port; it is sought again",
            )

    def _end(self) -> None:
        self._first = None
        self._stream.close()

    def _reading(self, frame: DepthFrame) -> ImageReading:
        again = self._number is not None and frame.number <= self._number
        if again:  # a recording that begins again, or a camera that counts anew
            self._clock.restart()
        capture = self._clock.capture_ns(frame.told_ns, frame.arrival_ns, frame.unix)
        if self._sequence < 0 or again:
            self._sequence += 1
        elif self._number is None:  # after it had gone
            self._sequence += max(1, round((capture - self._last_ns) * 1e-9 * self._config.rate))
        else:
            self._sequence += frame.number - self._number
        self._number, self._last_ns = frame.number, capture
        status = Status.OK if frame.depth.any() else Status.INVALID
        stamp = Stamp(capture, max(frame.arrival_ns, capture), self._sequence, self.name, status)
        return ImageReading(stamp, frame.depth, "16UC1")


def _mean_depth(frames: Depth) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The mean (h, w) of depths (n, h, w), without their holes, and where at least half of them have one."""
    count = np.count_nonzero(frames, axis=0)
    mean = frames.sum(axis=0, dtype=np.float64) / np.maximum(count, 1)
    return mean, 2 * count >= len(frames)


DRIVER = Driver(RealSenseBubbleConfig, RealSenseBubble)
