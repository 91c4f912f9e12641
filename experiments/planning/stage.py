"""The plan stage of a run: the plan is made, kept for the later stages, and left in the run's folder as a file."""

from __future__ import annotations

import time
from typing import Any

from experiments import kernels
from experiments.context import RunContext
from experiments.planning.files import plan_files, save_plan
from experiments.planning.make import make, task
from experiments.planning.schema import PlanStage
from planning.plan import Plan


def plan_stage(context: RunContext, stage: PlanStage) -> None:
    """Make the plan that later stages execute. Raises InfeasiblePlan."""
    if stage.backend == "fused":
        with context.progress.step("get the planner's kernels ready"):
            kernels.warm()
    begin = time.perf_counter()
    with context.progress.step(f"plan {stage.name}"):
        asked = task(context.resolved, stage, context.believed)
        made = make(context.resolved, stage, context.believed, asked)
    took = time.perf_counter() - begin
    context.plans[stage.name], context.tasks[stage.name] = made, asked
    file = save_plan(made, context.folder.path)
    how = {"optimiser": stage.optimiser["name"], "backend": stage.backend, "form": stage.form}
    context.results["plans"].append({**_row(made, file), **how, "time_s": took})


def take_plan_files(context: RunContext) -> None:
    """Read the plans that execute stages take from files, and leave copies in the run's folder. Raises InputError."""
    for named, plan in plan_files(context.resolved).items():
        if named not in context.plans:
            context.plans[named] = plan
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
