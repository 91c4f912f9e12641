"""Planned against measured and true: poses and wrenches of a trial over time, as figures in plotly's JSON form.

Colours are the page's business (light, dark, print): a trace says its role and the page gives the colour. The points
are in the page already, for the scene; ``meta`` of a trace says which of them it shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# symbol, unit, factor from SI, smallest span of the axis in that unit (so that noise does not fill a flat panel)
Panel = tuple[str, str, float, float]
POSE: tuple[Panel, ...] = (
    ("x", "mm", 1e3, 1.0),
    ("y", "mm", 1e3, 1.0),
    ("θ", "deg", 180 / math.pi, 1.0),
)
WRENCH: tuple[Panel, ...] = (
    ("fx", "N", 1.0, 0.5),
    ("fy", "N", 1.0, 0.5),
    ("τ", "N·mm", 1e3, 20.0),
)
ROWS = {"go": POSE, "eo": POSE, "ee": POSE, "wrench": WRENCH}
STYLES: dict[str, dict[str, Any]] = {
    "recorded": {"mode": "lines", "line": {"width": 1}, "hoverinfo": "skip", "opacity": 0.45},
    "planned": {"mode": "lines", "line": {"width": 2, "dash": "dash"}},
    "measured": {"mode": "lines+markers", "line": {"width": 1.25}, "marker": {"size": 6, "symbol": "circle"}},
    "truth": {"mode": "lines+markers", "line": {"width": 1.25}, "marker": {"size": 6, "symbol": "diamond-open"}},
}
FOUND = ("planned", "measured", "truth")
COLUMNS = 3
PANEL_HEIGHT, TITLE_HEIGHT, TOP, BOTTOM = 122, 43, 62, 44  # [px]
COLUMN_GAP = 0.065  # of the width


def styles() -> dict[str, dict[str, Any]]:
    """How each role is drawn, in plotly's terms: dashes and symbols tell the roles apart where colour does not."""
    common = {role: {"type": "scatter", "name": role, "legendgroup": role} for role in STYLES}
    hover = {role: {"hovertemplate": f"%{{y:.3f}}<extra>{role}</extra>"} for role in FOUND}
    return {role: {**common[role], **hover.get(role, {}), **style} for role, style in STYLES.items()}


def figure(trial: Mapping[str, Any]) -> dict[str, Any] | None:
    """Small multiples of one trial as `payload.build` gives it: a row per body, a column per component.

    ``data``: per trace its axes and ``meta`` = role, series, component and the factor from SI to mm, deg, N or N·mm;
    ``layout``: plotly's, times in s. None where the trial has no waypoints.
    """
    waypoints = trial["waypoints"]
    sources = {role: waypoints[role] for role in FOUND if waypoints[role] is not None} if waypoints else {}
    rows = [row for row in ROWS if any(series[row] is not None for series in sources.values())]
    if not rows:
        return None
    height = TOP + BOTTOM + PANEL_HEIGHT * len(rows) + TITLE_HEIGHT * (len(rows) - 1)
    layout = _layout(height)
    data: list[dict[str, Any]] = []
    for i, body in enumerate(rows):
        for j, (symbol, unit, factor, span) in enumerate(ROWS[body]):
            suffix = "" if i == j == 0 else str(i * COLUMNS + j + 1)
            for role in ("recorded", *sources):
                meta = {"role": role, "series": body, "component": j, "factor": factor}
                data.append({"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "showlegend": i == j == 0, "meta": meta})
            values = [row[j] * factor for series in sources.values() for row in series[body] or () if row is not None]
            across, along = _column(j), _row(i, len(rows))
            last = i == len(rows) - 1
            layout[f"xaxis{suffix}"] = {
                **{"domain": across, "anchor": f"y{suffix}", "range": _span(waypoints["t"]), "showticklabels": last},
                **({"title": {"text": "time [s]", "standoff": 6}} if last else {}),
                **({"matches": "x"} if suffix else {}),
            }
            layout[f"yaxis{suffix}"] = {"domain": along, "anchor": f"x{suffix}", "range": _range(values, span)}
            title = f"{symbol} [{unit}]" if body == "wrench" else f"{body} {symbol} [{unit}]"
            layout["annotations"].append(_title(title, across[0], along[1]))
    return {"data": data, "layout": layout}


def _layout(height: int) -> dict[str, Any]:
    return {
        "height": height,
        "margin": {"l": 52, "r": 8, "t": TOP, "b": BOTTOM},
        "hovermode": "x unified",
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "top", "yref": "container"},
        "dragmode": "zoom",
        "annotations": [],
    }


def _title(text: str, x: float, y: float) -> dict[str, Any]:
    at = {"x": x, "y": y, "xref": "paper", "yref": "paper", "xanchor": "left", "yanchor": "bottom"}
    return {"text": text, "font": {"size": 12}, "yshift": 2, "showarrow": False, **at}


def _column(j: int) -> list[float]:
    width = (1 - COLUMN_GAP * (COLUMNS - 1)) / COLUMNS
    return [round(j * (width + COLUMN_GAP), 6), round(j * (width + COLUMN_GAP) + width, 6)]


def _row(i: int, count: int) -> list[float]:
    inner = PANEL_HEIGHT * count + TITLE_HEIGHT * (count - 1)
    top = 1 - i * (PANEL_HEIGHT + TITLE_HEIGHT) / inner
    return [round(max(0.0, top - PANEL_HEIGHT / inner), 6), round(top, 6)]


def _span(times: Sequence[float]) -> list[float]:
    margin = max(times[-1] - times[0], 1.0) * 0.03
    return [round(times[0] - margin, 6), round(times[-1] + margin, 6)]


def _range(values: Iterable[float], span: float) -> list[float]:
    """Limits that hold all values with a margin and are at least ``span`` apart."""
    known = sorted(values) or [0.0]
    middle, half = (known[0] + known[-1]) / 2, max(known[-1] - known[0], span) / 2 * 1.12
    return [round(middle - half, 6), round(middle + half, 6)]
