"""What the gates of an arm let pass and what stops it, with the times, set-points and forces made up by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from drivers.config import ArmLimits
from drivers.errors import CommandRefused, DeviceTimeout, DriverError
from drivers.gates import CONFIRMED, Gates
from drivers.interfaces import ArmTarget
from mechanics.readings import Stamp, Status, WrenchReading

MS = 1_000_000
S = 1_000 * MS
HOME = (0.0, 0.2, 0.0)
REST = (0.0, 0.0, 0.0)


def gates(witnesses: dict[str, float | None] | None = None, patience: float = 0.0, **limits: Any) -> Gates:
    made = Gates("arm", ArmLimits(**limits), witnesses, patience)
    made.restart(0, np.array(HOME))
    made.begin()
    return made


def to(pose: Any = HOME, twist: Any = REST, duration: float = 0.1, sequence: int = 0) -> ArmTarget:
    return ArmTarget(np.array(pose, float), np.array(twist, float), duration, sequence)


def go(gate: Gates, target: ArmTarget, now_ns: int = 0) -> None:
    gate.admit(target, now_ns, now_ns)
    gate.accept(target, now_ns)


def wrench(ns: int, force: Any = (0, 0, 0), torque: Any = (0, 0, 0), status: Status = Status.OK) -> WrenchReading:
    return WrenchReading(Stamp(ns, ns, ns // MS, "wrist_ft", status), np.array([*force, *torque], float))


# -- set-points --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused_and_counted(place: int, bad: float) -> None:
    numbers = [*HOME, *REST, 0.1]
    numbers[place] = bad
    gate = gates()
    with pytest.raises(CommandRefused, match="not finite"):
        gate.admit(to(numbers[:3], numbers[3:6], numbers[6]), 0, 0)
    assert gate.summary()["refused"] == {"finite": 1}
    assert gate.summary()["accepted"] == 0


def test_a_replayed_set_point_is_refused_and_a_new_commander_counts_anew() -> None:
    gate = gates()
    go(gate, to(sequence=4))
    with pytest.raises(CommandRefused, match="target 4 came after 4"):
        gate.admit(to(sequence=4), 0, 0)
    gate.begin()
    go(gate, to(sequence=0))


@pytest.mark.parametrize(("sent_ns", "said"), [(0, "0.30 s ago"), (600 * MS, "0.30 s in the future")])
def test_a_set_point_of_another_time_is_refused(sent_ns: int, said: str) -> None:
    with pytest.raises(CommandRefused, match=said):
        gates(age=0.2).admit(to(), sent_ns, 300 * MS)


@pytest.mark.parametrize(
    ("pose", "said"),
    [((0.11, 0.2, 0), "x = 0.11 m"), ((0, 0.04, 0), "y = 0.04 m"), ((0, 0.2, math.radians(31)), "the angle = 31 deg")],
)
def test_outside_the_workspace_is_refused_by_name(pose: Any, said: str) -> None:
    gate = gates(x=(-0.1, 0.1), y=(0.05, 0.3), angle_deg=(-30, 30), step_mm=1e3, step_deg=90)
    with pytest.raises(CommandRefused, match=said):
        gate.admit(to(pose, duration=10), 0, 0)
    assert gate.summary()["refused"] == {"workspace": 1}


def test_what_the_joints_cannot_do_is_refused_in_the_backends_words() -> None:
    gate = Gates("arm", ArmLimits(), {}, 0.0, lambda pose: "joint 4 ends at -3.07 rad" if pose[0] > 0.05 else "")
    gate.restart(0, np.array(HOME))
    go(gate, to((0.04, 0.2, 0), duration=1))
    with pytest.raises(CommandRefused, match="joint 4 ends"):
        gate.admit(to((0.06, 0.2, 0), duration=1, sequence=1), 0, 0)


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (to((0.06, 0.2, 0), duration=10), "step of 0.06 m, the limit is 0.05 m"),
        (to((0, 0.2, math.radians(31)), duration=10), "turning step of 31 deg"),
        (to((0.03, 0.2, 0), duration=0.1), "speed of 0.3 m/s, the limit is 0.25 m/s"),
        (to(HOME, (0.3, 0, 0), 10), "speed of 0.3 m/s"),
        (to((0, 0.2, math.radians(20)), duration=0.1), "turning speed of 200 deg/s"),
        (to(HOME, (0.2, 0, 0), 0.02), "acceleration of 10 m/s²"),
        (to((0.002, 0.2, 0), duration=0.02), "acceleration of 10 m/s²"),  # 2 s / T² from rest
        (to(HOME, (0, 0, math.radians(100)), 0.02), "turning acceleration of 5e+03 deg/s²"),
    ],
)
def test_a_motion_that_is_too_harsh_is_refused_with_its_figure(target: ArmTarget, said: str) -> None:
    gate = gates()
    with pytest.raises(CommandRefused, match=said.replace("+", r"\+")):
        gate.admit(target, 0, 0)
    assert gate.summary()["refused"] == {"motion": 1}


def test_without_a_reading_of_the_arm_nothing_moves() -> None:
    gate = Gates("arm", ArmLimits())
    with pytest.raises(CommandRefused, match="has not told where it is"):
        gate.admit(to(), 0, 0)


def test_a_step_is_measured_from_the_set_point_before_and_after_a_hold_from_the_arm() -> None:
    gate = gates(step_mm=10)
    go(gate, to((0.01, 0.2, 0), duration=1))
    go(gate, to((0.02, 0.2, 0), duration=1, sequence=1))
    gate.at(np.array([0.001, 0.2, 0.0]))
    gate.rested()
    with pytest.raises(CommandRefused, match=r"step of 0\.029"):
        gate.admit(to((0.03, 0.2, 0), duration=1, sequence=2), 0, 0)


def test_an_angle_is_measured_the_short_way_round() -> None:
    gate = gates(angle_deg=(-200, 200), step_deg=5)
    gate.restart(0, np.array([0, 0.2, math.radians(179)]))
    go(gate, to((0, 0.2, math.radians(-179)), duration=1))


def cubic(start: Any, speed: Any, target: ArmTarget, at: float) -> tuple[Any, Any]:
    """Where an arm is that follows scipy's cubic Hermite spline from (start, speed) to the target, and how fast."""
    goal = CubicHermiteSpline([0, target.duration], [start, target.pose], [speed, target.twist])
    return goal(at), goal(at, 1)


