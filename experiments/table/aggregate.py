"""What a table says: its cells, comparisons and counts, from the tidy frame of trials.

A mean is over trials of each trial's mean over its waypoints, as far as it got. Its 95 % interval is Student's over
the trials: waypoints of one trial hang together. The standard deviation is over all waypoints of all trials, as the
paper's is; a trial tells mean and deviation of its own, which are pooled, trials counting alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments import statistics
from experiments.metrics import paper_summary
from experiments.paper import Figures, paper_figures
from experiments.table.schema import PLANS, SUMMARIES, Comparison, Count, Panel, Single, Table
from mechanics.yaml_input import InputError, Problem

MEASURED, TRUTH = "measured", "truth"
_COMPONENTS = ("fx_N", "fy_N", "tau_Nmm", "x_mm", "y_mm")
#: how a trial may end that has come to a result, if not to its end
_RESULTS = ("slipped", "lost_contact")

Pair = tuple[Any, ...]


@dataclass(frozen=True)
class Data:
    """Every trial that a table asks for, run or not, and every plan that was made, by tags."""

    trials: pd.DataFrame
    plans: pd.DataFrame


@dataclass(frozen=True)
class Finding:
    """Something that is held against a target: its ``value``, and in words what it is made of."""

    name: str
    value: float | None
    told: str


def picked(frame: pd.DataFrame, where: Mapping[str, Any]) -> pd.DataFrame:
    """The rows with these tags; several values of a tag are alternatives, None is a tag that was not given."""
    chosen = np.ones(len(frame), bool)
    for tag, value in where.items():
        if tag not in frame:
            return frame.iloc[:0]
        options = value if isinstance(value, list | tuple) else [value]
        column = frame[tag]
        chosen &= np.asarray(column.isna() if value is None else column.isin(options))
    return frame.loc[chosen]


def completed(trials: pd.DataFrame) -> int:
    """How many trials were completed."""
    return int(np.count_nonzero(trials["status"].to_numpy() == "completed")) if len(trials) else 0


def fell_short(table: Table, trials: pd.DataFrame) -> pd.DataFrame:
    """The trials that were not completed, and are to be.

    One that slips or loses its contact has had its result: it is held against the table where one of its counts of
    completed trials picks it.
    """
    missing = trials.loc[trials["status"] != "completed"]
    held = ~missing["status"].isin(_RESULTS)
    for entry in table.counts:
        if entry.of == "trials completed":
            held |= missing.index.isin(picked(missing, entry.where).index)
    return missing.loc[held]


def combinations(frame: pd.DataFrame, tags: Sequence[str]) -> list[dict[str, Any]]:
    """The values of ``tags`` that occur together, in their order; [{}] without tags."""
    if not tags:
        return [{}]
    present = [tag for tag in tags if tag in frame]
    rows = frame.loc[:, present].drop_duplicates().to_numpy(dtype=object).tolist()
    return [{tag: None if pd.isna(value) else value for tag, value in zip(present, row, strict=True)} for row in rows]


def figure(data: Data, where: Mapping[str, Any], name: str, witness: str) -> dict[str, Any] | None:
    """Mean, deviation, interval and number of a figure over the picked trials, or plans; None where nobody has it."""
    if name in PLANS:
        if witness == TRUTH:
            return None
        plans = picked(data.plans, {key: value for key, value in where.items() if key != "controller"})
        values = plans[name].dropna().to_numpy(float) if name in plans else np.empty(0)
        return _stated(values, np.zeros(len(values)))
    trials = picked(data.trials, where)
    if name in SUMMARIES:
        return _summary(trials, name, witness)
    means, deviations = _of_trials(trials, name, witness)
    return _stated(means, deviations)


def _of_trials(trials: pd.DataFrame, name: str, witness: str) -> tuple[np.ndarray, np.ndarray]:
    columns = [f"{witness}.{name}.{part}" for part in ("mean", "std")]
    if not set(columns) <= set(trials.columns):
        return np.empty(0), np.empty(0)
    known = trials.loc[:, columns].dropna().to_numpy(float)
    return known[:, 0], known[:, 1]


def _stated(means: np.ndarray, deviations: np.ndarray) -> dict[str, Any] | None:
    if not len(means):
        return None
    found = statistics.mean(means.tolist())
    pooled = float(np.sqrt(np.mean(deviations**2 + (means - found.mean) ** 2)))
    return {"mean": found.mean, "std": pooled, "low": found.low, "high": found.high, "n": found.n}


def _summary(trials: pd.DataFrame, name: str, witness: str) -> dict[str, Any] | None:
    """The paper's Table 3 arithmetic: the norm of component means, so that it has no deviation of its own."""
    components = {key: _of_trials(trials, key, witness)[0] for key in _COMPONENTS}
    if not all(len(values) for values in components.values()):
        return None
    means = {key: {"mean": float(values.mean())} for key, values in components.items()}
    found = paper_summary(means, float(trials["rho_mm"].iloc[0]) * 1e-3)[name]
    return {"mean": found, "std": None, "low": None, "high": None, "n": len(components["fx_N"])}


