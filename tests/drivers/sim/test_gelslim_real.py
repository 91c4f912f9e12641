"""How pictures of the simulated GelSlim compare with those of real gels."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.sim.gel_noise import GelNoise
from drivers.sim.mismatch import load_profile
from tests.recordings import DATA, recorded

from .finger_cases import BOX, HEXAGON, NOWHERE, FakeWorld, opened, pose, view

FIGURES = Path(__file__).parents[3] / "build" / "figures"
gelslim_data, gelsight_data = recorded("gelslim"), recorded("gelsight_edges")


def read(path: str | Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image.astype(np.float32)


def patch_statistics(change: np.ndarray) -> tuple[float, float]:
    """Contrast and edge width of the largest contact patch in a picture less its reference.

    Contrast: median over the patch of the largest change of a channel, where it exceeds 20 grey levels. Width: pixels
    over which the mean change goes from 10 to 90 % of its peak, by distance from the patch's boundary.
    """
    size = cv2.GaussianBlur(np.abs(change).max(axis=2).astype(np.float32), (0, 0), 1.0)
    clear = (size > 20).astype(np.uint8)
    closed = cv2.morphologyEx(clear, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    _, labels, areas, _ = cv2.connectedComponentsWithStats(closed)
    patch = (labels == 1 + areas[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    outlines, _ = cv2.findContours(patch, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    whole = cv2.drawContours(np.zeros_like(patch), outlines, -1, 1, -1)
    depth = cv2.distanceTransform(whole, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - whole, cv2.DIST_L2, 5)
    bins = [(depth >= i) & (depth < i + 1) for i in range(-25, 20)]
    profile = np.array([size[b].mean() if b.any() else 0.0 for b in bins])
    top = profile.argmax()
    level = (profile - np.median(size[depth < -25])) / (profile[top] - np.median(size[depth < -25]))
    low, high = (top - int(np.argmax(level[top::-1] < share)) for share in (0.1, 0.9))
    return float(np.median(size[(patch > 0) & (clear > 0)])), float(high - low)


def noise_level(one: np.ndarray, other: np.ndarray) -> float:
    """Standard deviation of a pixel beyond slow shading, by two pictures of the same."""
    difference = one - other
    return float((difference - cv2.GaussianBlur(difference, (0, 0), 8)).std() / np.sqrt(2))


def marker_pitch(image: np.ndarray) -> float:
    """Median distance [px] of a marker's four nearest neighbours, in the inner half of the picture."""
    grey = image.mean(axis=2).astype(np.float32)
    ink = cv2.GaussianBlur(cv2.GaussianBlur(grey, (0, 0), 10) - grey, (0, 0), 2)
    peak = (ink == cv2.dilate(ink, np.ones((11, 11)))) & (ink > 8)
    points = np.argwhere(peak)[:, ::-1].astype(float)
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    size = np.array(grey.shape[::-1])
    inner = (np.abs(points - size / 2) < size / 4).all(axis=1)
    return float(np.median(np.sort(distance[inner], axis=1)[:, 1:5]))


def simulated(outline: np.ndarray, rest: np.ndarray, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    sensor = opened(FakeWorld(view(outline, rest), GelNoise(noise=noise)), "left", 427, 320)
    sensor.restart(np.random.default_rng(3))
    return sensor.capture().image.astype(np.float32), sensor.reference().astype(np.float32)


PRESSED = [(HEXAGON * 0.6, pose(0, 0, 6)), (HEXAGON * 0.6, pose(-5, 3, 20)), (HEXAGON, pose(3, -2, 0))]


@gelslim_data
def test_contact_contrast_and_edge_width_are_those_of_a_real_gelslim() -> None:
    reference = read(DATA / "gelslim" / "ref.jpg")
    presses = sorted((DATA / "gelslim" / "press").glob("*.jpg"))
    real = np.array([patch_statistics(read(path) - reference) for path in presses])
    sim = np.array([patch_statistics(gel - bare) for gel, bare in (simulated(*p) for p in PRESSED)])
    (contrast, width), (sim_contrast, sim_width) = np.median(real, axis=0), np.median(sim, axis=0)
    assert 40 < contrast < 70
    assert 12 < width < 18
    assert sim_contrast == pytest.approx(contrast, rel=0.3)
    assert sim_width == pytest.approx(width, abs=3)


@gelslim_data
def test_markers_stand_as_far_apart_as_those_of_a_real_gelslim() -> None:
    real = marker_pitch(read(DATA / "gelslim" / "ref.jpg"))
    assert marker_pitch(simulated(HEXAGON, NOWHERE)[1]) == pytest.approx(real, rel=0.08)


@gelslim_data
def test_the_bare_gel_has_the_brightness_and_markers_the_darkness_of_a_real_one() -> None:
    real, sim = read(DATA / "gelslim" / "ref.jpg"), simulated(HEXAGON, NOWHERE)[1]
    middle = np.s_[110:210, 140:290]
    for statistic in (np.median, lambda grey: np.median(grey) - np.percentile(grey, 2)):
        assert statistic(sim[middle].mean(axis=2)) == pytest.approx(statistic(real[middle].mean(axis=2)), rel=0.3)


@gelslim_data
def test_the_noise_of_the_lab_is_that_of_real_gels() -> None:
    folder = DATA / "gelslim"
    real = noise_level(read(folder / "ref.jpg"), read(folder / "objects" / "reconstruct_0.jpg"))
    sensor = opened(FakeWorld(noise=load_profile("lab").gel), "left", 427, 320)
    sim = noise_level(*(sensor.capture().image.astype(np.float32) for _ in range(2)))
    assert sim == pytest.approx(real, rel=0.2)


@gelsight_data
def test_a_wall_is_as_clear_as_a_facet_of_the_edges_in_real_gelsight_pictures() -> None:
    folder = DATA / "gelsight_edges"
    background, facets = read(folder / "background.png"), []
    for i in range(11):
        label, angle = np.load(folder / str(i) / "label.npz"), 0.0
        angle = np.deg2rad(float(label["line_angle"]))
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        u, v = np.linspace(-0.3, 0.3, 61) * float(label["line_length"]), np.arange(-40, 40.5, 0.5)
        where = (label["line_center"] + u[:, None, None] * along + v[:, None] * across).astype(np.float32)
        change = read(folder / str(i) / "gelsight.png") - background
        profile = np.median(cv2.remap(change, where[..., 0], where[..., 1], cv2.INTER_LINEAR), axis=0)
        facets.append(np.ptp(profile, axis=0).max() / 2)  # two facets, one bright and one dark
    walls = []
    for outline, rest in PRESSED:
        gel, bare = simulated(outline, rest)
        walls.append(np.percentile(np.abs(gel - bare).max(axis=2)[np.abs(gel - bare).max(axis=2) > 20], 90))
    assert 50 < np.median(facets) < 110
    assert np.median(walls) == pytest.approx(np.median(facets), rel=0.4)


@gelslim_data
def test_a_figure_puts_real_and_simulated_pictures_side_by_side() -> None:
    folder = DATA / "gelslim"
    real = [folder / "ref.jpg", folder / "press" / "sample_10.jpg", folder / "objects" / "reconstruct_1.jpg"]
    shown = [simulated(HEXAGON, NOWHERE)[1], simulated(*PRESSED[1], noise=3.0)[0], simulated(BOX, pose(2, 1, -30))[0]]
    rows = [np.hstack([read(path) for path in real]), np.hstack(shown)]
    FIGURES.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(FIGURES / "gelslim_real_above_simulated_below.png"), np.vstack(rows).astype(np.uint8))