def test_a_set_point_in_the_place_of_one_that_is_under_way_is_judged_from_where_the_arm_is_by_then() -> None:
    """50 mm in a second; 10 ms later 50.1 mm in 20 ms, which is a leap of 50 mm and not a step of 0.1 mm."""
    gate = gates(step_mm=100)
    go(gate, to((0.05, 0.2, 0), duration=1.0))
    with pytest.raises(CommandRefused, match=r"speed of 2\.5 m/s, the limit is 0\.25"):
        gate.admit(to((0.0501, 0.2, 0), duration=0.02, sequence=1), 10 * MS, 10 * MS)
    gate.admit(to((0.0501, 0.2, 0), duration=1.0, sequence=1), 10 * MS, 10 * MS)


def test_set_points_that_pile_up_do_not_make_the_arm_fast() -> None:
    """Each 10 mm and 60 ms further than the one before, but 10 ms apart: a metre in a second."""
    gate, passed = gates(step_mm=100), 0
    for k in range(20):
        try:
            go(gate, to((0.01 * (k + 1), 0.2, 0), duration=0.06, sequence=k), 10 * k * MS)
        except CommandRefused:
            break
        passed += 1
    assert passed < 3


@pytest.mark.parametrize("when", [0.0, 0.01, 0.35, 0.9])
def test_the_way_to_a_set_point_is_the_cubic_that_arms_follow(when: float) -> None:
    gate = gates(turn_speed_deg=1e4, turn_acceleration_deg=1e5)
    first = to((0.03, 0.21, 0.2), (0.05, -0.02, 0.1), 1.0)
    go(gate, first)
    pose, twist = cubic(HOME, REST, first, when)
    assert gate._goal is not None
    found = gate._goal.planned(round(when * S))
    np.testing.assert_allclose(found[0], pose, atol=1e-12)
    np.testing.assert_allclose(found[1], twist, atol=1e-12)
    second = to((0.01, 0.2, 0.0), REST, 0.8, 1)
    gate.accept(second, round(when * S))  # begins where the first has come to
    there, speed = cubic(pose, twist, second, 0.4)
    found = gate._goal.planned(round((when + 0.4) * S))
    np.testing.assert_allclose(found[0], there, atol=1e-9)
    np.testing.assert_allclose(found[1], speed, atol=1e-9)


