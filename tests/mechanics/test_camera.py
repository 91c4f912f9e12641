import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechanics.camera import CameraModel, TagGeometry, point_in_world

seeds = st.integers(0, 2**32 - 1)


def random_camera(rng: np.random.Generator) -> CameraModel:
    X_WC = np.eye(4)
    X_WC[:3, :3] = cv2.Rodrigues(rng.normal(0, 1.5, 3))[0]
    X_WC[:3, 3] = rng.normal(0, 1, 3)
    K = np.array([[rng.uniform(400, 2000), 0, rng.uniform(300, 900)], [0, rng.uniform(400, 2000), 400], [0, 0, 1]])
    distortion = rng.normal(0, 1, 5) * (0.1, 0.05, 0.003, 0.003, 0.02)
    return CameraModel(1280, 720, K, distortion, X_WC)


def in_view(camera: CameraModel, rng: np.random.Generator, n: int = 12) -> np.ndarray:
    """World points 0.3 to 2 m in front of the camera, within 19° of its axis."""
    depth = rng.uniform(0.3, 2.0, n)
    p_C = np.column_stack((rng.uniform(-0.34, 0.34, (n, 2)) * depth[:, None], depth))
    return p_C @ camera.X_WC[:3, :3].T + camera.X_WC[:3, 3]


def opencv(camera: CameraModel, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and their derivative by the world point, by OpenCV."""
    R_CW = camera.X_WC[:3, :3].T
    t = -R_CW @ camera.X_WC[:3, 3]
    pixels, jacobian = cv2.projectPoints(p_W.reshape(-1, 1, 3), cv2.Rodrigues(R_CW)[0], t, camera.K, camera.distortion)
    return pixels.reshape(-1, 2), jacobian[:, 3:6].reshape(-1, 2, 3) @ R_CW


@given(seeds)
def test_projection_and_its_jacobian_agree_with_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    p_W = in_view(camera, rng)
    pixels, jacobian = opencv(camera, p_W)
    ours, by_point = camera.project_with_jacobian(p_W.reshape(3, 4, 3))
    np.testing.assert_allclose(ours.reshape(-1, 2), pixels, atol=1e-8)
    np.testing.assert_allclose(by_point.reshape(-1, 2, 3), jacobian, rtol=1e-7, atol=1e-6)
    np.testing.assert_array_equal(camera.project(p_W), ours.reshape(-1, 2))


@given(seeds)
@settings(max_examples=30)
def test_undistorted_pixels_are_those_of_the_camera_without_its_lens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    p_W = in_view(camera, rng)
    real, _ = opencv(camera, p_W)
    ideal, _ = opencv(CameraModel(1280, 720, camera.K, np.zeros(5), camera.X_WC), p_W)
    np.testing.assert_allclose(camera.undistort(real), ideal, atol=1e-7)
    np.testing.assert_allclose(camera.distort(ideal), real, atol=1e-8)


def test_viewer_sees_plane_x_to_the_right_and_plane_y_up() -> None:
    camera = CameraModel.looking_at((0.1, -0.5, 0.2), (0.1, 0.0, 0.2), 1000, 1280, 720)
    centre, right, up = camera.project(point_in_world([[0.1, 0.2], [0.11, 0.2], [0.1, 0.21]]))
    np.testing.assert_allclose(centre, (639.5, 359.5), atol=1e-9)
    np.testing.assert_allclose(right, (659.5, 359.5), atol=1e-9)  # 10 mm at 0.5 m and 1000 px are 20 px
    np.testing.assert_allclose(up, (639.5, 339.5), atol=1e-9)


def test_what_stands_in_front_of_the_plane_is_nearer_to_the_camera() -> None:
    camera = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 1000, 1280, 720)
    np.testing.assert_allclose(camera.project(point_in_world([0.01, 0.0], 0.1)), (639.5 + 25, 359.5), atol=1e-9)


@given(seeds, st.floats(-0.05, 0.05))
@settings(max_examples=30)
def test_plane_homography_maps_as_the_undistorted_projection(seed: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    position = rng.uniform((-0.2, -0.8, -0.1), (0.2, -0.4, 0.4))
    camera = CameraModel.looking_at(tuple(position), (0, 0, 0.1), 1400, 1280, 720)
    p = rng.uniform(-0.1, 0.2, (6, 2))
    mapped = cv2.perspectiveTransform(p[None], camera.plane_homography(height))[0]
    expected, _ = opencv(camera, np.column_stack((p[:, 0], np.full(6, -height), p[:, 1])))
    np.testing.assert_allclose(mapped, expected, atol=1e-8)


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 1000, 1280, 720)
    pixels = camera.project([[0, -0.6, 0], [0, 0, 0]])
    assert np.isnan(pixels[0]).all() and np.isfinite(pixels[1]).all()


def test_camera_survives_json_exactly() -> None:
    camera = random_camera(np.random.default_rng(1))
    again = CameraModel.from_dict(json.loads(json.dumps(camera.as_dict())))
    for name in ("width", "height", "K", "distortion", "X_WC"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [[1, 0], [0, 1]]}, r"camera K: expected shape \(3, 3\), got \(2, 2\)"),
        ({"distortion": [0, 0, 0, 0]}, r"camera distortion: expected shape \(5,\), got \(4,\)"),
        ({"K": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "positive focal lengths"),
        ({"X_WC": np.diag([1.0, 1, -1, 1]).tolist()}, "expected a rotation"),
        ({"X_WC": (np.eye(4) * np.nan).tolist()}, "finite"),
        ({"width": 0}, "positive size"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change: dict, message: str) -> None:
    good = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 1000, 1280, 720).as_dict()
    with pytest.raises(ValueError, match=message):
        CameraModel.from_dict(good | change)


def test_missing_and_unknown_fields_are_named() -> None:
    with pytest.raises(ValueError, match=r"missing \['K'.*unknown \['k'\]"):
        CameraModel.from_dict({"k": 1, "width": 2, "height": 3})


@pytest.mark.parametrize("target", [(0.0, -0.5, 0.0), (0.0, -0.5, 0.3)])
def test_an_empty_or_vertical_view_is_refused(target: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="empty or vertical"):
        CameraModel.looking_at((0.0, -0.5, 0.0), target, 1000, 64, 64)


def test_points_of_another_shape_are_refused() -> None:
    camera = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 1000, 1280, 720)
    with pytest.raises(ValueError, match=r"expected shape \(\.\.\., 3\), got \(4, 2\)"):
        camera.project(np.zeros((4, 2)))


def test_tag_corners_follow_the_mount_on_the_body() -> None:
    quarter_turn = TagGeometry(id=0, size=0.04, pose=(0.1, -0.2, np.pi / 2))
    np.testing.assert_allclose(
        quarter_turn.corners, [[0.12, -0.22], [0.12, -0.18], [0.08, -0.18], [0.08, -0.22]], atol=1e-15
    )
