"""The pose in space of a tag, and the second pose that its corners allow."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mechanics.camera import CameraModel
from mechanics.square_pose import square_pose

K = np.array([[1400.0, 0.0, 639.5], [0.0, 1390.0, 359.5], [0.0, 0.0, 1.0]])
CAMERA = CameraModel(1280, 720, K)
BENT = CameraModel(1280, 720, K, np.array([0.05, -0.02, 0.001, -0.001, 0.0]))
SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


def tag(tilt_x, tilt_y, roll, x=0.0, y=0.0, z=0.5):
    """X_CT of a tag that, untilted, is read upright: its y is the camera's −y, and it faces the camera."""
    X_CT = np.eye(4)
    X_CT[:3, :3] = Rotation.from_euler("xyz", [tilt_x, tilt_y, roll]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    X_CT[:3, 3] = x, y, z
    return X_CT


def seen(camera, X_CT, size):
    corners = 0.5 * size * SQUARE @ X_CT[:3, :3].T + X_CT[:3, 3]
    return camera.project(corners)


def posed(camera, corners, size):
    found = square_pose(camera, corners, size)
    assert found is not None
    return found


angles = st.floats(-0.7, 0.7)


@given(angles, angles, st.floats(-3.1, 3.1), st.floats(-0.1, 0.1), st.floats(-0.05, 0.05), st.floats(0.2, 1.5))
@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "lens"])
def test_perfect_corners_give_the_pose(camera, tilt_x, tilt_y, roll, x, y, z):
    X_CT = tag(tilt_x, tilt_y, roll, x, y, z)
    found = posed(camera, seen(camera, X_CT, 0.04), 0.04)
    # head-on, where both poses meet, the tilt is the square root of what is lost to rounding
    np.testing.assert_allclose(found.X_CT, X_CT, atol=1e-5)
    assert found.residual_px < 1e-4
    assert found.X_CT[2, 2] < 0  # seen from the front


@given(st.floats(0.2, 0.8), angles, st.floats(-3.1, 3.1), st.floats(0.1, 0.5), st.integers(0, 1000))
def test_both_poses_are_those_of_opencv(tilt_x, tilt_y, roll, z, seed):
    corners = seen(CAMERA, tag(tilt_x, tilt_y, roll, z=z), 0.04) + np.random.default_rng(seed).normal(0, 0.1, (4, 2))
    found = posed(CAMERA, corners, 0.04)
    order = [3, 2, 1, 0]
    square = (0.02 * SQUARE)[order]
    _, turns, moves, _ = cv2.solvePnPGeneric(
        square, corners[order].reshape(4, 1, 2), K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    for ours, turn, move in zip((found.X_CT, found.other), turns, moves, strict=True):
        np.testing.assert_allclose(ours[:3, :3], cv2.Rodrigues(turn)[0], atol=1e-5)
        np.testing.assert_allclose(ours[:3, 3], np.ravel(move), atol=1e-6)


def test_a_tag_that_is_read_upright_has_x_right_y_up_and_z_toward_the_reader():
    found = posed(CAMERA, np.array([[600.0, 400.0], [680.0, 400.0], [680.0, 320.0], [600.0, 320.0]]), 0.04)
    np.testing.assert_allclose(found.X_CT[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=0.15)
    assert found.X_CT[2, 3] == pytest.approx(1400 * 0.04 / 80, rel=0.02)


def test_a_tag_near_by_and_tilted_is_beyond_doubt_and_one_far_away_is_not():
    near = posed(CAMERA, seen(CAMERA, tag(0.5, 0.3, 0.2, z=0.15), 0.04), 0.04)
    noise = np.random.default_rng(0).normal(0, 0.1, (4, 2))
    far = posed(CAMERA, seen(CAMERA, tag(0.5, 0.3, 0.2, z=3.0), 0.04) + noise, 0.04)
    assert near.ambiguity < 0.01 and far.ambiguity > 0.2
    assert far.flip > 0.5


def test_the_second_pose_is_the_first_tilted_the_other_way():
    found = posed(CAMERA, seen(CAMERA, tag(0.4, 0.0, 0.0, z=1.0), 0.04), 0.04)
    assert found.other[1, 2] == pytest.approx(-found.X_CT[1, 2], abs=0.05)
    assert found.flip == pytest.approx(0.8, abs=0.05)
    assert found.residual_px <= found.other_residual_px


def test_residual_and_ambiguity_do_not_depend_on_the_size():
    corners = seen(CAMERA, tag(0.4, 0.2, 0.1), 0.04) + np.random.default_rng(1).normal(0, 0.2, (4, 2))
    small, large = posed(CAMERA, corners, 0.04), posed(CAMERA, corners, 1.0)
    assert small.ambiguity == pytest.approx(large.ambiguity, rel=1e-6)
    np.testing.assert_allclose(large.X_CT[:3, 3] * 0.04, small.X_CT[:3, 3], rtol=1e-6)


@pytest.mark.parametrize(
    "corners",
    [
        np.full((4, 2), np.nan),
        np.full((4, 2), np.inf),
        np.zeros((4, 2)),
        np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]),
        np.zeros((3, 2)),
        np.full((4, 2), 1e300),
    ],
)
def test_corners_of_no_square_give_no_pose_or_one_of_finite_numbers(corners):
    with np.errstate(all="ignore"):
        found = square_pose(CAMERA, corners, 0.04)
    assert found is None or np.isfinite(found.X_CT).all()


def test_a_tag_without_size_has_no_pose():
    assert square_pose(CAMERA, seen(CAMERA, tag(0, 0, 0), 0.04), 0.0) is None
