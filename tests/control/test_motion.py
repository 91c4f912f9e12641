"""Ramps and paths: what reaches the arm, against the boundary conditions they promise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from control.motion import Mover, quintic
from drivers.config import ArmLimits
from drivers.errors import CommandRefused
from drivers.gates import Gates


class Arm:
    def __init__(self):
        self.targets = []

    def command(self, target):
        self.targets.append(target)


class Clock:
    lockstep = True

    def __init__(self):
        self.slept = 0.0

    def now_ns(self):
        return round(self.slept * 1e9)

    def sleep(self, seconds):
        self.slept += seconds


@pytest.fixture
def arm():
    return Arm()


@pytest.fixture
def clock():
    return Clock()


def mover(arm, clock, start=(0.0, 0.0, 0.0), **more):
    return Mover(arm, clock, 50.0, np.array(start), 0.05, **more)


def test_the_ramp_starts_and_ends_at_rest_and_is_symmetric():
    assert quintic(0.0) == (0.0, 0.0)
    assert quintic(1.0) == (1.0, 0.0)
    assert quintic(0.5)[0] == pytest.approx(0.5)
    assert quintic(0.5)[1] == pytest.approx(1.875)  # peak speed of minimum jerk


@given(st.floats(0, 1))
def test_the_slope_is_the_derivative_of_the_position(s):
    h = 1e-6
    assert quintic(s)[1] == pytest.approx((quintic(s + h)[0] - quintic(s - h)[0]) / (2 * h), abs=1e-6)


def test_a_ramp_takes_its_time_and_ends_on_the_goal_at_rest(arm, clock):
    mover(arm, clock).ramp(np.array([0.01, -0.02, 0.3]), 0.2)
    assert clock.slept == pytest.approx(0.2)
    assert arm.targets[-1].pose == pytest.approx([0.01, -0.02, 0.3])
    assert arm.targets[-1].twist == pytest.approx([0.0, 0.0, 0.0])


def test_a_turn_goes_the_short_way(arm, clock):
    mover(arm, clock, (0, 0, 3.0)).ramp(np.array([0.0, 0.0, -3.0]), 0.2)
    assert max(target.pose[2] for target in arm.targets) == pytest.approx(2 * np.pi - 3.0)


def test_twists_integrate_to_the_displacement(arm, clock):
    mover(arm, clock).ramp(np.array([0.05, 0.0, 0.0]), 1.0)
    assert sum(target.twist[0] for target in arm.targets) * 0.02 == pytest.approx(0.05, rel=1e-4)


def test_a_path_passes_through_its_points_in_order(arm, clock):
    path = np.array([[0.01, 0.0, 0.0], [0.01, 0.01, 0.0], [0.0, 0.01, 0.0]])
    mover(arm, clock).through(path, 1.0)
    reached = np.array([target.pose for target in arm.targets])
    assert [np.abs(reached - point).sum(axis=1).argmin() for point in path] == sorted(
        np.abs(reached - point).sum(axis=1).argmin() for point in path
    )
    assert reached[-1] == pytest.approx(path[-1])
    on_the_polyline = np.minimum(
        np.abs(reached[:, 1]), np.minimum(np.abs(reached[:, 0] - 0.01), np.abs(reached[:, 1] - 0.01))
    )
    assert on_the_polyline.max() < 1e-12


def test_resting_repeats_the_set_point(arm, clock):
    mover(arm, clock, (0.1, 0.2, 0.3)).rest(0.1)
    assert len(arm.targets) == 5
    assert all((target.pose == [0.1, 0.2, 0.3]).all() and not target.twist.any() for target in arm.targets)


def test_sequence_numbers_count_up(arm, clock):
    moving = mover(arm, clock)
    moving.rest(0.1)
    moving.ramp(np.array([0.01, 0.0, 0.0]), 0.1)
    assert [target.sequence for target in arm.targets] == list(range(1, 11))


def test_free_motions_keep_to_the_speed(arm, clock):
    mover(arm, clock).travel(np.array([0.1, 0.0, 0.0]))
    assert clock.slept == pytest.approx(2.0)


def test_a_slower_pace_stretches_every_motion_along_the_same_path(arm, clock):
    slow = Mover(arm, clock, 50.0, np.zeros(3), 0.05, pace=0.2)
    slow.ramp(np.array([0.01, 0.0, 0.0]), 0.2)
    assert clock.slept == pytest.approx(1.0)
    assert max(t.twist[0] for t in arm.targets) == pytest.approx(1.875 * 0.01)  # peak of minimum jerk over 1 s
    slow.follow(np.array([0.011, 0.0, 0.0]), np.array([0.05, 0.0, 0.0]))
    assert clock.slept == pytest.approx(1.1)
    assert [t.pose[0] for t in arm.targets[-5:]] == pytest.approx([0.0102, 0.0104, 0.0106, 0.0108, 0.011])
    assert [t.twist[0] for t in arm.targets[-5:]] == pytest.approx([0.01] * 5)
    slow.rest(0.1)
    assert clock.slept == pytest.approx(1.2)


class WallClock(Clock):
    """Time that passes by itself, too: while a set-point is on its way."""

    lockstep = False


class SlowArm(Arm):
    def __init__(self, clock, takes):
        super().__init__()
        self.clock, self.takes, self.at = clock, takes, []

    def command(self, target):
        self.at.append(self.clock.slept)
        self.clock.slept += self.takes.pop(0) if self.takes else 0.004
        super().command(target)


def test_in_real_time_what_a_set_point_takes_does_not_slow_the_motion_down():
    clock = WallClock()
    arm = SlowArm(clock, [])
    mover(arm, clock).ramp(np.array([0.01, 0.0, 0.0]), 1.0)
    assert len(arm.targets) == 50
    assert arm.at[-1] - arm.at[0] == pytest.approx(49 * 0.02, abs=0.005)


def test_in_real_time_each_set_point_has_its_period_after_a_pause_too():
    clock = WallClock()
    arm = SlowArm(clock, [])
    moving = mover(arm, clock)
    for _ in range(2):
        clock.slept += 1.0  # somebody plans
        moving.ramp(np.array([0.01, 0.0, 0.0]), 0.2)
    gaps = np.diff(arm.at)
    assert np.delete(gaps, 9) == pytest.approx([0.02] * 18)
    assert gaps[9] > 1.0


def test_in_real_time_a_long_delay_is_not_made_up_for():
    clock = WallClock()
    arm = SlowArm(clock, [0.004, 0.004, 0.3])
    mover(arm, clock).ramp(np.array([0.01, 0.0, 0.0]), 0.2)
    after = np.diff(arm.at)[3:]
    assert (after >= 0.02 - 1e-9).all()


class GatedArm(Arm):
    """An arm behind its server's gates, whose watchdog holds it while no set-point comes."""

    def __init__(self, clock, **limits):
        super().__init__()
        self.clock, self.gates = clock, Gates("arm", ArmLimits(hold_after=0.1, **limits))
        self.gates.restart(0, np.zeros(3))
        self.stalls = {}  # how long set-points are under way [s], by their sequence numbers

    def command(self, target):
        sent_ns = self.clock.now_ns()
        self.clock.slept += self.stalls.get(target.sequence, 0.0)
        now_ns = self.clock.now_ns()
        self.gates.watch(now_ns)
        if self.gates.stopped:
            raise CommandRefused("arm", "command a set-point", self.gates.stopped)
        self.gates.admit(target, sent_ns, now_ns)
        self.gates.accept(target, now_ns)
        super().command(target)


