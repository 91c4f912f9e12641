"""The steps of a tactile finger: its picture, the picture of it untouched, and where a touch appears."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from experiments.check_device.bench import Bench, Step
from experiments.check_device.findings import Finding, judged, skipped
from experiments.check_device.pictures import exposure
from mechanics.readings import ImageReading

#: the least change that is a touch: grey levels of a gel, and [0.1 mm] of a membrane
TOUCH = {"bgr8": 8.0, "mono8": 8.0, "16UC1": 10.0}
#: the share of a depth picture that may be without depth
HOLES = 0.3
#: the largest mean change of an untouched finger from its reference
UNTOUCHED = {"bgr8": 4.0, "mono8": 4.0, "16UC1": 5.0}
#: of the picture that is taken for the touch: what changed most
_PART = 0.02


def _change(picture: NDArray, reference: NDArray) -> NDArray[np.float64]:
    """(h, w): how far each pixel is from the reference, smoothed; 0 where a depth is missing."""
    now, then = picture.astype(np.float32), reference.astype(np.float32)
    change = np.abs(now - then)
    if change.ndim == 3:
        change = change.mean(axis=2)
    elif picture.dtype == np.uint16:
        change[(picture == 0) | (reference == 0)] = 0.0
    return cv2.GaussianBlur(change, (0, 0), max(1.0, picture.shape[1] / 100)).astype(np.float64)


def _picture(bench: Bench) -> Finding:
    reading: ImageReading = bench.device.capture()
    height, width = reading.image.shape[:2]
    said = bench.describe().extra
    if (width, height) != (said["width"], said["height"]):
        return judged(False, f"{width} × {height} px, not {said['width']} × {said['height']}", "Correct width, height")
    if reading.encoding == "16UC1":
        depths = reading.image[reading.image > 0]
        holes = 1.0 - depths.size / reading.image.size
        middle = float(np.median(depths)) / 10 if depths.size else 0.0
        measured = f"{width} × {height} px; {middle:.1f} mm in the middle; {holes:.0%} without depth"
        return judged(holes <= HOLES, measured, "See to the camera's range, and to light from outside", holes=holes)
    light, good, remedy = exposure(reading.image.mean(axis=2) if reading.image.ndim == 3 else reading.image)
    return judged(good, f"{width} × {height} px; {light}", remedy)


def _reference(bench: Bench) -> Finding:
    take = getattr(bench.opened.backend, "take_reference", None)
    asked = "A picture of the untouched finger is taken. Let nothing touch it"
    if take is not None and (bench.reference is not None or bench.person.ready(asked)):
        file = bench.reference or Path(f"{bench.opened.config.name}-{bench.opened.name}.png")
        if file.exists():
            return judged(
                False, f"{file} is there already", "Name another file with --reference, or move that one away"
            )
        take(file=file)
        return judged(True, f"taken into {file}: name it as `reference` in the station file")
    reading, reference = bench.device.capture(), bench.device.reference()
    change = float(_change(reading.image, reference).mean())
    unit = "mm" if reading.encoding == "16UC1" else "grey levels"
    size = change / 10 if unit == "mm" else change
    measured = f"the picture is {size:.2g} {unit} from the one of the untouched finger"
    if not bench.person.here:
        return judged(True, f"{measured}; nobody said whether something touches it")
    if not bench.person.confirm("Does nothing touch the finger?"):
        return skipped(f"{measured}; something touches it")
    remedy = "The gel or the light has changed: take a new reference (--reference FILE)"
    return judged(change <= UNTOUCHED[reading.encoding], measured, remedy)


def _touches(bench: Bench) -> Finding:
    """Where a touch appears: x and y of a finger's frame are right and up as one sees the held object from it."""
    if not bench.person.here:
        return skipped("it needs a hand")
    finger = getattr(bench.config, "finger", "left")
    sides = {
        "upper": ("upper edge, toward the wrist", 1, -1),
        "right": ("edge at W's +x", 0, 1 if finger == "left" else -1),
    }
    quiet: ImageReading = bench.device.capture()
    said, wrong = list[str](), False
    for words, axis, sign in sides.values():
        if not bench.person.ready(f"Press a fingertip into it near its {words}, and keep pressing"):
            continue
        change = _change(bench.device.capture().image, quiet.image)
        largest = float(change.max())
        u, v = _middle(change)
        place = (u, v)[axis] * sign
        said.append(f"{words}: {_place(u, v)}, {largest:.0f} levels")
        wrong = wrong or largest < TOUCH[quiet.encoding] or place <= 0
    if not said:
        return skipped("it was not touched")
    remedy = "See to `finger`, `rotate` and `flip`: up in the picture is toward the wrist (docs/deploy.md)"
    return judged(not wrong, "; ".join(said), remedy)


def _middle(change: NDArray[np.float64]) -> tuple[float, float]:
    """Where most has changed, from the picture's middle: (right, down), each from −1 to 1."""
    height, width = change.shape
    most = np.where(change >= np.quantile(change, 1 - _PART), change, 0.0)
    weight = max(most.sum(), 1e-9)
    rows, columns = np.mgrid[:height, :width]
    u, v = (most * columns).sum() / weight, (most * rows).sum() / weight
    return float(2 * u / (width - 1) - 1), float(2 * v / (height - 1) - 1)


def _place(u: float, v: float) -> str:
    across = "left" if u < 0 else "right"
    return f"in the {'upper' if v < 0 else 'lower'} {across} of the picture ({u:+.2f}, {-v:+.2f})"


STEPS = (
    Step("picture", "its size and light", _picture, asks=True),
    Step("reference", "how it looks untouched", _reference, asks=True),
    Step("touch", "where in the picture a touch appears", _touches, asks=True),
)
