"""Which pictures of a Soft Bubble show a touch, over time: a picture also shows what the ones before have left.

A picture alone cannot tell a light touch from a trace. Two things remember:

* the camera. The driver of a stereo camera mixes each picture with the last one, y = x + s (y' − x), so that a
  membrane that has sprung back is seen to come back over several pictures. x follows from two pictures. Whether a
  camera does so is heard in the noise of an untouched membrane: white noise is as far from the picture before the last
  as from the last, mixed noise is 1 + s times as far (squared).
* the membrane. One that is held gives way by creep, and does not spring back all the way. As a standard linear solid,
  w = K [(1 + c) x − c u] with u̇ = (x − u) / T, it rests at x = u c / (1 + c) when nothing presses.

What the picture shows beyond both, and beyond what the membrane showed while nothing touched it, is pressed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Stamp

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: share s of the last picture in this one: 1 − alpha of a RealSense's temporal filter as it is delivered
CAMERA_SHARE = 0.6
#: what tells a camera that mixes: that ratio of squares, taken over so many pictures
MIXED, ENOUGH = 1.2, 3
#: longest time between two pictures of a camera that mixes them [s]
SLOWEST_CAMERA = 0.1
#: c and T [s]: a rubber membrane's creep, as the lab profile of the simulated station assumes it
CREEP, CREEP_TIME = 0.08, 8.0
#: least depth of a touch [m]: two to three of a depth camera's steps ...
LEAST_PRESSED = 0.25e-3
#: ... its depth over the noise: by chance no patch of the membrane is off by as much in an hour at 30 Hz ...
SIGNIFICANT = 6.0
#: ... and its least area [m²]
LEAST_AREA = 3e-5
#: how far an untouched membrane may come to lie from its reference [m], by the gas's temperature or old creep
WANDER = 0.65e-3
#: side of the blocks in which pictures are kept [m], and the width over which they are averaged [m, standard
#: deviation]: a membrane is bent by a touch over some 12 mm
BLOCK, SMOOTH = 1.5e-3, 4e-3


@dataclass(frozen=True)
class Touch:
    """Whether something presses: the deepest place [m], beyond all traces, of what is ``found``; 0 where nothing is."""

    found: bool
    deepest: float = 0.0


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is remembered after a picture; arrays are (rows, columns) of blocks [m]."""

    stamp: Stamp
    inward: Image
    known: Mask
    rest: Image
    crept: Image
    #: the picture before, where that came just before and nothing touches in this one
    earlier: Image | None = None


