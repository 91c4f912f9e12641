"""Every trial as a point, with mean and interval of its cell: the data of the page's figures.

Colours are the page's business: a series says the name of one, and a symbol that tells it apart without any.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from experiments import statistics
from experiments.campaign.frame import METHOD, Pairing, plain, shown
from experiments.campaign.report.collect import LINK, Collected
from experiments.report.summary import AGGREGATES, words

#: colour of the style and symbol of plotly's; the ninth method begins anew
LOOKS = (
    ("measured", "circle"),
    ("truth", "square"),
    ("slip", "triangle-up"),
    ("wrench", "star"),
    ("go-edge", "pentagon"),
    ("stick", "triangle-down"),
    ("eo-edge", "hexagon"),
    ("free", "cross"),
)
SOURCES = ("measured", "truth")
#: so many points a page carries; of more, each group shows every second, third …
MOST_POINTS = 20_000
#: so many rows has a figure; a larger campaign has several, drawn when they come near the screen
ROWS = 48
#: a row, what lies between cells, and the margins [px]
ROW, GAP, TOP, BOTTOM = 26, 14, 66, 48
#: so many letters has a legend of two lines at 800 px; of more methods each row says its own, below its cell's name
LEGEND = 110
_ENTRY = 8
#: as the Parquet file has them, to what a screen can show
_DIGITS = 6


def quantities(trials: pd.DataFrame) -> list[tuple[str, str, str, int]]:
    """The errors that some trial has: key, head, unit, decimals."""
    return [one for one in AGGREGATES if any(f"{source}.{one[0]}.mean" in trials for source in SOURCES)]


def values(rows: pd.DataFrame, source: str, key: str) -> list[float | None]:
    """The error of each trial, None where it has none."""
    column = f"{source}.{key}.mean"
    return [plain(value) for value in rows[column]] if column in rows else [None] * len(rows)


def estimate(found: Sequence[float | None]) -> statistics.Estimate | None:
    """Mean and interval of those that are known; None where none is."""
    known = [value for value in found if value is not None]
    return statistics.mean(known) if known else None


def groups(collected: Collected) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """The trials of each cell and method, in the order of the jobs; cell and method as in `METHOD` and the keys."""
    by = [*collected.keys, *METHOD]
    if len(collected.trials):
        for _, rows in collected.trials.groupby(by, sort=False, dropna=False):
            yield {key: plain(rows[key].iloc[0]) for key in by}, rows


def method(of: Mapping[str, Any], several: bool) -> str:
    """A method in words; with its skill where there are ``several``."""
    return f"{words(of['skill'])}, {words(of['controller'])}" if several else words(of["controller"])


def several_skills(collected: Collected) -> bool:
    """Whether a method has to be told with its skill: where a cell has several."""
    if not len(collected.trials):
        return False
    trials = collected.trials.assign(skill=[str(skill) for skill in collected.trials["skill"].tolist()])
    cells = trials.groupby(list(collected.keys), dropna=False) if collected.keys else [("", trials)]
    return any(len(set(rows["skill"].tolist())) > 1 for _, rows in cells)


def distributions(collected: Collected) -> dict[str, Any] | None:
    """The figure of all errors; None where no trial has any."""
    heads, several = quantities(collected.trials), several_skills(collected)
    step = 1 + len(collected.trials) // (MOST_POINTS + 1)
    found = []
    for of, rows in groups(collected):
        thin = rows.iloc[::step]
        estimates = {s: {h[0]: estimate(values(rows, s, h[0])) for h in heads} for s in SOURCES}
        points = {s: {h[0]: values(thin, s, h[0]) for h in heads} for s in SOURCES}
        names, done = [_name(row) for row in thin.to_dict("records")], (thin["status"] == "completed").tolist()
        label = " · ".join(shown(of[key]) for key in collected.keys)
        found.append(_group(label, method(of, several), points, estimates, names, done, thin[LINK].tolist()))
    return _figure(found, collected.keys, heads, step, zero=False)


def differences(collected: Collected) -> dict[str, Any] | None:
    """The figure of all differences over pairs, of two pairs and more; None where there is none."""
    heads, several = quantities(collected.trials), several_skills(collected)
    step = 1 + 2 * len(collected.trials) // (MOST_POINTS + 1)
    found = []
    for one in collected.pairings:
        points, estimates, pairs = {}, {}, list(dict.fromkeys([*one.rows_a.index, *one.rows_b.index]))
        for key, *_ in heads:
            a, b = one.values(f"measured.{key}.mean")
            points[key] = [a[pair] - b[pair] if pair in a and pair in b else None for pair in pairs]
            estimates[key] = statistics.paired_over(a, b)
        if not any(e is not None and e.n > 1 for e in estimates.values()):
            continue
        known = [n for n, _ in enumerate(pairs) if any(points[key][n] is not None for key in points)][::step]
        shared = pd.concat([one.rows_b, one.rows_a])
        first = shared.loc[~shared.index.duplicated(keep="last")]
        rows = [first.loc[[pairs[n]]].iloc[0].to_dict() for n in known]
        thin = {"measured": {key: [points[key][n] for n in known] for key in points}}
        label = " · ".join(shown(value) for value in one.cell.values())
        told = pair_told(one, several)
        links, names = [row[LINK] for row in rows], [_name(row, paired=True) for row in rows]
        found.append(_group(label, told, thin, {"measured": estimates}, names, [True] * len(known), links))
    return _figure(found, collected.keys, heads, step, zero=True)


def pair_told(one: Pairing, several: bool) -> str:
    """A pair of controllers in words: ``a − b``."""
    return (f"{words(one.skill)}: " if several else "") + f"{words(one.a)} − {words(one.b)}"


def _name(row: Mapping[str, Any], paired: bool = False) -> str:
    seed = f", seed {row['seed']:g}" if isinstance(row.get("seed"), int | float) else ""
    trial = plain(row["trial"])
    number = f", trial {trial:g}" if isinstance(trial, int | float) else ""
    status = "" if paired or row["status"] == "completed" else f", {words(row['status'])}"
    return f"{row['job']}{seed}{number}{status}"


def _group(
    label: str,
    series: str,
    points: Mapping[str, Mapping[str, list[float | None]]],
    estimates: Mapping[str, Mapping[str, statistics.Estimate | None]],
    names: list[str],
    done: list[bool],
    links: list[str],
) -> dict[str, Any]:
    return {
        "cell": label,
        "series": series,
        "names": names,
        "links": links,
        "done": done,
        "values": {s: {key: [_rounded(v) for v in found] for key, found in of.items()} for s, of in points.items()},
        "means": {s: {key: _mean(found) for key, found in of.items()} for s, of in estimates.items()},
    }


def _figure(
    found: list[dict[str, Any]],
    keys: Sequence[str],
    heads: Sequence[tuple[str, str, str, int]],
    step: int,
    zero: bool,
) -> dict[str, Any] | None:
    sources = [
        source
        for source in SOURCES
        if any(mean is not None for group in found for mean in group["means"].get(source, {}).values())
    ]
    if not sources:
        return None
    names = list(dict.fromkeys(group["series"] for group in found))
    looks = {name: LOOKS[n % len(LOOKS)] for n, name in enumerate(names)}
    named = sum(len(name) + _ENTRY for name in names) > LEGEND
    cells: dict[str, list[dict[str, Any]]] = {}
    for group in found:
        cells.setdefault(group["cell"], []).append(group)
    pages: list[list[dict[str, Any]]] = [[]]
    for own in cells.values():
        if pages[-1] and len(pages[-1]) + len(own) > ROWS:
            pages.append([])
        pages[-1] += own
    return {
        "keys": " · ".join(keys),
        "quantities": [{"key": key, "head": head, "unit": unit} for key, head, unit, _ in heads],
        "series": [{"name": name, "color": look[0], "symbol": look[1]} for name, look in looks.items()],
        "sources": sources,
        "step": step,
        "zero": zero,
        "size": {"row": ROW, "gap": GAP, "top": TOP, "bottom": BOTTOM},
        "named": named,
        "pages": [{"height": _height(page, named), "groups": page} for page in pages],
    }


def _height(page: Sequence[Mapping[str, Any]], named: bool) -> int:
    cells = len({group["cell"] for group in page})
    return TOP + BOTTOM + ROW * (len(page) + (cells if named else 0)) + GAP * cells


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DIGITS)


def _mean(found: statistics.Estimate | None) -> list[float | int | None] | None:
    if found is None:
        return None
    return [_rounded(found.mean), _rounded(found.low), _rounded(found.high), found.n]
