"""From a table file to jobs: which calibrations come first, which runs follow, and what each job is told."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.calibrate import store
from experiments.calibrate.store import Calibrations
from experiments.campaign.jobs import InfeasibleJob
from experiments.check import check
from experiments.files import EXPERIMENTS, Resolved, load
from experiments.planning.schema import PlanStage
from experiments.schema import ExecuteStage
from experiments.table.aggregate import refuse_doubles
from experiments.table.schema import CalibrationEntry, RunEntry, Table, Trajectory
from mechanics.yaml_input import InputError, Problem, locate, nearest, one_of, parse, read_yaml, set_key
from planning.errors import InfeasiblePlan

#: what keys begin with that calibrations have no use for
_OF_RUNS = ("stages", "trial")
#: words that YAML reads as something else than text
_NOT_TEXT = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


@dataclass(frozen=True)
class Options:
    """What the command line asks of a table: ``trials`` and ``runs`` make it a part."""

    seed: int = 0
    trials: int | None = None
    runs: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()

    @property
    def part(self) -> bool:
        """Whether only a part of the table is run."""
        return self.trials is not None or bool(self.runs)


@dataclass(frozen=True)
class Asked:
    """One job: an experiment with its ``sets``; ``tags`` and the ``trial`` and ``controllers`` that it stands for.

    ``stages`` are those that it runs, ``execute`` among them, where trials are asked for.
    """

    id: str
    experiment: str
    station: str | None
    sets: tuple[str, ...]
    tags: dict[str, Any] = field(default_factory=dict)
    stages: tuple[dict[str, Any], ...] = ()
    trial: int = 0
    controllers: tuple[str, ...] = ()
    plans_of: str | None = None

    @property
    def all_sets(self) -> tuple[str, ...]:
        """``sets``, and the stages with this job's trial and controllers."""
        if not self.stages:
            return self.sets
        return (*self.sets, f"stages={json.dumps([self._told(stage) for stage in self.stages], ensure_ascii=False)}")

    def _told(self, stage: dict[str, Any]) -> dict[str, Any]:
        if stage["stage"] != "execute":
            return stage
        settings = {name: given for name, given in stage["settings"].items() if name in self.controllers}
        own = {"controllers": list(self.controllers), "settings": settings, "trials": 1, "first": self.trial}
        return {**stage, **own}

    def of(self, controllers: Sequence[str]) -> Asked:
        """The same trial under some of its controllers."""
        return replace(self, id=f"{self.id}-{'-'.join(controllers)}", controllers=tuple(controllers))

    def executing(self, plan: Path) -> Asked:
        """The same trial of a saved plan, taken to this job's fingers."""
        stages = tuple({**s, "plan": str(plan), "restiffen": True} for s in self.stages if s["stage"] == "execute")
        return replace(self, stages=stages)


def load_table(name: str, sets: Sequence[str] = ()) -> tuple[Table, tuple[str, ...]]:
    """The table ``name``, shipped as ``table_<name>.yaml`` or a path; and those ``sets`` that are for its jobs.

    A set whose key begins with ``table.`` changes the table itself. Raises InputError.
    """
    shipped = {p.stem.removeprefix("table_"): p for p in EXPERIMENTS[0].glob("table_*.yaml")}
    if name in shipped:
        document = read_yaml(shipped[name])
    elif name.endswith((".yaml", ".yml")):
        document = read_yaml(locate(name, "table", EXPERIMENTS, EXPERIMENTS[:1]))
    else:
        wrong = "there is no such table"
        raise InputError([Problem("table", None, name, wrong, f"{one_of(shipped)}, or a path", nearest(name, shipped))])
    for text in sets:
        key, equals, value = text.partition("=")
        if key.startswith("table.") and equals:
            document = set_key(document, key.removeprefix("table."), value)
    return parse(Table, document), tuple(text for text in sets if not text.startswith("table."))


def selected(table: Table, runs: Sequence[str]) -> tuple[RunEntry, ...]:
    """The runs asked for, by default all, and those whose plans they execute. Raises InputError."""
    known = [run.name for run in table.runs]
    for name in runs:
        if name not in known:
            wrong = f"table {table.name} has no run {name!r}"
            raise InputError([Problem("table", None, "--runs", wrong, one_of(known), nearest(name, known))])
    asked = set(runs or known)
    for run in reversed(table.runs):
        if run.name in asked and run.plans_of is not None:
            asked.add(run.plans_of)
    return tuple(run for run in table.runs if run.name in asked)


