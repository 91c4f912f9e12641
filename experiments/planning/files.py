"""Plans as files: those that an experiment names, and those that a run leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from experiments import registries
from experiments.files import Resolved
from experiments.schema import PLAN_FILE, ExecuteStage
from mechanics.yaml_input import InputError, Problem
from planning.plan import Plan

#: the folder of a run that holds its plans
FOLDER = "plans"
#: a grasp, a mass or an outline that differs by more than rounding is another one
SAME = 1e-9


def plan_files(resolved: Resolved, own: Mapping[str, Path] = MappingProxyType({})) -> dict[str, Plan]:
    """The plans that execute stages take from files, by what stands there. Raises InputError, at that stage.

    ``own`` are copies that a run has taken of some of them, which then count.
    """
    found: dict[str, Plan] = {}
    for i, stage in enumerate(resolved.experiment.stages):
        if isinstance(stage, ExecuteStage) and stage.from_file:
            _refuse_laws_that_plan(resolved, i, stage)
            if stage.plan not in found:
                found[stage.plan] = _read(resolved, i, stage.plan, own.get(stage.plan))
    return found


def _refuse_laws_that_plan(resolved: Resolved, i: int, stage: ExecuteStage) -> None:
    """A file has the plan alone, not what it was made of."""
    for n, name in enumerate(stage.controllers):
        if registries.controllers()[name].needs_task:
            wrong = f"{name} re-plans: it needs a plan stage in this experiment, not a plan from a file"
            expected = f"`plan:` that names a plan stage of this experiment, or controllers without {name}"
            raise InputError([resolved.experiment_document.problem(("stages", i, "controllers", n), wrong, expected)])


def _read(resolved: Resolved, i: int, name: str, own: Path | None) -> Plan:
    from planning.plan_file import PlanFileError, load

    def problem(wrong: str, expected: str) -> InputError:
        return InputError([resolved.experiment_document.problem(("stages", i, "plan"), wrong, expected)])

    try:
        plan = load(_located(resolved, name) if own is None else own)
    except PlanFileError as error:
        raise problem(error.problem, f"a plan that a run has left under {FOLDER}/ ({error.remedy})") from None
    if (other := _foreign(plan, resolved)) is not None:
        raise problem(f"{name} was made for {other}", "a plan for what this experiment holds and moves")
    return plan


def _located(resolved: Resolved, name: str) -> Path:
    """A path from the current folder or from the experiment's; else the plan that lies in the run's own folder."""
    home = Path(resolved.experiment_document.file).parent
    for path in (Path(name).expanduser(), home / name, home / FOLDER / Path(name).name):
        if path.is_file():
            return path
    return Path(name)


def _foreign(plan: Plan, resolved: Resolved) -> str | None:
    """What the plan was made for, where this experiment has another."""
    if not np.allclose(plan.X_go_gocf, resolved.grasp, rtol=0, atol=SAME):
        x, y, theta = plan.X_go_gocf
        return f"a grasp at ({x * 1e3:g}, {y * 1e3:g}) mm, {np.degrees(theta):g}°"
    if abs(plan.mass - resolved.grasped.mass) > SAME:
        return f"a grasped object of {plan.mass:g} kg"
    if plan.eo is not None and resolved.extrinsic is None:
        return "an extrinsic object, and there is none here"
    return None


def save_plan(plan: Plan, run_folder: Path) -> str:
    """Write a plan into the run's folder; return its path from there."""
    from planning.plan_file import save

    file = file_of(plan.name)
    (run_folder / file).parent.mkdir(exist_ok=True)
    save(plan, run_folder / file)
    return file


def file_of(name: str) -> str:
    """The path of a run's plan ``name`` from the run's folder."""
    return f"{FOLDER}/{name}{PLAN_FILE}"


def saved_plan(name: str, run_folder: Path) -> Plan | None:
    """The plan ``name`` that lies in a run's folder; None where none does, or none that can be executed."""
    from planning.plan_file import PlanFileError, load

    try:
        return load(run_folder / file_of(name))
    except PlanFileError:
        return None


def own_plan(path: Path) -> Plan:
    """A plan that a run has left in its folder. Raises InputError where that can no longer be read."""
    from planning.plan_file import PlanFileError, load

    try:
        return load(path)
    except PlanFileError as error:
        expected = "the plan that the run has left there; without it, run the experiment anew"
        raise InputError([Problem(str(path), None, "--resume", error.problem, expected)]) from None
