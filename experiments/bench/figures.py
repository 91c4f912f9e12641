"""A benchmark's figures, their targets in `experiments/targets.yaml`, and the table of both."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

import experiments
from experiments.progress import Heard, unheard
from experiments.provenance import provenance
from mechanics.yaml_input import parse, read_yaml

TARGETS = Path(experiments.__file__).parent / "targets.yaml"


@dataclass(frozen=True)
class Figure:
    """One measured figure: the median of ``runs`` measurements, their spread, and what was measured."""

    name: str
    median: float
    low: float
    high: float
    unit: str
    runs: int
    what: str = ""


class Target(BaseModel):
    """The least or the most that a figure may be, and why."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    at_least: float | None = None
    at_most: float | None = None
    source: str

    def holds(self, value: float) -> bool:
        """Whether ``value`` reaches the target."""
        return (self.at_least is None or value >= self.at_least) and (self.at_most is None or value <= self.at_most)

    def __str__(self) -> str:
        parts = [f"≥ {self.at_least:g}"] if self.at_least is not None else []
        parts += [f"≤ {self.at_most:g}"] if self.at_most is not None else []
        return ", ".join(parts)


class Targets(BaseModel):
    """The whole file: benchmark → figure → target, and for `extrinsic table` table → finding → target."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sim: dict[str, Target]
    estimation: dict[str, Target]
    planning: dict[str, Target]
    load: dict[str, Target] = {}
    bus: dict[str, Target] = {}
    tables: dict[str, dict[str, Target]] = {}


def targets_of(benchmark: str) -> dict[str, Target]:
    """The targets of a benchmark by figure. Raises InputError for a file that cannot be read."""
    return getattr(parse(Targets, read_yaml(TARGETS)), benchmark)


def median_of(name: str, measure: Callable[[], float], unit: str, runs: int, what: str = "") -> Figure:
    """Measure ``runs`` times after one unmeasured warm-up."""
    measure()
    return figure_of(name, [measure() for _ in range(runs)], unit, what)


def figure_of(name: str, values: Iterable[float], unit: str, what: str = "") -> Figure:
    """The figure of measured values."""
    array = np.array(list(values))
    return Figure(name, float(np.median(array)), float(array.min()), float(array.max()), unit, len(array), what)


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call [s]."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


Part = tuple[float, Callable[[], Iterable[Figure]]]
"""About how long a part of a benchmark takes [s], of which only the ratios count, and what measures it."""


def in_parts(parts: Sequence[Part], heard: Heard = unheard) -> Iterator[Figure]:
    """The figures of all ``parts``; ``heard`` is told what share of the work is done after each."""
    whole, done = sum(takes for takes, _ in parts), 0.0
    for takes, measure in parts:
        yield from measure()
        done += takes
        heard(done / whole)


def shortfalls(figures: Iterable[Figure], targets: dict[str, Target]) -> list[str]:
    """A line for each figure that misses its target, and for each target that nothing measured."""
    measured = {figure.name: figure for figure in figures}
    lines = []
    for name, target in targets.items():
        if name not in measured:
            lines.append(f"{name}: not measured, target {target}")
        elif not target.holds(measured[name].median):
            figure = measured[name]
            what = f"; {figure.what}" if figure.what else ""
            lines.append(f"{name}: {figure.median:.3g} {figure.unit}, target {target} ({target.source}){what}")
    return lines


def table(title: str, figures: Iterable[Figure], targets: dict[str, Target]) -> Table:
    """The figures beside their targets."""
    shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    shown.add_column("figure", overflow="fold")
    for column in ("median", "range"):
        shown.add_column(column, justify="right", no_wrap=True)
    shown.add_column("unit", no_wrap=True)
    shown.add_column("target", no_wrap=True)
    shown.add_column("holds")
    for figure in figures:
        target = targets.get(figure.name)
        holds = target is None or target.holds(figure.median)
        shown.add_row(
            escape(figure.name),
            f"{figure.median:.3g}",
            f"{figure.low:.3g} – {figure.high:.3g}",
            escape(figure.unit),
            "" if target is None else str(target),
            "" if target is None else "yes" if holds else "no",
            style=None if holds else "red",
        )
    return shown


def as_json(benchmark: str, figures: Iterable[Figure], targets: dict[str, Target]) -> dict[str, Any]:
    """What `--json` writes."""
    rows = []
    for figure in figures:
        target = targets.get(figure.name)
        rows.append(
            asdict(figure)
            | {
                "target": None if target is None else target.model_dump(),
                "holds": None if target is None else target.holds(figure.median),
            }
        )
    return {"schema": 1, "benchmark": benchmark, "provenance": provenance(), "figures": rows}