def calibration_phases(table: Table, runs: Sequence[RunEntry]) -> list[list[CalibrationEntry]]:
    """The calibrations that ``runs`` need: those of one phase do not wait for each other."""
    needed = {run.calibration for run in runs}
    for entry in reversed(table.calibrations):
        if entry.name in needed:
            needed.add(entry.after)
    depth: dict[str | None, int] = {None: -1}
    for entry in table.calibrations:
        depth[entry.name] = depth[entry.after] + 1
    wanted = [entry for entry in table.calibrations if entry.name in needed]
    return [[e for e in wanted if depth[e.name] == d] for d in range(max(depth.values()) + 1) if wanted]


def calibration_job(table: Table, entry: CalibrationEntry, options: Options, folder: Path) -> Asked:
    """The job of a calibration that leaves its files in ``folder``."""
    sets = _calibrating(table, entry, options, folder)
    return Asked(f"calibration-{entry.name}", entry.experiment, entry.station, sets, {"run": entry.name})


def _calibrating(table: Table, entry: CalibrationEntry, options: Options, folder: Path | None) -> tuple[str, ...]:
    """The sets of a calibration: what the table and the command line say of stages and trials is for the runs."""
    common = {key: value for key, value in table.set.items() if not key.startswith(_OF_RUNS)}
    asked = [text for text in options.sets if not text.startswith(_OF_RUNS)]
    return _sets(common, entry.set, asked, options.seed, folder)


def run_jobs_of(table: Table, run: RunEntry, options: Options, folder: Path | None) -> list[Asked]:
    """A job for each trajectory and trial of a run, all controllers of a trial in one: they are compared in pairs.

    ``folder`` has its calibration files. Raises InputError for a key or a value that the experiment does not take.
    """
    controllers = table.controllers_of(run)
    jobs: list[Asked] = []
    for n, trajectory in enumerate(table.trajectories_of(run)):
        sets = _sets({**table.set, **run.set}, trajectory.set, options.sets, options.seed, folder)
        resolved, stages = _resolved(table, run, trajectory, sets, controllers)
        tags = _tags(run, trajectory, resolved)
        others = tuple(text for text in sets if not text.startswith("stages"))  # the stages are resolved
        if run.plans_of is not None and resolved.experiment.grasp.centre_mm == "auto":
            centre = _grasp_centre(table, run.plans_of, trajectory.name, options, folder)
            others = (*others, f"grasp.centre_mm={json.dumps(centre)}")
        one = Asked(f"{run.name}-{trajectory.name}", run.experiment, run.station, others, tags, stages)
        if not controllers:
            jobs.append(one)
            continue
        jobs += [
            replace(one, id=f"{one.id}-{number}", trial=number, controllers=controllers, plans_of=run.plans_of)
            for number in _numbers(table, run, n, options)
        ]
    return jobs


def _numbers(table: Table, run: RunEntry, n: int, options: Options) -> range:
    """The numbers of the trials of a run's n-th trajectory."""
    trials = table.trials_of(run)
    return range(n * trials, n * trials + trials)[: options.trials]


def _grasp_centre(
    table: Table, name: str, trajectory: str, options: Options, folder: Path | None
) -> tuple[float, float]:
    """Where the object is held [mm] in the run whose plans are executed again: with other fingers, too."""
    run = next(run for run in table.runs if run.name == name)
    own = next((one.set for one in table.trajectories_of(run) if one.name == trajectory), {})
    sets = _sets({**table.set, **run.set}, own, options.sets, options.seed, folder)
    given = tuple(text for text in sets if not text.startswith("stages"))
    return load(run.experiment, run.station, given).grasp_centre_mm


def check_first(table: Table, runs: Sequence[RunEntry], options: Options) -> None:
    """Resolve every calibration and run, try their tasks with nominal figures, and see that comparisons are of pairs.

    All that before anything is started. Raises InputError, and InfeasiblePlan where there is no plan.
    """
    _refuse_more_trials(table, runs, options)
    left: dict[str | None, set[str]] = {None: set()}
    for entry in (entry for phase in calibration_phases(table, runs) for entry in phase):
        sets = _calibrating(table, entry, options, None)
        with _told_of(f"calibration {entry.name}"):
            resolved = load(entry.experiment, entry.station, sets)
            made = store.made_by(resolved)
            if not made:
                wrong = f"{entry.experiment} has no stage that calibrates"
                raise InputError([_problem(table, "calibrations", entry.name, wrong, "`calibrate_…` stages")])
            check(resolved, Calibrations())
        left[entry.name] = left[entry.after] | made
    trials: list[dict[str, Any]] = []
    for run in runs:
        controllers = table.controllers_of(run)
        for n, trajectory in enumerate(table.trajectories_of(run)):
            sets = _sets({**table.set, **run.set}, trajectory.set, options.sets, options.seed, None)
            with _told_of(f"run {run.name}, trajectory {trajectory.name}"):
                resolved, _ = _resolved(table, run, trajectory, sets, controllers)
                check(resolved, Calibrations())
            if run.calibration is not None and not left[run.calibration].intersection(store.wanted(resolved)):
                wrong = f"nothing that {run.calibration} finds is of this run's sensor, objects or devices"
                raise InputError([_problem(table, "runs", run.name, wrong, "one that is, or no `calibration`")])
            tags = _tags(run, trajectory, resolved)
            numbers = _numbers(table, run, n, options)
            trials += [{**tags, "controller": name, "trial": number} for number in numbers for name in controllers]
    refuse_doubles(table, pd.DataFrame(trials))


