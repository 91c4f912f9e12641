"""Benchmarks: figures of one run side by side, and the targets they are held against."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from experiments.bench import figures
from experiments.exit_codes import ExitCode
from experiments.json_output import beside, put
from experiments.progress import Heard, Progress, unheard
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem, nearest, one_of

#: columns of a table that goes to a file or a pipe
FILE_WIDTH = 160


@dataclass(frozen=True)
class Options:
    """What a benchmark is asked for; None where it has a usual figure of its own, or no such option.

    ``runs``: measurements per figure. ``horizons``: steps of the problems of `planning`. ``minutes`` are of `load` and
    `bus`, ``viewers`` of `load`.
    """

    runs: int | None = None
    horizons: Sequence[int] | None = None
    minutes: float | None = None
    viewers: int | None = None


def _sim(options: Options, heard: Heard) -> Iterator[figures.Figure]:
    from experiments.bench import sim

    return sim.run(options.runs or RUNS, heard)


def _estimation(options: Options, heard: Heard) -> Iterator[figures.Figure]:
    from experiments.bench import estimation

    return estimation.run(options.runs or RUNS, heard)


def _planning(options: Options, heard: Heard) -> Iterator[figures.Figure]:
    from experiments.bench import planning

    return planning.run(options.runs or RUNS, options.horizons or planning.HORIZONS, heard)


def _load(options: Options, _: Heard) -> Iterator[figures.Figure]:
    from experiments.bench import load

    viewers = load.VIEWERS if options.viewers is None else options.viewers
    return load.run(options.minutes or load.MINUTES, viewers)


def _bus(options: Options, _: Heard) -> Iterator[figures.Figure]:
    from experiments.bench import bus

    return bus.run(bus.SECONDS if options.minutes is None else 60.0 * options.minutes)


def _seconds(name: str, options: Options) -> float | None:
    """How long a benchmark takes that measures for a set time; None where it depends on the machine."""
    if name == "load":
        from experiments.bench import load

        return 60.0 * (options.minutes or load.MINUTES) + load.AROUND
    if name == "bus":
        from experiments.bench import bus

        return 2 * (bus.SECONDS if options.minutes is None else 60.0 * options.minutes) + bus.AROUND
    return None


@contextmanager
def _progress(name: str, options: Options, progress: Progress) -> Iterator[Heard]:
    """The time left, by the clock or by the parts that are done; what is yielded is to be told their share."""
    seconds = _seconds(name, options)
    if seconds is None and progress.console.is_terminal:
        with progress.share(f"bench {name}") as heard:
            yield heard
    else:
        with progress.step(f"bench {name}", seconds):
            yield unheard


def _side_by_side(measured: Sequence[figures.Figure]) -> Table:
    from experiments.bench import planning_table

    return planning_table.side_by_side(measured)


BENCHMARKS: dict[str, Callable[[Options, Heard], Iterator[figures.Figure]]] = {
    "sim": _sim,
    "estimation": _estimation,
    "planning": _planning,
    "load": _load,
    "bus": _bus,
}
#: which benchmarks have an option
HAVE: dict[str, tuple[str, ...]] = {
    "runs": ("sim", "estimation", "planning"),
    "horizons": ("planning",),
    "minutes": ("load", "bus"),
    "viewers": ("load",),
}
#: measurements per figure
RUNS = 5
#: a second table of some benchmarks, made from the same figures
TABLES: dict[str, Callable[[Sequence[figures.Figure]], Table]] = {"planning": _side_by_side}


def horizons_of(text: str | None) -> tuple[int, ...] | None:
    """Numbers of steps, as ``40,200,1000``. Raises InputError for anything else."""
    if text is None:
        return None
    words = text.split(",")
    if not all(word.strip().isdecimal() and 1 <= int(word) <= 100_000 for word in words):
        wrong, expected = f"{text!r} are no horizons", "whole numbers of steps, such as 40,200,1000"
        raise InputError([Problem("bench", None, "--horizons", wrong, expected)])
    return tuple(dict.fromkeys(int(word) for word in words))


def main(name: str, options: Options, json_file: Path | None, out: Path | None, check: bool) -> ExitCode:
    """Run a benchmark and show it; the exit code says whether every target holds, if that was asked.

    Raises InputError for a benchmark that does not exist, or one that has no such option.
    """
    if name not in BENCHMARKS:
        known = one_of(BENCHMARKS)
        raise InputError([Problem("bench", None, name, "there is no such benchmark", known, nearest(name, BENCHMARKS))])
    for option, value in asdict(options).items():
        if value is not None and name not in HAVE[option]:
            having = " or ".join(f"bench {other}" for other in HAVE[option])
            raise InputError([Problem("bench", None, f"--{option}", f"{name} has no {option}", having)])
    targets = figures.targets_of(name)
    said = terminal(stderr=True)
    measured: list[figures.Figure] = []
    with _progress(name, options, Progress(said)) as heard:
        for figure in BENCHMARKS[name](options, heard):
            measured.append(figure)
            said.print(f"{figure.name}: {figure.median:.3g} {figure.unit}", highlight=False, markup=False)
    console = beside(json_file, FILE_WIDTH)
    console.print(figures.table(f"bench {name}", measured, targets))
    if name in TABLES:
        console.print(TABLES[name](measured))
    for path in (json_file, None if out is None else out / f"{name}.json"):
        put(path, figures.as_json(name, measured, targets))
    short = figures.shortfalls(measured, targets) if check else []
    for line in short:
        said.print(f"short: {line}", style="red", highlight=False, markup=False, soft_wrap=True)
    return ExitCode.FELL_SHORT if short else ExitCode.DONE
