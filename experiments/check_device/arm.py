"""The steps of an arm: where it says that it is, what its joints allow, and, on request, 5 mm and a stop."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from time import monotonic

import numpy as np

from control.motion import Mover
from drivers.config import ArmLimits
from drivers.errors import CommandRefused
from drivers.interfaces import Arm, ArmTarget
from experiments.check_device.bench import MOMENT, Bench, Step
from experiments.check_device.findings import Finding, judged, skipped
from mechanics.readings import Array

#: how far it moves [m], in which time [s], and at how many set-points a second
WAY, DURATION, RATE = 0.005, 2.0, 50.0
#: how near to its goal an arm comes to rest, and how far it goes on after a stop [m]
REACHED, STOPPED = 1e-3, 1e-3
#: an arm that moves less than this between two looks rests [m, rad]; it is waited for so long [s]
STILL, PATIENCE = 5e-5, 5.0
#: a resting arm scatters less than this [m, rad]
REST = (5e-4, 2e-3)
HOLDER = "check-device"


def _pose(bench: Bench, seconds: float = MOMENT) -> Array:
    return bench.gather(lambda reading: reading.pose, seconds).mean(axis=0)


def _words(pose: Array) -> str:
    x, y, angle = np.round((pose[0] * 1e3, pose[1] * 1e3, np.degrees(pose[2])), 2) + 0.0  # no minus before a zero
    return f"{x:.1f} mm right, {y:.1f} mm up, {angle:.2f}°"


def _limits(bench: Bench) -> ArmLimits:
    return getattr(bench.config, "limits", ArmLimits())


def _where(bench: Bench) -> Finding:
    pose, limits = _pose(bench), _limits(bench)
    within = all(
        low <= value <= high
        for value, (low, high) in zip(
            (*pose[:2], np.degrees(pose[2])), (limits.x, limits.y, limits.angle_deg), strict=True
        )
    )
    measured, figures = f"{_words(pose)} in W", {"pose": pose.tolist()}
    if not within:
        remedy = "See to `plane` and `tool` (or what your arm's backend calls them), or guide it there by hand"
        return judged(False, f"{measured}: outside the limits of the station file", remedy, **figures)
    if bench.person.here:
        question = f"The end-effector's frame is {_words(pose)} from W's origin on the table. Is that what you see?"
        remedy = "Measure where the task plane stands in the robot's base, and how ee sits on the flange"
        return judged(bench.person.confirm(question), measured, remedy, **figures)
    return judged(True, f"{measured}, within the limits; nobody looked", **figures)


def _rests(bench: Bench) -> Finding:
    spread = np.ptp(bench.gather(lambda reading: reading.pose), axis=0)
    distance, turn = float(np.hypot(*spread[:2])), float(spread[2])
    measured = f"{distance * 1e3:.3f} mm and {np.degrees(turn):.3f}° in {MOMENT:g} s"
    good = distance <= REST[0] and turn <= REST[1]
    return judged(good, measured, "It moves, or shakes: hold it, and see to its load and stiffness")


def _gates(bench: Bench) -> Finding:
    found = bench.device.safety()
    stopped = found["stopped"]
    holders = bench.device.lease_holders()
    who = f"commanded by {', '.join(holders)}" if holders else "nobody commands it"
    if stopped:
        return judged(False, f"stopped: {stopped}; {who}", "Once the reason is gone: `extrinsic recover STATION`")
    return judged(True, f"not stopped; {who}")


def _joints(bench: Bench) -> Finding:
    reachable = getattr(bench.opened.backend, "reachable", None)
    if reachable is None:
        return skipped("only the backend itself can tell: end the server, and check it alone")
    limits, here = _limits(bench), _pose(bench)
    refused = reachable(here)
    if refused:
        return judged(False, f"where it is now: {refused}", "Guide it away from the ends of its joints")
    corners = [np.array([x, y, 0.0]) for x, y in itertools.product(limits.x, limits.y)]
    beyond = [f"({c[0]:g}, {c[1]:g})" for c in corners if reachable(c)]
    said = f"the corners {', '.join(beyond)} of the workspace are out of reach" if beyond else "the workspace's too"
    return judged(True, f"where it is now is within reach; {said}", out_of_reach=beyond)


def _move(bench: Bench) -> Finding:
    if not bench.move:
        return skipped("it moves on request only: --move")
    here, limits = _pose(bench), _limits(bench)
    goal = here + np.array([0.0, WAY, 0.0])
    if goal[1] > limits.y[1]:
        return judged(False, f"it stands at the upper end of its limits, {limits.y[1]:g} m", "Guide it lower")
    question = (
        f"THE ARM MOVES: {WAY * 1e3:g} mm up within {DURATION:g} s, then down, half way of which it is stopped. Is its "
        "way clear, and a hand at the robot's own stop?"
    )
    if not bench.person.confirm(question):
        return skipped("nobody agreed")
    device = bench.device
    with device.lease(HOLDER):
        mover = Mover(device, bench.opened.clock, RATE, here, WAY / DURATION)
        mover.ramp(goal, DURATION)
        missed = _rested(bench, lambda: mover.rest(MOMENT)) - goal
        with suppress(_HalfWay):
            back = Mover(device, bench.opened.clock, RATE, goal, WAY / DURATION, _until(device, here[1] + WAY / 2))
            back.ramp(here, DURATION)
            back.rest(DURATION)
        at_stop = device.latest().pose
        device.stop(HOLDER)
        went_on = _rested(bench) - at_stop
        refused = _refuses(bench, at_stop)
    device.recover()
    off, on = float(np.hypot(*missed[:2])), float(np.hypot(*went_on[:2]))
    measured = (
        f"{off * 1e3:.2f} mm off after {WAY * 1e3:g} mm; after the stop it went on for {on * 1e3:.2f} mm, and "
        f"{'refused' if refused else 'TOOK'} a set-point; it is recovered"
    )
    good = off <= REACHED and on <= STOPPED and refused
    return judged(good, measured, "Do not go on: see to its stiffness, load and stop", off_mm=off * 1e3, on_mm=on * 1e3)


def _rested(bench: Bench, meanwhile: Callable[[], None] = lambda: None) -> Array:
    """The pose at which the arm rests, or is after `PATIENCE`; ``meanwhile`` is done between two looks."""
    until, last = monotonic() + PATIENCE, _pose(bench, 0.1)
    while True:
        meanwhile()
        pose = _pose(bench, 0.1)
        if np.abs(pose - last).max() < STILL or monotonic() > until:
            return pose
        last = pose


class _HalfWay(Exception):
    """Where the motion is fastest."""


def _until(arm: Arm, height: float) -> Callable[[], None]:
    """What ends a motion down where the arm has come to ``height`` [m]."""

    def tick() -> None:
        if arm.latest().pose[1] <= height:
            raise _HalfWay

    return tick


def _refuses(bench: Bench, pose: Array) -> bool:
    try:
        bench.device.command(ArmTarget(pose, np.zeros(3), 1.0 / RATE))
    except CommandRefused:
        return True
    return False


STEPS = (
    Step("pose", "where the end-effector is in W: measure it", _where),
    Step("rest", "whether it stands still", _rests),
    Step("gates", "whether it is stopped, and who commands it", _gates),
    Step("joints", "what of the workspace its joints reach", _joints),
    Step("move", "5 mm at low speed, and a stop", _move, asks=True),
)
