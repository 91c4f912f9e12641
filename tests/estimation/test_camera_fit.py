"""Intrinsics from views of a tag board, against the exact camera model and through the simulated camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.config import TagCameraConfig
from drivers.sim.mismatch import load_profile
from drivers.sim.tag_camera import SimTagCamera
from estimation.camera_fit import PARAMETERS, fit_camera
from estimation.errors import FitError
from mechanics.camera import CameraModel
from mechanics.readings import TagDetection
from mechanics.tag_board import TagBoard

BOARD = TagBoard()
POINTS = BOARD.points()
START = CameraModel.looking_at((0, -0.55, 0.07), (0, 0, 0.07), 1400, 1280, 720)
TRUE = replace(
    START,
    K=np.array([[1436.0, 0, 650.3], [0, 1431.0, 352.8], [0, 0, 1]]),
    distortion=np.array([-0.12, 0.06, 8e-4, -6e-4, 0.0]),
)
FACING = np.diag([1.0, -1.0, -1.0])  # the board upright before the camera, in the camera's axes

View = tuple[TagDetection, ...]


def board_poses() -> list[np.ndarray]:
    """X_CB: near and tilted in the middle, and in the four corners of the picture."""
    middle = [(0, 0, 0.42, *tilt) for tilt in ((0, 0, 0), (30, 0, 0), (-30, 0, 0), (0, 30, 0), (0, -30, 0))]
    corners = [(x, y) for x in (-0.45, 0.45) for y in (-0.35, 0.35)]
    far = [(x, y, 0.55, *tilt) for x, y in corners for tilt in ((25, 25, 0), (-25, -25, 90))]
    near = [(0.6 * x, 0.7 * y, 0.42, 30, -20, 10) for x, y in corners]
    turned = [(0.7 * x, 0.8 * y, 0.48, -20, 35, 180) for x, y in corners]
    out = []
    for x, y, depth, *tilt in middle + far + near + turned:
        X_CB = np.eye(4)
        X_CB[:3, :3] = FACING @ Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        X_CB[:3, 3] = (x * 640 / 1400 * depth, y * 360 / 1400 * depth, depth)
        out.append(X_CB)
    return out


def seen(camera: CameraModel, X_CB: np.ndarray, rng: np.random.Generator | None = None, sigma: float = 0.02) -> View:
    """The corners that ``camera`` sees of the tags that lie well in its picture."""
    out = []
    for id, corners in POINTS.items():
        X_WB = camera.X_WC @ X_CB
        pixels = camera.project(corners @ X_WB[:3, :3].T + X_WB[:3, 3])
        if rng is not None:
            pixels = pixels + sigma * rng.standard_normal((4, 2))
        if (pixels > 5).all() and (pixels < (camera.width - 6, camera.height - 6)).all():
            out.append(TagDetection(id, pixels, 0, 100.0))
    return tuple(out)


def parameters(camera: CameraModel) -> np.ndarray:
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion])


def moved(view: View, by: Callable[[int], object]) -> View:
    return tuple(replace(d, corners=d.corners + np.asarray(by(d.id), float)) for d in view)


@pytest.fixture(scope="module")
def noisy() -> list[View]:
    rng = np.random.default_rng(5)
    return [seen(TRUE, X_CB, rng) for X_CB in board_poses()]


def test_perfect_corners_give_the_camera_whatever_it_was_thought_to_be() -> None:
    views = [seen(TRUE, X_CB) for X_CB in board_poses()]
    fit = fit_camera(POINTS, views, START)
    np.testing.assert_allclose(parameters(fit.camera), parameters(TRUE), rtol=1e-4, atol=2e-6)
    assert fit.rms_px < 1e-3  # OpenCV takes pixels as single floats
    assert (fit.rejected_views, fit.rejected_tags, fit.held) == ((), (), ("k3",))
    assert (fit.n_views, fit.n_corners) == (len(views), 4 * sum(map(len, views)))
    np.testing.assert_allclose(fit.X_CB, board_poses(), atol=2e-6)
    np.testing.assert_array_equal(fit.camera.X_WC, START.X_WC)


def test_the_covariance_is_that_of_repeated_calibrations() -> None:
    errors, claimed, sigma = [], [], np.zeros(9)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        fit = fit_camera(POINTS, [seen(TRUE, X_CB, rng) for X_CB in board_poses()], START)
        error = (parameters(fit.camera) - parameters(TRUE))[:8]
        errors.append(error)
        claimed.append(error @ np.linalg.solve(fit.covariance[:8, :8], error))
        assert fit.rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.1)
        sigma = np.sqrt(np.diag(fit.covariance))
        assert sigma[8] == 0 and list(fit.sigma.values()) == sigma.tolist() and list(fit.sigma) == list(PARAMETERS)
    # the sum of 40 × 8 squared normal errors has a standard deviation of 25 about 320
    assert 240 < np.sum(claimed) < 420
    np.testing.assert_allclose(np.std(errors, axis=0), sigma[:8], rtol=0.35)


def test_more_views_of_a_lens_that_bends_much_may_free_its_last_coefficient() -> None:
    bent = replace(TRUE, distortion=np.array([-0.3, 0.12, 0, 0, -0.08]))
    fit = fit_camera(POINTS, [seen(bent, X_CB) for X_CB in board_poses()], START, held=())
    np.testing.assert_allclose(fit.camera.distortion, bent.distortion, atol=1e-3)
    assert fit.sigma["k3"] > 0
    with pytest.raises(FitError, match="k7"):
        fit_camera(POINTS, [seen(bent, X_CB) for X_CB in board_poses()], START, held=("k7",))


def test_a_board_that_bent_in_one_view_and_a_tag_misread_in_another_are_left_out(noisy: list[View]) -> None:
    views = list(noisy)
    rng = np.random.default_rng(0)
    views[3] = moved(views[3], lambda id: 1.5 * rng.standard_normal((4, 2)))
    wrong = views[7][4].id
    views[7] = moved(views[7], lambda id: (3.0, -2.0) if id == wrong else 0)
    fit = fit_camera(POINTS, views, START)
    assert fit.rejected_views == (3,)
    assert fit.rejected_tags == ((7, wrong),)
    assert np.isnan(fit.view_rms_px[3]) and np.isnan(fit.X_CB[3]).all()
    error = (parameters(fit.camera) - parameters(TRUE))[:8]
    assert np.abs(error / np.sqrt(np.diag(fit.covariance))[:8]).max() < 4


def test_a_tag_cut_by_the_picture_and_a_tag_seen_twice_count_for_nothing(noisy: list[View]) -> None:
    views = list(noisy)
    first, second = views[0][:2]
    cut = first.corners.copy()
    cut[0, 0] = 1.0
    views[0] = (replace(first, corners=cut), second, replace(second, corners=second.corners + 40), *views[0][2:])
    without = [views[0][3:], *views[1:]]
    got, expected = (parameters(fit_camera(POINTS, some, START).camera) for some in (views, without))
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_too_few_views_are_told(noisy: list[View]) -> None:
    with pytest.raises(FitError, match="3 of 5") as told:
        fit_camera(POINTS, [*noisy[:3], noisy[3][:1], ()], START)
    with pytest.raises(FitError, match="0 of 2"):
        fit_camera(POINTS, [(), ()], START)
    assert "Show the board more often" in told.value.remedy


def test_views_of_one_orientation_leave_the_focal_length_open() -> None:
    rng = np.random.default_rng(0)
    poses = [X_CB.copy() for X_CB in board_poses()]
    for X_CB in poses:
        X_CB[:3, :3] = FACING
    with pytest.raises(FitError, match=r"fx.*fy.*left open: the board's tilts differ by 0\.\d°"):
        fit_camera(POINTS, [seen(TRUE, X_CB, rng) for X_CB in poses], START)


def test_views_in_the_middle_only_leave_the_lens_open() -> None:
    rng = np.random.default_rng(0)
    poses = []
    for tilt in ((35, 0, 0), (-35, 0, 0), (0, 35, 0), (0, -35, 0), (25, 25, 0), (-25, 25, 90)):
        X_CB = np.eye(4)
        X_CB[:3, :3] = FACING @ Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        X_CB[:3, 3] = (0, 0, 1.6)
        poses.append(X_CB)
    with pytest.raises(FitError, match="left open"):
        fit_camera(POINTS, [seen(TRUE, X_CB, rng, 0.05) for X_CB in poses], START)


@pytest.mark.parametrize(
    ("board", "word"),
    [
        ({}, "an empty one"),
        ({1: np.zeros((4, 3))}, "on one line"),
        ({1: np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.0]])}, "on one line"),
        ({1: np.full((4, 3), np.nan)}, "finite"),
        ({1: POINTS[100], 2: POINTS[101] + (0, 0, 0.01)}, "flat"),
        ({1: POINTS[100][:3]}, r"\(4, 3\)"),
    ],
)
def test_a_degenerate_board_is_told(board: dict[int, np.ndarray], word: str, noisy: list[View]) -> None:
    with pytest.raises(FitError, match=word):
        fit_camera(board, noisy, START)


def test_a_board_that_was_printed_otherwise_is_told(noisy: list[View]) -> None:
    with pytest.raises(FitError, match="px off where the best camera has them"):
        fit_camera(replace(BOARD, gap=0.0115).points(), noisy, START)


def test_a_corner_that_is_not_a_number_is_told_with_its_view_and_tag(noisy: list[View]) -> None:
    views = list(noisy)
    views[2] = moved(views[2], lambda id: np.nan if id == 105 else 0)
    with pytest.raises(FitError, match="tag 105 in view 2"):
        fit_camera(POINTS, views, START)


class _Booth:
    """What a simulated camera needs of its world, and nothing to see in it but the board."""

    lockstep = True
    profile = load_profile("lab")

    def now_ns(self) -> int:
        return 0

    def visible_tags(self):
        return []

    def tag_twists(self):
        return {}

    def screens(self):
        return []


def test_the_camera_of_the_lab_is_found_through_its_pictures() -> None:
    config = TagCameraConfig.model_validate(
        {"kind": "tag_camera", "position": (0, -0.55, 0.07), "look_at": (0, 0, 0.07)}
    )
    camera = SimTagCamera("camera", config, _Booth())
    with camera:
        camera.restart(np.random.default_rng(1))
        views = []
        for X_CB in board_poses():
            camera.show(BOARD, START.X_WC @ X_CB)
            views.append(camera.capture().detections)
    true, nominal = camera._renderer.camera, camera.camera
    assert not np.array_equal(true.K, nominal.K)
    # whoever set it up knew neither lens nor focal length
    fit = fit_camera(POINTS, views, replace(START, K=START.K * [[1.03], [1.03], [1]]))
    assert fit.rms_px < 0.025
    error = (parameters(fit.camera) - parameters(true))[:8]
    assert np.abs(error / np.sqrt(np.diag(fit.covariance))[:8]).max() < 4
    # directions of rays over the picture, but for how the camera as a whole is turned: that is the hand-eye's
    grid = np.stack(np.meshgrid(np.linspace(20, 1260, 15), np.linspace(20, 700, 9)), axis=-1).reshape(-1, 2)

    def rays(model: CameraModel) -> np.ndarray:
        out = np.column_stack((model.undistort(grid), np.ones(len(grid)))) @ np.linalg.inv(model.K).T
        return out / np.linalg.norm(out, axis=1, keepdims=True)

    def off(model: CameraModel) -> float:
        turn = Rotation.align_vectors(rays(true), rays(model))[0]
        return float(np.sqrt(np.mean(np.sum((turn.apply(rays(model)) - rays(true)) ** 2, axis=1)))) * 1400

    assert off(fit.camera) < 0.015  # px
    assert off(fit.camera) < 0.5 * off(nominal)
