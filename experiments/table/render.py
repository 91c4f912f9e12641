"""A table for the terminal and as Markdown, from what `table.json` says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table as Grid

from experiments.table.schema import HEADINGS

_TAGS = {"mu_ground": "µ ground", "mu_object": "µ object"}
#: lines of a row, from top to bottom: their name, and how a cell says it
LINES = ("trials", "measured", "95 %", "truth", "paper")


def number(value: float) -> str:
    """A figure with as many places as can be compared."""
    size = abs(value)
    if size and size < 0.00995:
        return f"{value:.3f}" if size >= 0.0005 else f"{value:.1e}"
    return f"{value:.2f}" if size < 9.995 else f"{value:.1f}" if size < 99.95 else f"{value:.0f}"


def spread(figure: Mapping[str, Any] | None) -> str:
    """Mean ± standard deviation, where there is one."""
    if figure is None:
        return "–"
    return number(figure["mean"]) + ("" if figure["std"] is None else f" ±{number(figure['std'])}")


def interval(figure: Mapping[str, Any] | None) -> str:
    """From where to where."""
    if figure is None or figure["low"] is None:
        return "–"
    return f"{number(figure['low'])}…{number(figure['high'])}"


def tagged(tags: Mapping[str, Any]) -> list[str]:
    """What tells a row or a column, in words."""
    named = ((_TAGS.get(tag), value) for tag, value in tags.items() if value is not None)
    return [f"{name} {value:g}" if name else str(value) for name, value in named]


def said(line: str, cell: Mapping[str, Any], first: bool = True) -> str:
    """What a ``line`` says of a cell; "" where it has nothing to say. Trials are told of a row's ``first`` figure."""
    if line == "trials":
        return f"{cell['completed']} of {cell['trials']}" if cell["trials"] and first else ""
    if line == "95 %":
        return interval(cell["measured"]) if cell["measured"] and cell["measured"]["low"] is not None else ""
    return "" if cell[line] is None and line != "measured" else spread(cell[line])


def lines(row: Mapping[str, Any]) -> list[str]:
    """Those of `LINES` that say something in some cell of the row."""
    return [line for line in LINES if any(said(line, cell) for cell in row["cells"])]


def heads(panel: Mapping[str, Any], join: str = " ") -> list[str]:
    """What stands above each figure of a panel."""
    return [join.join([*tagged(column["tags"]), HEADINGS[column["figure"]]]) for column in panel["columns"]]


def panel_grid(panel: Mapping[str, Any]) -> Grid:
    """One panel: a block of lines for each row; what is at or below the paper is green."""
    grid = Grid(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=panel["title"], title_justify="left")
    grid.add_column("", no_wrap=True)
    grid.add_column("", no_wrap=True, style="dim")
    for head in heads(panel, "\n"):
        grid.add_column(escape(head.replace(" [", "\n[")), justify="right", no_wrap=True)
    for row in panel["rows"]:
        told = lines(row)
        first = row["cells"][0]["figure"]
        cells = ["\n".join(_coloured(line, cell, cell["figure"] == first) for line in told) for cell in row["cells"]]
        grid.add_row(escape("\n".join(tagged(row["tags"]))), "\n".join(told), *cells, end_section=True)
    return grid


def _coloured(line: str, cell: Mapping[str, Any], first: bool) -> str:
    text = said(line, cell, first)
    ours, theirs = cell["measured"], cell["paper"]
    if line == "measured" and ours is not None:
        better = theirs is not None and ours["mean"] <= theirs["mean"]
        return f"[bold green]{text}[/]" if better else f"[bold]{text}[/]"
    return f"[dim]{text}[/]" if line in ("truth", "paper") else text


def findings_grid(findings: Sequence[Mapping[str, Any]]) -> Grid:
    """What is held against targets, and what else was compared."""
    grid = Grid(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title="Held against", title_justify="left")
    grid.add_column("", overflow="fold", ratio=4)
    grid.add_column("ours", overflow="fold", ratio=4)
    grid.add_column("target", no_wrap=True)
    grid.add_column("holds", no_wrap=True)
    for one in findings:
        style = "red" if one["holds"] is False else None
        grid.add_row(escape(one["name"]), escape(one["told"]), one["target"] or "", _holds(one), style=style)
    return grid


