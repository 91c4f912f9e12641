"""The contract of the arms: every backend keeps it. What every device has to keep is in `test_devices`."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from drivers.errors import CommandRefused
from drivers.interfaces import ArmTarget
from tests.conformance.lab import about, live, replayed

pytestmark = pytest.mark.alone

HOME, THERE = np.array([0.0, 0.25, 0.1]), np.array([0.02, 0.26, 0.2])
#: how long a real arm may take over a motion and to be still [s]
_PATIENCE = 30.0


def at_rest(lab, arm):
    """Where the arm is once it moves no more."""
    lab.clock.sleep(0.6)
    if lab.simulation is not None:
        return arm.latest().pose
    deadline = time.monotonic() + _PATIENCE
    before = arm.latest()
    while time.monotonic() < deadline:
        lab.clock.sleep(0.3)
        now = arm.latest()
        # the robot's own time: one that runs late has not gone on yet
        if now.stamp.sequence >= before.stamp.sequence + 20:
            if np.abs(now.pose - before.pose).max() < 1e-4:
                return now.pose
            before = now
    raise AssertionError("the arm does not come to rest")


@pytest.fixture
def arm(lab):
    """The arm, at rest where it was at first."""
    arm = lab.of("arm")
    if lab.simulation is None and np.abs(at_rest(lab, arm) - HOME).max() > 1e-3:
        with arm.lease("fixture"):
            arm.command(ArmTarget(HOME, np.zeros(3), 1.0))
            at_rest(lab, arm)
    return arm


def reached(lab, arm, pose):
    """Whether the arm rests at ``pose``, as well as it can."""
    return (np.abs(at_rest(lab, arm) - pose) <= lab.accuracy).all()


def stays_on_the_way(lab, arm) -> bool:
    """Whether the arm rests, away from both ends of the motion it was on."""
    here = at_rest(lab, arm)
    lab.clock.sleep(0.3)
    still = np.abs(arm.latest().pose - here).max() < (1e-9 if lab.simulation is not None else 1e-4)
    margin = 0.001 if lab.simulation is not None else 0.0005
    return margin < here[0] < 0.02 - margin and bool(still)


def half_way(lab, arm):
    """Let the arm get half-way to `THERE`."""
    if lab.simulation is not None:
        lab.clock.sleep(0.25)
        return
    deadline = time.monotonic() + _PATIENCE
    while arm.latest().pose[0] < 0.008 and time.monotonic() < deadline:
        lab.clock.sleep(0.005)


@about("arm")
@live
def test_arm_goes_to_its_target(lab, arm):
    with arm.lease("test"):
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        assert reached(lab, arm, THERE)


@about("arm")
def test_command_without_the_lease_is_refused(lab, arm):
    before = at_rest(lab, arm)
    with pytest.raises(CommandRefused) as caught:
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
    assert caught.value.device == "arm" and "lease" in caught.value.reason
    assert reached(lab, arm, before)
    if lab.simulation is not None:
        np.testing.assert_allclose(arm.latest().pose, HOME, atol=1e-9)


@about("arm")
def test_second_commander_is_refused(lab, arm):
    with arm.lease("first"), lab.join() as other, pytest.raises(CommandRefused):
        other.of("arm").acquire("second")
    with lab.join() as other, other.of("arm").lease("second"):
        pass


@about("arm")
@replayed
def test_a_recorded_arm_refuses_to_move(lab):
    arm = lab.of("arm")
    with arm.lease("test"), pytest.raises(CommandRefused, match="a recording does not move"):
        arm.command(ArmTarget(arm.latest(10.0).pose, np.zeros(3), 0.5))


@about("arm")
@live
def test_not_finite_is_refused_and_changes_nothing(lab, arm):
    parts = {"pose": THERE, "twist": np.zeros(3), "duration": 0.5}
    with arm.lease("test"):
        arm.command(ArmTarget(**parts))
        for bad in (math.nan, math.inf, -math.inf):
            broken = {"pose": np.array([0.0, bad, 0.0]), "twist": np.array([0.0, 0.0, bad]), "duration": bad}
            for place, value in broken.items():
                with pytest.raises(CommandRefused):
                    arm.command(ArmTarget(**(parts | {place: value})))
        assert reached(lab, arm, THERE)


@about("arm")
@live
def test_stop_latches_until_recover(lab, arm):
    with arm.lease("test"):
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        half_way(lab, arm)
        arm.stop()
        assert stays_on_the_way(lab, arm)
        with pytest.raises(CommandRefused):
            arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        arm.recover()
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        assert reached(lab, arm, THERE)


@about("arm")
@live
@pytest.mark.parametrize("verb", ["stop", "hold"])
def test_stop_and_hold_need_no_lease(lab, arm, verb):
    with lab.join() as other, arm.lease("test"):
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        half_way(lab, arm)
        getattr(other.of("arm"), verb)()
        assert stays_on_the_way(lab, arm)


@about("arm")
@live
def test_hold_lets_the_next_command_pass(lab, arm):
    with arm.lease("test"):
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        half_way(lab, arm)
        arm.hold()
        assert stays_on_the_way(lab, arm)
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        assert reached(lab, arm, THERE)


@about("arm")
@live
def test_end_of_the_lease_holds_the_arm(lab, arm):
    with arm.lease("test"):
        arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
        half_way(lab, arm)
    assert stays_on_the_way(lab, arm)


@about("arm")
@live
def test_closing_leaves_the_arm_held(lab, arm):
    arm.acquire("test")
    arm.command(ArmTarget(THERE, np.zeros(3), 0.5))
    half_way(lab, arm)
    arm.close()
    arm.close()
    lab.clock.sleep(0.1)
    arm.connect()
    assert stays_on_the_way(lab, arm)
    with arm.lease("another"):
        pass
