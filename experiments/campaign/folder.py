"""What a campaign leaves on disk, and what of it is there already: the truth about a campaign is its folder."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from experiments.calibrate import store
from experiments.campaign.jobs import Job, digest, moved, planned_trials
from experiments.files import Resolved, dump_resolved, load
from experiments.planning.files import plan_files
from experiments.results_file import Planned, Results, Word, read_json
from experiments.run_folder import write_atomic, write_json
from experiments.schema import ExecuteStage
from mechanics.yaml_input import InputError, Problem
from planning import plan_file

#: a run with one of these has come to its end, and running it again would give the same
ENDED = ("completed", "fell_short", "stopped", "infeasible")

#: the name of a run's folder, and its number; whatever else lies beside is somebody's own
_RUN = re.compile(r"run(?:\.([1-9][0-9]{0,8}))?")


#: what says which jobs a campaign has
_TOLD = "campaign.json"
#: what says what a table's folder was begun for
ASKED = "asked.json"


class JobFolder:
    """``jobs/<id>/``: the experiment, frozen, and its runs ``run``, ``run.1``, … of which none is ever overwritten."""

    def __init__(self, path: Path):
        self.path = path
        self.experiment = path / "experiment.yaml"
        self._failure = path / "failed.json"

    def runs(self) -> list[Path]:
        """Its run folders, oldest first."""
        found = {int(match[1] or 0): path for path in self.path.glob("run*") if (match := _RUN.fullmatch(path.name))}
        return [found[number] for number in sorted(found) if found[number].is_dir()]

    def next_run(self) -> Path:
        """A new run folder, made by nobody else."""
        number = len(self.runs())
        while True:
            path = self.path / (f"run.{number}" if number else "run")
            try:
                path.mkdir()
            except FileExistsError:
                number += 1
            else:
                return path

    def ended(self) -> tuple[Path, dict[str, Any]] | None:
        """The newest run that came to its end, and its results."""
        for run in reversed(self.runs()):
            results = _results(run)
            if results is not None and results["status"] in ENDED:
                return run, results
        return None

    def newest(self) -> dict[str, Any] | None:
        """The results of the newest run that has any, whole or not."""
        return next((found for run in reversed(self.runs()) if (found := _results(run)) is not None), None)

    def told(self) -> str | None:
        """Why the newest run did not come to its end, where it has ended itself and left word of it."""
        results = _results(runs[-1]) if (runs := self.runs()) else None
        return None if results is None or results["status"] == "running" else results["reason"] or None

    @property
    def failure(self) -> str | None:
        """Why the job was given up, if it was."""
        if not self._failure.is_file():
            return None
        told = read_json(self._failure, _Failure)
        return "given up, nobody can read why" if told is None else told["reason"]

    def give_up(self, reason: str) -> None:
        """Note why no more attempt is made."""
        write_json(self._failure, {"reason": reason})

    def try_again(self) -> None:
        """Forget that it was given up."""
        self._failure.unlink(missing_ok=True)


def _results(run: Path) -> dict[str, Any] | None:
    """The results of a run; None where there are none that anybody can read: then it has not come to its end."""
    return read_json(run / "results.json", Results)


class _Failure(BaseModel):
    reason: str


class _Job(BaseModel):
    id: str = Field(pattern=r"^[^/\\\x00.][^/\\\x00]{0,199}$")
    tags: dict[Word, str | int | float | bool | None]
    trials: list[Planned]


class _Campaign(BaseModel):
    jobs: list[_Job]


def is_campaign(path: Path) -> bool:
    """Whether a campaign lies in a folder, and no run."""
    return (path / _TOLD).is_file()


def is_table(path: Path) -> bool:
    """Whether a table lies in a folder, or was begun there: its campaigns are below."""
    return (path / ASKED).is_file()


class CampaignFolder:
    """``campaign.json`` with what the campaign is, and ``jobs/<id>/`` for each of its jobs."""

    def __init__(self, path: Path):
        self.path = path.absolute()
        self.campaign = self.path / _TOLD

    def job(self, id: str) -> JobFolder:
        """The folder of a job."""
        return JobFolder(self.path / "jobs" / id)

    def read(self) -> dict[str, Any]:
        """What campaign.json says. Raises InputError where there is none."""
        if not self.campaign.is_file():
            raise InputError([Problem(str(self.path), None, "", "no campaign.json in it", "a sweep's folder")])
        found = read_json(self.campaign, _Campaign)
        if found is None:
            raise InputError([Problem(str(self.campaign), None, "", "no campaign can be read in it", "a sweep's own")])
        return found

    def agree(self, jobs: Sequence[Job], resolved: Mapping[str, Resolved]) -> dict[str, Any]:
        """What campaign.json says of these jobs, now or once `keep` has written it.

        Raises InputError when the folder holds something else, or another campaign.
        """
        asked = {**_described(jobs, resolved), "folder": str(self.path)}
        if self.campaign.is_file():
            if wrong := _difference(self.read()["jobs"], asked["jobs"]):
                expected = "the same sweep, or another folder for this one"
                raise InputError(
                    [Problem(str(self.path), None, "--out", f"another sweep lies there: {wrong}", expected)]
                )
        elif self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            wrong, expected = "there is something there already, and no sweep", "a new or an empty folder"
            raise InputError([Problem(str(self.path), None, "--out", wrong, expected)])
        return asked

    def keep(self, asked: Mapping[str, Any], jobs: Sequence[Job], resolved: Mapping[str, Resolved]) -> None:
        """Write what is not there yet: campaign.json, and each job's experiment with what it reads frozen beside it.

        So the calibrations and the plan files that a campaign began with are those that it ends with, and a worker
        needs no other folder than this one, wherever it is moved. Raises InputError when it cannot be written.
        """
        shelves = _shelves(resolved[job.id] for job in jobs)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            begun = self.campaign.is_file()
            there = self.read().get("folder") if begun else None
            if not begun:
                write_json(self.campaign, asked)
            for job in jobs:
                folder = self.job(job.id)
                if not folder.experiment.is_file():
                    folder.path.mkdir(parents=True, exist_ok=True)
                    frozen = load(
                        job.experiment, job.station, (*job.sets, *self._freeze(folder, resolved[job.id], shelves))
                    )
                    write_atomic(folder.experiment, dump_resolved(frozen))
                elif there is not None and there != str(self.path):
                    frozen = moved(load(str(folder.experiment)), Path(there), self.path)
                    write_atomic(folder.experiment, dump_resolved(frozen))
            if begun and there != str(self.path):
                write_json(self.campaign, asked)
        except OSError as error:
            wrong = f"cannot be written: {error.strerror}"
            raise InputError([Problem(str(self.path), None, "--out", wrong, "a folder you may write to")]) from None

    def _freeze(self, folder: JobFolder, resolved: Resolved, shelves: Mapping[Path, str]) -> list[str]:
        """Copy what the job reads; the sets that name the copies. A job that calibrates writes to a copy of its own."""
        sets: list[str] = []
        stages = resolved.experiment.stages
        source = store.folder_of(resolved)
        if any(stage.stage.startswith("calibrate") for stage in stages):
            sets.append(_set("calibration.source", copied(source, folder.path / "calibrations")))
        elif resolved.experiment.calibration.source != "none" and source.is_dir():
            sets.append(_set("calibration.source", copied(source, self.path / "calibrations" / shelves[source])))
        elif resolved.experiment.calibration.source == "auto":
            sets.append(_set("calibration.source", "none"))  # what others calibrate meanwhile is not of this campaign
        plans = plan_files(resolved)
        for i, stage in enumerate(stages):
            if isinstance(stage, ExecuteStage) and stage.from_file:
                copy = folder.path / "plans" / Path(stage.plan).name
                copy.parent.mkdir(exist_ok=True)
                plan_file.save(plans[stage.plan], copy)
                sets.append(_set(f"stages.{i}.plan", copy))
        return sets


def _shelves(every: Iterable[Resolved]) -> dict[Path, str]:
    """What the copy of each folder of calibrations is called: as the folder, as long as no other is called so."""
    names: dict[Path, str] = {}
    for source in map(store.folder_of, every):
        number, name = 1, source.name
        while source not in names and name in names.values():
            number += 1
            name = f"{source.name}-{number}"
        names.setdefault(source, name)
    return names


def _set(key: str, value: object) -> str:
    return f"experiment.{key}={json.dumps(str(value))}"


def copied(source: Path, target: Path) -> Path:
    """``target``, a copy of the files in ``source`` made once, at once; an empty folder where there is no source."""
    if not target.exists():
        aside = target.with_name(f".{target.name}")
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        for file in source.glob("*.yaml"):
            shutil.copy2(file, aside)
        aside.replace(target)
    return target


def _described(jobs: Sequence[Job], resolved: Mapping[str, Resolved]) -> dict[str, Any]:
    told = {
        "schema": 1,
        "experiment": resolved[jobs[0].id].experiment.name,
        "jobs": [
            {
                "id": job.id,
                "experiment": job.experiment,
                "station": job.station,
                "sets": list(job.sets),
                "tags": dict(job.tags),
                "resolved": digest(resolved[job.id], job.home),
                "trials": planned_trials(resolved[job.id]),
            }
            for job in jobs
        ],
    }
    return json.loads(json.dumps(told, allow_nan=False))  # as it will be read: a tuple is a list there


def _difference(there: Sequence[Mapping[str, Any]], asked: Sequence[Mapping[str, Any]]) -> str:
    """The first difference between two campaigns' jobs in words; '' where there is none."""
    known, wanted = {job["id"]: job for job in there}, {job["id"]: job for job in asked}
    for id, job in wanted.items():
        if id not in known:
            return f"it has no job {id}"
        if known[id]["tags"] != job["tags"]:
            return f"its job {id} is {known[id]['tags']}, not {job['tags']}"
        if known[id].get("resolved") != job["resolved"]:
            return f"its job {id} has another experiment or station (jobs/{id}/experiment.yaml)"
    more = [id for id in known if id not in wanted]
    return f"it has a job {more[0]}, too" if more else ""