class ContactMemory:
    """Tells touches from traces in the successive pictures of one finger.

    The first picture has nothing before it, and neither has one that is older than the last: there, what the picture
    alone says stands. Asked again about the same picture, it answers the same.
    """

    def __init__(
        self,
        camera_share: float = CAMERA_SHARE,
        creep: float = CREEP,
        creep_time: float = CREEP_TIME,
        least: float = LEAST_PRESSED,
    ):
        """``camera_share`` s of a camera that mixes, ``creep`` c and T [s] as above; ``least`` [m] depth of a touch.

        Raises ValueError for a share outside [0, 1), a negative creep, or a time or depth that is not positive.
        """
        if not 0 <= camera_share < 1 or creep < 0 or creep_time <= 0 or least <= 0:
            raise ValueError(
                f"contact memory: camera share {camera_share:g}, creep {creep:g} over {creep_time:g} s, least depth "
                f"{least:g} m; expected a share in [0, 1), a creep of 0 or more, a time and a depth above 0"
            )
        self._share, self._time, self._least = camera_share, creep_time, least
        self._left = np.float32(creep / (1.0 + creep))
        self._block = 0
        #: sums of squared differences to the last picture and the one before it, and how many
        self._steps, self._heard = np.zeros(2), 0
        self._before: _Seen | None = None
        self._last: _Seen | None = None

    def touch(self, inward: Image, valid: Mask, pitch: float, stamp: Stamp, alone: bool) -> Touch:
        """What presses in a picture, and remember it.

        ``inward`` (h, w) [m] is how far each pixel has come toward the camera since the reference, where it is
        ``valid`` (h, w); ``pitch`` [m] the distance of pixels, the same in each call; ``alone`` whether the picture by
        itself shows a touch.
        """
        self._block = self._block or max(1, round(BLOCK / pitch))
        side = self._block * pitch
        here, known = _blocks(inward, valid, self._block)
        asked_again = self._last is not None and self._last.stamp == stamp
        before = self._turn(stamp)
        if before is None:
            # of a touch that nobody saw begin the membrane has crept all it can; what is less than one is no touch
            none = np.zeros_like(here)
            rest, crept = (none, here) if alone else (np.clip(here, -WANDER, WANDER), none)
            self._last = _Seen(stamp, here, known, np.where(known, rest, none), np.maximum(crept, none))
            return Touch(alone, float(here.max(initial=0.0)) if alone else 0.0)
        seconds = 1e-9 * (stamp.capture_ns - before.stamp.capture_ns)
        pictures = max(stamp.sequence - before.stamp.sequence, seconds / SLOWEST_CAMERA, 1.0)
        share = self._share**pictures if self.mixes else 0.0
        kept = np.float32(np.exp(-seconds / self._time))
        both = known & before.known
        now = (here - np.float32(share) * before.inward) / np.float32(1 - share)
        residue = self._left * before.crept
        found = self._pressed(np.asarray(now - before.rest - residue, np.float32), both, side)
        rest, earlier = before.rest, None
        if not found.found:
            if pictures == 1.0:
                earlier = before.inward
                if before.earlier is not None and both.any() and not asked_again:
                    self._listen((here - before.inward)[both], (here - before.earlier)[both])
            aim = np.clip(now - residue, -WANDER, WANDER)
            rest = np.where(both, aim + kept * (rest - aim), rest)
        aim = np.maximum(here, np.float32(0))
        crept = np.where(known, aim + kept * (before.crept - aim), before.crept)
        self._last = _Seen(stamp, here, known, rest, crept, earlier)
        return found

    @property
    def mixes(self) -> bool:
        """Whether the camera mixes its pictures, as far as is known; where it is not, it may."""
        return self._heard < ENOUGH or bool(self._steps[1] > MIXED * self._steps[0])

    def _listen(self, to_last: Image, to_earlier: Image) -> None:
        """Take in how far (n,) [m] an untouched picture is from the last two."""
        most = 6.0 * float(np.abs(to_last).mean())  # a pixel may jump
        if most > 0.0:
            self._steps += [np.minimum(off * off, most * most).mean() for off in (to_last, to_earlier)]
            self._heard += 1

    def _turn(self, stamp: Stamp) -> _Seen | None:
        """What was remembered before the picture with this stamp."""
        last = self._last
        if last is not None:
            new = (stamp.capture_ns - last.stamp.capture_ns, stamp.sequence - last.stamp.sequence)
            if min(new) < 0:
                self._before = None  # late, or of another run
            elif max(new) > 0:
                self._before = last
        return self._before

    def _pressed(self, beyond: Image, known: Mask, side: float) -> Touch:
        """What of ``beyond`` is too deep, and too wide, for noise."""
        width = SMOOTH / side
        weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), width)
        beyond = np.where(known, beyond, np.float32(0))
        smooth = cv2.GaussianBlur(beyond, (0, 0), width) / np.maximum(weight, 1e-3)
        inner = known & (weight > 0.8)
        if not inner.any():
            return Touch(False)
        # noise that neighbours do not share is as strong at all widths: in white noise, the variance of the difference
        # to a mean of half the width is 1.8 times that of the mean
        half = cv2.GaussianBlur(beyond, (0, 0), 0.5 * width)
        half /= np.maximum(cv2.GaussianBlur(known.astype(np.float32), (0, 0), 0.5 * width), 1e-3)
        noise = 1.4826 / np.sqrt(1.8) * float(np.median(np.abs(half - smooth)[inner]))
        deep = inner & (smooth > max(self._least, SIGNIFICANT * noise))
        _, labels, figures, _ = cv2.connectedComponentsWithStats(deep.astype(np.uint8), connectivity=4)
        wide = np.flatnonzero(figures[1:, cv2.CC_STAT_AREA] * side**2 >= LEAST_AREA) + 1
        if len(wide) == 0:
            return Touch(False)
        return Touch(True, float(smooth[np.isin(labels, wide)].max()))


def _blocks(inward: Image, valid: Mask, size: int) -> tuple[Image, Mask]:
    """Means [m] of square blocks of ``size`` pixels over what is valid, and whether half of a block is."""
    rows, columns = (n // size for n in inward.shape)
    part = np.s_[: rows * size, : columns * size]
    share = cv2.resize(valid[part].astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    total = np.where(valid, inward, np.float32(0))[part].astype(np.float32)
    mean = cv2.resize(total, (columns, rows), interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-3)
    return np.asarray(mean, np.float32), share >= 0.5
