"""Where trials will have the bodies, known before they run: of a saved plan, or of the task that a stage will plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from control.approach import UP, retreat
from experiments.faults.schema import FaultsStage
from experiments.files import Resolved
from experiments.schema import ExecuteStage
from mechanics.readings import Array
from planning import closure
from planning.plan import Plan
from planning.problem import ANGLE, TRAVEL
from planning.skills.base import SkillTask


@dataclass(frozen=True, eq=False)
class Poses:
    """Where a trial of a plan has the bodies: X_W_go (n, 3) and X_W_eo (n, 3), or None without an extrinsic object.

    The first is where it looks whether it may begin, with the go in free air; the others are waypoints.
    """

    go: Array
    eo: Array | None


def of_plan(plan: Plan, clearance: float) -> Poses:
    """The poses of a plan, its go ``clearance`` [m] off at first."""
    air = plan.preload_go[0] + clearance * np.append(retreat(plan), 0.0)
    eo = None if plan.eo is None or plan.preload_eo is None else np.vstack([plan.preload_eo[:1], plan.eo])
    return Poses(np.vstack([air, plan.go]), eo)


def of_task(task: SkillTask, clearance: float) -> Poses:
    """The poses of a task's nominal trajectory, from which the plan will hardly differ as far as a camera can tell."""
    problem, rest = task.problem, task.rest or task.problem
    y = problem.start * problem.scale
    placed = closure.place(problem, y[:, ANGLE], y[:, TRAVEL])
    first = closure.place(rest, y[: len(rest.eo), ANGLE], y[: len(rest.eo), TRAVEL])
    sign = 1.0 if problem.eo_body is None else -1.0  # normals point into the body acted on: the eo, where there is one
    away = sign * np.sum(placed.normals[0, : len(problem.contacts)], axis=0)
    size = float(np.linalg.norm(away))
    air = first.go[0] + clearance * np.append(UP if size < 1e-6 else away / size, 0.0)
    eo = None if problem.eo_body is None else np.vstack([first.eo[:1], placed.eo])
    return Poses(np.vstack([air, placed.go]), eo)


def executed(resolved: Resolved, tasks: Mapping[str, SkillTask], plans: Mapping[str, Plan]) -> dict[str, Poses]:
    """The poses of every plan that a stage executes, by its name: of ``tasks`` and of saved ``plans``."""
    clearance = resolved.experiment.trial.clearance_mm * 1e-3
    named = [s.plan for s in resolved.experiment.stages if isinstance(s, ExecuteStage | FaultsStage)]
    poses = {name: of_task(tasks[name], clearance) for name in named if name in tasks}
    return poses | {name: of_plan(plans[name], clearance) for name in named if name in plans}
