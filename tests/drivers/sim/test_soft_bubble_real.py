"""The simulated Soft Bubble beside a recording of a real one: noise, deformation, and both side by side in a figure.

The figure goes to `build/figures`, which is never part of the project; statistics of the recording are in the asserts.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.sim.bubble_geometry import DOME, Dome, camera_of
from drivers.sim.bubble_membrane import Membrane
from drivers.sim.bubble_noise import NoiseSource
from drivers.sim.bubble_optics import BubbleView, quantised
from drivers.sim.mismatch import load_profile
from tests.recordings import DATA, recorded

ROOT = Path(__file__).parents[3]
FOLDER = DATA / "softbubble"
pytestmark = recorded("softbubble")

#: pinhole of the recording [px], at a quarter of its resolution one pixel in four; where its dome's axis is [m]
FOCAL, CENTRE, AXIS = 434.0, (313.7, 247.5), (0.021, -0.0017)


@pytest.fixture(scope="module")
def recording() -> np.ndarray:
    """Depth (150, 120, 160) [m] at every fourth pixel, NaN where there is none; frames 0 to 59 are untouched."""
    with np.load(FOLDER / "depth_quarter_all150.npz") as file:
        depth = file["z_m"].astype(float)
    depth[(depth <= 0) | (depth > 0.2)] = np.nan
    return depth


@pytest.fixture(scope="module")
def simulated() -> np.ndarray:
    """Sixty frames of the untouched dome as the `lab` profile has them, every fourth pixel [m]."""
    view = BubbleView(camera_of(640, 480))
    noise = NoiseSource(load_profile("lab").bubble.stereo, (480, 640), np.random.default_rng(0), 1 / 30)
    frames = [quantised(noise.spoil(view.reference, k / 30))[::4, ::4] * 1e-4 for k in range(60)]
    return np.where(np.array(frames) > 0, frames, np.nan)


def median(frames: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any depth
        return np.nanmedian(frames, axis=0)


def steady(frames: np.ndarray) -> np.ndarray:
    """Pixels with a depth in nearly every frame."""
    return np.isfinite(frames).mean(axis=0) > 0.95


def residuals(frames: np.ndarray) -> np.ndarray:
    """What each pixel does from frame to frame, without jumps; NaN elsewhere."""
    left = frames - median(frames)
    left -= np.nanmean(np.where(np.abs(left) < 1e-3, left, 0.0), axis=0)
    return np.where(steady(frames) & (np.abs(left) < 1e-3), left, np.nan)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.nanmean(a * b) / np.sqrt(np.nanmean(a * a) * np.nanmean(b * b)))


def test_noise_is_of_the_real_size(recording, simulated) -> None:
    real, ours = (np.nanstd(residuals(f)[:, steady(f)], axis=0) * 1e3 for f in (recording[:60], simulated))
    assert np.median(real) == pytest.approx(0.047, abs=0.01)
    assert np.median(ours) == pytest.approx(np.median(real), rel=0.25)
    assert np.sqrt((ours**2).mean()) == pytest.approx(np.sqrt((real**2).mean()), rel=0.25)


def test_noise_is_as_like_its_neighbours_in_space_and_time(recording, simulated) -> None:
    for lag in (1, 2, 4):  # of four pixels
        real, ours = (
            np.mean([likeness(r[:, :, lag:], r[:, :, :-lag]), likeness(r[:, lag:], r[:, :-lag])])
            for r in (residuals(recording[:60]), residuals(simulated))
        )
        assert ours == pytest.approx(real, abs=0.2)
    for lag in (1, 2, 5):
        real, ours = (likeness(r[lag:], r[:-lag]) for r in (residuals(recording[:60]), residuals(simulated)))
        assert ours == pytest.approx(real, abs=0.12)
    still = [np.nanmean(np.diff(f[:60], axis=0)[:, steady(f[:60])] == 0) for f in (recording, simulated)]
    assert still[1] == pytest.approx(still[0], abs=0.15)  # steps of 0.1 mm: most pixels do not move at all


def test_roughness_and_jumps_are_of_the_real_size(recording, simulated) -> None:
    rough, jumps = [], []
    for frames in (recording[:60], simulated):
        image, good = median(frames), steady(frames)
        weight = good.astype(float)
        smooth = cv2.GaussianBlur(np.where(good, image, 0), (0, 0), 2) / np.maximum(
            cv2.GaussianBlur(weight, (0, 0), 2), 0.1
        )
        inside = cv2.erode(cv2.morphologyEx(good.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9))), np.ones((13, 13)))
        left = (image - smooth)[good & (inside > 0)]
        rough.append(1.4826 * np.median(np.abs(left - np.median(left))) * 1e3)
        jumps.append(np.mean(np.abs(frames - image)[:, good] > 2e-3))
    assert rough[1] == pytest.approx(rough[0], rel=0.4)
    assert 0.2 < jumps[1] / jumps[0] < 5


# -- the touch ---------------------------------------------------------------------------------------------------------

row, column = np.mgrid[:120, :160] * 4.0


def touched(recording: np.ndarray, frame: int):
    """Deformation (120, 160) [m] of a frame, where pixels are (x, y) [m] from the dome's axis, pixels to compare."""
    reference, here = median(recording[:60]), recording[frame]
    X, Y = (column - CENTRE[0]) / FOCAL * reference, (row - CENTRE[1]) / FOCAL * reference
    x, y = X - AXIS[0], Y - AXIS[1]
    good = steady(recording[:60]) & np.isfinite(here) & ((x / DOME.a) ** 2 + (y / DOME.b) ** 2 < 0.94)
    good &= cv2.erode(cv2.morphologyEx(good.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9))), np.ones((9, 9))) > 0
    # along a ray, the depth of an inclined membrane changes by more or less than its height
    fall = -(DOME.top**2) / np.where(good, DOME.height(x, y), 1.0)
    along = fall * (x / DOME.a**2 * X + y / DOME.b**2 * Y) / reference
    return (reference - here) * (1 - along), x, y, good