def printed(table: Table, where: Mapping[str, Any], rows: pd.DataFrame | None = None) -> Figures:
    """The paper's figures for these tags; none where it has none.

    A tag that ``where`` does not say is that of all ``rows``, if they are alike in it. Figures that stand farther out
    in the file hold for what is within.
    """
    if table.paper is None:
        return {}
    path: list[str] = []
    for part in table.paper.at.split("."):
        value = part
        if part.startswith("{"):
            tag = part.strip("{}")
            said = _said(tag, where, rows)
            if said is None:
                continue
            value = table.paper.stand_in.get(tag, {}).get(said, said)
        path.append(value)
    return {name: pair for n in range(len(path)) for name, pair in paper_figures(path[: n + 1]).items()}


def _said(tag: str, where: Mapping[str, Any], rows: pd.DataFrame | None) -> str | None:
    """The value of a tag; None where it is not known."""
    if where.get(tag) is not None:
        return str(where[tag])
    if rows is None or tag not in rows:
        return None
    values = rows[tag].dropna().unique().tolist()
    return str(values[0]) if len(values) == 1 else None


def panels(table: Table, data: Data) -> list[dict[str, Any]]:
    """Each panel with its rows and cells, JSON-able."""
    return [_panel(table, panel, data) for panel in table.panels]


def _panel(table: Table, panel: Panel, data: Data) -> dict[str, Any]:
    frame = data.plans if all(name in PLANS for name in panel.figures) else data.trials
    chosen = picked(frame, panel.where)
    columns = [(across, name) for across in combinations(chosen, panel.across) for name in panel.figures]
    rows = []
    for tags in combinations(chosen, panel.rows):
        cells = [_cell(table, data, {**panel.where, **tags, **across}, name) for across, name in columns]
        rows.append({"tags": tags, "cells": cells})
    heads = [{"tags": across, "figure": name} for across, name in columns]
    return {"title": panel.title, "columns": heads, "rows": rows}


def _cell(table: Table, data: Data, where: dict[str, Any], name: str) -> dict[str, Any]:
    trials = picked(data.plans if name in PLANS else data.trials, where)
    paper = printed(table, where, trials).get(name)
    return {
        "where": where,
        "figure": name,
        "trials": 0 if name in PLANS else len(trials),
        "completed": completed(trials),
        MEASURED: figure(data, where, name, MEASURED),
        TRUTH: figure(data, where, name, TRUTH),
        "paper": None if paper is None else {"mean": paper[0], "std": paper[1]},
    }


