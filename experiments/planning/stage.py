"""The plan stage of a run: the plan is made, kept for the later stages, and left in the run's folder as a file."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from experiments import kernels
from experiments.context import RunContext
from experiments.planning.files import file_of, own_plan, plan_files, save_plan, saved_plan
from experiments.planning.make import make, task
from experiments.planning.schema import PlanStage
from planning.plan import Plan


def plan_stage(context: RunContext, stage: PlanStage) -> None:
    """Make the plan that later stages execute. Raises InfeasiblePlan."""
    known = context.believed
    asked = task(context.resolved, stage, known)
    made = saved_plan(stage.name, context.folder.path)  # a run that was cut off may have left it
    took = 0.0 if made is None else made.time_s
    if made is None:
        if stage.backend == "fused":
            with context.progress.step("get the planner's kernels ready"):
                kernels.warm()
        begin = time.perf_counter()
        with context.progress.step(f"plan {stage.name}"):
            made = make(context.resolved, stage, known, asked)
        took = time.perf_counter() - begin
        save_plan(made, context.folder.path)
    context.plans[stage.name], context.tasks[stage.name] = made, asked
    file = file_of(stage.name)
    how = {"optimiser": stage.optimiser["name"], "backend": stage.backend, "form": stage.form}
    believed = {"stiffness": known.stiffness.tolist(), "friction": known.friction}
    context.results["plans"].append({**_row(made, file), **how, "believed": believed, "time_s": took})


def take_plan_again(context: RunContext, stage: PlanStage) -> None:
    """Take the plan of a finished stage from the run's folder; its task by what was believed then.

    Raises InputError where it is no longer there.
    """
    row = next(row for row in context.results["plans"] if row["name"] == stage.name and "from" not in row)
    then = {"stiffness": np.array(row["believed"]["stiffness"]), "friction": row["believed"]["friction"]}
    context.plans[stage.name] = own_plan(context.folder.path / row["file"])
    context.tasks[stage.name] = task(context.resolved, stage, replace(context.believed, **then))


def take_plan_files(context: RunContext) -> None:
    """Read the plans that execute stages take from files, and leave copies in the run's folder. Raises InputError."""
    own = {row["from"]: context.folder.path / row["file"] for row in context.results["plans"] if "from" in row}
    for named, plan in plan_files(context.resolved, own).items():
        if named not in context.plans:
            context.plans[named] = plan
            if named not in own:
                file = save_plan(plan, context.folder.path)
                context.results["plans"].append({**_row(plan, file), "from": named, "time_s": plan.time_s})


def _row(plan: Plan, file: str) -> dict[str, Any]:
    return {
        "name": plan.name,
        "skill": plan.skill,
        "planner": plan.planner,
        "steps": len(plan.ee),
        "queries": plan.queries,
        "loss": plan.loss,
        "status": plan.status,
        "file": file,
    }