def held_up(clock, at, seconds):
    """A tick after which, at set-point ``at``, the commander is held up for so long."""
    ticks = iter(range(1, 1000))

    def tick():
        if next(ticks) == at:
            clock.slept += seconds

    return tick


MOTIONS = {
    "ramp": lambda moving: moving.ramp(np.array([0.08, 0.0, 0.4]), 1.0),
    "path": lambda moving: moving.through(np.array([[0.04, 0.0, 0.2], [0.08, 0.0, 0.4]]), 1.0),
}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("at", [3, 17, 25, 26, 40, 49])
def test_a_motion_whose_commander_was_held_up_goes_on_from_rest_along_its_path(motion, at):
    clock, told = WallClock(), []
    arm = GatedArm(clock, acceleration=2.0)
    moving = mover(arm, clock, tick=held_up(clock, at, 0.3), event=lambda *said: told.append(said))
    MOTIONS[motion](moving)
    x = np.array([target.pose[0] for target in arm.targets])
    assert (np.diff(x) > 0).all() and x[-1] == pytest.approx(0.08)
    assert arm.targets[-1].twist == pytest.approx([0, 0, 0], abs=1e-9)
    refused = arm.gates.summary()["refused"]
    assert refused in ({}, {"motion": 1})  # slow as it is at the ends, no gate minds
    assert len(told) == sum(refused.values())
    # what the twists say is where the next set-points are; only of where it halted, it is not
    means, twists = np.diff(x) / 0.02, np.array([target.twist[0] for target in arm.targets])
    off = np.abs(means - (twists[1:] + twists[:-1]) / 2) > 0.015
    assert set(np.flatnonzero(off)) <= ({at - 1} if refused else set())
    if 17 <= at <= 26:
        assert refused and "halted in the midst of a motion, 0.3 s late" in told[0][1]


