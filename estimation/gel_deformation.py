"""What a gel's colour picture says of its surface: how its shading differs from the untouched one, and where.

A gel shows slopes: where its surface is tilted, its lights fall otherwise and its colour changes (photometric stereo).
What else changes is taken out first: the dots printed on it (hidden), the frame's exposure and the slow drift of light
and camera (fitted where nothing presses).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.gel_markers import Dots, find_dots
from estimation.tactile_pose import FingerModel, Picture, PoseStatus
from mechanics.readings import ImageReading, Status

Floats = NDArray[np.float32]

#: change of a channel that is a slope and not drift [grey levels]; contacts of real gels change by 40 to 120
CONTRAST = 12.0
#: and its strongest change in a place where something presses
CLEAR_CONTRAST = 28.0
#: and in standard deviations of the picture's grain after smoothing
SIGNIFICANT = 5.0
#: least part of the picture that a contact changes
LEAST_PATCH = 0.001
#: a picture whose channels spread by less holds nothing [grey levels]
BLANK_SPREAD = 4.0
#: part of the picture at the end of its range, beyond that of the reference, that makes it useless
SATURATED_PART = 0.08
#: part of the rows that repeat the one before, or hold one value
TORN_PART = 0.04
#: part of the picture that differs from the reference: beyond it, it is no picture of this gel
FOREIGN_PART = 0.6
#: and so is one in which even the half that fits best differs by this [grey levels]; grain is 3 to 5
FOREIGN_GRAIN = 12.0

_EVERY = 5  # pixel that is looked at for drift


@dataclass(frozen=True, eq=False)
class GelReference:
    """The untouched gel: ``bare`` (h, w, 3) in grey levels with the dots filled in, and its ``dots``.

    ``pitch`` [px] is that of the dots; None: a twentieth of the width.
    """

    bare: Floats
    dots: Dots
    pitch: float | None
    clipped: float
    raw: Picture

    @classmethod
    def of(cls, picture: NDArray[np.uint8] | NDArray[np.uint16], pitch: float | None = None) -> GelReference:
        """From the untouched picture (h, w, 3) bgr8. Raises ValueError for one that is none."""
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise ValueError(f"gel reference: expected (h, w, 3) uint8 in BGR, got {picture.shape} {picture.dtype}")
        if float(picture.reshape(-1, 3).std(axis=0).max()) < BLANK_SPREAD:
            raise ValueError("gel reference: the picture is of one colour; switch the gel's lights on, take it anew")
        dots = find_dots(picture, pitch)
        raw = picture.astype(np.float32)
        seen = (dots.mask == 0).astype(np.float32)
        width = 0.2 * (pitch or picture.shape[1] / 20)
        around = cv2.GaussianBlur(raw * seen[..., None], (0, 0), width)
        share = cv2.GaussianBlur(seen, (0, 0), width)
        filled = around / np.maximum(share, 1e-3)[..., None]
        bare = np.where(seen[..., None] > 0, raw, filled).astype(np.float32)
        return cls(bare, dots, pitch, _clipped(picture), picture)

    @classmethod
    def of_finger(cls, finger: FingerModel) -> GelReference:
        """That of a ``finger``, with the pitch it is described with."""
        pitch, scale = (finger.described.get(key) for key in ("marker_pitch_mm", "mm_per_px"))
        return cls.of(finger.reference, pitch / scale if pitch and scale else None)


@dataclass(frozen=True, eq=False)
class GelDeformation:
    """A picture against the reference.

    ``change`` (h, w, 3): shading less the untouched one [grey levels], 0 under dots; ``seen`` (h, w): 1 where there
    is no dot in either picture; ``noise``: the grain of a channel, 1 σ; ``size`` (h, w): length of the change over
    the channels, smoothed over dots and grain; ``patch`` (h, w): where the surface is tilted; ``dots``: of the
    picture. A status other than OK says why it is of no use.
    """

    change: Floats
    seen: Floats
    noise: float
    size: Floats
    patch: NDArray[np.bool_]
    dots: Dots
    status: PoseStatus = PoseStatus.OK
    reason: str = ""

    def blobs(self) -> list[NDArray[np.bool_]]:
        """The contact patches one by one, largest first: each (h, w) and filled."""
        bridged = cv2.morphologyEx(self.patch.astype(np.uint8), cv2.MORPH_CLOSE, _disc(self.patch.shape[1] / 25))
        outlines, _ = cv2.findContours(bridged, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        masks = [cv2.drawContours(np.zeros_like(bridged), outlines, i, 1, -1) > 0 for i in range(len(outlines))]
        least = 2 * LEAST_PATCH * self.patch.size
        return sorted((m for m in masks if m.sum() > least), key=lambda m: -int(m.sum()))


def distrusted(image: ImageReading) -> tuple[PoseStatus, str] | None:
    """Why ``image`` is not to be looked at, by what it says of itself; None where it may be."""
    status = image.stamp.status
    if status is Status.OK:
        return None
    if status is Status.NO_CONTACT:
        return PoseStatus.NO_CONTACT, "the finger says that it holds nothing"
    if status is Status.SATURATED:
        return PoseStatus.SATURATED, "the finger says that its picture is at the end of its range"
    return PoseStatus.UNTRUSTED, f"the reading is {status.name.lower()}"


def useless(picture: Picture, reference: GelReference) -> tuple[PoseStatus, str] | None:
    """Why nothing can be read from ``picture`` at all; None where something may."""
    if picture.shape != reference.raw.shape or picture.dtype != np.uint8:
        shown = f"the picture is {picture.shape} {picture.dtype}, its reference {reference.raw.shape} uint8"
        return PoseStatus.UNTRUSTED, shown
    if float(cv2.meanStdDev(picture)[1].max()) < BLANK_SPREAD:
        return PoseStatus.BLANK, "the picture is of one colour: a covered lens, or no light"
    some = picture[:, :: max(1, picture.shape[1] // 64)]
    repeated = (some[1:] == some[:-1]).all(axis=(1, 2)) | (some[1:] == some[1:, :1]).all(axis=(1, 2))
    if repeated.mean() > TORN_PART:
        return PoseStatus.TORN, f"{100 * repeated.mean():.0f} % of the rows are missing or repeat the one before"
    clipped = _clipped(picture) - reference.clipped
    if clipped > SATURATED_PART:
        return PoseStatus.SATURATED, f"{100 * clipped:.0f} % of the picture is at the end of its range"
    return None


def deformation(picture: Picture, reference: GelReference) -> GelDeformation:
    """What ``picture`` (h, w, 3) bgr8 shows against the ``reference``. Status NO_CONTACT where nothing has changed."""
    fault = useless(picture, reference)
    if fault is not None:
        h, w = reference.bare.shape[:2]
        nothing = np.zeros((h, w), np.float32)
        no_dots = Dots(np.empty((0, 2)), 0.0, np.zeros((h, w), np.uint8))
        return GelDeformation(reference.bare * 0, nothing, 0.0, nothing, nothing > 0, no_dots, *fault)
    if len(reference.dots):
        dots = find_dots(picture, reference.pitch, reference.dots.area)
        hidden = reference.dots.mask | dots.mask
    else:
        dots, hidden = reference.dots, reference.dots.mask
    seen = (hidden == 0).astype(np.float32)
    change, noise = _undrifted(picture, reference.bare, seen)
    change *= seen[..., None]
    # what a dot hides is told by what lies around it; half the resolution is enough for that
    h, w = seen.shape
    width = 0.06 * (reference.pitch or w / 20) if len(dots) else 0.5
    both = cv2.resize(cv2.merge((*cv2.split(change), seen)), (w // 2, h // 2), interpolation=cv2.INTER_AREA)
    both = cv2.GaussianBlur(both, (0, 0), width)
    smooth = both[..., :3] / (both[..., 3:] + 0.05)
    small = np.sqrt(cv2.transform(smooth * smooth, np.ones((1, 3), np.float32)))
    grain = noise * np.sqrt(3.0) / (4 * np.sqrt(np.pi) * width)  # after smoothing
    least = max(CONTRAST, SIGNIFICANT * grain)
    pressed = _pressed(small, least, max(CLEAR_CONTRAST, 2 * least))
    size = np.asarray(cv2.resize(small, (w, h)), np.float32)
    patch = cv2.resize(pressed.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
    part = float(patch.mean())
    status, reason = PoseStatus.OK, ""
    if part > FOREIGN_PART or noise > FOREIGN_GRAIN:
        status = PoseStatus.TORN
        reason = f"{100 * part:.0f} % of the picture differ from the reference: not all of it is of this gel and light"
        patch = np.zeros_like(patch)
    elif part < LEAST_PATCH:
        status, reason = PoseStatus.NO_CONTACT, "the picture is that of the untouched gel"
    return GelDeformation(change, seen, noise, size, patch, dots, status, reason)


def _undrifted(picture: Picture, bare: Floats, seen: Floats) -> tuple[Floats, float]:
    """The picture less the bare gel as this frame's light shows it, and the grain.

    Per channel a gain, a level and a slow slope across the picture, from pixels that nothing has tilted: those that
    fit, by Tukey's weights.
    """
    h, w = seen.shape
    rows, columns = np.nonzero(seen[::_EVERY, ::_EVERY])
    rows, columns = _EVERY * rows, _EVERY * columns
    before = bare[rows, columns].T.astype(float)
    now = picture[rows, columns].T - before
    ramp = np.stack((np.ones(len(rows)), columns * (2 / w) - 1, rows * (2 / h) - 1))
    fits, grains = np.empty((3, 4)), []
    for c in range(3):
        A, b = np.concatenate((before[c : c + 1] / 128, ramp)), now[c]
        # a face of any size leaves most of the gel as it was
        r, scale = b - np.median(b), 4.0
        for _ in range(3):
            scale = max(_spread(r[::2]), 0.5)
            use = A * (np.abs(r) < 3 * scale)
            fits[c] = np.linalg.lstsq(use @ A.T, use @ b, rcond=1e-9)[0]
            r = b - fits[c] @ A
        grains.append(max(_spread(r), 0.5))
    gain, level = 1 + fits[:, 0] / 128, fits[:, 1]
    across = np.linspace(-1, 1, w, dtype=np.float32)[None, :, None] * fits[:, 2].astype(np.float32)
    down = np.linspace(-1, 1, h, dtype=np.float32)[:, None, None] * fits[:, 3].astype(np.float32)
    out = picture - bare * gain.astype(np.float32)
    out -= across + level.astype(np.float32)
    out -= down
    return np.asarray(out, np.float32), float(np.sqrt(np.mean(np.square(grains))))


def _pressed(size: Floats, least: float, clear: float) -> NDArray[np.bool_]:
    """Where ``size`` is beyond ``least``, in pieces that are beyond ``clear`` somewhere: drifting light never is."""
    weak = cv2.morphologyEx((size > least).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, found = cv2.connectedComponents(weak)
    labels = np.asarray(found, np.int32)
    strong = np.bincount(labels[size > clear], minlength=count) > 0.1 * LEAST_PATCH * size.size
    strong[0] = False
    return strong[labels]


def _spread(values: NDArray[np.floating]) -> float:
    """Standard deviation by the median of the absolute deviations."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _clipped(picture: Picture) -> float:
    """Part of the picture that is white in a channel, or black in all."""
    white = cv2.inRange(picture, (0, 0, 0), (253, 253, 253)) == 0
    black = cv2.inRange(picture, (0, 0, 0), (2, 2, 2)) > 0
    return float((white | black).mean())


def _disc(diameter: float) -> NDArray[np.uint8]:
    size = 2 * round(0.5 * diameter) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
