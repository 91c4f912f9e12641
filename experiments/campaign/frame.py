"""The table of all trials of a campaign, and what it comes to: per cell of the grid and controller."""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from experiments.campaign.folder import CampaignFolder, JobFolder
from experiments.run_folder import write_json
from experiments.statistics import paired_over, rate
from experiments.tables import COLUMNS

TRIALS, SUMMARY = "trials.parquet", "summary.json"
_PAIR = ".pair"
#: what tells two methods apart within a cell of the grid
METHOD = ("skill", "controller")


def trials_frame(folder: Path) -> pd.DataFrame:
    """One row for each trial of the jobs that have been run: ``job``, ``run`` (its folder), the tags, then the row of
    results.json, its figures as ``measured.wrench_N.mean`` and so on.

    A trial that its job did not get to has a row, too, with the job's status and reason. A tag with the name of
    another column stands as ``grid.<name>``. Raises InputError where there is no campaign.
    """
    campaign = CampaignFolder(folder)
    jobs = campaign.read()["jobs"]
    rows = [row for job in jobs for row in _rows(campaign.path, campaign.job(job["id"]), job)]
    return frame_of(rows, leading=("job", "run"))


def frame_of(rows: Sequence[Mapping[str, Any]], leading: Sequence[str] = ()) -> pd.DataFrame:
    """Rows of results.json as a table: their figures as ``measured.wrench_N.mean`` and so on.

    Without any row it has the columns that every row has, those in ``leading`` first.
    """
    if not rows:
        return pd.DataFrame(columns=[*leading, *METHOD, "trial", "status", "reason"])
    frame = pd.json_normalize([dict(row) for row in rows], sep=".")
    nested = {name for name in frame if any(other.startswith(f"{name}.") for other in frame)}
    frame = frame.drop(
        columns=[name for name in nested if not frame[name].dropna().size]
    )  # where a trial had no figures
    for name in frame.columns:
        kinds = {type(value) for value in frame[name].dropna()}
        if len(kinds) > 1 and not kinds <= {int, float}:  # a tag that is a figure in one cell and a word in another
            frame[name] = frame[name].map(str, na_action="ignore")
    return frame


def _rows(root: Path, folder: JobFolder, job: Mapping[str, Any]) -> list[dict[str, Any]]:
    ended, failure = folder.ended(), folder.failure
    if ended is None and failure is None:
        return []  # not run yet
    runs = folder.runs()
    run = ended[0] if ended is not None else (runs[-1] if runs else folder.path)
    results = ended[1] if ended is not None else folder.newest()
    trials = [] if results is None else results["trials"]
    status, reason = ("failed", failure) if results is None or ended is None else (results["status"], results["reason"])
    missing = [{**planned, "status": status, "reason": reason} for planned in job["trials"][len(trials) :]]
    every = [*trials, *missing]
    columns = {"job", "run"}.union(*every)
    tags = {f"grid.{key}" if key in columns else key: value for key, value in job["tags"].items()}
    return [{"job": job["id"], "run": str(run.relative_to(root)), **tags, **row} for row in every]


def cells(folder: Path, frame: pd.DataFrame) -> list[dict[str, Any]]:
    """For each cell of the grid and method: ``n``, ``completed``, the share that completed with Wilson's 95 % interval,
    and mean and spread over the trials of each error (`experiments.tables.COLUMNS`), as far as trials have it.

    A trial's figure is its mean over the waypoints that it reached. Seeds are pooled.
    """
    by = [*cell_keys(folder, frame), *METHOD]
    found: list[dict[str, Any]] = []
    for _, group in frame.groupby(by, sort=False, dropna=False):
        cell = {key: plain(group[key].iloc[0]) for key in by}
        completed = rate(group["status"].tolist().count("completed"), len(group))
        figures = {name: _over(group, f"measured.{name}.mean") for name in COLUMNS}
        found.append(
            {
                "cell": {key: cell[key] for key in by if key not in METHOD},
                **{key: cell[key] for key in METHOD},
                "n": completed.n,
                "completed": completed.successes,
                "success": {"rate": completed.share, "low": completed.low, "high": completed.high},
                "measured": figures,
            }
        )
    return found


@dataclass(frozen=True)
class Pairing:
    """Two controllers ``a`` and ``b`` of one skill in one cell of the grid, with the rows of each by their pair.

    A pair is the trials of one seed and number: whatever they share, such as their grasp, is out of their difference.
    """

    cell: dict[str, Any]
    skill: Any
    a: str
    b: str
    rows_a: pd.DataFrame
    rows_b: pd.DataFrame

    def values(self, column: str) -> tuple[dict[Hashable, float], dict[Hashable, float]]:
        """The known figures in a ``column`` of either, by their pair; none where nobody has the column."""
        if column not in self.rows_a:
            return {}, {}
        a, b = (rows.dropna(subset=[column])[column].astype(float).to_dict() for rows in (self.rows_a, self.rows_b))
        return a, b


