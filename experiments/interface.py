"""The Python interface: what the command does, in three lines of a notebook.

::

    from experiments import run

    pivoting = run("grasped_pivoting", set={"world.profile": "lab"})
    pivoting.trials[["controller", "status", "measured.wrench_N.mean"]]

Bad input raises `mechanics.yaml_input.InputError`, before anything was started and with the command's own words; a run
that could not be carried out raises `RunFailed`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console

from drivers.wire import log_arrays
from drivers.wire.codec import Reading
from drivers.wire.log_arrays import Series
from drivers.wire.records import Record
from experiments import kernels
from experiments.exit_codes import ExitCode
from experiments.results_file import Results, read_json
from experiments.run_folder import RunFolder
from mechanics.yaml_input import InputError, Problem, nearest, one_of
from planning.plan import Plan

if TYPE_CHECKING:
    from pandas import DataFrame

Sets = Mapping[str, Any] | Sequence[str]


class RunFailed(Exception):
    """A run that began and could not be carried out: a device failed, it was stopped, a plan is infeasible.

    ``run`` is what it has left behind. A trial that falls short is no failure of the run: its row says how it ended.
    """

    def __init__(self, run: Run):
        self.run = run
        super().__init__(run)

    def __str__(self) -> str:
        return f"{self.run.status}: {self.run.reason}\n    what there is of it: Run.open({str(self.run.folder)!r})"


def run(
    experiment: str | Path,
    station: str | Path | None = None,
    *,
    set: Sets = (),
    out: str | Path | None = None,
    rehearse: bool = False,
    speed: float | None = None,
    quiet: bool = False,
) -> Run:
    """Run an experiment as `extrinsic run` does: plan, execute, log, measure, report.

    ``experiment`` and ``station`` are files, or names of shipped ones. ``set`` has keys of either with their values,
    ``{"trial.ramp": 0.3}``, or the command's ``["trial.ramp=0.3"]``. ``out`` is the run's folder, new or empty. With
    ``quiet`` nothing is printed. Raises what the module's docstring says, and KeyboardInterrupt where the user
    interrupted it, after the arm is held and the log closed.
    """
    from experiments import runner
    from experiments.files import load

    kernels.keep()
    chosen = [*settings(set), *(["rehearse=true"] if rehearse else [])]
    chosen += [] if speed is None else [f"trial.speed={speed:g}"]
    resolved = load(str(experiment), None if station is None else str(station), chosen)
    console = Console(stderr=True, quiet=quiet)
    outcome = runner.run(resolved, None if out is None else Path(out), console)
    done = Run(outcome.folder.path, outcome.results)
    if outcome.exit_code is ExitCode.INTERRUPTED:
        raise KeyboardInterrupt(str(RunFailed(done)))
    if outcome.exit_code not in (ExitCode.DONE, ExitCode.FELL_SHORT):
        raise RunFailed(done)
    return done


def settings(set: Sets) -> list[str]:
    """``set`` as the command's ``key=value``. Raises InputError for a value that no YAML file could hold."""
    if isinstance(set, str):
        raise InputError([Problem("set", None, "", f"{set!r} is text", "{key: value}, or a list of key=value")])
    if not isinstance(set, Mapping):
        return list(set)
    found: list[str] = []
    for key, value in set.items():
        try:
            found.append(f"{key}={json.dumps(value, allow_nan=False, default=_plain, ensure_ascii=False)}")
        except (TypeError, ValueError) as error:
            expected = "text, a figure, a list or a mapping of those"
            raise InputError([Problem(f"set {key}", None, str(key), f"{error}", expected)]) from None
    return found


