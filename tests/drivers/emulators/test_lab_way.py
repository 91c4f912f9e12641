"""The way that the emulated robot leads the plant: what is a motion, and what is only a robot that holds its pose."""

import numpy as np

from drivers.emulators.lab import _Way

SPAN = 0.004


def walked(poses):
    """How often the way along ``poses`` (n, 3), one each 4 ms, set out."""
    way, count = _Way(0.0, poses[0]), 0
    for i, pose in enumerate(poses[1:], 1):
        way.told(i * SPAN, pose)
        way.ahead(SPAN)
        count += way.sets_out(SPAN)
    return count


def ramp(start, goal, seconds):
    s = np.linspace(0, 1, round(seconds / SPAN))[:, None]
    return start + (goal - start) * s**3 * (10 - 15 * s + 6 * s * s)


def wobbling(pose, seconds, seed=0):
    """A robot that holds its pose: micrometres, and a sag that friction lets go slowly."""
    n = round(seconds / SPAN)
    sag = np.linspace(0, 5e-5, n)[:, None] * [0, -1, 0]
    return pose + sag + np.random.default_rng(seed).normal(0, [5e-6, 5e-6, 2e-5], (n, 3))


HERE, THERE = np.array([0.0, 0.15, 0.2]), np.array([0.004, 0.149, 0.25])


def test_a_robot_that_holds_its_pose_sets_out_on_nothing():
    assert walked(wobbling(HERE, 5.0)) == 0


def test_each_motion_sets_out_once_however_long_it_takes():
    for seconds in (0.2, 2.0):
        way = [wobbling(HERE, 0.5), ramp(HERE, THERE, seconds), wobbling(THERE, 0.5), ramp(THERE, HERE, seconds)]
        assert walked(np.concatenate([*way, wobbling(HERE, 0.5)])) == 2


def test_a_turn_alone_is_a_motion():
    turned = HERE + np.array([0, 0, 0.05])
    assert walked(np.concatenate([wobbling(HERE, 0.5), ramp(HERE, turned, 0.3), wobbling(turned, 0.5)])) == 1
