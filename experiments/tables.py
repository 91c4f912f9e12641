"""Tables for the terminal: the errors of a run, the devices of a station."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from drivers.status import DeviceStatus


def error_table(results: dict[str, Any]) -> Table:
    """Pose and wrench error of every trial, through the sensors and, in simulation, against the truth beside it."""
    title = f"{results['experiment']} on {results['station']}, seed {results['seed']}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("trial", overflow="fold")
    table.add_column("status")
    table.add_column("seen by")
    table.add_column(escape("pose [mm]"), justify="right", no_wrap=True)
    table.add_column(escape("wrench [N]"), justify="right", no_wrap=True)
    for trial in results["trials"]:
        name, status = escape(trial["name"]), trial["status"]
        style = None if status == "completed" else "yellow"
        for witness in ("measured", "truth"):
            figures = trial[witness]
            if figures is None and witness == "truth":
                continue
            cells = [_cell((figures or {}).get(key)) for key in ("go_pose_mm", "wrench_N")]
            table.add_row(name, status, witness, *cells, style=style)
            name = status = ""
    if not results["trials"]:
        table.add_row("no trial was run", results["status"])
    return table


def _cell(figure: dict[str, float] | None) -> str:
    return "–" if figure is None else f"{figure['mean']:.3f} ± {figure['std']:.3f}"


def status_table(rows: Sequence[DeviceStatus]) -> Table:
    """One line per device."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("device", "kind", "backend", "alive"):
        table.add_column(name, no_wrap=True)
    for name in ("rate [Hz]", "age [s]", "gaps"):
        table.add_column(escape(name), justify="right")
    table.add_column("note")
    for row in rows:
        table.add_row(
            escape(row.name),
            row.kind,
            row.backend,
            "yes" if row.alive else "no",
            "–" if row.rate is None else f"{row.rate:.0f}",
            "–" if row.age is None else f"{row.age:.2f}",
            "–" if row.gaps is None else str(row.gaps),
            escape(row.note),
            style=None if row.alive else "red",
        )
    return table
