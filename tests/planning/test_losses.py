"""Each loss on numbers worked out by hand, and the barriers at and beyond their limits."""

import math

import numpy as np
import pytest
import torch

from planning import losses
from planning.problem import PlanarArm


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.fixture(params=[np.array, tensor], ids=["numpy", "torch"])
def array(request):
    """What makes the arrays that a loss is given."""
    return request.param


def test_the_cone_loss_is_one_minus_the_cosine_with_the_normal(array):
    force = array([[3.0, 4.0], [2.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(losses.cone(force), [1 - 3 / 5, 0.0, 1.0, 2.0, 1.0], atol=1e-15)


def test_the_cone_loss_has_a_gradient_where_there_is_no_force():
    force = tensor([0.0, 0.0]).requires_grad_()
    losses.cone(force).backward()
    assert force.grad is not None
    assert force.grad.tolist() == [-1 / losses.NO_FORCE, 0.0]


def test_only_what_pulls_is_charged_for_pulling(array):
    np.testing.assert_array_equal(losses.pull(array([[3.0, 9.0], [-2.0, 9.0], [0.0, 1.0]])), [0.0, -2.0, 0.0])


def test_the_force_loss_is_what_misses_the_wish(array):
    np.testing.assert_array_equal(losses.contact_force(array([[3.0, 1.0]]), array([[2.5, 2.0]])), [[0.5, -1.0]])


def test_penetration_is_a_tenth_of_the_logarithm_of_the_room_in_radians(array):
    limits = array([[-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]])
    got = losses.penetration(array([0.1, -0.5 + math.exp(-3), 0.5, -0.6]), limits)
    expected = [[-0.1 * math.log(0.6), -0.1 * math.log(0.4)], [0.3, -0.1 * math.log(1 - math.exp(-3))]]
    np.testing.assert_allclose(got[:2], expected, rtol=1e-14)
    assert got[2].tolist() == pytest.approx([0.0, math.inf])
    assert got[3].tolist() == pytest.approx([math.inf, -0.1 * math.log(1.1)])


def test_slack_track_and_smooth_measure_newtons_and_millimetres(array):
    np.testing.assert_allclose(losses.slack(array([[1.0, 2.0, 0.3]]), 0.05), [[1.0, 2.0, 6.0]])
    got = losses.track(array([0.3]), array([0.01]), array([0.1]), array([0.012]), 0.05)
    np.testing.assert_allclose(got, [[10.0, -2.0]])
    go = array([[0.0, 0.0, 0.1], [0.001, -0.002, 0.2], [0.001, 0.0, 0.2]])
    np.testing.assert_allclose(losses.smooth(go, 0.05), [[1.0, -2.0, 5.0], [0.0, 2.0, 0.0]], atol=1e-15)


def test_a_barrier_is_nothing_in_the_middle_and_infinite_from_the_limit_on(array):
    got = losses.barrier(array([0.0, 0.75, 1.0, 1.5, math.nan, math.inf]))
    np.testing.assert_allclose(got, [0.0, 0.1 * math.log(4), *[math.inf] * 4])


def test_the_workspace_is_a_barrier_per_coordinate(array):
    limits = array([[0.0, 2.0], [-1.0, 1.0], [-0.4, 0.4]])
    got = losses.workspace(array([[1.5, 0.0, -0.2], [1.0, 1.0, 0.0]]), limits)
    quarter = -0.1 * math.log(1 - 0.25)
    np.testing.assert_allclose(got, [[quarter, 0.0, quarter], [0.0, math.inf, 0.0]], atol=1e-16)


def test_the_sensor_has_a_barrier_for_its_force_and_one_for_its_torque(array):
    wrench = array([[3.0, -4.0, 0.2], [0.0, 0.0, 0.0], [0.0, 11.0, 0.0]])
    both = losses.sensor(wrench, 10.0, 0.4)
    quarter = -0.1 * math.log(1 - 0.25)
    np.testing.assert_allclose(both, [[quarter, quarter], [0.0, 0.0], [math.inf, 0.0]])
    np.testing.assert_array_equal(losses.sensor(wrench, None, 0.4), both[:, 1:])
    np.testing.assert_array_equal(losses.sensor(wrench, 10.0, None), both[:, :1])
    assert losses.sensor(wrench, None, None).shape == (3, 0)


def arm(elbow=1, limits=((-3.0, 3.0),) * 3, zero=(0.0, 0.0, 0.0)) -> PlanarArm:
    return PlanarArm(
        np.array([0.3, -0.2]), 0.5, 0.4, np.array([0.1, -0.05]), elbow, np.array(zero), np.array(limits, dtype=float)
    )


def forward(a: PlanarArm, readings) -> np.ndarray:
    """X_W_ee from the joints: three rotations and three translations as homogeneous matrices."""

    def moved(angle, x, y):
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, x], [0, 1, y], [0, 0, 1]])

    q = np.asarray(readings) - a.zero
    T = moved(0, *a.base) @ moved(q[0], a.upper, 0) @ moved(q[1], a.fore, 0) @ moved(q[2], *a.tool)
    return np.array([T[0, 2], T[1, 2], math.atan2(T[1, 0], T[0, 0])])


