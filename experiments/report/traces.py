"""Planned against measured and true: poses and wrenches of a trial over time, as plotly figures.

Colours are the page's business (light, dark, print): a trace says its ``meta.role`` and the page gives the colour.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

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
ROWS = (
    ("go", "grasped object", POSE),
    ("eo", "extrinsic object", POSE),
    ("ee", "end-effector", POSE),
    ("wrench", "sensor on grasped object", WRENCH),
)
STYLES: dict[str, dict[str, Any]] = {
    "recorded": {"mode": "lines", "line": {"width": 1}, "hoverinfo": "skip", "opacity": 0.45},
    "planned": {"mode": "lines", "line": {"width": 2, "dash": "dash"}},
    "measured": {"mode": "lines+markers", "line": {"width": 1.25}, "marker": {"size": 6, "symbol": "circle"}},
    "truth": {"mode": "lines+markers", "line": {"width": 1.25}, "marker": {"size": 6, "symbol": "diamond-open"}},
}
ROW_HEIGHT, MARGIN = 165, 106  # [px]


def figure(trial: Mapping[str, Any]) -> Figure | None:
    """Small multiples of one trial as `payload.build` gives it: a row per body, a column per component.

    y in mm, deg, N and N·mm; x in s. ``meta`` of a trace: role, series, component, factor from SI. The ``recorded``
    traces are empty: the page fills them from the playback. None where the trial has no way-points.
    """
    from plotly.subplots import make_subplots

    waypoints = trial["waypoints"]
    if waypoints is None:
        return None
    sources = {role: waypoints[role] for role in ("planned", "measured", "truth") if waypoints[role] is not None}
    rows = [row for row in ROWS if any(series[row[0]] is not None for series in sources.values())]
    if not rows:
        return None
    titles = [f"{body} {symbol} [{unit}]" for body, _, panels in rows for symbol, unit, _, _ in panels]
    titles = [title.removeprefix("wrench ") for title in titles]
    height = ROW_HEIGHT * len(rows) + MARGIN
    spacing = 46 / (height - MARGIN)
    fig = make_subplots(len(rows), 3, subplot_titles=titles, horizontal_spacing=0.065, vertical_spacing=spacing)
    shown: set[str] = set()
    for i, (body, _, panels) in enumerate(rows):
        for j, (_, _, factor, span) in enumerate(panels):
            curves = {role: _curve(series[body], j, factor) for role, series in sources.items()}
            for role in ("recorded", *curves):
                meta = {"role": role, "series": body, "component": j, "factor": factor}
                fig.add_scatter(
                    x=[] if role == "recorded" else waypoints["t"],
                    y=curves.get(role, []),
                    name=role,
                    legendgroup=role,
                    showlegend=role not in shown,
                    meta=meta,
                    hovertemplate=None if role == "recorded" else f"%{{y:.3f}}<extra>{role}</extra>",
                    row=i + 1,
                    col=j + 1,
                    **STYLES[role],
                )
                shown.add(role)
            fig.update_yaxes(range=_range(curves.values(), span), row=i + 1, col=j + 1)
    _lay_out(fig, waypoints["t"], len(rows), height)
    return fig


def skeleton(fig: Figure) -> dict[str, Any]:
    """The figure as JSON without its points: the page takes them from the way-points by each trace's ``meta``."""
    parts = fig.to_plotly_json()
    parts["data"] = [{key: value for key, value in trace.items() if key not in {"x", "y"}} for trace in parts["data"]]
    return parts


def _curve(rows: Sequence[Sequence[float] | None] | None, component: int, factor: float) -> list[float | None]:
    return [None if row is None else round(row[component] * factor, 5) for row in rows or []]


def _range(curves: Any, span: float) -> list[float]:
    """Limits that hold all curves with a margin and are at least ``span`` apart."""
    values = [value for curve in curves for value in curve if value is not None]
    low, high = (min(values), max(values)) if values else (0.0, 0.0)
    middle, half = (low + high) / 2, max(high - low, span) / 2 * 1.12
    return [round(middle - half, 5), round(middle + half, 5)]


def _lay_out(fig: Figure, times: Sequence[float], rows: int, height: int) -> None:
    margin = max(times[-1] - times[0], 1.0) * 0.03
    fig.update_xaxes(range=[times[0] - margin, times[-1] + margin], matches="x", showticklabels=False)
    fig.update_xaxes(title={"text": "time [s]", "standoff": 6}, showticklabels=True, row=rows)
    fig.layout.xaxis.matches = None  # the one that the others match
    fig.update_annotations(xanchor="left", font={"size": 12}, yshift=2)
    for annotation, axis in zip(fig.layout.annotations, fig.select_xaxes(), strict=True):
        annotation.x = axis.domain[0]
    fig.update_layout(
        template="none",
        height=height,
        margin={"l": 52, "r": 8, "t": 62, "b": 44},
        hovermode="x unified",
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "top", "yref": "container"},
        dragmode="zoom",
    )