@pytest.mark.parametrize("late", [0, 5, 19])
def test_a_commander_that_was_held_up_for_a_moment_may_make_up_for_it(late: int) -> None:
    """Every third set-point of a motion at 0.2 m/s comes late, and the next at its own time."""
    gate = gates(x=(-1, 1))
    go(gate, to((0.001, 0.2, 0), (0.05, 0, 0), 0.04))
    x, speed, now = 0.001, 0.05, 40
    for k in range(1, 60):
        faster = min(speed + 0.02, 0.2)
        x, speed = x + (speed + faster) / 2 * 0.02, faster
        sent = now + (late if k % 3 == 0 else 0)
        go(gate, to((x, 0.2, 0), (speed, 0, 0), 0.02, k), sent * MS)
        now += 20
    assert gate.summary()["refused"] == {}


def test_a_commander_that_looks_ahead_passes() -> None:
    """Set-points 20 ms apart, each 100 ms ahead on a line at 0.1 m/s: they replace one another on the way."""
    gate = gates(x=(-1, 1))
    go(gate, to((0.005, 0.2, 0), (0.1, 0, 0), 0.1))
    for k in range(1, 60):
        go(gate, to((0.005 + 0.002 * k, 0.2, 0), (0.1, 0, 0), 0.1, k), 20 * k * MS)
    assert gate.summary()["refused"] == {}


@pytest.mark.parametrize("pose", [None, (math.nan, 0.2, 0.0), (0.0, math.inf, 0.0)])
def test_where_the_arm_says_nothing_of_where_it_is_nothing_moves(pose: Any) -> None:
    gate = gates()
    gate.at(None if pose is None else np.array(pose))
    with pytest.raises(CommandRefused, match="has not told where it is"):
        gate.admit(to(), 0, 0)
    gate.at(np.array(HOME))
    gate.admit(to(), 0, 0)


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.5, 3.0), st.floats(-0.2, 0.2), st.integers(2, 40))
def test_a_minimum_jerk_motion_within_the_limits_passes_at_any_rate(
    dx: float, dy: float, T: float, turn: float, ticks: int
) -> None:
    # 10 s³ − 15 s⁴ + 6 s⁵: its greatest speed is 15/8 and its greatest acceleration 10/√3 of distance over T and T²
    distance = math.hypot(dx, dy)
    fits = distance * 15 / 8 <= 0.25 * T and distance * 10 / math.sqrt(3) <= 4.0 * T * T and distance <= 0.05
    gate = gates()
    for i in range(1, ticks + 1):
        s = i / ticks
        at, slope = s**3 * (10 - 15 * s + 6 * s * s), 30 * s * s * (1 - s) ** 2 / T
        pose = (at * dx, 0.2 + at * dy, at * turn)
        if fits:
            go(gate, to(pose, (slope * dx, slope * dy, slope * turn), T / ticks, i), round(i * T / ticks * S))
    assert gate.summary()["refused"] == {}


# -- force -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("force", "torque"), [((0, 0, 41), (0, 0, 0)), ((0, 0, 0), (0, 6, 0)), ((30, 30, 0), (0, 0, 0))]
)
def test_a_force_beyond_its_limit_stops_within_three_readings(force: Any, torque: Any) -> None:
    gate = gates({"wrist_ft": 0.001}, force=40, torque=5)
    said = [gate.feel("wrist_ft", wrench(i * MS, force, torque), i * MS) for i in range(CONFIRMED)]
    assert said[:-1] == [""] * (CONFIRMED - 1)
    assert "the limits are 40 N and 5 N·m" in said[-1]


def test_one_outlier_stops_nothing() -> None:
    gate = gates({"wrist_ft": 0.001})
    for i in range(100):
        force = (0, 0, 90) if i % 3 == 0 else (0, 0, 1)
        assert gate.feel("wrist_ft", wrench(i * MS, force), i * MS) == ""


def test_a_saturated_sensor_stops_the_arm() -> None:
    gate = gates({"wrist_ft": 0.001})
    said = [gate.feel("wrist_ft", wrench(i * MS, status=Status.SATURATED), i * MS) for i in range(CONFIRMED)]
    assert said[-1] == "wrist_ft is saturated"


