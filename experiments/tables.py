"""Tables for the terminal: the errors of a run, the devices of a station."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from drivers.status import DeviceStatus


def error_table(results: dict[str, Any]) -> Table:
    """Pose and wrench error of every trial, through the sensors and, in simulation, against the truth beside it."""
    table = Table(
        title=f"{results['experiment']} on {results['station']}, seed {results['seed']}", title_justify="left"
    )
    table.add_column("trial")
    table.add_column("status")
    simulated = any(trial["truth"] is not None for trial in results["trials"])
    witnesses = ("measured", "truth") if simulated else ("measured",)
    for witness in witnesses:
        table.add_column(f"pose [mm]\n{witness}", justify="right")
        table.add_column(f"wrench [N]\n{witness}", justify="right")
    for trial in results["trials"]:
        cells = [escape(trial["name"]), trial["status"]]
        for witness in witnesses:
            figures = trial[witness] or {}
            cells += [_cell(figures.get("go_pose_mm")), _cell(figures.get("wrench_N"))]
        table.add_row(*cells, style=None if trial["status"] == "completed" else "yellow")
    if not results["trials"]:
        table.add_row("no trial was run", results["status"])
    return table


def _cell(figure: dict[str, float] | None) -> str:
    return "–" if figure is None else f"{figure['mean']:.3f} ± {figure['std']:.3f}"


def status_table(rows: Sequence[DeviceStatus]) -> Table:
    """One line per device."""
    table = Table()
    for name in ("device", "kind", "backend", "alive"):
        table.add_column(name)
    for name in ("rate [Hz]", "age [s]", "gaps"):
        table.add_column(name, justify="right")
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
