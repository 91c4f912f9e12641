"""Runs what a table asks for: its calibrations first, then its runs, on the campaign's engine."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from experiments.campaign.engine import reach, run_jobs
from experiments.campaign.folder import ASKED, CampaignFolder, copied
from experiments.campaign.frame import trials_frame
from experiments.campaign.jobs import Job, JobOutcome
from experiments.check import check
from experiments.files import load
from experiments.run_folder import write_json
from experiments.table import jobs
from experiments.table.aggregate import Data
from experiments.table.jobs import Asked, Options
from experiments.table.schema import RunEntry, Table
from mechanics.yaml_input import InputError, Problem
from planning.errors import InfeasiblePlan

#: a trial that ended so took the rest of its job with it
_TOOK_THE_REST = ("stopped", "diverged")


@dataclass(frozen=True)
class Engine:
    """Who runs jobs, and how many at a time: the campaign's engine, or a test's."""

    run: Callable[..., Sequence[JobOutcome]] = run_jobs
    frame: Callable[[Path], pd.DataFrame] = trials_frame
    reach: Callable[[str], None] = reach
    workers: int = 2
    scheduler: str | None = None


class CalibrationFailed(Exception):
    """A calibration found no answer. ``status`` is its run's."""

    def __init__(self, name: str, status: str, reason: str, run: Path | None):
        self.status = status
        super().__init__(f"calibration {name}: {status}: {reason}" + ("" if run is None else f"\n  {run}"))


def measure(table: Table, options: Options, engine: Engine, folder: Path, console: Console) -> Data:
    """Calibrate and run what the table asks for in ``folder``, as far as it is not there yet.

    Raises InputError and InfeasiblePlan before anything is started, and CalibrationFailed.
    """
    runs = jobs.selected(table, options.runs)
    jobs.check_first(table, runs, options)
    if engine.scheduler is not None and not (folder / ASKED).is_file():  # one that was begun may have nothing to run
        engine.reach(engine.scheduler)
    _begin(folder, table, options)
    calibrated = _calibrate(table, options, engine, folder, console)
    done: list[tuple[Asked, pd.DataFrame]] = []
    plans: list[dict[str, Any]] = []
    made: dict[str, dict[str, Path]] = {}
    for n, phase in enumerate(_run_phases(runs)):
        asked = [
            job for run in phase for job in jobs.run_jobs_of(table, run, options, calibrated.get(run.calibration or ""))
        ]
        ready, refused = _with_plans(asked, made)
        for job, frame, rows in _run(ready, engine, folder / f"runs-{n}", console):
            done.append((job, frame))
            plans += [{**job.tags, **row} for row in rows]
            for row in rows:
                made.setdefault(job.tags["run"], {})[job.tags["trajectory"]] = row["file"]
        done += refused
    return Data(_together(done), pd.DataFrame(plans))


