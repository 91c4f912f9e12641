"""How each plan was found: the loss against the queries it took, from what the plans' files say of themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from experiments.report.summary import duration, is_number, listed, mapping, words
from planning.plan_file import PlanFileError, load

HEIGHT = 260  # [px]
MOST = 1000  # points of a curve
LEAST = 1e-6  # of the loss, that a term which is told adds to it
ENDED = {"converged": "it converged", "iterations": "its budget was spent", "stalled": "it stalled"}
STYLES: dict[str, dict[str, Any]] = {
    "loss": {
        **{"type": "scatter", "mode": "lines+markers", "name": "loss", "line": {"width": 1.5}, "marker": {"size": 4}},
        "hovertemplate": "%{x:,} queries: %{y:.4g}<extra></extra>",
    },
}


def found(folder: Path, rows: Iterable[Any]) -> dict[str, dict[str, Any] | str]:
    """By name what the file of each plan of results.json says of how it was found, or what is wrong with the file."""
    told: dict[str, dict[str, Any] | str] = {}
    for row in rows:
        file = mapping(row).get("file")
        if not isinstance(file, str) or not (folder / file).resolve().is_relative_to(folder.resolve()):
            continue
        name = str(mapping(row).get("name"))
        try:
            told[name] = load(folder / file).provenance
        except PlanFileError as error:
            told[name] = error.problem
    return told


def figures(plans: Any, rows: Any) -> list[dict[str, Any]]:
    """A figure for each plan that an optimiser has found, in plotly's JSON form as in `traces`, with its caption.

    ``plans`` as of `found`, ``rows`` the plans of results.json. ``text`` says how it began and ended, ``problem`` why
    there is nothing to draw: then ``data`` is empty.
    """
    known = mapping(plans)
    drawn = []
    for row in rows if isinstance(rows, list) else []:
        plan = mapping(row)
        told = known.get(str(plan.get("name")))
        if isinstance(told, str):
            drawn.append(_undrawn(plan, f"its file cannot be read: {told}"))
        elif isinstance(told, Mapping) and (figure := _figure(plan, told)) is not None:
            drawn.append(figure)
    return drawn


def _figure(plan: Mapping[str, Any], told: Mapping[str, Any]) -> dict[str, Any] | None:
    curve, asked = listed(told.get("curve")), listed(told.get("curve_queries"))
    by_query = len(asked) == len(curve) and all(is_number(n) for n in asked)
    across = asked if by_query else list(range(1, len(curve) + 1))
    points = [(x, y) for x, y in zip(across, curve, strict=True) if is_number(y) and math.isfinite(y)]
    if len(points) < 2:
        return None  # the nominal trajectory: nothing was sought
    keep = sorted({round(i * (len(points) - 1) / (MOST - 1)) for i in range(MOST)}) if len(points) > MOST else None
    points = points if keep is None else [points[i] for i in keep]
    losses = [y for _, y in points]
    ended = ENDED.get(str(told.get("ended")), words(told.get("ended")))
    fall = f"from {losses[0]:.4g} to {min(losses):.4g}"
    text = f"Loss {fall} in {_count(plan.get('queries'))} queries and {_seconds(told.get('optimising_s'))}; {ended}."
    terms = {str(k): v for k, v in mapping(told.get("terms")).items() if is_number(v) and abs(v) > LEAST * min(losses)}
    shortfalls = [str(item) for item in listed(told.get("shortfalls"))]
    return {
        "name": str(plan.get("name")),
        "text": text,
        "problem": "; ".join(shortfalls),
        "terms": [(name, f"{value:.4g}") for name, value in sorted(terms.items(), key=lambda item: -item[1])],
        "data": [{"x": [x for x, _ in points], "y": losses, "meta": {"role": "loss"}, "showlegend": False}],
        "layout": _layout("queries" if by_query else "iterations", all(y > 0 for y in losses)),
    }


def _undrawn(plan: Mapping[str, Any], problem: str) -> dict[str, Any]:
    return {"name": str(plan.get("name")), "text": "", "problem": problem, "terms": [], "data": [], "layout": {}}


def _layout(across: str, positive: bool) -> dict[str, Any]:
    title = {"xref": "paper", "yref": "paper", "xanchor": "left", "yanchor": "bottom", "x": 0, "y": 1, "yshift": 2}
    return {
        "height": HEIGHT,
        "margin": {"l": 62, "r": 12, "t": 30, "b": 44},
        "hovermode": "closest",
        "dragmode": "zoom",
        "xaxis": {"title": {"text": across, "standoff": 6}, "rangemode": "tozero"},
        "yaxis": {"type": "log", "exponentformat": "power"} if positive else {},
        "annotations": [{**title, "text": "loss", "font": {"size": 12}, "showarrow": False}],
    }


def _count(value: Any) -> str:
    return f"{value:,}" if is_number(value) else "an unknown number of"


def _seconds(value: Any) -> str:
    return duration(value) if is_number(value) else "an unknown time"
