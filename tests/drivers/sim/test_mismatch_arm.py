"""Where the arm truly is: bias, repeatability and lag, by the figures of the profile."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from drivers.interfaces import ArmTarget
from drivers.sim.arm import BUILD_UP
from drivers.sim.mismatch import Lab

from .profiles import about, device, move, profile, sigma_of


def test_bias_stands_between_the_reported_and_the_true_pose(world_of):
    figures = profile(arm={"bias": {"xy_mm": [0.3, 0.25], "angle_deg": 0.2}})
    size = np.array([0.3e-3, 0.25e-3, np.radians(0.2)])
    biases = np.array([Lab(figures, seed).arm_bias for seed in range(400)]) / size
    assert [sigma_of(column) for column in biases.T] == [about(1, 400)] * 3
    world = world_of(figures, seed=7)
    for pose in ((0.0, 0.3, 0.0), (0.05, 0.32, 0.2)):
        move(world, pose)
        off = world.truth().ee - device(world, "arm").latest().pose
        np.testing.assert_allclose(off, Lab(figures, 7).arm_bias, atol=1e-12)
        np.testing.assert_allclose(device(world, "arm").latest().pose, pose, atol=1e-12)


REPEAT = {"repeatability": {"xy_mm": [0.05, 0.04], "angle_deg": 0.03}}
REPEAT_SI = np.array([0.05e-3, 0.04e-3, np.radians(0.03)])


def test_each_motion_ends_elsewhere_within_the_repeatability(world_of):
    world = world_of(profile(arm=REPEAT))
    arm, plant, off = device(world, "arm"), world.plant(), []
    plant.step = lambda *_: None  # only the arm is asked
    with arm.lease("test"):
        for i in range(300):
            arm.command(ArmTarget(np.array([0.01 * (i % 2), 0.3, 0.0]), np.zeros(3), 0.2))
            world.advance(0.21)
            off.append(np.subtract(arm.true_pose, arm.pose))
    off = np.array(off) / REPEAT_SI
    assert [sigma_of(column) for column in off.T] == [about(1, 300)] * 3
    assert np.abs(np.mean(off[1:] * off[:-1], axis=0)).max() < 4 / sqrt(300), "motions are independent"


def test_while_the_arm_rests_its_error_stays(world_of):
    world = world_of(profile(arm=REPEAT))
    move(world, (0.01, 0.3, 0.0))
    first = world.truth().ee
    move(world, (0.01, 0.3, 0.0), (0.01, 0.3, 0.0))
    np.testing.assert_array_equal(world.truth().ee, first)
    device(world, "arm").hold()
    world.advance(0.1)
    np.testing.assert_array_equal(world.truth().ee, first)


def test_a_streamed_motion_is_one_motion(world_of):
    world = world_of(profile(arm=REPEAT))
    arm, draws = device(world, "arm"), []
    arm._leave_rest = lambda leave=arm._leave_rest: (draws.append(1), leave())
    goal = np.zeros(3)
    with arm.lease("test"):
        for i in range(1, 51):
            s = i / 50
            goal = np.array([0.02 * s * s * (3 - 2 * s), 0.3, 0.0])
            arm.command(ArmTarget(goal, np.array([0.02 * 6 * s * (1 - s), 0.0, 0.0]), 0.02))
            world.advance(0.02)
        for _ in range(10):
            arm.command(ArmTarget(goal, np.zeros(3), 0.02))
            world.advance(0.02)
    assert len(draws) == 1


def test_the_true_twist_is_the_rate_of_the_true_pose(world_of):
    world = world_of(profile(arm=REPEAT | {"lag": 0.02}))
    arm, path = device(world, "arm"), []
    with arm.lease("test"):
        arm.command(ArmTarget(np.array([0.002, 0.301, 0.01]), np.zeros(3), 0.3))
        for _ in range(600):
            arm.advance(0.001)
            path.append((arm.true_pose, arm.true_twist))
    poses, twists = np.array(path).transpose(1, 0, 2)
    steps = np.diff(poses, axis=0) / 0.001
    np.testing.assert_allclose(0.5 * (twists[1:] + twists[:-1]), steps, atol=0.01 * np.abs(twists).max())
    # and nothing jumps: no step is longer than the fastest speed allows
    assert np.abs(steps).max() <= 1.05 * np.abs(twists).max()


def test_repeatability_is_paired_over_the_trials_of_one_number(world_of):
    world = world_of(profile(arm=REPEAT))

    def ends(trial: int) -> np.ndarray:
        world.regrasp(trial)
        out = []
        for x in (0.01, 0.02, 0.0):
            move(world, (x, 0.3, 0.0))
            out.append(world.truth().ee)
        return np.array(out)

    first, other, again = ends(4), ends(5), ends(4)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_lagging_arm_follows_as_a_first_order_system(world_of):
    lag, speed = 0.02, 0.05
    world = world_of(profile(arm={"lag": lag}))
    arm, reported = device(world, "arm"), []
    with arm.lease("test"):
        # the aim runs along v (2 t² − t³): at t = 1 its derivatives are v, −2 v and −6 v
        arm.command(ArmTarget(np.array([speed, 0.3, 0.0]), np.array([speed, 0.0, 0.0]), 1.0))
        for _ in range(1000):
            arm.advance(0.001)
            reported.append(arm.pose[0])
        aim = arm._aim[0]
        assert aim - reported[-1] == pytest.approx(speed * lag * (1 + 2 * lag - 6 * lag**2), rel=1e-4)
        # the set-point stops; what is left decays with the time constant, and never overshoots
        left = []
        for _ in range(800):
            arm.advance(0.001)
            left.append(arm._aim[0] - arm.pose[0])
    assert left[20] / left[0] == pytest.approx(np.exp(-1), rel=1e-6)
    assert min(left) >= 0 and left[-1] == 0
    np.testing.assert_array_equal(arm.true_pose, arm.pose)


def test_a_lagging_arm_that_is_stopped_stays_where_it_is(world_of):
    world = world_of(profile(arm={"lag": 0.05} | REPEAT))
    arm = device(world, "arm")
    with arm.lease("test"):
        arm.command(ArmTarget(np.array([0.05, 0.3, 0.0]), np.zeros(3), 0.3))
        world.advance(BUILD_UP / 2)
        arm.stop()
        here = arm.true_pose
        world.advance(0.2)
        assert arm.true_pose == here and arm.true_twist == (0.0, 0.0, 0.0)
        arm.recover()
