"""The figures of `extrinsic bench planning` as one table: a row for each method, columns for the horizons."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from experiments.bench.figures import Figure

_NAME = re.compile(r"(?P<method>.+), (?P<form>\w+) form, (?P<steps>\d+) steps: (?P<quantity>.+)")
#: columns with a figure for each horizon, and those of the shortest one: heading, quantity, format
_TIMES = (("ms an iteration", "iteration"), ("ms a plan", "plan"))
_REST = (
    ("loss", "loss", ".4g"),
    ("… from nominal", "loss from the nominal trajectory", ".4g"),
    ("× faster, iteration", "iterations per cvxpylayers iteration", ".0f"),
    ("× faster, plan", "plans per cvxpylayers plan", ".0f"),
    ("force off", "force error", ".0e"),
    ("gradient off", "gradient error", ".0e"),
)

Key = tuple[str, str, int, str]


def side_by_side(figures: Sequence[Figure]) -> Table:
    """Every method in a row, a section for each form. What has one figure is of the shortest horizon."""
    found: dict[Key, Figure] = {}
    for figure in figures:
        if match := _NAME.fullmatch(figure.name):
            found[match["form"], match["method"], int(match["steps"]), match["quantity"]] = figure
    horizons = sorted({steps for _, _, steps, _ in found})
    problems = dict.fromkeys(figure.what.rpartition("; ")[2] for figure in found.values() if " form, " in figure.what)
    shown = Table(
        title="side by side",
        title_justify="left",
        caption="\n".join(escape(problem) for problem in problems),
        caption_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    shown.add_column("method")
    for heading, _ in _TIMES:
        shown.add_column(f"{heading}\nK = {' / '.join(map(str, horizons))}", justify="right")
    for heading, _, _ in _REST:
        shown.add_column(heading, justify="right")
    for form in dict.fromkeys(form for form, _, _, _ in found):
        shown.add_section()
        shown.add_row(f"{form} form", style="bold")
        for method in dict.fromkeys(method for of, method, _, _ in found if of == form):
            times = [
                " / ".join(_cell(found.get((form, method, steps, quantity)), ".3g") for steps in horizons)
                for _, quantity in _TIMES
            ]
            rest = [_cell(found.get((form, method, horizons[0], quantity)), text) for _, quantity, text in _REST]
            shown.add_row(escape(method), *times, *rest)
    return shown


def _cell(figure: Figure | None, text: str) -> str:
    return "–" if figure is None else format(figure.median, text)
