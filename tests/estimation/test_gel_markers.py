"""Dots of a gel and the shear they show: against the simulated gel's truth, and a camera and motion of our own."""

import json

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from drivers.sim.mismatch import load_profile
from estimation.gel_markers import Dots, MarkerTracker, find_dots
from estimation.tactile_pose import FingerModel, left_difference
from experiments.bench.tactile_gel import GelHand, open_gelslim
from mechanics.camera import CameraModel

BOARD = np.array([(-0.06, -0.06), (0.06, -0.06), (0.06, 0.06), (-0.06, 0.06)])
BOX = np.array([(-0.012, -0.06), (0.012, -0.06), (0.012, 0.011), (-0.012, 0.011)])


def pose(x_mm: float = 0, y_mm: float = 0, degrees: float = 0) -> np.ndarray:
    return np.array([x_mm / 1e3, y_mm / 1e3, np.deg2rad(degrees)])


def held(outline: np.ndarray, shear: np.ndarray, rest: np.ndarray | None = None) -> GelHand:
    """The object lay at ``rest`` in ee when it was grasped and has been carried along by ``shear`` since."""
    rest = pose() if rest is None else rest
    c, s = np.cos(shear[2]), np.sin(shear[2])
    go = np.array([*(np.array([[c, -s], [s, c]]) @ rest[:2] + shear[:2]), rest[2] + shear[2]])
    return GelHand(load_profile("lab"), outline, go, shear=shear)


def outside(hand: GelHand, finger: FingerModel, dots: Dots) -> np.ndarray:
    """Distance of each dot from the face by OpenCV, where a plain pinhole without lens error sees it."""
    ideal = cv2.undistortPoints(
        dots.centres[:, None].astype(np.float64), finger.camera.K, finger.camera.distortion, P=finger.camera.K
    )[:, 0]
    rays = np.column_stack((ideal, np.ones(len(ideal)))) @ np.linalg.inv(finger.camera.K).T
    X_ee_C = finger.X_ee_F @ finger.camera.X_WC
    way, eye = rays @ X_ee_C[:3, :3].T, X_ee_C[:3, 3]
    at = eye + way * ((0 - eye[1]) / way[:, 1])[:, None]
    z = np.exp(1j * hand.X_ee_go[2]) * (hand.outline[:, 0] + 1j * hand.outline[:, 1]) + complex(*hand.X_ee_go[:2])
    polygon = (1e4 * np.stack((z.real, z.imag), axis=-1)).astype(np.float32)
    points = 1e4 * at[:, (0, 2)]
    return np.array([-1e-4 * cv2.pointPolygonTest(polygon, (float(x), float(y)), True) for x, y in points])


def read(hand: GelHand, side: str = "left", seed: int = 0, guess: np.ndarray | None = None, **described: float):
    device = open_gelslim(hand, side)
    device.restart(np.random.default_rng(seed))
    finger = FingerModel.of(device.describe().extra | described, device.reference())
    tracker = MarkerTracker(finger, find_dots(finger.reference))
    dots = find_dots(device.capture().image)
    return tracker.shear(dots, outside(hand, finger, dots), pose() if guess is None else guess)


@pytest.mark.parametrize("side", ["left", "right"])
def test_dots_are_found_where_the_device_says_that_they_are(side: str) -> None:
    device = open_gelslim(held(BOX, pose()), side)
    extra = json.loads(json.dumps(device.describe().extra))
    camera = CameraModel.from_dict(extra["camera"])
    markers = np.array(extra["markers_mm"]) / 1e3
    X_CF = np.linalg.inv(camera.X_WC)
    expected, _ = cv2.projectPoints(
        np.column_stack((markers, np.zeros(len(markers)))),
        cv2.Rodrigues(X_CF[:3, :3])[0],
        X_CF[:3, 3],
        camera.K,
        camera.distortion,
    )
    expected = expected[:, 0]
    inner = ((expected > 8) & (expected < (camera.width - 9, camera.height - 9))).all(axis=1)
    found = find_dots(device.reference()).centres
    gap = np.linalg.norm(expected[inner][:, None] - found, axis=2).min(axis=1)
    assert inner.sum() > 200
    assert (gap < 0.3).mean() > 0.98
    assert np.median(gap) < 0.06


def test_a_picture_without_marks_has_no_dots() -> None:
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    smooth = 90 + 60 * np.exp(-((x - 150) ** 2 + (y - 90) ** 2) / 90.0**2)
    picture = np.clip(smooth[..., None] + 3 * rng.standard_normal((240, 320, 3)), 0, 255).astype(np.uint8)
    assert len(find_dots(picture)) == 0


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("outline", "shear"),
    [
        (BOX, pose(0.4, -0.3, 0.5)),
        (BOX, pose(-0.9, 0.8, -3)),
        (BOARD, pose(0, 0, 2)),
        (BOARD, pose(0.7, 0.7, -1)),
    ],
)
def test_the_shear_is_that_of_the_plant_to_some_micrometres(side: str, outline: np.ndarray, shear: np.ndarray) -> None:
    found = read(held(outline, shear, pose(1, 2, 12)), side)
    error = left_difference(found.pose, shear)
    assert found.known
    assert np.hypot(*error[:2]) < 6e-6
    assert abs(error[2]) < np.radians(0.03)
    assert found.dots > 0.9 * found.under