def _plain(value: Any) -> Any:
    """numpy's figures and arrays, and paths, as JSON has them."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is no value of a file")


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """A run: its folder, and what it left there, read when it is asked for. ``results`` are those of results.json."""

    folder: Path
    results: dict[str, Any] = field(repr=False)

    @classmethod
    def open(cls, folder: str | Path) -> Self:
        """The run in a folder. Raises InputError where there is none, or none with results."""
        found = RunFolder.open(Path(folder))
        results = read_json(found.results, Results)
        if results is None:
            wrong, repair = "no results can be read in it", f"extrinsic repair {found.path} rebuilds them from the log"
            raise InputError([Problem(str(found.results), None, "", wrong, repair)])
        return cls(found.path, results)

    @property
    def status(self) -> str:
        """How it ended: ``completed``, ``fell_short``, …; ``running`` where it has not, or was killed."""
        return self.results["status"]

    @property
    def reason(self) -> str:
        """Why, where it did not complete."""
        return self.results["reason"]

    @cached_property
    def trials(self) -> DataFrame:
        """A row for each trial, with the columns of a sweep's table: ``controller``, ``measured.wrench_N.mean``, …"""
        from experiments.campaign.frame import frame_of

        return frame_of(self.results["trials"])

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """The plans that it made or took from files, by name. Raises InputError for one that can no longer be read."""
        from experiments.planning.files import own_plan

        return {row["name"]: own_plan(self.folder / row["file"]) for row in self.results["plans"]}

    @cached_property
    def log(self) -> Log:
        """Everything that was logged, by topic."""
        return Log(tuple(RunFolder(self.folder).logs()), self.results["station"])

    @property
    def report(self) -> Path:
        """Its report, a page for a browser."""
        return RunFolder(self.folder).report

    def __repr__(self) -> str:
        return f"Run({self.folder}: {self.status}, {len(self.results['trials'])} trials)"

    def _repr_html_(self) -> str:
        """The command's table, for a notebook."""
        from experiments.tables import error_table

        console = Console(record=True, file=io.StringIO(), width=110, force_jupyter=False)
        console.print(error_table(self.results))
        table = console.export_html(inline_styles=True, code_format="<pre>{code}</pre>")
        return f"{table}<p>report: <code>{self.report}</code></p>"


class Log(Mapping[str, Series]):
    """The logs of a run as arrays by topic: ``log["wrist_ft/wrench"]`` is a `drivers.wire.log_arrays.Series`.

    Topics go by their names on the station, with or without the station's own in front. A topic is read when it is
    first asked for; pictures are read each time, and `readings` gives them one after the other.
    """

    def __init__(self, files: tuple[Path, ...], station: str):
        self.files = files
        self._prefix = f"{station}/"
        self._known: dict[str, Series] = {}

    @cached_property
    def counts(self) -> dict[str, int]:
        """How many messages each topic has."""
        found = log_arrays.topics(self.files)
        return {topic.removeprefix(self._prefix): count for topic, count in sorted(found.items())}

    def __getitem__(self, topic: str) -> Series:
        """Raises KeyError with the nearest topic; ProtocolError for a type that no station has."""
        name = self._named(topic)
        if name in self._known:
            return self._known[name]
        found = log_arrays.series(self.files, self._key(name))
        if found.values.ndim == 2:
            self._known[name] = found
        return found

    def readings(self, topic: str) -> Iterator[Reading | Record]:
        """The readings of a topic, or records of the run, as frozen values, one after the other."""
        return log_arrays.readings(self.files, self._key(self._named(topic)))

    def __iter__(self) -> Iterator[str]:
        return iter(self.counts)

    def __len__(self) -> int:
        return len(self.counts)

    def __repr__(self) -> str:
        return f"Log({', '.join(self.counts)})"

    def _named(self, topic: str) -> str:
        name = str(topic).removeprefix(self._prefix)
        if name not in self.counts:
            close = nearest(name, self.counts)
            raise KeyError(f"nothing was logged of {topic!r}; {f'nearest: {close}' if close else one_of(self.counts)}")
        return name

    def _key(self, name: str) -> str:
        return name if name.startswith("run/") else f"{self._prefix}{name}"