def findings(table: Table, data: Data, shown: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """What comparisons, counts and single figures of the table come to; ``shown`` are its panels."""
    found = [one for entry in table.comparisons for one in _compared(table, entry, data)]
    found += [_counted(entry, data, shown) for entry in table.counts]
    return found + [_single(entry, data) for entry in table.figures]


def refuse_doubles(table: Table, trials: pd.DataFrame) -> None:
    """Look at what each comparison would pair of ``trials``, run or not.

    Raises InputError where two trials of one side are alike in all that tells pairs apart.
    """
    problems = [
        Problem(f"table {table.name}", None, f"comparisons.{i}", wrong, expected)
        for i, entry in enumerate(table.comparisons)
        for _, sides in _sides(entry, trials)
        for wrong, expected in _doubled(sides, _alike_in(table, entry, sides))
    ]
    if problems:
        raise InputError(dict.fromkeys(problems))


def _sides(entry: Comparison, trials: pd.DataFrame) -> Iterator[tuple[dict[str, Any], list[pd.DataFrame]]]:
    """For each value of ``each``, the trials of a and those of b."""
    frame = picked(trials, entry.where)
    for each in combinations(frame, entry.each):
        here = picked(frame, each)
        yield each, [picked(here, where) for where in (entry.a, entry.b)]


def _alike_in(table: Table, entry: Comparison, sides: Sequence[pd.DataFrame]) -> list[str]:
    """The tags that the two trials of a pair are alike in, and their number.

    It is all tags but those that a and b are told apart by: those that either sets, and those that follow from them,
    such as the run: of these a has no value that b has, too.
    """
    free = [tag for tag in table.tags if tag not in entry.a and tag not in entry.b]
    values = [[set(_known(side, [tag])) for side in sides] for tag in free]
    return [tag for tag, (a, b) in zip(free, values, strict=True) if a & b] + ["trial"]


def _doubled(sides: Sequence[pd.DataFrame], alike_in: Sequence[str]) -> Iterator[tuple[str, str]]:
    """What is wrong, and what is expected, of each side with two trials of one pair."""
    for side in sides:
        pairs = _known(side, alike_in)
        twice = next((pair for i, pair in enumerate(pairs) if pair in pairs[:i]), None)
        if twice is not None:
            told = ", ".join(f"{tag} {value}" for tag, value in zip(alike_in, twice, strict=True) if value is not None)
            runs = [run for (run,), pair in zip(_known(side, ["run"]), pairs, strict=True) if pair == twice]
            wrong = f"there are {len(runs)} trials with {told}, of {', '.join(dict.fromkeys(map(str, runs)))}"
            yield wrong, "one: give `each` or `where` a tag that tells them apart"


def _compared(table: Table, entry: Comparison, data: Data) -> Iterator[Finding]:
    column = f"{MEASURED}.{entry.figure}.mean"
    for each, rows in _sides(entry, data.trials):
        name = ", ".join([entry.name, *map(str, filter(None, each.values()))])
        alike_in = _alike_in(table, entry, rows)
        sides = [_by_pair(side, alike_in, column) for side in rows]
        common = [pair for pair in sides[0] if pair in sides[1]]
        if not common:
            yield Finding(name, None, "no pair of trials has both")
            continue
        found = statistics.paired([sides[0][pair] for pair in common], [sides[1][pair] for pair in common])
        value = {"mean": found.mean, "upper": found.high, "lower": found.low}[entry.judged]
        asked = {pair for side in rows for pair in _known(side, alike_in)}
        ended_early = [side.loc[side["status"] != "completed"] for side in rows]
        early = {pair for side in ended_early for pair in _known(side, alike_in)}.intersection(common)
        told = f"{found.mean:+.3f} ({_told_apart(found)}), {found.n} of {len(asked)} pairs"
        yield Finding(name, value, told + (f", {len(early)} not completed" if early else ""))


def _told_apart(found: statistics.Estimate) -> str:
    """Both ends of an interval, and what they say of the sign."""
    if found.low is None or found.high is None:
        return "no interval"
    verdict = "surely below" if found.high < 0 else "surely above" if found.low > 0 else "undecided"
    return f"95 % {found.low:+.3f} to {found.high:+.3f}, {verdict}"


def _known(trials: pd.DataFrame, columns: Sequence[str]) -> list[Pair]:
    """The values of ``columns`` of each trial; None where there is none."""
    rows = trials.reindex(columns=list(columns)).to_numpy(dtype=object).tolist()
    return [tuple(None if pd.isna(value) else value for value in row) for row in rows]


def _by_pair(trials: pd.DataFrame, alike_in: Sequence[str], column: str) -> dict[Pair, float]:
    """A figure by what pairs of trials are alike in."""
    if column not in trials:
        return {}
    known = trials.dropna(subset=[column])
    return dict(zip(_known(known, alike_in), known[column].to_numpy(float).tolist(), strict=True))


def _counted(entry: Count, data: Data, shown: Sequence[Mapping[str, Any]]) -> Finding:
    if entry.of == "trials completed":
        trials = picked(data.trials, entry.where)
        done = completed(trials)
        return Finding(entry.name, float(done), f"{done} of {len(trials)}")
    below = entry.of == "cells at or below the paper"
    reached, missed = 0, []
    for cell in _cells(entry, shown):
        if cell["paper"] is None:
            continue
        ours, theirs = cell[MEASURED], cell["paper"]["mean"]
        if ours is not None and (ours["mean"] <= theirs if below else ours["mean"] >= theirs):
            reached += 1
        else:
            missed.append(_named(cell))
    told = f"{reached} of {reached + len(missed)}" + (f"; not {', '.join(missed)}" if missed else "")
    return Finding(entry.name, float(reached), told)


def _cells(entry: Count, shown: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """The cells of all panels that the count picks."""
    for panel in shown:
        for row in panel["rows"]:
            for cell in row["cells"]:
                if entry.figures is not None and cell["figure"] not in entry.figures:
                    continue
                if all(_is(cell["where"].get(tag), value) for tag, value in entry.where.items()):
                    yield cell


def _is(value: Any, asked: Any) -> bool:
    return value in asked if isinstance(asked, list | tuple) else value == asked


def _named(cell: Mapping[str, Any]) -> str:
    told = [str(value) for tag, value in cell["where"].items() if tag != "controller" and value is not None]
    ours = "none" if cell[MEASURED] is None else f"{cell[MEASURED]['mean']:.3g}"
    return f"{' '.join(told)} {cell['figure']} {ours} ({cell['paper']['mean']:g})"


def _single(entry: Single, data: Data) -> Finding:
    found = figure(data, entry.where, entry.figure, MEASURED)
    if found is None:
        return Finding(entry.name, None, "not measured")
    interval = "" if found["low"] is None else f" (95 % {found['low']:.3f} to {found['high']:.3f})"
    return Finding(entry.name, found["mean"], f"{found['mean']:.3f}{interval}, {found['n']} trials")