def test_the_estimators_wrench_is_a_witness_of_its_own_and_may_be_silent() -> None:
    gate = gates({"wrist_ft": 0.001, "estimator": None}, force=40)
    gate.feel("wrist_ft", wrench(S), S)
    gate.admit(to(), S, S)
    assert "estimator measures 45.0 N" in gate.feel("estimator", wrench(S, (45, 0, 0)), S)


@pytest.mark.parametrize("status", [Status.OK, Status.INVALID, Status.STALE])
def test_nothing_moves_while_the_force_is_unknown(status: Status) -> None:
    gate = gates({"wrist_ft": 0.001})
    gate.feel("wrist_ft", wrench(0), 0)
    gate.admit(to(), 3 * MS, 3 * MS)
    bad = wrench(4 * MS, (math.nan, 0, 0) if status is Status.OK else (0, 0, 0), status=status)
    gate.feel("wrist_ft", bad, 4 * MS)
    with pytest.raises(DeviceTimeout, match=r"wrist_ft: watch over the arm: no reading for 0.004 s"):
        gate.admit(to(), 4 * MS, 4 * MS)
    assert gate.summary()["refused"] == {"witness": 1}


def test_readings_that_come_late_are_as_good_as_none() -> None:
    gate = gates({"wrist_ft": 0.001}, age=0.2)
    gate.feel("wrist_ft", wrench(0), 300 * MS)
    with pytest.raises(DeviceTimeout, match=r"no reading for 0.3 s"):
        gate.admit(to(), 300 * MS, 300 * MS)


def test_on_a_network_a_short_silence_is_a_delay() -> None:
    gate = gates({"wrist_ft": 0.001}, patience=0.02)
    gate.feel("wrist_ft", wrench(0), 0)
    gate.admit(to(), 19 * MS, 19 * MS)
    with pytest.raises(DeviceTimeout):
        gate.admit(to(), 21 * MS, 21 * MS)


def moving(before: Any, after: Any, *, twist: Any = (0.01, 0, 0), jump: float = 8.0) -> list[str]:
    """What is said of a force that changes at once after 100 ms of a motion."""
    gate = gates({"wrist_ft": 0.001}, jump=jump)
    go(gate, to((0.01, 0.2, 0), twist, 1.0))
    return [gate.feel("wrist_ft", wrench(i * MS, before if i < 100 else after), i * MS) for i in range(200)]


def test_contact_that_is_lost_at_once_in_mid_motion_stops_the_arm() -> None:
    said = moving((0, 0, -20), (0, 0, -5))
    first = next(i for i, text in enumerate(said) if text)
    assert 100 <= first < 110
    assert "contact was lost" in said[first]


def test_a_force_that_changes_slowly_or_a_little_stops_nothing() -> None:
    assert not any(moving((0, 0, -20), (0, 0, -14)))
    gate = gates({"wrist_ft": 0.001}, jump=8)
    go(gate, to((0.01, 0.2, 0), (0.01, 0, 0), 1.0))
    assert not any(gate.feel("wrist_ft", wrench(i * MS, (0, 0, -0.03 * i)), i * MS) for i in range(1000))  # 30 N/s


def test_a_tare_at_rest_is_no_lost_contact() -> None:
    gate = gates({"wrist_ft": 0.001}, jump=8)
    assert not any(gate.feel("wrist_ft", wrench(i * MS, (0, 0, -20 * (i < 50))), i * MS) for i in range(100))


# -- stop and recover ----------------------------------------------------------------------------------------------


def test_a_set_point_that_a_stop_overtook_leads_nowhere() -> None:
    """It passed, the stop came while it was on its way to the robot, and then it was accepted."""
    gate = gates(stop_after=1.0)
    late = to((0.001, 0.2, 0), (0.01, 0, 0), 0.1)
    gate.admit(late, 0, 0)
    gate.stop("a person")
    gate.accept(late, 4 * MS)
    gate.recover()
    assert gate.watch(60 * S) == ""
    gate.at(np.array([0.03, 0.2, 0.0]))  # where the stop left the arm
    go(gate, to((0.031, 0.2, 0), duration=0.1, sequence=1), 60 * S)


def test_a_saturated_sensor_stops_the_arm_again_after_a_recovery() -> None:
    """Nobody knows whether what it no longer shows grows."""
    gate = gates({"wrist_ft": 0.001})

    def feel(start: int, status: Status) -> bool:
        readings = [wrench(i * MS, (30, 0, 0), status=status) for i in range(start, start + 5)]
        return "".join([gate.feel("wrist_ft", one, one.stamp.capture_ns) for one in readings]) != ""

    assert feel(0, Status.SATURATED)
    gate.stop("saturated")
    gate.recover()
    assert feel(10, Status.SATURATED)
    gate.recover()
    assert not feel(20, Status.OK)


