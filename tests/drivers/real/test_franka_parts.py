"""What a Franka's driver computes by itself, against closed forms and other libraries."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from drivers.errors import ProtocolError
from drivers.interfaces import ArmTarget
from drivers.real.arm_frames import ArmFrames, PlaneInBase, ToolMount, fixed_axes
from drivers.real.franka_config import FrankaConfig, Load
from drivers.real.franka_link import RobotTime
from drivers.real.franka_motion import LEG, Way, joint_limits
from drivers.real.joint_angles import joint_angles, pose_error
from mechanics.task_plane import DEFAULT_PLANE
from mechanics.yaml_input import Refusal

LENGTH = st.floats(-0.5, 0.5)
ANGLE = st.floats(-3.0, 3.0)
POSE = st.tuples(LENGTH, LENGTH, ANGLE).map(np.array)
#: looking at the robot from its front: the plane's x is the base's Y
TURNED = ArmFrames(PlaneInBase(origin=(0.4, 0.1, -0.05), x=(0, 1, 0)), ToolMount())


@given(POSE)
def test_a_planar_pose_comes_back_from_the_robots_base(pose):
    back, distance, tilt = TURNED.planar(TURNED.ee_in_base(pose))
    assert np.abs(back - pose).max() < 1e-12 and abs(distance) < 1e-12 and tilt < 1e-7


@given(st.tuples(ANGLE, ANGLE, ANGLE), st.tuples(LENGTH, LENGTH, LENGTH))
def test_a_pose_out_of_the_plane_reads_as_the_task_plane_reads_it(angles, position):
    X_W_ee = np.eye(4)
    X_W_ee[:3, :3], X_W_ee[:3, 3] = Rotation.from_rotvec(angles).as_matrix(), position
    expected = DEFAULT_PLANE.pose_from_se3(X_W_ee)
    for found, wanted in zip(TURNED.planar(TURNED.X_O_W @ X_W_ee), expected, strict=True):
        assert np.allclose(found, wanted, atol=1e-7)


def test_the_default_hand_points_down_and_opens_across_the_plane():
    """F's z is the hand's approach; the hand sits turned by −45° on the flange and opens along its own y."""
    X_O_F = ArmFrames(PlaneInBase(), ToolMount()).flange_in_base(np.array([0.0, 0.2, 0.0]))
    assert np.allclose(X_O_F[:3, 2], [0, 0, -1])
    hand_y = Rotation.from_euler("z", -45, degrees=True).apply([0, 1, 0])
    assert np.allclose(np.abs(X_O_F[:3, :3] @ hand_y), [0, 1, 0])
    assert np.allclose(X_O_F[:3, 3], [0.5, 0.0, 0.2 + 0.1034])


@given(st.tuples(ANGLE, ANGLE, ANGLE))
def test_a_tools_rotation_is_about_fixed_axes(angles):
    assert np.allclose(fixed_axes(*angles), Rotation.from_euler("xyz", angles).as_matrix())


@given(POSE, POSE)
def test_a_twist_is_the_derivative_of_the_pose(pose, twist):
    h = 1e-6
    before, after = TURNED.ee_in_base(pose - h * twist), TURNED.ee_in_base(pose + h * twist)
    linear, angular = TURNED.twist_in_base(twist)
    assert np.allclose((after - before)[:3, 3] / (2 * h), linear, atol=1e-7)
    turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * h)
    assert np.allclose(turned, angular, atol=1e-6)
    assert np.allclose(TURNED.planar_twist(linear, angular), twist)


@given(POSE, POSE, POSE, st.floats(0.1, 5.0), st.floats(0.0, 1.0))
def test_a_way_is_the_cubic_through_both_ends(start, twist, arriving, T, s):
    goal = start + np.array([0.05, -0.1, 0.4])
    way = Way(7.0, start, twist, ArmTarget(goal, arriving, T))
    cubic = CubicHermiteSpline([0, T], [start, goal], [twist, arriving])
    pose, speed = way.at(s)
    assert np.allclose(pose, cubic(s * T)) and np.allclose(speed, cubic(s * T, 1))


def test_a_way_turns_the_short_way_round():
    way = Way(0.0, np.array([0, 0, 3.0]), np.zeros(3), ArmTarget(np.array([0, 0, -3.0]), np.zeros(3), 1.0))
    assert np.isclose(way.at(1.0)[0][2], 2 * np.pi - 3.0)


def test_legs_follow_the_robots_clock_whatever_was_missed_and_end_at_the_set_point():
    goal = np.array([0.1, 0.0, 0.0])
    way = Way(0.0, np.zeros(3), np.zeros(3), ArmTarget(goal, np.zeros(3), 0.2))
    given_out, arrivals = [], []
    for now in (0.0, 0.005, LEG, 0.1, 0.11, 0.185):
        leg, last = way.leg(now)
        if leg is not None:
            given_out.append(leg)
            arrivals.append(now + leg[2])
    assert len(given_out) == 4 and last
    for (pose, _, _), arrival in zip(given_out[:-1], arrivals[:-1], strict=True):
        assert np.allclose(pose, goal * (3 * (arrival / 0.2) ** 2 - 2 * (arrival / 0.2) ** 3))
    assert np.array_equal(given_out[-1][0], goal) and np.isclose(arrivals[-1], 0.2)


def test_readings_are_numbered_by_the_robots_clock_so_that_a_skip_is_a_loss():
    clock = RobotTime(100.0)
    clock.restart(None)
    taken = [clock.take(t) for t in (5000, 5000, 5003, 5010, 5019, 5020, 5047, 5050)]
    assert taken == [0, None, None, 1, None, 2, 4, 5]
    assert clock.now == 5.05
    clock.restart(5)
    first = clock.take(12)
    assert first is not None and first >= 6


def test_a_clock_stands_still_while_it_is_looked_at_and_not_while_this_computer_slept(monkeypatch):
    now = 100.0
    monkeypatch.setattr("drivers.real.franka_link.monotonic", lambda: now)
    clock = RobotTime(100.0)
    clock.restart(None)
    clock.take(5000)
    now += 3.0  # nobody looked
    assert clock.silent == pytest.approx(3.0)
    clock.take(5000)
    assert clock.silent < 0.5, "one look in three seconds tells little of the robot"
    for _ in range(1000):
        now += 0.001
        clock.take(5000)
    assert clock.silent == pytest.approx(1.0, abs=0.5)
    clock.take(5001)
    assert clock.silent == 0


def planar_arm(q):
    """Two links of 1 m in the plane z = 0, and four joints that turn the hand; a flange that turns with all of them."""
    R1, R12 = Rotation.from_euler("z", q[0]), Rotation.from_euler("z", q[0] + q[1])
    X = np.eye(4)
    X[:3, 3] = R1.apply([1, 0, 0]) + R12.apply([1, 0, 0])
    X[:3, :3] = Rotation.from_euler("z", q.sum()).as_matrix()
    return X


def planar_jacobian(q, h=1e-7):
    return np.stack(
        [pose_error(planar_arm(q - h * e), planar_arm(q + h * e)) / (2 * h) for e in np.eye(q.size)], axis=1
    )


def test_joint_angles_reach_what_can_be_reached_and_stay_within_their_limits():
    wide = (np.full(3, -3.0), np.full(3, 3.0))
    wanted = np.array([0.3, 0.9, -0.4])
    q, there = joint_angles(planar_arm, planar_jacobian, np.array([0.1, 0.5, 0.0]), planar_arm(wanted), wide)
    assert there and np.allclose(q, wanted, atol=1e-3)
    tight = (np.array([-3.0, -3.0, -0.2]), np.array([3.0, 3.0, 0.2]))
    q, there = joint_angles(planar_arm, planar_jacobian, np.array([0.1, 0.5, 0.0]), planar_arm(wanted), tight)
    assert not there and (q >= tight[0]).all() and (q <= tight[1]).all()


URDF = '<robot name="r">{}</robot>'
JOINT = '<joint name="j{0}" type="revolute"><limit lower="-{0}" upper="{0}"/></joint>'


def test_joint_limits_are_read_from_the_robots_model():
    low, high = joint_limits("arm", URDF.format("".join(JOINT.format(i) for i in range(1, 8))))
    assert np.array_equal(high, np.arange(1, 8)) and np.array_equal(low, -high)


@pytest.mark.parametrize(
    "urdf",
    [
        "",
        "no xml",
        URDF.format(""),
        URDF.format(JOINT.format(1) * 6),
        URDF.format(JOINT.format("x") * 7),
        URDF.format('<joint name="j" type="revolute"><limit/></joint>' * 7),
        '<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><robot name="r">&b;</robot>',
    ],
)
def test_a_model_that_is_none_is_told(urdf):
    with pytest.raises(ProtocolError, match="arm: read the joints' limits"):
        joint_limits("arm", urdf)


@pytest.mark.parametrize(
    "wrong",
    [
        {"plane": {"x": (1.0, 0.1, 0.0)}},
        {"plane": {"x": (0.0, 0.0, 1.0)}},
        {"host": "not a host"},
        {"host": ""},
        {"joint_stiffness": (1000.0,) * 6},
        {"cartesian_stiffness": (5.0, 100, 100, 10, 10, 10)},
        {"braking": 0.0},
        {"dynamics": 1.5},
        {"unknown": 1},
    ],
)
def test_a_configuration_that_cannot_be_is_refused(wrong):
    with pytest.raises((ValidationError, Refusal)):
        FrankaConfig.model_validate({"kind": "arm", "backend": "real", "driver": "franka", **wrong})


def test_a_load_has_the_inertia_of_a_body():
    with pytest.raises((ValidationError, Refusal)):
        Load(mass=1.0, inertia=(0.1, 0.01, 0.01))
