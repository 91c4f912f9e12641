"""Whether the arm's gates will let pass what trials ask of it: where they go, and how fast between waypoints.

A set-point that they refuse ends a trial in the midst. What the optimiser and corrections change is millimetres: only
what no trial can do is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from control.motion import quintic
from drivers.config import ArmConfig, ArmLimits
from experiments import planned_poses
from experiments.files import Resolved
from mechanics import se2
from mechanics.readings import Array
from mechanics.yaml_input import Problem
from planning.plan import Plan
from planning.skills.base import SkillTask

#: how far an optimised plan may be from the nominal one, to which the poses belong [m, m, rad]
_OFF = np.array([0.01, 0.01, math.radians(5)])


def problems(resolved: Resolved, tasks: Mapping[str, SkillTask], plans: Mapping[str, Plan]) -> list[Problem]:
    """The first thing that an arm of the station would refuse in a trial."""
    document, trial = resolved.experiment_document, resolved.experiment.trial
    arms = {name: arm for name, arm in resolved.station.devices.items() if isinstance(arm, ArmConfig)}
    for plan, poses in planned_poses.executed(resolved, tasks, plans).items():
        ee = se2.compose(poses.go, resolved.grasp)
        for name, arm in arms.items():
            for step, said in () if resolved.experiment.rehearse else _beyond(ee, arm.limits):  # it is lifted there
                when = "before it touches" if step == 0 else f"at waypoint {step - 1}"
                wrong = f"plan {plan} takes {name} to {said} {when}"
                expected = f"a motion within its workspace, or another in the station file: devices.{name}.limits"
                return [document.problem(("stages",), wrong, expected)]
            for step, said, least in _hurried(ee[1:], trial.ramp / trial.speed, trial.control_rate, arm.limits):
                wrong = f"plan {plan} has {name} {said} on the way from waypoint {step} to {step + 1}"
                enough = math.ceil(100 * least * trial.speed) / 100
                expected = f"at least {enough:g} s, or more waypoints: `steps` of the plan's parameters"
                return [document.problem(("trial", "ramp"), wrong, expected)]
    return []


def _beyond(ee: Array, limits: ArmLimits) -> Iterator[tuple[int, str]]:
    """The poses X_W_ee (n, 3) that lie clearly outside the workspace, and how."""
    spans = (limits.x, limits.y, tuple(math.radians(angle) for angle in limits.angle_deg))
    for axis, (low, high) in enumerate(spans):
        values = ee[:, axis] if axis < 2 else se2.wrap(ee[:, axis])
        outside = (values < low - _OFF[axis]) | (values > high + _OFF[axis])
        if outside.any():
            step = int(np.argmax(outside))
            letter, unit, scale = (("x", "m", 1.0), ("y", "m", 1.0), ("an angle", "deg", math.degrees(1)))[axis]
            span = f"its limits are {low * scale:g} to {high * scale:g} {unit}"
            yield step, f"{letter} = {values[step] * scale:.3g} {unit} ({span})"


def _hurried(ee: Array, seconds: float, rate: float, limits: ArmLimits) -> Iterator[tuple[int, str, float]]:
    """The ramps between waypoints ``ee`` (K, 3) that a gate would refuse: after which, why, and the time that will do.

    A ramp is what `control.motion.Mover` makes of it and the gates see (`drivers.gates`): means and changes of speed
    between set-points of a quintic.
    """
    steps = np.diff(ee, axis=0)
    steps[:, 2] = se2.wrap(steps[:, 2])
    far, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    speed, acceleration = _peaks(seconds, rate)
    turn_speed, turn_acceleration = math.radians(limits.turn_speed_deg), math.radians(limits.turn_acceleration_deg)
    for values, peak, limit, power, what in (
        (far, speed, limits.speed, 1, "move at {:.3g} m/s, above its limit of {:g} m/s"),
        (turn, speed, turn_speed, 1, "turn at {:.3g} rad/s, above its limit of {:.3g} rad/s"),
        (far, acceleration, limits.acceleration, 2, "speed up by {:.3g} m/s², above its limit of {:g} m/s²"),
        (turn, acceleration, turn_acceleration, 2, "speed up its turn by {:.3g} rad/s², above {:.3g} rad/s²"),
    ):
        k = int(np.argmax(values)) if len(values) else 0
        if len(values) and values[k] * peak > limit:
            yield k, what.format(values[k] * peak, limit), seconds * (values[k] * peak / limit) ** (1 / power)


def _peaks(seconds: float, rate: float) -> tuple[float, float]:
    """The greatest speed [1/s] and acceleration [1/s²] between set-points of a unit ramp, as gates measure them."""
    ticks = max(1, round(seconds * rate))
    T = 1.0 / rate
    at = np.array([quintic(i / ticks) for i in range(ticks + 1)])
    twist = at[:, 1] / (ticks * T)
    mean = np.diff(at[:, 0]) / T
    change, reach = np.diff(twist) / T, 2 * (mean - twist[:-1]) / T
    return max(mean.max(), twist.max()), max(np.abs(change).max(), np.abs(reach).max())