def _begin(folder: Path, table: Table, options: Options) -> None:
    """Note what the folder is for. Raises InputError where something else lies, or nothing can be written."""
    note = folder / ASKED
    asked = json.loads(json.dumps({"table": table.model_dump(mode="json"), **asdict(options)}))

    def refused(wrong: str, expected: str) -> InputError:
        return InputError([Problem(str(folder), None, "--out", wrong, expected)])

    try:
        if note.is_file():
            if json.loads(note.read_text(encoding="utf-8")) != asked:
                expected = "the same table, seed and options, or another folder"
                raise refused("another table was begun there", expected)
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise refused("there is something there already, and no table", "a new or an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
        write_json(note, asked)
    except OSError as error:
        raise refused(f"cannot be written: {error.strerror}", "a folder you may write to") from None


def _calibrate(table: Table, options: Options, engine: Engine, folder: Path, console: Console) -> dict[str, Path]:
    """Run the calibrations that are needed; the folder of each, by name."""
    shelf = folder / "calibrations"
    (shelf / "none").mkdir(parents=True, exist_ok=True)  # nobody's earlier files
    found = {"": shelf / "none"}
    for n, phase in enumerate(jobs.calibration_phases(table, jobs.selected(table, options.runs))):
        asked = [jobs.calibration_job(table, entry, options, found[entry.after or ""]) for entry in phase]
        place = folder / f"calibration-{n}"
        for entry, outcome in zip(phase, _outcomes(asked, engine, place, console), strict=True):
            if outcome.status != "completed":
                raise CalibrationFailed(entry.name, outcome.status, outcome.reason, outcome.run)
            found[entry.name] = copied(
                CampaignFolder(place).job(outcome.job.id).path / "calibrations", shelf / entry.name
            )
            if _names(found[entry.name]) == _names(found[entry.after or ""]):  # a rehearsal touches nothing, say
                raise CalibrationFailed(entry.name, "fell_short", "it has left no calibration file", outcome.run)
    return found


def _names(shelf: Path) -> set[str]:
    return {file.name for file in shelf.glob("*.yaml")}


def _run_phases(runs: Sequence[RunEntry]) -> list[list[RunEntry]]:
    """The runs that plan by themselves, then those that execute saved plans."""
    phases = [[run for run in runs if run.plans_of is None], [run for run in runs if run.plans_of is not None]]
    return [phase for phase in phases if phase]


def _with_plans(
    asked: Sequence[Asked], made: dict[str, dict[str, Path]]
) -> tuple[list[Asked], list[tuple[Asked, pd.DataFrame]]]:
    """The jobs that can run, with the plan that each is to execute; and those that have none, with their rows."""
    ready, refused = [], []
    for job in asked:
        if job.plans_of is None:
            ready.append(job)
            continue
        plan = made.get(job.plans_of, {}).get(job.tags["trajectory"])
        if plan is None:
            refused.append((job, _not_run(job, "infeasible", f"{job.plans_of} has no plan for this trajectory")))
        else:
            ready.append(job.executing(plan))
    return ready, refused


def _run(
    asked: Sequence[Asked], engine: Engine, folder: Path, console: Console
) -> Iterator[tuple[Asked, pd.DataFrame, list[dict[str, Any]]]]:
    """Run jobs; each with the rows of its trials and of its plans.

    A trial that stops the arm, or leaves nonsense in the simulated world, ends its run: the controllers that did not
    get their turn get it in a run of their own.
    """
    again: list[Asked] = []
    for job, frame, plans in _once(asked, engine, folder, console):
        left = _left(job, frame)
        if left:
            again.append(job.of(left))
        yield job, frame.loc[~frame["controller"].isin(left)] if left else frame, plans
    if again:
        for job, frame, _ in _run(again, engine, folder.with_name(f"{folder.name}-again"), console):
            yield job, frame, []


def _left(job: Asked, frame: pd.DataFrame) -> list[str]:
    """The controllers of a job that did not get their turn since a trial before them ended it."""
    if "name" not in frame:
        return []
    turned = frame.loc[frame["name"].notna(), ["controller", "status"]].to_numpy().tolist()
    if not turned or turned[-1][1] not in _TOOK_THE_REST:
        return []
    return [name for name in job.controllers if name not in {controller for controller, _ in turned}]


def _once(
    asked: Sequence[Asked], engine: Engine, folder: Path, console: Console
) -> Iterator[tuple[Asked, pd.DataFrame, list[dict[str, Any]]]]:
    if not asked:
        return
    feasible: list[Asked] = []
    for job in asked:
        refusal = _refusal(job)
        if refusal is None:
            feasible.append(job)
        else:
            yield job, _not_run(job, "infeasible", refusal), []
    outcomes = {outcome.job.id: outcome for outcome in _outcomes(feasible, engine, folder, console)}
    frame = engine.frame(folder) if feasible else pd.DataFrame(columns=["job"])
    for job in feasible:
        outcome = outcomes[job.id]
        rows = frame.loc[frame["job"] == job.id].dropna(axis="columns", how="all")
        if not len(rows) and job.controllers:
            rows = _not_run(job, outcome.status, outcome.reason)
        yield job, rows, _plans(folder, job)


def _refusal(job: Asked) -> str | None:
    """Why a job has no plan by what was calibrated, or None."""
    try:
        check(load(job.experiment, job.station, job.all_sets))
    except InfeasiblePlan as error:
        return str(error)
    return None


def _outcomes(asked: Sequence[Asked], engine: Engine, folder: Path, console: Console) -> Sequence[JobOutcome]:
    told = [
        Job(
            job.id,
            job.experiment,
            job.station,
            job.all_sets,
            {key: job.tags.get(key) for key in ("run", "trajectory")},
            home=folder.parent,  # the table's, with what was calibrated and planned for these jobs
        )
        for job in asked
    ]
    if not told:
        return []
    return engine.run(told, folder, workers=engine.workers, scheduler=engine.scheduler, console=console)


def _plans(folder: Path, job: Asked) -> list[dict[str, Any]]:
    """The plans that a job has made, with their files."""
    ended = CampaignFolder(folder).job(job.id).ended()
    if ended is None:
        return []
    run, results = ended
    return [
        {
            "job": job.id,
            "plan_time_s": plan["time_s"],
            "plan_loss": plan["loss"],
            "queries": plan["queries"],
            "status": plan["status"],
            "file": run / plan["file"],
        }
        for plan in results["plans"]
        if "from" not in plan
    ]


def _not_run(job: Asked, status: str, reason: str) -> pd.DataFrame:
    return pd.DataFrame([
        {"job": job.id, "controller": name, "trial": job.trial, "status": status, "reason": reason}
        for name in job.controllers
    ])  # fmt: skip


def _together(done: Sequence[tuple[Asked, pd.DataFrame]]) -> pd.DataFrame:
    """One frame of all trials; a job's tags stand above what its rows say under the same name."""
    frames = [frame.assign(**job.tags, job=job.id) for job, frame in done if len(frame)]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=["job", "status", "controller"])