def _problem(table: Table, key: str, name: str, wrong: str, expected: str) -> Problem:
    return Problem(f"table {table.name}", None, f"{key}.{name}", wrong, expected)


def _refuse_more_trials(table: Table, runs: Sequence[RunEntry], options: Options) -> None:
    """``--trials`` makes a part of the table, never more than the table."""
    most = max(table.trials_of(run) for run in runs)
    if options.trials is not None and options.trials > most:
        wrong = f"{options.trials} are more than there are: {most} of each trajectory"
        expected = f"at most {most}; more are made by --set table.trials={options.trials}"
        raise InputError([Problem(f"table {table.name}", None, "--trials", wrong, expected)])


@contextmanager
def _told_of(what: str) -> Iterator[None]:
    """What goes wrong inside says where: the calibration, or the run and its trajectory."""
    try:
        yield
    except InputError as error:
        raise InputError([replace(p, file=f"{what}: {p.file}") for p in error.problems]) from None
    except InfeasiblePlan as error:
        raise InfeasibleJob(what, error) from None


def _sets(
    common: Mapping[str, Any], own: Mapping[str, Any], asked: Sequence[str], seed: int, folder: Path | None
) -> tuple[str, ...]:
    """``key=value`` of every layer, what comes later counting more; the command line's last."""
    layers = {key: written(value) for key, value in {**common, **own}.items()}
    source = "none" if folder is None else str(folder.absolute())
    fixed = ("seed", "calibration.source")
    given = (text for text in asked if text.partition("=")[0] not in fixed)
    return (
        *(f"{key}={value}" for key, value in layers.items()),
        *given,
        f"seed={seed}",
        f"calibration.source={written(source)}",
    )


def written(value: Any) -> str:
    """A value as it stands behind ``key=`` in a set: YAML on one line, plain text plain."""
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z/][\w./-]*", value) and value.lower() not in _NOT_TEXT:
        return value
    return json.dumps(value, ensure_ascii=False)


def _resolved(
    table: Table, run: RunEntry, trajectory: Trajectory, sets: tuple[str, ...], controllers: tuple[str, ...]
) -> tuple[Resolved, tuple[dict[str, Any], ...]]:
    """The experiment with these ``sets`` and ``controllers``, and the stages that it is to run."""
    given = [text for text in sets if text.startswith("stages=")]
    whole = load(run.experiment, run.station, given)
    at = [i for i, stage in enumerate(whole.experiment.stages) if isinstance(stage, ExecuteStage)]
    if controllers and len(at) != 1:
        wrong = f"run {run.name}: {run.experiment} has {len(at)} execute stages"
        raise InputError([Problem(f"table {table.name}", None, "runs", wrong, "an experiment with one")])
    own = [f"stages.{at[0]}.controllers={json.dumps(controllers)}"] if controllers else []
    rest = [text for text in sets if text not in given]  # a law's settings can be set where the law is there
    resolved = load(run.experiment, run.station, [*given, *own, *rest])
    kinds = (PlanStage, ExecuteStage) if controllers else PlanStage
    stages = [stage for stage in resolved.experiment.stages if isinstance(stage, kinds)]
    return resolved, tuple(stage.model_dump(mode="json") for stage in stages)


def _tags(run: RunEntry, trajectory: Trajectory, resolved: Resolved) -> dict[str, Any]:
    """What tells the trials of a run: its own tags, and what the experiment says of friction, sensor and sizes."""
    eo, mu = resolved.extrinsic, resolved.friction
    return {
        "run": run.name,
        "trajectory": trajectory.name,
        "sensor": resolved.sensor.name,
        "mu_ground": mu["go-ground"] if eo is None else mu["eo-ground"],
        "mu_object": None if eo is None else mu["go-eo"],
        "rho_mm": (resolved.grasped if eo is None else eo).polygon.radius_of_gyration * 1e3,
        **run.tags,
    }
