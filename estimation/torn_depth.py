"""Whether a depth picture of a membrane is whole: parts that are missing, or of another moment."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: largest hole, over the area of the membrane
MOST_MISSING = 0.04
#: a step between neighbours that no membrane has, over the distance between them
STEEPEST = 3.0
#: how far a membrane may bulge outward [m]
MOST_OUTWARD = 8e-3


def torn(inward: Image, valid: Mask, seen: Mask, pitch: float) -> str:
    """What is missing of a picture, what no membrane can show, and what does not go on where it meets the rest.

    ``inward`` (h, w) [m] is how far each pixel has come toward the camera, ``valid`` (h, w) where that was measured,
    ``seen`` (h, w) where it could have been; ``pitch`` [m] is the distance of neighbouring pixels. Empty where the
    picture is whole.
    """
    gone = (seen & ~valid).astype(np.uint8)
    whole = max(float(seen.sum()), 1.0)
    # at the rim a stereo camera loses a pixel now and then: up to two per cent in one place, eight in all
    clumps = cv2.connectedComponentsWithStats(cv2.morphologyEx(gone, cv2.MORPH_OPEN, np.ones((3, 3))), connectivity=4)
    largest, all_gone = float(clumps[2][1:, cv2.CC_STAT_AREA].max(initial=0)) / whole, float(gone.sum()) / whole
    lines = max(_share_of_lines(gone, seen, axis) for axis in (0, 1))
    if largest > MOST_MISSING or all_gone > 5 * MOST_MISSING or lines > 0.02:
        return f"{100 * all_gone:.0f} % of the picture are missing"
    calm = np.asarray(cv2.medianBlur(inward, 3), np.float32)
    wild = valid & ((calm < -MOST_OUTWARD) | (np.abs(inward - calm) > 3e-3))
    if wild.sum() > 0.01 * seen.sum():
        return f"{100 * wild.sum() / seen.sum():.0f} % of the picture are depths that no membrane has"
    within = valid & (cv2.erode(seen.astype(np.uint8), np.ones((7, 7))) > 0)
    for axis, name in ((0, "row"), (1, "column")):
        where = _break(calm, within, axis, pitch)
        if where is not None:
            return f"the picture breaks at {name} {where}"
    return ""


def _share_of_lines(gone: NDArray[np.uint8], seen: Mask, axis: int) -> float:
    """Share of the rows (axis 1) or columns (axis 0) that are missing as a whole."""
    full = seen.sum(axis=axis)
    long = full > 20
    return float((gone.sum(axis=axis)[long] > 0.9 * full[long]).mean()) if long.any() else 0.0


def _break(inward: Image, valid: Mask, axis: int, pitch: float) -> int | None:
    """The row (axis 0) or column (axis 1) at which the field jumps along a long stretch; None where it does not."""
    if axis == 1:
        inward, valid = np.ascontiguousarray(inward.T), np.ascontiguousarray(valid.T)
    # across a step of a field that has slopes and kinks, the slopes on both sides account for most of the change
    step = inward[1:] - inward[:-1]
    jump = step[2:-2] - 0.5 * (step[:-4] + step[4:])
    whole = valid[1:] & valid[:-1]
    whole = whole[2:-2] & whole[:-4] & whole[4:]
    run = max(13, inward.shape[1] // 10)
    weight = cv2.blur(whole.astype(np.float32), (run, 1))
    mean = cv2.blur(np.where(whole, jump, np.float32(0)), (run, 1)) / np.maximum(weight, 0.5)
    noise = 1.4826 * float(np.median(np.abs(mean[weight > 0.5]))) if (weight > 0.5).any() else 0.0
    mean = np.abs(np.where(weight > 0.5, mean, 0))
    worst = mean.max(axis=1)
    at = int(worst.argmax())
    return at + 3 if worst[at] > max(STEEPEST * pitch, 8 * noise) else None