def model(deep: float, at: np.ndarray, tip: float, x: np.ndarray, y: np.ndarray, gas: float) -> np.ndarray:
    """Deformation by a round tip. A tip follows the membrane's inclination: here the dome is flat, its rim the same."""
    low = Dome(top=0.012, gas=gas)
    t = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    membrane = Membrane(low)
    membrane.press(at + tip * np.stack((np.cos(t), np.sin(t)), axis=1), low.top - float(low.height(*at)) + deep)
    return low.height(x, y) - membrane.height(x, y)


def radial(d: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Median [mm] of rings 4 mm wide."""
    return np.array([np.median(d[(r >= a) & (r < a + 0.004)]) * 1e3 for a in np.arange(0.0, 0.056, 0.004)])


@pytest.mark.parametrize("frame", [66, 80, 95, 104])
def test_touch_has_the_depth_the_decay_and_the_bulge_of_the_real_one(recording, frame: int) -> None:
    d, x, y, good = touched(recording, frame)
    smooth = cv2.medianBlur(np.where(good, d, 0).astype(np.float32), 3)
    peak = np.unravel_index(smooth.argmax(), smooth.shape)
    at = np.array([x[peak], y[peak]])
    deep = float(smooth[peak])
    assert 0.003 < deep < 0.0065
    r = np.hypot(x - at[0], y - at[1])[good]
    real = radial(d[good], r)

    def simulated(gas: float) -> np.ndarray:
        """With the tip as deep as it takes for the innermost ring to agree."""
        first = radial(model(deep, at, 0.003, x[good], y[good], gas), r)
        return radial(model(deep * real[0] / first[0], at, 0.003, x[good], y[good], gas), r)

    ours, dry = simulated(DOME.gas), simulated(0.0)
    assert np.sqrt(((ours - real) ** 2).mean()) < 0.065 * real[0]
    # it falls to a third within the same distance, to a ring's half width
    third = [np.interp(-p[0] / 3, -p, np.arange(len(p)) * 4.0) for p in (real[:8], ours[:8])]
    assert third[1] == pytest.approx(third[0], abs=2.5)
    # the gas pushes the rest outward
    assert -0.7 < real.min() < -0.2 and -0.7 < ours.min() < -0.1
    assert dry.min() > -1e-3 and ((ours - real) ** 2).mean() < ((dry - real) ** 2).mean()


def test_figure_side_by_side(recording) -> None:
    """Depth and deformation, real above, simulated below."""

    def shown(image: np.ndarray, low: float, high: float) -> np.ndarray:
        grey = np.clip((np.nan_to_num(image, nan=low) - low) / (high - low), 0, 1) * 255
        return cv2.resize(cv2.applyColorMap(grey.astype(np.uint8), cv2.COLORMAP_VIRIDIS), (640, 480), interpolation=0)

    def frames():
        yield median(recording[:60]), recording[95]
        view = BubbleView(camera_of(640, 480))
        noise = NoiseSource(load_profile("lab").bubble.stereo, (480, 640), np.random.default_rng(0))
        reference = quantised(noise.spoil(view.reference, None)) * 1e-4
        box = np.array([[-0.12, -0.025], [0.0285, -0.025], [0.0285, 0.025], [-0.12, 0.025]])
        pressed = quantised(noise.spoil(view.depth(box, 0.012), 0.0)) * 1e-4
        yield tuple(np.where(image > 0, image, np.nan)[::4, ::4] for image in (reference, pressed))

    rows = [
        np.hstack([shown(a, 0.06, 0.1), shown(b, 0.06, 0.1), shown(a - b, -0.001, 0.006 if k == 0 else 0.012)])
        for k, (a, b) in enumerate(frames())
    ]
    folder = ROOT / "build" / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(folder / "soft_bubble.png"), np.vstack(rows))
