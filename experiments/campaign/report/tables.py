"""A campaign in words and rows: how it stands, its cells, what failed and why, its worst trials."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from experiments.campaign.frame import plain, shown
from experiments.campaign.report import points
from experiments.campaign.report.collect import LINK, Collected
from experiments.report.summary import AGGREGATES, Verdict, level, words
from experiments.statistics import Estimate, rate

#: so many of the worst trials by each error, and so many of those that failed for one reason, are linked
WORST, EXAMPLES = 5, 6
#: so many trials are listed one by one; all are in the Parquet file
LISTED = 1000
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def verdict(collected: Collected) -> Verdict:
    """How the campaign stands."""
    summary, trials = collected.summary, collected.trials
    done = trials["status"].tolist().count("completed")
    count = f"{done} of {len(trials)} trial{'s' * (len(trials) != 1)} completed" if len(trials) else "no trial was run"
    jobs, ended, given_up = summary["jobs"], summary["ended"], len(collected.given_up)
    if given_up:
        count += f"; {given_up} job{'s were' if given_up > 1 else ' was'} given up"
    left = jobs - ended - given_up
    if left > 0:
        why = {"interrupted": "it was interrupted", "scheduler_failed": "its scheduler went away"}
        told = why.get(str(summary["status"]), "it was cut off, or still runs")
        detail = (
            f"{ended} of {jobs} jobs have ended, {left} {'are' if left > 1 else 'is'} missing: {told}. So far {count}."
        )
        return Verdict("aborted", "Unfinished", detail)
    if given_up or done < len(trials) or not len(trials):
        return Verdict("short", "Fell short", f"{count}.")
    return Verdict("completed", "Completed", f"{count}.")


def facts(collected: Collected) -> list[tuple[str, str]]:
    """Label and value of what identifies the campaign."""
    grid = {key: values for key, values in collected.grid.items() if key != "seed"}
    seeds, started = collected.grid.get("seed", ()), collected.started
    git = collected.provenance.get("git", ())
    pairs = [
        ("Experiment", str(collected.summary.get("experiment") or "")),
        ("Station", _some(collected.stations)),
        *((key, _some(values)) for key, values in grid.items()),
        ("Seeds", _ranges(seeds)),
        ("Jobs", f"{collected.summary['ended']} of {collected.summary['jobs']} ended"),
        ("Git", ", ".join(git)),
        ("Begun", _time(started[0]) if started else ""),
    ]
    return [(label, value or "not recorded") for label, value in pairs]


def _time(text: str) -> str:
    """An instant as people read it; whatever else stands there as it is."""
    try:
        return f"{datetime.fromisoformat(text).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"
    except ValueError:
        return text


def _some(values: Sequence[str], most: int = 12) -> str:
    more = f", … ({len(values)})" if len(values) > most else ""
    return ", ".join(values[:most]) + more


def _ranges(seeds: Sequence[str]) -> str:
    """Seeds as `--seeds` takes them: 0-4, 7."""
    if not seeds or not all(seed.isdecimal() for seed in seeds):
        return _some(seeds)
    found: list[list[int]] = []
    for seed in sorted(map(int, seeds)):
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return _some([str(first) if first == last else f"{first}-{last}" for first, last in found])


def warnings(collected: Collected) -> list[str]:
    """What a reader has to know before comparing cells: runs of several revisions or versions."""
    mixed = [path for path, values in collected.provenance.items() if len(values) > 1]
    named = ", ".join(path.removeprefix("versions.") for path in mixed)
    return [f"The runs were not all made by the same: they differ in {named}."] if mixed else []


def cell_rows(collected: Collected) -> dict[str, Any]:
    """``keys`` and ``heads``, and a row for each cell and method: trials, share that completed, errors as text."""
    heads, several = points.quantities(collected.trials), points.several_skills(collected)
    rows = []
    for of, trials in points.groups(collected):
        share = rate(trials["status"].tolist().count("completed"), len(trials))
        rows.append(
            {
                "cell": [shown(of[key]) for key in collected.keys],
                "method": points.method(of, several),
                "n": len(trials),
                "share": share,
                "level": "completed" if share.successes == share.n else "short",
                "errors": [_error(points.values(trials, "measured", h[0]), h[3]) for h in heads],
                "truth": [_error(points.values(trials, "truth", h[0]), h[3]) for h in heads],
            }
        )
    for row, before in zip(rows, [None, *rows], strict=False):
        row["first"] = before is None or before["cell"] != row["cell"]
    return {"keys": list(collected.keys), "heads": heads, "rows": rows}


def _error(found: Sequence[float | None], decimals: int) -> dict[str, str] | None:
    told = points.estimate(found)
    if told is None:
        return None
    shown = {"mean": f"{told.mean:.{decimals}f}", "interval": _interval(told, decimals)}
    if told.n > 1:  # a single trial has no spread
        shown["std"] = f"{np.std([value for value in found if value is not None]):.{decimals}f}"
    return shown


def _interval(told: Estimate, decimals: int, sign: str = "") -> str:
    if told.low is None or told.high is None:
        return ""
    return f"{told.low:{sign}.{decimals}f} … {told.high:{sign}.{decimals}f}"


def difference_rows(collected: Collected) -> list[dict[str, Any]]:
    """A row for each cell and pair of controllers of which two pairs and more are known."""
    heads, several = points.quantities(collected.trials), points.several_skills(collected)
    rows = []
    for one in collected.pairings:
        found = [points.statistics.paired_over(*one.values(f"measured.{h[0]}.mean")) for h in heads]
        if any(e is not None and e.n > 1 for e in found):
            errors = [
                None
                if e is None
                else {"mean": f"{e.mean:+.{h[3]}f}", "interval": _interval(e, h[3], "+"), "n": e.n, "sure": _sure(e)}
                for e, h in zip(found, heads, strict=True)
            ]
            cell = [shown(value) for value in one.cell.values()]
            rows.append({"cell": cell, "pair": points.pair_told(one, several), "errors": errors})
    return rows


def _sure(told: Estimate) -> bool:
    """Whether the interval tells the sign."""
    return told.low is not None and told.high is not None and (told.low > 0 or told.high < 0)


def failure_rows(collected: Collected) -> list[dict[str, Any]]:
    """Why trials did not complete: a row for each status and reason, figures in it aside; the most frequent first."""
    trials, several = collected.trials, points.several_skills(collected)
    short = trials.loc[trials["status"] != "completed"]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in short.to_dict("records"):
        reason = str(plain(row.get("reason")) or "")
        groups.setdefault((str(row["status"]), _NUMBER.sub("…", reason)), []).append({**row, "reason": reason})
    found = []
    for (status, pattern), rows in sorted(groups.items(), key=lambda item: -len(item[1])):
        reasons = {row["reason"] for row in rows}
        where: dict[str, int] = {}
        for row in rows:
            cell = ", ".join(shown(plain(row[key])) for key in collected.keys)
            told = points.method(row, several) + (f" at {cell}" if cell else "")
            where[told] = where.get(told, 0) + 1
        found.append(
            {
                "status": words(status),
                "level": level(status),
                "reason": pattern if len(reasons) > 1 else next(iter(reasons)),
                "n": len(rows),
                "where": [f"{count} × {told}" for told, count in sorted(where.items(), key=lambda w: -w[1])][:EXAMPLES],
                "examples": [(trial_name(row), row[LINK]) for row in rows[:EXAMPLES]],
                "more": max(0, len(rows) - EXAMPLES),
            }
        )
    return found


def worst(collected: Collected) -> list[dict[str, Any]]:
    """For each error the trials that have most of it, as measured."""
    several, found = points.several_skills(collected), []
    for key, head, unit, decimals in AGGREGATES:
        column = f"measured.{key}.mean"
        if column not in collected.trials or not len(collected.trials[column].dropna()):
            continue
        most = collected.trials.astype({column: float}).nlargest(WORST, column)
        rows = [
            {**_trial(row, collected.keys, several), "value": f"{row[column]:.{decimals}f}"}
            for row in most.to_dict("records")
        ]
        found.append({"head": head, "unit": unit, "rows": rows})
    return found


def trial_rows(collected: Collected) -> dict[str, Any]:
    """The first trials one by one, and how many there are besides."""
    heads, several = points.quantities(collected.trials), points.several_skills(collected)
    rows = []
    for row in collected.trials.head(LISTED).to_dict("records"):
        figures = [plain(row.get(f"measured.{h[0]}.mean")) for h in heads]
        told = ["–" if f is None else f"{f:.{h[3]}f}" for f, h in zip(figures, heads, strict=True)]
        rows.append({**_trial(row, collected.keys, several), "errors": told})
    return {"heads": heads, "rows": rows, "more": max(0, len(collected.trials) - LISTED)}


def _trial(row: Mapping[Any, Any], keys: Sequence[str], several: bool) -> dict[str, Any]:
    return {
        "name": trial_name(row),
        "link": row[LINK],
        "cell": [shown(plain(row[key])) for key in keys],
        "method": points.method(row, several),
        "seed": shown(plain(row.get("seed"))),
        "trial": shown(plain(row.get("trial"))),
        "status": words(row["status"]),
        "level": level(row["status"]),
    }


def trial_name(row: Mapping[Any, Any]) -> str:
    """The run of a trial: its job, and the attempt where it was not the first."""
    run = str(row["run"]).rsplit("/", 1)[-1]
    return str(row["job"]) + (f"/{run}" if run.startswith("run.") else "")


def provenance_rows(collected: Collected) -> Iterator[tuple[str, str]]:
    """Path and value of where the figures come from; several values where runs differ."""
    if collected.sets:
        yield "set", ", ".join(collected.sets)
    for path, values in collected.provenance.items():
        yield path, " | ".join(values)