def pairings(folder: Path, frame: pd.DataFrame) -> Iterator[Pairing]:
    """Every cell of the grid, skill and pair of controllers, the later one less the earlier."""
    keys = [*cell_keys(folder, frame), "skill"]
    # the same trial of the same skill comes more than once where a run has several plans of it
    nth = frame.groupby(["job", *METHOD, "trial"], dropna=False).cumcount()
    frame = frame.assign(**{_PAIR: list(zip(frame["job"], frame["trial"], nth, strict=True))})
    for _, group in frame.groupby(keys, sort=False, dropna=False):
        laws = {name: rows.set_index(_PAIR) for name, rows in group.groupby("controller", sort=False)}
        for b, a in combinations(laws, 2):
            cell = {key: plain(group[key].iloc[0]) for key in keys}
            yield Pairing(cell, cell.pop("skill"), str(a), str(b), laws[a], laws[b])


def comparisons(folder: Path, frame: pd.DataFrame) -> list[dict[str, Any]]:
    """For each of the `pairings`: the mean of ``a`` − ``b`` in each error, and its 95 % interval by Student's t, over
    the pairs that both have a figure of.
    """
    found: list[dict[str, Any]] = []
    for one in pairings(folder, frame):
        measured = {name: _difference(*one.values(f"measured.{name}.mean")) for name in COLUMNS}
        if any(measured.values()):
            found.append({"cell": one.cell, "skill": one.skill, "a": one.a, "b": one.b, "measured": measured})
    return found


def _difference(a: Mapping[Hashable, float], b: Mapping[Hashable, float]) -> dict[str, Any] | None:
    found = paired_over(a, b)
    return None if found is None else {"mean": found.mean, "low": found.low, "high": found.high, "n": found.n}


def cell_keys(folder: Path, frame: pd.DataFrame) -> list[str]:
    """The columns that tell the cells of the grid apart."""
    named = dict.fromkeys(key for job in CampaignFolder(folder).read()["jobs"] for key in job["tags"])
    keys = [column for key in named if (column := f"grid.{key}" if f"grid.{key}" in frame else key) in frame]
    return [key for key in keys if key != "seed"]


def plain(value: Any) -> Any:
    """A value of a frame as JSON has it."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and np.isnan(value) else value


def _over(group: pd.DataFrame, column: str) -> dict[str, float] | None:
    known = group[column].dropna().to_numpy(float) if column in group else np.empty(0)
    return {"mean": float(known.mean()), "std": float(known.std()), "n": len(known)} if len(known) else None


def save(folder: Path, summary: Mapping[str, Any], frame: pd.DataFrame) -> None:
    """Write ``trials.parquet`` and ``summary.json`` into the campaign's folder, each at once."""
    aside = folder / f".{TRIALS}"
    frame.to_parquet(aside, index=False)
    aside.replace(folder / TRIALS)
    write_json(folder / SUMMARY, summary)


def summary_table(title: str, found: list[dict[str, Any]]) -> Table:
    """The cells for a terminal."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    keys = list(dict.fromkeys(key for cell in found for key in cell["cell"]))
    methods = ["controller"] if len({cell["skill"] for cell in found}) < 2 else list(METHOD)
    for name in (*keys, *methods):
        table.add_column(escape(name), overflow="fold")
    table.add_column("n", justify="right")
    table.add_column("completed", justify="right", no_wrap=True)
    figures = [name for name in COLUMNS if any(cell["measured"][name] for cell in found)]
    for name in figures:
        table.add_column(escape(COLUMNS[name]), justify="right", no_wrap=True)
    for cell in found:
        success = cell["success"]
        share = f"{success['rate']:.0%} ({success['low']:.0%}–{success['high']:.0%})"
        table.add_row(
            *(escape(shown(cell["cell"][key])) for key in keys),
            *(escape(shown(cell[key])) for key in methods),
            str(cell["n"]),
            share,
            *(_figure(cell["measured"][name]) for name in figures),
            style=None if cell["completed"] == cell["n"] else "yellow",
        )
    return table


def comparison_table(found: list[dict[str, Any]]) -> Table:
    """The differences between controllers for a terminal, those of two pairs and more."""
    told = [one for one in found if any(figure and figure["n"] > 1 for figure in one["measured"].values())]
    title = "Differences over pairs of trials of one seed and number, with 95 % intervals"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    keys = list(dict.fromkeys(key for one in told for key in one["cell"]))
    skills = ["skill"] if len({one["skill"] for one in told}) > 1 else []
    for name in (*keys, *skills, "controllers"):
        table.add_column(escape(name), overflow="fold")
    table.add_column("pairs", justify="right")
    figures = [name for name in COLUMNS if any(one["measured"][name] for one in told)]
    for name in figures:
        table.add_column(escape(COLUMNS[name]), justify="right", no_wrap=True)
    for one in told:
        table.add_row(
            *(escape(shown(one["cell"][key])) for key in keys),
            *(escape(shown(one[key])) for key in skills),
            escape(f"{one['a']} − {one['b']}"),
            str(max(figure["n"] for figure in one["measured"].values() if figure)),
            *(_interval(one["measured"][name]) for name in figures),
        )
    return table


def _interval(figure: Mapping[str, Any] | None) -> str:
    if figure is None or figure["low"] is None:
        return "–"
    return f"{figure['mean']:+.3f}\n{figure['low']:+.3f}…{figure['high']:+.3f}"


def shown(value: Any) -> str:
    """A tag's value as people read it."""
    return "–" if value is None else value if isinstance(value, str) else json.dumps(value)


def _figure(figure: Mapping[str, float] | None) -> str:
    return "–" if figure is None else f"{figure['mean']:.3f} ± {figure['std']:.3f}"
