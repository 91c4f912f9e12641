"""The environment's wrench on the go, from either sensor: signs from statics, covariances from sampling."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.contact_location import ContactLocator, ContactStatus
from estimation.contact_wrench import (
    EnvironmentWrench,
    environment_wrench,
    from_elasticity,
    from_force_torque,
    fuse,
    loosened,
    wrist_covariance,
)
from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.tactile_pose import ANGLE_LENGTH
from experiments.bench.contact import OUTLINES, wrench_of
from mechanics import se2
from mechanics import wrench as wrenches
from mechanics.catalogue import load_sensor
from mechanics.elasticity import Elasticity
from mechanics.task_plane import TaskPlane

from .contact_cases import ATI, MU

BOX = OUTLINES["tall_box"]
LOAD = FreeAirLoad(0.1, np.array([0.0, 0.0]), 9.81)
GRASP = np.array([0.0, 0.045, 0.1])
X_W_GO = np.array([0.2, 0.3, 0.4])
ELASTICITY = Elasticity(load_sensor("soft_bubble").stiffness)
POSE_INFORMATION = np.linalg.inv(np.diag([2e-4, 2e-4, np.radians(0.3)]) ** 2)


def random_information(rng):
    columns = np.diag([20.0, 20.0, 300.0]) @ rng.normal(size=(3, 3))
    return columns @ columns.T


def test_a_go_that_hangs_free_feels_nothing_of_its_environment():
    p_W = se2.compose(X_W_GO, GRASP)[:2]
    weight = 0.981
    lever = p_W[0] - X_W_GO[0]  # the fingers hold it left or right of the centre of mass
    w_ext = np.array([0.0, weight, -lever * weight])
    assert environment_wrench(w_ext, X_W_GO, p_W, LOAD) == pytest.approx(np.zeros(3), abs=1e-12)


def test_fingers_that_press_a_go_down_are_answered_by_the_ground_that_pushes_up():
    p_W = X_W_GO[:2]
    # fingers push down with 3 N, the weight with 0.981 N: the ground carries both
    assert environment_wrench(np.array([0.0, -3.0, 0.0]), X_W_GO, p_W, LOAD) == pytest.approx([0.0, 3.981, 0.0])


def test_the_wrist_covariance_is_that_of_sampled_readings():
    sensor = WristSensor(np.array([0.02, 0.2, 0.5]), np.zeros(3))
    X_W_ee, p_W = np.array([0.1, 0.4, -0.3]), np.array([0.12, 0.35])
    rng = np.random.default_rng(0)
    noise = rng.multivariate_normal(np.zeros(3), ATI, 40_000)
    # WristSensor's own way from a reading to a wrench, one reading for each basis vector: the map is linear
    columns = [sensor.wrench_on_go(TaskPlane().wrench_to_spatial(e), X_W_ee, p_W) for e in np.eye(3)]
    sampled = np.cov((noise @ np.array(columns)).T)
    expected = wrist_covariance(ATI, se2.compose(X_W_ee, sensor.X_ee_s), p_W)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(sampled / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03)
    correlation = expected[0, 2] / (scale[0] * scale[2])
    assert abs(correlation) > 0.5  # the lever: noise of the force is noise of the torque


def test_both_sources_give_the_same_wrench_of_a_go_in_balance():
    point = np.array([0.01, -0.07345])
    w_env_go = wrench_of(point, np.array([0.4, 3.0]))
    X_W_gocf = se2.compose(X_W_GO, GRASP)
    p_W = X_W_gocf[:2]
    w_env_W = wrenches.about(wrenches.rotated(w_env_go, X_W_GO[2]), X_W_GO[:2], p_W)
    weight = np.array([0.0, -0.981, -(X_W_GO[0] - p_W[0]) * 0.981])
    w_ext = -(w_env_W + weight)
    X_W_ee = ELASTICITY.ee_pose(X_W_GO, GRASP, w_ext)
    by_sensor = from_force_torque(w_ext, np.diag([1e-3, 1e-3, 1e-5]), X_W_GO, p_W, LOAD)
    by_spring = from_elasticity(ELASTICITY, se2.between(X_W_ee, X_W_GO), POSE_INFORMATION, GRASP, X_W_GO, LOAD)
    for source in (by_sensor, by_spring):
        assert source.about == pytest.approx(GRASP[:2])
        assert source.moved_to((0.0, 0.0)).wrench == pytest.approx(w_env_go, abs=1e-9)
        found = ContactLocator(BOX, MU).locate(source)
        # first, not alone: a pose known to 0.2 mm and 0.3° is a force known to 0.4 N
        assert found.hypotheses[0].point == pytest.approx(point, abs=1e-5)


def test_the_springs_information_is_that_of_sampled_poses():
    rng = np.random.default_rng(1)
    X_ee_go = se2.inverse(np.array([0.002, 0.04, 0.15]))
    deviations = np.array([2e-6, 3e-6, 4e-5])  # small, so that the sampled map is linear
    samples = deviations * rng.standard_normal((20_000, 3))
    said = from_elasticity(ELASTICITY, X_ee_go, np.diag(deviations**-2), GRASP, X_W_GO, LOAD)
    wrong = [
        from_elasticity(ELASTICITY, se2.compose(d, X_ee_go), np.eye(3), GRASP, X_W_GO, LOAD).wrench
        for d in samples[:3000]
    ]
    sampled = np.cov(np.array(wrong).T)
    expected = np.linalg.inv(said.information)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(sampled / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.08)


def test_what_the_image_leaves_open_says_nothing_of_the_wrench_and_the_force_sensor_fills_it():
    # two parallel sides, seen at 30°: the translation along them is open
    direction = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    X_ee_go = se2.inverse(np.array([0.002, 0.043, 0.01]))
    said = from_elasticity(ELASTICITY, X_ee_go, POSE_INFORMATION, GRASP, X_W_GO, LOAD, unobserved=direction[None])
    values = np.linalg.eigvalsh(said.information)
    assert values[0] == pytest.approx(0.0, abs=1e-9 * values[-1]) and values[1] > 1e-3 * values[2]
    # however far the object slides along them, what is known of the wrench stays the same
    slid = se2.compose(0.01 * direction, X_ee_go)
    other = from_elasticity(ELASTICITY, slid, POSE_INFORMATION, GRASP, X_W_GO, LOAD, unobserved=direction[None])
    assert other.information @ other.wrench == pytest.approx(said.information @ said.wrench, rel=1e-6)
    sensor = EnvironmentWrench.of([0.1, 3.0, 0.2], np.diag([1e-2, 1e-2, 1e-4]), said.about)
    joined, again = fuse(said, sensor), fuse(sensor, other)
    assert np.linalg.eigvalsh(joined.information)[0] > 0
    assert joined.wrench == pytest.approx(again.wrench, rel=1e-6, abs=1e-9)


def test_angle_and_translation_that_are_open_together_are_left_out_together():
    direction = np.array([0.6, 0.0, 0.8])  # of (x, y, θ · ANGLE_LENGTH)
    said = from_elasticity(ELASTICITY, se2.inverse(GRASP), POSE_INFORMATION, GRASP, X_W_GO, LOAD, direction[None])
    moved = direction * [1, 1, 1 / ANGLE_LENGTH]
    # at zero wrench x = 0 and ee's axes are gocf's: the wrench that this motion makes, in go
    w = wrenches.rotated(ELASTICITY.wrench(moved), GRASP[2])
    full = from_elasticity(ELASTICITY, se2.inverse(GRASP), POSE_INFORMATION, GRASP, X_W_GO, LOAD)
    assert w @ said.information @ w == pytest.approx(0.0, abs=1e-9 * (w @ full.information @ w))


def test_without_any_observation_there_is_no_contact():
    nothing = from_elasticity(ELASTICITY, se2.inverse(GRASP), np.zeros((3, 3)), GRASP, X_W_GO, LOAD)
    assert ContactLocator(BOX, MU).locate(nothing).status is ContactStatus.NO_WRENCH


def test_fusing_is_the_covariance_weighted_mean_wherever_the_sources_are_given():
    rng = np.random.default_rng(2)
    A, B = np.linalg.inv(random_information(rng)), np.linalg.inv(random_information(rng))
    a, b = rng.normal(size=3), rng.normal(size=3)
    gain = A @ np.linalg.inv(A + B)
    joined = fuse(EnvironmentWrench.of(a, A), EnvironmentWrench.of(b, B).moved_to((0.1, -0.2)))
    assert joined.wrench == pytest.approx(a + gain @ (b - a), rel=1e-6)
    np.testing.assert_allclose(np.linalg.inv(joined.information), A - gain @ A, rtol=1e-6, atol=1e-12)


def test_moving_a_wrench_moves_its_covariance():
    rng = np.random.default_rng(3)
    C = np.linalg.inv(random_information(rng))
    moved = EnvironmentWrench.of([1.0, 2.0, 0.1], C, (0.1, 0.2)).moved_to((-0.1, 0.0))
    # 0.2 m right and up of the new point: τ gains 0.2 fy − 0.2 fx
    A = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.2, 0.2, 1.0]])
    assert moved.wrench == pytest.approx(A @ [1.0, 2.0, 0.1])
    np.testing.assert_allclose(np.linalg.inv(moved.information), A @ C @ A.T, rtol=1e-8)


def test_loosening_adds_a_covariance_and_leaves_the_unobserved_unobserved():
    rng = np.random.default_rng(4)
    H, Q = random_information(rng), np.diag([0.01, 0.02, 1e-4])
    loose = loosened(EnvironmentWrench(np.zeros(3), H, np.zeros(2)), Q).information
    np.testing.assert_allclose(np.linalg.inv(loose), np.linalg.inv(H) + Q, rtol=1e-8)
    seen = np.array([1.0, 2.0, 3.0])
    rank_one = loosened(EnvironmentWrench(np.zeros(3), np.outer(seen, seen), np.zeros(2)), Q).information
    # only seenᵀ w was measured, with variance one; it now has seenᵀ Q seen more
    np.testing.assert_allclose(rank_one, np.outer(seen, seen) / (1 + seen @ Q @ seen), rtol=1e-9)


def test_shapes_and_covariances_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="positive definite"):
        EnvironmentWrench.of(np.zeros(3), np.diag([1.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match=r"expected wrench \(\.\.\., 3\)"):
        EnvironmentWrench(np.zeros(6), np.eye(3), np.zeros(2))
