"""How the object lies in the fingers: anew in each trial, by the figures of the profile."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from scipy.stats import kstest

from drivers.errors import CommandRefused
from drivers.sim.mismatch import Lab, Mismatch, load_profile
from mechanics import se2

from .profiles import move, profile

GRASP = {"offset": {"xy_mm": [1.45, 1.0], "angle_deg": 1.8}, "spread": 0.25}
SIZES = np.array([1.45e-3, 1.0e-3, np.radians(1.8)])


@pytest.mark.parametrize("seed", [0, 1, 17])
def test_eight_trials_go_through_the_eight_octants(seed):
    lab = Lab(profile(grasp=GRASP), seed)
    offsets = np.array([lab.grasp_offset(trial) for trial in range(16)])
    for eight in (offsets[:8], offsets[8:]):
        assert len({tuple(np.sign(offset)) for offset in eight}) == 8
    assert len(np.unique(offsets[:, 0])) == 16


def test_the_order_of_the_octants_is_the_seeds():
    signs = {
        tuple(np.sign(Lab(profile(grasp=GRASP), seed).grasp_offset(trial)).tobytes() for trial in range(8))
        for seed in range(20)
    }
    assert len(signs) == 20


def test_sizes_of_the_grasp_spread_evenly_about_the_figure():
    lab = Lab(profile(grasp=GRASP), 0)
    ratio = np.abs([lab.grasp_offset(trial) for trial in range(400)]) / SIZES
    for column in ratio.T:
        assert kstest(column, "uniform", (0.75, 0.5)).pvalue > 1e-4
    assert np.abs(np.corrcoef(ratio.T) - np.eye(3)).max() < 0.2


def test_a_new_grasp_moves_the_object_in_the_fingers_by_the_draw_in_no_time(world_of):
    figures = profile(grasp=GRASP)
    world = world_of(figures)
    world.advance(0.1)
    before, now = world.truth(), world.now_ns()
    world.regrasp(2)
    assert world.now_ns() == now
    offset = Lab(figures, 0).grasp_offset(2)
    gocf = se2.compose(se2.compose(world.truth().go, np.array([0.0, 0.045, 0.0])), offset)
    nominal = se2.compose(before.go, np.array([0.0, 0.045, 0.0]))
    # the frame in which the fingers rest is where it was; the object under it has moved. What the other lever of the
    # weight turns is a third of a degree
    np.testing.assert_allclose(gocf[:2], nominal[:2], atol=5e-5)
    assert abs(gocf[2] - nominal[2]) < np.radians(0.5)


def test_after_a_new_grasp_the_object_hangs_at_rest(world_of):
    figures = profile(
        grasp=GRASP, membrane={"stiffening": 26.7, "hysteresis": 0.2, "yield_length": 6e-4}, stiffness={"error": 0.05}
    )
    world = world_of(figures)
    world.advance(0.1)
    world.regrasp(5)
    before = world.truth()
    world.advance(0.5)
    np.testing.assert_allclose(world.truth().go, before.go, atol=1e-9)


def test_what_a_trial_draws_does_not_hang_on_what_ran_before(world_of):
    figures = load_profile("lab")

    def poses_after(*trials: int) -> tuple[np.ndarray, np.ndarray]:
        world = world_of(figures)
        for trial in trials:
            world.regrasp(trial)
            move(world, (0.001 * trial, 0.29, 0.02 * trial))
        world.regrasp(3)
        move(world, (0.01, 0.29, 0.0), (0.0, 0.3, 0.0))
        return world.truth().ee, world.truth().go

    (ee, go), (ee_later, go_later) = poses_after(), poses_after(0, 7)
    np.testing.assert_allclose(ee_later, ee, atol=1e-12)
    # what is left is the membrane's memory of how the hand was held when it closed
    np.testing.assert_allclose(go_later, go, atol=5e-4)
    np.testing.assert_allclose(go_later[:2], go[:2], atol=5e-5)


def test_other_trials_and_other_seeds_grasp_otherwise(world_of):
    world = world_of(load_profile("lab"))
    poses = []
    for seed, trial in ((0, 0), (0, 1), (0, 8), (1, 0)):
        world.reset(seed, world.scene)
        world.regrasp(trial)
        poses.append(se2.between(world.truth().ee, world.truth().go))
    assert min(np.abs(a - b).max() for i, a in enumerate(poses) for b in poses[:i]) > 1e-5


def test_a_new_grasp_that_would_hit_the_table_is_refused_and_changes_nothing(world_of):
    world = world_of(profile(grasp={"offset": {"xy_mm": [0, 5]}}), start=(0.0, 0.122, 0.0))
    before = world.truth()
    low = next(trial for trial in range(8) if Lab(world.profile, 0).grasp_offset(trial)[1] > 0)
    with pytest.raises(CommandRefused, match="go and ground would overlap"):
        world.regrasp(low)
    world.advance(0.01)
    np.testing.assert_allclose(world.truth().go, before.go, atol=1e-12)
    with pytest.raises(CommandRefused, match="Trials count from 0"):
        world.regrasp(-1)


def test_the_true_wrench_is_about_the_grasp_centre_that_plans_speak_of(world_of):
    world = world_of(profile(grasp=GRASP))
    world.regrasp(0)
    truth = world.truth()
    # only the weight: its moment about the point 45 mm up the object's axis, wherever the fingers truly hold it
    lever = truth.go[0] - se2.compose(truth.go, np.array([0.0, 0.045, 0.0]))[0]
    np.testing.assert_allclose(truth.wrench, [0.0, 0.981, lever * 0.981], atol=1e-9)


def test_handling_leaves_strains_that_fill_the_yield_ellipsoid_evenly():
    lab = Lab(profile(membrane={"hysteresis": 0.2, "yield_length": 6e-4}), 0)
    strains = np.array([lab.membrane_strain(trial) for trial in range(500)])
    # the share of a ball within r is r³
    assert kstest(np.linalg.norm(strains, axis=1) ** 3, "uniform").pvalue > 1e-4
    assert np.abs(strains.mean(axis=0)).max() < 4 * sqrt(1 / 5 / 500)
    assert not Lab(Mismatch(), 0).membrane_strain(0).any()