def test_its_covariance_is_honest() -> None:
    rng = np.random.default_rng(5)
    squares = []
    for k in range(16):
        shear = rng.standard_normal(3) * (3e-4, 3e-4, 0.01)
        hand = held(BOX, shear, pose(rng.uniform(-3, 3), rng.uniform(-3, 3), rng.uniform(-180, 180)))
        found = read(hand, "left" if k % 2 else "right", k)
        error = left_difference(found.pose, shear)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    # of 16 the median scatters by a quarter
    assert 0.15 < np.median(squares) / chi2.median(3) < 1.7
    assert np.mean(squares) < 2 * 3


def test_a_shear_beyond_half_a_pitch_is_told_by_the_dots_beside_the_face() -> None:
    """1.9 mm of a pitch of 2.3: under the face alone, it looks like 0.4 mm the other way."""
    shear = pose(1.9, 0.2, 0.5)
    found = read(held(BOX, shear))
    assert np.hypot(*left_difference(found.pose, shear)[:2]) < 2e-5


def test_where_the_face_covers_all_a_guess_tells_pitches_apart() -> None:
    shear = pose(2.0, -0.3, 0.4)
    found = read(held(BOARD, shear), guess=pose(1.6, 0, 0))
    assert np.hypot(*left_difference(found.pose, shear)[:2]) < 2e-5


def test_the_dots_spread_says_how_deep_the_gel_is_pressed_in() -> None:
    """The device presses to 0.8 mm and says 0.6."""
    found = read(held(BOX, pose(0.3, 0.1, 1)), indentation_mm=0.6)
    assert found.depth == pytest.approx(0.8e-3, abs=0.03e-3)
    assert np.hypot(*left_difference(found.pose, pose(0.3, 0.1, 1))[:2]) < 1e-5


def test_without_dots_under_the_face_there_is_no_shear_and_its_covariance_says_so() -> None:
    device = open_gelslim(held(BOX, pose()), "left")
    finger = FingerModel.of(device.describe().extra, device.reference())
    tracker = MarkerTracker(finger, find_dots(finger.reference))
    dots = find_dots(device.capture().image)
    found = tracker.shear(dots, np.full(len(dots), 5e-3))
    assert not found.known
    assert "0 dots under the face" in found.reason
    assert np.sqrt(np.diag(found.covariance))[:2].min() > 3e-3


def test_dots_that_move_at_random_are_no_shear() -> None:
    device = open_gelslim(held(BOARD, pose()), "left")
    finger = FingerModel.of(device.describe().extra, device.reference())
    reference = find_dots(finger.reference)
    tracker = MarkerTracker(finger, reference)
    rng = np.random.default_rng(2)
    scattered = reference.centres + rng.uniform(-8, 8, reference.centres.shape)
    found = tracker.shear(Dots(scattered, reference.area, reference.mask), None)
    assert not found.known
    assert "one body" in found.reason


def test_a_motion_of_our_own_comes_back() -> None:
    """A pinhole straight above dots in no grid: each dot moved, raised and seen by hand."""
    rng = np.random.default_rng(3)
    rest = rng.uniform(-0.02, 0.02, (3000, 2))
    keep: list[int] = []
    for i, p in enumerate(rest):
        if all(np.hypot(*(p - rest[j])) > 2e-3 for j in keep):
            keep.append(i)
    rest = rest[keep]
    angle, shift, depth, far = np.radians(1.7), np.array([0.5e-3, -0.3e-3]), 0.7e-3, 0.04
    moved = rest @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) + shift
    X_WC = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[2, 3] = far
    focal = 280.0

    def pixels(p: np.ndarray, height: float) -> np.ndarray:
        return np.array([160.0, 120.0]) + focal * p * (1, -1) / (far - height)

    camera = CameraModel(320, 240, np.array([[focal, 0, 160.0], [0, focal, 120.0], [0, 0, 1]]), X_WC=X_WC)
    X_ee_F = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1]])
    finger = FingerModel("gelslim", camera, X_ee_F, np.zeros((240, 320, 3), np.uint8), {"indentation_mm": 0.8})
    mask = np.zeros((240, 320), np.uint8)
    tracker = MarkerTracker(finger, Dots(pixels(rest, 0.0), 20.0, mask))
    found = tracker.shear(Dots(pixels(moved, depth), 20.0, mask), None)
    np.testing.assert_allclose(found.pose, [*shift, angle], atol=1e-7)
    assert found.depth == pytest.approx(depth, abs=2e-6)