@pytest.mark.parametrize("elbow", [1, -1])
def test_the_joints_found_for_a_pose_lead_forward_to_it(array, elbow):
    rng = np.random.default_rng(4)
    zero = rng.uniform(-1, 1, 3)
    a = arm(elbow, zero=zero, limits=zero[:, None] + [[-math.pi, math.pi]] * 3)
    for _ in range(50):
        q = zero + rng.uniform(-3, 3, 3) * [1, 0, 1] + [0, elbow * rng.uniform(0.05, 3.0), 0]
        found, reachable = losses.joint_readings(a, array(forward(a, q)))
        assert reachable
        np.testing.assert_allclose(found, q, atol=1e-11)


def test_of_equal_angles_the_one_near_the_joint_s_middle_is_taken(array):
    a = arm(limits=((4.0, 8.0), (-3.0, 3.0), (-8.0, -4.0)))
    q = np.array([6.0, 1.0, -6.0])
    found, _ = losses.joint_readings(a, array(forward(a, q)))
    np.testing.assert_allclose(found, q, atol=1e-12)


def test_joints_are_a_barrier_each_and_infinite_out_of_reach(array):
    a = arm(limits=((0.0, 2.0), (0.0, 2.0), (-1.0, 1.0)))
    ee = np.array([forward(a, [1.5, 1.0, 0.5]), forward(a, [2.5, 1.0, 0.0]), [5.0, 5.0, 0.0], [0.4, -0.25, 0.0]])
    got = losses.joints(array(ee), a)
    quarter = -0.1 * math.log(1 - 0.25)
    np.testing.assert_allclose(got[0], [quarter, 0.0, quarter], atol=1e-13)
    assert got[1, 0] == math.inf
    assert (got[2] == math.inf).all()  # too far
    assert (got[3] == math.inf).all()  # too near: the wrist is at the shoulder, but the arm is 0.1 m long when folded


def test_joint_gradients_are_those_of_central_differences():
    a = arm(elbow=-1, limits=((-2.0, 2.0), (-3.0, 0.0), (-2.0, 2.0)))
    ee = tensor(forward(a, [0.4, -1.2, 0.3]))
    J = torch.autograd.functional.jacobian(lambda x: losses.joints(x, a), ee)
    assert isinstance(J, torch.Tensor)
    for i in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[i] = 1e-6
        difference = (losses.joints(ee + step, a) - losses.joints(ee - step, a)) / 2e-6
        np.testing.assert_allclose(J[:, i], difference, atol=1e-8)


def test_infinite_barriers_leave_no_nan_in_the_gradient():
    a = arm()
    ee = tensor([[9.0, 9.0, 0.0], [0.4, -0.25, 0.0]]).requires_grad_()
    for r in (
        losses.joints(ee, a),
        losses.workspace(ee, tensor([[0.0, 1.0]] * 3)),
        losses.penetration(ee[:, 0], tensor([[0.0, 1.0]] * 2)),
    ):
        (gradient,) = torch.autograd.grad(r[r.isfinite()].sum() if r.isfinite().any() else r.sum(), ee)
        assert gradient.isfinite().all()
