"""What a campaign consists of: jobs, each one run, all of them looked at before any is started."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.check import check
from experiments.files import Resolved, dump_resolved, load
from experiments.schema import ExecuteStage
from mechanics.yaml_input import InputError, Problem
from planning.errors import InfeasiblePlan


@dataclass(frozen=True)
class Job:
    """One run. ``sets`` are as ``--set`` takes them; ``tags`` tell the jobs apart in the campaign's table.

    What the run reads from the folder ``home`` moves with the campaign: two that differ by where it lies are the same.
    """

    id: str
    experiment: str
    station: str | None = None
    sets: tuple[str, ...] = ()
    tags: Mapping[str, Any] = field(default_factory=dict)
    home: Path | None = None

    @property
    def told(self) -> str:
        """The job in words: its tags."""
        return ", ".join(f"{key}={value}" for key, value in self.tags.items()) or self.id


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended. ``status`` is its run's, or ``failed`` where no run came to an end; ``run`` is the newest one.

    ``attempts`` counts its runs, those of earlier starts of the campaign included.
    """

    job: Job
    status: str
    reason: str
    run: Path | None
    attempts: int

    @property
    def ended(self) -> bool:
        """Whether its trials were run, however they ended."""
        return self.status != FAILED


FAILED = "failed"


class InfeasibleJob(InfeasiblePlan):
    """The task of a job has no plan. ``told`` is the job in words."""

    def __init__(self, told: str, error: InfeasiblePlan):
        super().__init__(error.step, error.contact, error.need, error.have, error.by, error.reason)
        self.told = told

    def __str__(self) -> str:
        return f"{self.told}: {super().__str__()}"


def resolve(jobs: Sequence[Job]) -> dict[str, Resolved]:
    """The jobs' resolved experiments by id. Raises InputError with each fault once, and the first job that has it."""
    found: dict[str, Resolved] = {}
    faults: dict[Problem, Problem] = {}
    for job in jobs:
        if job.id in found:
            faults.setdefault(_twice(job), _twice(job))
        try:
            found[job.id] = load(job.experiment, job.station, job.sets)
        except InputError as error:
            _note(faults, error, job)
    if faults:
        raise InputError(faults.values())
    return found


def examine(jobs: Iterable[Job], resolved: Mapping[str, Resolved]) -> None:
    """The dry run of every job; jobs that differ by their trials' numbers alone are one task.

    Raises InputError with each fault once, and InfeasibleJob for the first task that has no plan.
    """
    faults: dict[Problem, Problem] = {}
    infeasible: list[InfeasibleJob] = []
    seen: set[str] = set()
    for job in jobs:
        task = _task(resolved[job.id])
        if task in seen:
            continue
        seen.add(task)
        try:
            check(resolved[job.id])
        except InputError as error:
            _note(faults, error, job)
        except InfeasiblePlan as error:
            infeasible.append(InfeasibleJob(job.told, error))
    if faults:
        raise InputError(faults.values())
    if infeasible:
        raise infeasible[0]


def digest(resolved: Resolved, home: Path | None = None) -> str:
    """A fingerprint of everything that an experiment and its station say; paths within ``home`` as seen from there."""
    if home is not None:
        resolved = moved(resolved, home, Path())
    return hashlib.sha256(dump_resolved(resolved).encode()).hexdigest()


def moved(resolved: Resolved, here: Path, there: Path) -> Resolved:
    """The experiment with the calibrations and the plan files that it reads from ``here`` read from ``there``."""

    def place(name: str) -> str:
        return str(there / Path(name).relative_to(here)) if Path(name).is_relative_to(here) else name

    experiment = resolved.experiment
    calibration = experiment.calibration.model_copy(update={"source": place(experiment.calibration.source)})
    stages = tuple(
        stage.model_copy(update={"plan": place(stage.plan)})
        if isinstance(stage, ExecuteStage) and stage.from_file
        else stage
        for stage in experiment.stages
    )
    changed = experiment.model_copy(update={"calibration": calibration, "stages": stages})
    return replace(resolved, experiment=changed)


def planned_trials(resolved: Resolved) -> list[dict[str, Any]]:
    """The rows that results.json has once every trial of the experiment was run, in order, without their outcome."""
    skills = {stage.name: stage.skill for stage in resolved.experiment.stages if stage.stage == "plan"}
    extrinsic = None if resolved.extrinsic is None else resolved.extrinsic.name
    return [
        {
            "skill": skills.get(stage.plan),
            "controller": controller,
            "grasped_object": resolved.grasped.name,
            "extrinsic_object": extrinsic,
            "sensor": resolved.sensor.name,
            "trial": trial,
        }
        for stage in resolved.experiment.stages
        if isinstance(stage, ExecuteStage)
        for trial in range(stage.first, stage.first + stage.trials)
        for controller in stage.controllers
    ]


def _task(resolved: Resolved) -> str:
    stages = tuple(
        stage.model_copy(update={"first": 0, "trials": 1}) if isinstance(stage, ExecuteStage) else stage
        for stage in resolved.experiment.stages
    )
    return digest(replace(resolved, experiment=resolved.experiment.model_copy(update={"stages": stages})))


def _note(faults: dict[Problem, Problem], error: InputError, job: Job) -> None:
    for problem in error.problems:
        faults.setdefault(problem, replace(problem, wrong=f"{problem.wrong} ({job.told})"))


def _twice(job: Job) -> Problem:
    return Problem("campaign", None, job.id, "two jobs have this id", "an id of its own for each job")
