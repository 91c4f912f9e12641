"""Benchmarks: figures of one run side by side, and the targets they are held against."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from experiments.bench import figures
from experiments.exit_codes import ExitCode
from experiments.progress import Progress
from experiments.run_folder import write_json
from mechanics.yaml_input import InputError, Problem, nearest, one_of

Horizons = Sequence[int] | None
#: columns of a table that goes to a file or a pipe
FILE_WIDTH = 160


def _sim(runs: int, _horizons: Horizons) -> Iterator[figures.Figure]:
    from experiments.bench import sim

    return sim.run(runs)


def _estimation(runs: int, _horizons: Horizons) -> Iterator[figures.Figure]:
    from experiments.bench import estimation

    return estimation.run(runs)


def _planning(runs: int, horizons: Horizons) -> Iterator[figures.Figure]:
    from experiments.bench import planning

    return planning.run(runs, horizons or planning.HORIZONS)


def _side_by_side(measured: Sequence[figures.Figure]) -> Table:
    from experiments.bench import planning_table

    return planning_table.side_by_side(measured)


BENCHMARKS: dict[str, Callable[[int, Horizons], Iterator[figures.Figure]]] = {
    "sim": _sim,
    "estimation": _estimation,
    "planning": _planning,
}
#: a second table of some benchmarks, made from the same figures
TABLES: dict[str, Callable[[Sequence[figures.Figure]], Table]] = {"planning": _side_by_side}


def main(
    name: str, runs: int, json_file: Path | None, out: Path | None, check: bool, horizons: Horizons = None
) -> ExitCode:
    """Run a benchmark and show it; the exit code says whether every target holds, if that was asked.

    ``horizons``: steps of the problems of `planning`. Raises InputError for a benchmark that does not exist, or one
    that has no horizons.
    """
    if name not in BENCHMARKS:
        known = one_of(BENCHMARKS)
        raise InputError([Problem("bench", None, name, "there is no such benchmark", known, nearest(name, BENCHMARKS))])
    if horizons is not None and name != "planning":
        raise InputError([Problem("bench", None, "--horizons", f"{name} has no horizons", "bench planning")])
    targets = figures.targets_of(name)
    said = Console(stderr=True)
    measured: list[figures.Figure] = []
    with Progress(said).step(f"bench {name}"):
        for figure in BENCHMARKS[name](runs, horizons):
            measured.append(figure)
            said.print(f"{figure.name}: {figure.median:.3g} {figure.unit}", highlight=False, markup=False)
    console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else FILE_WIDTH)
    console.print(figures.table(f"bench {name}", measured, targets))
    if name in TABLES:
        console.print(TABLES[name](measured))
    for path in (json_file, None if out is None else out / f"{name}.json"):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, figures.as_json(name, measured, targets))
    short = figures.shortfalls(measured, targets) if check else []
    for line in short:
        said.print(f"short: {line}", style="red", highlight=False, markup=False, soft_wrap=True)
    return ExitCode.FELL_SHORT if short else ExitCode.DONE
