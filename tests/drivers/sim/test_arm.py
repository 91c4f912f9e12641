"""The simulated arm follows its set-points, holds, stops, and belongs to one commander."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.config import ArmConfig
from drivers.errors import CommandRefused, NotConnected
from drivers.interfaces import ArmTarget
from drivers.sim.arm import SimArm
from drivers.sim.mismatch import Mismatch

REST = (0.0, 0.0, 0.0)


class Stage:
    """A world that has a scene and no plant."""

    lockstep, profile, timestep_ns = True, Mismatch(), 1_000_000

    def now_ns(self):
        return 0

    def plant(self, device, asked):
        return self


@pytest.fixture
def arm():
    return opened()


def opened() -> SimArm:
    arm = SimArm("arm", ArmConfig(kind="arm"), Stage())  # pyright: ignore[reportArgumentType]
    arm.connect()
    arm.acquire("test")
    return arm


def target(pose, twist=REST, duration=0.1) -> ArmTarget:
    return ArmTarget(np.array(pose, float), np.array(twist, float), duration)


def follow(arm: SimArm, seconds: float, dt: float = 0.001) -> np.ndarray:
    """Poses and twists (n, 2, 3) at each step."""
    out = []
    for _ in range(round(seconds / dt)):
        arm.advance(dt)
        out.append((arm.pose, arm.twist))
    return np.array(out)


poses = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-1, 1))
twists = st.tuples(*3 * [st.floats(-0.5, 0.5)])


@given(first=poses, second=poses, v1=twists, v2=twists)
def test_motion_is_smooth_and_meets_pose_and_twist_of_every_target(first, second, v1, v2):
    arm = opened()
    arm.command(target(first, v1))
    path = follow(arm, 0.1)
    np.testing.assert_allclose(path[-1], [first, v1], atol=1e-9)
    arm.command(target(second, v2))
    path = np.concatenate([path, follow(arm, 0.1)])
    np.testing.assert_allclose(path[-1], [second, v2], atol=1e-9)
    # C1: the twist is the derivative of the pose (trapezium rule), across the change of target as well
    integrated = np.cumsum(0.5 * (path[1:, 1] + path[:-1, 1]) * 0.001, axis=0)
    np.testing.assert_allclose(path[1:, 0] - path[0, 0], integrated, atol=1e-3)
    speed_jumps = np.abs(np.diff(path[:, 1], axis=0)).max()
    accelerations = [np.abs(6 * np.subtract(b, a)) / 0.01 + 100 for a, b in (((0, 0, 0), first), (first, second))]
    assert speed_jumps < 0.001 * np.max(accelerations) * 2


def test_arm_rests_on_the_last_target_without_overshoot(arm):
    arm.command(target((0.01, 0.0, 0.0), (0.1, 0.0, 0.0)))
    path = follow(arm, 0.5)
    assert path[:, 0, 0].max() <= 0.01 + 1e-12
    np.testing.assert_array_equal(path[-1], [(0.01, 0.0, 0.0), REST])


def test_arm_turns_the_short_way(arm):
    arm.place((0.0, 0.0, 3.0))
    arm.command(target((0.0, 0.0, -3.0)))
    path = follow(arm, 0.1)
    assert path[-1, 0, 2] == pytest.approx(2 * math.pi - 3.0)


@pytest.mark.parametrize("command", ["hold", "stop", "release", "close"])
def test_arm_stays_where_it_is_when_told(arm, command):
    arm.command(target((0.1, 0.0, 0.0)))
    here = follow(arm, 0.05)[-1, 0]
    getattr(arm, command)()
    after = follow(arm, 0.2)
    np.testing.assert_array_equal(after[:, 0], np.broadcast_to(here, after[:, 0].shape))
    np.testing.assert_array_equal(after[:, 1], 0.0)


def test_hold_does_not_refuse_what_comes_next_but_stop_does(arm):
    arm.hold()
    arm.command(target((0.1, 0.0, 0.0)))
    arm.stop()
    with pytest.raises(CommandRefused, match="stopped"):
        arm.command(target((0.1, 0.0, 0.0)))
    arm.recover()
    arm.command(target((0.1, 0.0, 0.0)))
    np.testing.assert_allclose(follow(arm, 0.1)[-1, 0], [0.1, 0.0, 0.0])


def test_lease_belongs_to_one(arm):
    arm.acquire("test")
    with pytest.raises(CommandRefused, match="'test' holds the lease") as caught:
        arm.acquire("other")
    assert caught.value.device == "arm"
    arm.release()
    arm.release()
    with pytest.raises(CommandRefused, match="no lease"):
        arm.command(target(REST))
    arm.acquire("other")
    arm.command(target(REST))


def test_closing_gives_the_lease_back(arm):
    arm.close()
    with pytest.raises(NotConnected):
        arm.command(target(REST))
    arm.connect()
    arm.acquire("other")


@pytest.mark.parametrize(
    ("pose", "twist", "duration"),
    [
        ((math.nan, 0, 0), REST, 0.1),
        ((0, math.inf, 0), REST, 0.1),
        (REST, (0, 0, math.nan), 0.1),
        (REST, REST, math.nan),
        (REST, REST, 0.0),
        (REST, REST, -1.0),
        ((0.0, 0.0), REST, 0.1),
    ],
)
def test_set_points_without_meaning_are_refused_and_change_nothing(arm, pose, twist, duration):
    arm.command(target((0.1, 0.0, 0.0)))
    with pytest.raises(CommandRefused):
        arm.command(target(pose, twist, duration))
    np.testing.assert_allclose(follow(arm, 0.1)[-1, 0], [0.1, 0.0, 0.0])