def test_a_motion_goes_on_too_when_it_was_a_set_point_on_its_way_that_was_held_up():
    clock, told = WallClock(), []
    arm = GatedArm(clock, acceleration=2.0, age=0.2)
    arm.stalls = {25: 0.3}
    mover(arm, clock, event=lambda *said: told.append(said)).ramp(np.array([0.08, 0.0, 0.4]), 1.0)
    assert arm.gates.summary()["refused"] == {"age": 1}
    assert len(told) == 1 and "it was sent 0.30 s ago" in told[0][1]
    assert arm.targets[-1].pose == pytest.approx([0.08, 0.0, 0.4])


def test_a_short_delay_that_nobody_held_the_arm_for_costs_nothing():
    clock = WallClock()
    arm = GatedArm(clock)
    mover(arm, clock, tick=held_up(clock, 25, 0.08)).ramp(np.array([0.08, 0.0, 0.0]), 1.0)
    assert len(arm.targets) == 50 and not arm.gates.summary()["refused"]


def test_what_is_refused_for_another_reason_is_raised():
    clock = WallClock()
    arm = GatedArm(clock, x=(-0.04, 0.04))
    with pytest.raises(CommandRefused, match="outside the workspace"):
        mover(arm, clock).ramp(np.array([0.08, 0.0, 0.0]), 1.0)
    assert arm.gates.summary()["refused"] == {"workspace": 1}


def test_a_stop_that_came_while_the_commander_was_held_up_is_raised():
    clock, told = WallClock(), []
    arm = GatedArm(clock, stop_after=0.2)
    moving = mover(arm, clock, tick=held_up(clock, 25, 0.3), event=lambda *said: told.append(said))
    with pytest.raises(CommandRefused, match=r"no set-point for 0\.3"):
        moving.ramp(np.array([0.08, 0.0, 0.0]), 1.0)
    assert not told


def test_going_above_sweeps_nothing_off_the_table(arm, clock):
    mover(arm, clock, (0.0, 0.1, 0.0)).go_above(np.array([0.02, 0.05, 0.1]))
    poses = np.array([target.pose for target in arm.targets])
    assert poses[-1] == pytest.approx([0.02, 0.05, 0.1])
    assert (poses[poses[:, 0] < 0.02 - 1e-9, 1] == 0.1).all(), "it goes across before it goes down"
