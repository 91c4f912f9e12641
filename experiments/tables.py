"""Tables for the terminal: the errors of a run, the devices of a station."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from drivers.status import DeviceStatus
from drivers.wire.security import WARNING_DAYS
from experiments.paper import beside

#: columns: figure and heading; the extrinsic object's only where there is one
COLUMNS = {"go_pose_mm": "pose [mm]", "eo_pose_mm": "eo pose [mm]", "wrench_N": "wrench [N]"}


def error_table(results: dict[str, Any]) -> Table:
    """Pose and wrench error of every trial, through the sensors and, in simulation, against the truth beside it."""
    title = f"{results['experiment']} on {results['station']}, seed {results['seed']}\n"
    # narrow: a terminal of 80 columns has room for the names of trials
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
    table.add_column("trial", overflow="fold")
    table.add_column("status", no_wrap=True)
    table.add_column("seen by", no_wrap=True)
    moved = any(trial.get("extrinsic_object") for trial in results["trials"])
    figures = [key for key in COLUMNS if moved or key != "eo_pose_mm"]
    for key in figures:
        table.add_column(escape(COLUMNS[key]), justify="right", no_wrap=True)
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for trial in results["trials"]:
        groups.setdefault((trial["skill"], trial["controller"]), []).append(trial)
        style = None if trial["status"] == "completed" else "yellow"
        _rows(table, escape(trial["name"]), trial["status"], [trial], style, figures)
        slip = trial.get("finger_slip")
        if isinstance(slip, dict) and slip.get("detected") is True:
            table.add_row("  slipped in the fingers", style="yellow")
    for rehearsal in results.get("rehearsals", ()):
        force = f"at most {rehearsal['force']:.2f} N on the object"
        table.add_row(escape(rehearsal["name"]), rehearsal["status"], "wrist", force)
    if not results["trials"] and not results.get("rehearsals"):
        table.add_row("no trial was run", results["status"])
    paper = beside(results["trials"])["rows"]
    several = len({skill for skill, _ in groups}) > 1
    for (skill, controller), group in groups.items():
        printed = paper.get(group[0]["name"])
        if printed is not None and not set(printed) & set(figures):  # the paper has components alone
            printed = None
        if len(group) == 1 and printed is None:
            continue
        table.add_section()
        if len(group) > 1:
            completed = sum(trial["status"] == "completed" for trial in group)
            name = f"{skill}, {controller}" if several else controller
            _rows(table, name, f"{completed} of {len(group)}", group, "bold", figures)
        if printed is not None:
            name = controller if len(group) == 1 else ""
            table.add_row(name, "", "paper", *(_cell(printed.get(key)) for key in figures), style="dim")
    for row in _differences(groups, figures, several):
        table.add_section()
        table.add_row(*row)
    return table


def _differences(
    groups: Mapping[tuple[str, str], Sequence[dict[str, Any]]], keys: Sequence[str], several: bool
) -> Iterator[list[str]]:
    """A line for each controller against its skill's first one, over two and more trials that both have: the mean
    difference and its 95 % interval."""
    first: dict[str, str] = {}
    for (skill, controller), group in groups.items():
        base = first.setdefault(skill, controller)
        if controller == base or len(group) < 2:
            continue
        from experiments.statistics import paired_over  # scipy's statistics take a second to import

        found = {key: paired_over(_by_trial(group, key), _by_trial(groups[skill, base], key)) for key in keys}
        pairs = max((one.n for one in found.values() if one is not None), default=0)
        if pairs > 1:
            name = f"{controller} − {base}"
            cells = [
                "–" if one is None or one.low is None else f"{one.mean:+.2f}\n{one.low:+.2f}…{one.high:+.2f}"
                for one in found.values()
            ]
            yield [f"{skill}, {name}" if several else name, f"{pairs} pairs", "measured\n95 %", *cells]


def _by_trial(group: Sequence[dict[str, Any]], key: str) -> dict[Hashable, float]:
    """A figure by the trial's number; and by how often it has come before, where a run has several plans of a skill."""
    found: dict[Hashable, float] = {}
    times: Counter[int] = Counter()
    for trial in group:
        number = trial.get("trial", 0)
        figure = (trial["measured"] or {}).get(key)
        if figure is not None:
            found[number, times[number]] = figure["mean"]
        times[number] += 1
    return found