def test_a_clock_that_is_set_hides_no_silence() -> None:
    """The wall's clock goes back by a minute: the commander, and the sensor, are as silent as before."""
    gate = gates({"wrist_ft": 0.001}, hold_after=0.1)
    wall = 1_700_000_000 * S
    gate.restart(0, np.array(HOME), wall)
    gate.feel("wrist_ft", wrench(wall), 0)
    first = to((0.0001, 0.2, 0), (0.01, 0, 0), 0.02)
    gate.admit(first, wall, 0, wall)
    gate.accept(first, 0)
    wall -= 60 * S
    assert gate.watch(500 * MS) == "hold"
    with pytest.raises(DeviceTimeout, match=r"no reading for 0\.5 s"):
        gate.admit(to((0.0002, 0.2, 0), REST, 0.1, 1), wall + 500 * MS, 500 * MS, wall + 500 * MS)


def test_a_stop_keeps_its_first_reason_until_it_is_recovered() -> None:
    gate = gates()
    gate.stop("a person")
    gate.stop("later")
    assert gate.stopped == "a person"
    gate.recover()
    assert gate.stopped == ""


def test_after_a_recovery_under_load_the_arm_may_leave_and_may_not_press_on() -> None:
    gate = gates({"wrist_ft": 0.001}, force=40)

    def feel(force: float, start: int) -> bool:
        readings = [wrench(i * MS, (0, 0, force)) for i in range(start, start + CONFIRMED)]
        said = [gate.feel("wrist_ft", reading, reading.stamp.capture_ns) for reading in readings]
        return any(said)

    assert feel(50, 0)
    gate.stop("too much")
    gate.recover()
    assert not feel(50, 10)
    assert not feel(54, 20)
    assert feel(56, 30)  # more than a tenth beyond what it was recovered at
    gate.stop("more")
    gate.recover()
    assert not feel(30, 40)
    assert feel(41, 50)  # it was within the limit: from there on the limit holds again


# -- the watchdogs -------------------------------------------------------------------------------------------------


def test_a_commander_that_falls_silent_in_mid_motion_is_held_then_stopped() -> None:
    gate = gates(hold_after=0.1, stop_after=1.0)
    go(gate, to((0.0001, 0.2, 0), (0.01, 0, 0), 0.02))
    assert gate.watch(120 * MS) == ""
    assert gate.watch(121 * MS) == "hold"
    assert gate.watch(500 * MS) == ""  # once
    assert "in the midst of a motion" in gate.summary()["held"]
    assert gate.watch(1021 * MS) == "stop"
    assert "no set-point for 1" in gate.stopped


def test_a_commander_that_rests_may_think_as_long_as_it_likes() -> None:
    gate = gates()
    go(gate, to((0.001, 0.2, 0), REST, 0.1))
    assert gate.watch(100 * S) == ""


def test_an_arm_that_could_not_be_held_is_to_be_held_again() -> None:
    gate = gates(hold_after=0.1, stop_after=1.0)
    go(gate, to((0.0001, 0.2, 0), (0.01, 0, 0), 0.02))
    assert gate.watch(200 * MS) == "hold"
    gate.unheld()
    assert gate.watch(250 * MS) == "hold"


def test_the_next_set_point_ends_a_hold() -> None:
    gate = gates()
    go(gate, to((0.001, 0.2, 0), (0.01, 0, 0), 0.1))
    assert gate.watch(300 * MS) == "hold"
    go(gate, to((0.001, 0.2, 0), REST, 0.1, 1), 400 * MS)
    assert gate.summary()["held"] == ""


@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats(), st.floats()), max_size=20))
def test_whatever_is_sent_either_passes_or_is_refused_and_counted(numbers: list[tuple[float, ...]]) -> None:
    gate, refused = gates(), 0
    for i, (x, y, speed, duration) in enumerate(numbers):
        try:
            go(gate, to((x, y, 0), (speed, 0, 0), duration, i))
        except DriverError:
            refused += 1
    found = gate.summary()
    assert sum(found["refused"].values()) == refused
    assert found["accepted"] == len(numbers) - refused