def _holds(finding: Mapping[str, Any]) -> str:
    return "" if finding["holds"] is None else "yes" if finding["holds"] else "no"


def show(console: Console, result: Mapping[str, Any]) -> None:
    """Print a table: its panels, what is held against targets, and what did not go through."""
    parts: list[RenderableType] = [f"[bold]{escape(result['title'])}[/]", escape(_about(result))]
    parts += [panel_grid(panel) for panel in result["panels"]]
    if result["findings"]:
        parts.append(findings_grid(result["findings"]))
    parts += [Padding(escape(line), (0, 0, 0, 2)) for line in legend(result)]
    parts += [Padding(escape(line), (0, 0, 0, 2)) for line in calibrated(result)]
    incomplete = ended_early(result)
    if incomplete:
        parts += ["Trials that were not completed", *(f"  [yellow]{escape(line)}[/]" for line in incomplete)]
    console.print(Group(*parts))


def _about(result: Mapping[str, Any]) -> str:
    part = "; a part of the table" if result["part"] else ""
    return f"seed {result['seed']}{part}; {result['source']} beside ours" if result["source"] else ""


def legend(result: Mapping[str, Any]) -> list[str]:
    """How the figures came about, and the table's own notes."""
    return [
        "measured: mean ± standard deviation over the waypoints of all trials; through wrist sensor and tags",
        "95 %: Student's interval of the mean, over trials; of a comparison, over its pairs of trials",
        "truth: the simulated plant's own; the paper's figures: mean ± standard deviation, as printed there",
        *result["notes"],
    ]


def calibrated(result: Mapping[str, Any]) -> list[str]:
    """Stiffness and friction that were found, a line for each calibration."""
    found = []
    for name, files in result["calibrations"].items():
        told = []
        for one in files:
            if one.get("kind") == "elasticity":
                K = one["stiffness"]
                told.append(f"K {K[0][0]:.0f}, {K[1][1]:.0f} N/m, {K[2][2]:.2f} N·m/rad")
            elif one.get("kind") == "friction":
                low, high = one["interval"]
                told.append(f"µ {one['pair']} {one['mu']:.3f} ({low:.3f}…{high:.3f})")
        if told:
            found.append(f"calibrated, {name}: {'; '.join(told)}")
    return found


def ended_early(result: Mapping[str, Any]) -> list[str]:
    """Trials that did not end as planned, those of a kind on one line."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for trial in result["incomplete"]:
        groups.setdefault((trial["run"], trial["controller"], trial["status"]), []).append(trial)
    return [
        f"{run}, {controller}: {len(trials)} {status}: {trials[0]['reason']}"
        for (run, controller, status), trials in groups.items()
    ]


def markdown(result: Mapping[str, Any]) -> str:
    """The same to be read in a browser or an editor."""
    page = [f"# {result['title']}", "", _about(result), ""]
    for panel in result["panels"]:
        page += [f"## {panel['title']}", ""] if panel["title"] else []
        body = []
        for row in panel["rows"]:
            name = f"**{', '.join(tagged(row['tags']))}**"
            for line in lines(row):
                first = row["cells"][0]["figure"]
                body.append([name, line, *(said(line, cell, cell["figure"] == first) for cell in row["cells"])])
                name = ""
        page += [*_pipes(["", "", *heads(panel)], body), ""]
    if result["findings"]:
        body = [[one["name"], one["told"], one["target"] or "", _holds(one)] for one in result["findings"]]
        page += ["## Held against", "", *_pipes(["", "ours", "target", "holds"], body), ""]
    incomplete = ended_early(result)
    if incomplete:
        page += ["## Trials that were not completed", "", *(f"* {line}" for line in incomplete), ""]
    page += [f"* {line}" for line in (*legend(result), *calibrated(result))]
    return "\n".join(page) + "\n"


def _pipes(head: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    rows = [head, ["---", *["---:"] * (len(head) - 1)], *body]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