def _rows(
    table: Table, name: str, status: str, trials: list[dict[str, Any]], style: str | None, keys: Sequence[str]
) -> None:
    """A line for each witness, beside the name: one trial's figures, or mean and spread over the trials' means."""
    lines: list[list[str]] = []
    for witness in ("measured", "truth"):
        seen = [trial[witness] for trial in trials if trial[witness] is not None]
        if seen or witness == "measured":
            lines.append([witness, *(_cell(_over([figures.get(key) for figures in seen])) for key in keys)])
    table.add_row(name, status, *("\n".join(column) for column in zip(*lines, strict=True)), style=style)


def _over(figures: list[dict[str, float] | None]) -> dict[str, float] | None:
    known = [figure for figure in figures if figure is not None]
    if len(known) < 2:
        return known[0] if known else None
    means = [figure["mean"] for figure in known]
    return {"mean": statistics.fmean(means), "std": statistics.pstdev(means)}


def _cell(figure: dict[str, float] | None) -> str:
    return "–" if figure is None else f"{figure['mean']:.2f} ± {figure['std']:.2f}"


def faults_table(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per fault and moment: how it ended, how long the arm moved on, and what is not as it has to be."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in ("fault", "device", "moment", "ended"):
        table.add_column(name, no_wrap=True)
    table.add_column(escape("moved on [ms]"), justify="right")
    table.add_column(escape("force [N]"), justify="right")
    table.add_column("short", overflow="fold")
    for row in rows:
        fault = row["fault"]
        table.add_row(
            fault["kind"] + (f" {fault['value']:g}" if "value" in fault else ""),
            escape(fault.get("device", "world")),
            row["moment"],
            row["status"],
            "–" if row["moved_on_s"] is None else f"{row['moved_on_s'] * 1e3:.0f}",
            "–" if row["force_N"] is None else f"{row['force_N']:.1f}",
            escape("; ".join(row["short"])),
            style="red" if row["short"] else None,
        )
    short = sum(bool(row["short"]) for row in rows)
    table.title = f"{len(rows)} cells, {short} short\n" if short else f"{len(rows)} cells, all as expected\n"
    table.title_justify = "left"
    return table


#: columns from which on a status table has room for notes
_NOTES_BESIDE = 100
#: and for the kinds of devices
_KINDS = 72


def status_table(
    rows: Sequence[DeviceStatus],
    certificates: Sequence[tuple[str, int]] = (),
    *,
    width: int = 120,
    models: bool = True,
) -> Group:
    """One line per device, then one per certificate, by its name and the days that it has left.

    In less than 100 columns (``width``) the notes stand below the table, in less than 72 the kinds are left out.
    ``models``: whether devices say what they are, where there is room.
    """
    beside, kinds = width >= _NOTES_BESIDE, width >= _KINDS
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1) if beside else (0, 1, 0, 0), show_edge=False)
    for name in ("device", "kind", "backend", "alive") if kinds else ("device", "alive"):
        table.add_column(name, no_wrap=True)
    for name in ("rate [Hz]", "age [s]", "gaps"):
        table.add_column(escape(name), justify="right", no_wrap=True)
    if beside:
        table.add_column("note", overflow="fold")
    below: dict[str, list[str]] = {}

    def add(name: str, kind: Sequence[str], figures: Sequence[str], note: str, style: str | None) -> None:
        if not beside and note:
            below.setdefault(note, []).append(name)
        cells = (escape(name), *(kind if kinds else ()), *figures, *((escape(note),) if beside else ()))
        table.add_row(*cells, style=style)

    for row in rows:
        stopped = row.arm is not None and bool(row.arm.stopped)
        figures = (
            "yes" if row.alive else "no",
            "–" if row.rate is None else f"{row.rate:.0f}",
            "–" if row.age is None else f"{row.age:.2f}",
            "–" if row.gaps is None else str(row.gaps),
        )
        style = "red" if stopped or not row.alive else "yellow" if row.condition else None
        add(row.name, (row.kind, row.backend), figures, row.note if models and beside else "; ".join(row.notes), style)
    table.add_section()
    for name, days in certificates:
        valid, soon = days >= 0, days < WARNING_DAYS
        note = f"{days} days left" if valid else "expired"
        if soon:
            note += "; `extrinsic lab renew` makes a new one"
        style = "yellow" if soon and valid else None if valid else "red"
        add(name, ("certificate", ""), ("yes" if valid else "no", "", "", ""), note, style)
    notes = [Text(f"{', '.join(names)}: {note}") for note, names in below.items()]
    return Group(table, *([Text()] if notes else []), *notes)
