import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mechanics import se2, wrench
from mechanics.task_plane import DEFAULT_PLANE, TaskPlane

ANGLE = st.floats(-3.1, 3.1)
NUMBER = st.floats(-2, 2)
POSE = st.tuples(NUMBER, NUMBER, ANGLE).map(np.array)


def plane_of(rotation: Rotation, origin) -> TaskPlane:
    axes = rotation.as_matrix()
    return TaskPlane(tuple(origin), tuple(axes[:, 0]), tuple(axes[:, 1]))


PLANES = st.builds(
    lambda rotvec, origin: plane_of(Rotation.from_rotvec(rotvec), origin),
    st.tuples(NUMBER, NUMBER, NUMBER),
    st.tuples(NUMBER, NUMBER, NUMBER),
)


def test_the_default_plane_has_x_right_z_up_and_minus_y_toward_the_viewer():
    np.testing.assert_array_equal(DEFAULT_PLANE.normal, [0, -1, 0])
    np.testing.assert_array_equal(DEFAULT_PLANE.point_to_3d([0.3, 0.7]), [0.3, 0, 0.7])


def test_a_counter_clockwise_quarter_turn_takes_the_bodys_x_to_worlds_z():
    R = DEFAULT_PLANE.pose_to_se3([0, 0, math.pi / 2])[:3, :3]
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 0, 1], atol=1e-15)


@given(PLANES, POSE)
def test_the_rotation_is_about_the_normal(plane, pose):
    T = plane.pose_to_se3(pose)
    np.testing.assert_allclose(
        T[:3, :3], Rotation.from_rotvec(pose[2] * np.array(plane.normal)).as_matrix(), atol=1e-12
    )
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@given(PLANES, POSE)
def test_poses_come_back_with_nothing_out_of_plane(plane, pose):
    back, distance, tilt = plane.pose_from_se3(plane.pose_to_se3(pose))
    np.testing.assert_allclose(back, pose, atol=1e-12)
    assert abs(distance) < 1e-12
    assert tilt < 1e-7


@given(PLANES, POSE)
def test_ros_quaternions_are_scipys_and_come_back(plane, pose):
    position, quaternion = plane.pose_to_ros(pose)
    expected = Rotation.from_rotvec(pose[2] * np.array(plane.normal)).as_quat(canonical=True)
    if expected[3] > 1e-6:  # at half a turn both signs are canonical
        np.testing.assert_allclose(quaternion, expected, atol=1e-12)
    back, distance, tilt = plane.pose_from_ros(position, -3.0 * quaternion)  # any multiple is the same rotation
    np.testing.assert_allclose(back, pose, atol=1e-12)
    assert abs(distance) < 1e-12
    assert tilt < 1e-7


@given(POSE, st.floats(-1, 1), st.floats(0.01, 1.5), st.floats(0, 6))
def test_what_leaves_the_plane_is_measured(pose, distance, tilt, direction):
    """A swing about an axis of the plane and a step along the normal are told apart from the planar pose."""
    plane = DEFAULT_PLANE
    axis = math.cos(direction) * np.array(plane.x) + math.sin(direction) * np.array(plane.y)
    T = plane.pose_to_se3(pose)
    swung = Rotation.from_rotvec(tilt * axis) * Rotation.from_matrix(T[:3, :3])
    T[:3, :3] = swung.as_matrix()
    T[:3, 3] += distance * np.array(plane.normal)
    for back, far, angle in (plane.pose_from_se3(T), plane.pose_from_ros(T[:3, 3], swung.as_quat())):
        np.testing.assert_allclose(back, pose, atol=1e-9)
        assert math.isclose(far, distance, abs_tol=1e-12)
        assert math.isclose(angle, tilt, rel_tol=1e-6)


def test_a_torque_about_minus_y_is_counter_clockwise():
    np.testing.assert_allclose(DEFAULT_PLANE.wrench_to_planar([1, 2, 3, 4, 5, 6]), [1, 3, -5])


@given(PLANES, st.tuples(NUMBER, NUMBER, NUMBER).map(np.array))
def test_planar_wrenches_come_back_from_space(plane, w):
    np.testing.assert_allclose(plane.wrench_to_planar(plane.wrench_to_spatial(w)), w, atol=1e-12)


@given(PLANES, POSE, st.tuples(*[NUMBER] * 6).map(np.array))
def test_a_bodys_frame_embeds_like_the_world(plane, X_WB, spatial_B):
    """Reading a body-frame wrench in the plane commutes with turning it into the world's axes."""
    R = plane.pose_to_se3(X_WB)[:3, :3]
    spatial_W = np.concatenate([R @ spatial_B[:3], R @ spatial_B[3:]])
    planar = wrench.rotated(plane.wrench_to_planar(spatial_B), X_WB[2])
    np.testing.assert_allclose(plane.wrench_to_planar(spatial_W), planar, atol=1e-12)


@given(POSE, POSE)
def test_composition_in_the_plane_is_composition_in_space(a, b):
    expected = DEFAULT_PLANE.pose_to_se3(a) @ DEFAULT_PLANE.pose_to_se3(b)
    np.testing.assert_allclose(DEFAULT_PLANE.pose_to_se3(se2.compose(a, b)), expected, atol=1e-12)


def test_batches_and_torch_agree_with_single_poses():
    poses = np.random.default_rng(1).normal(size=(2, 4, 3))
    T = DEFAULT_PLANE.pose_to_se3(poses)
    assert T.shape == (2, 4, 4, 4)
    np.testing.assert_allclose(T[1, 2], DEFAULT_PLANE.pose_to_se3(poses[1, 2]))
    np.testing.assert_allclose(DEFAULT_PLANE.pose_to_se3(torch.tensor(poses)).numpy(), T)
    back, _, _ = DEFAULT_PLANE.pose_from_se3(torch.tensor(T))
    np.testing.assert_allclose(back.numpy(), poses, atol=1e-12)


@pytest.mark.parametrize(
    ("axes", "rule"),
    [
        ({"x": (2.0, 0, 0)}, r"\|x\| = 1"),
        ({"y": (0.0, 0, 0.9)}, r"\|y\| = 1"),
        ({"y": (1.0, 0, 0)}, "x · y = 0"),
        ({"origin": (0.0, math.nan, 0.0)}, "origin"),
    ],
)
def test_axes_that_are_not_orthonormal_are_refused(axes, rule):
    with pytest.raises(ValueError, match=rule):
        TaskPlane(**axes)


def test_a_zero_quaternion_is_refused():
    with pytest.raises(ValueError, match="all zeros"):
        DEFAULT_PLANE.pose_from_ros([0, 0, 0], [0, 0, 0, 0])
