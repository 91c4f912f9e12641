"""The paper's two figures of identification in plotly's JSON form: displacement against wrench, and the friction cone.

As in `traces`, a trace says its role and the page gives the colour. No name goes into a figure, since plotly reads
markup in texts: names stand in the captions, which the page escapes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.calibrate.models import ElasticityCalibration, FrictionCalibration
from experiments.report.traces import POSE, WRENCH
from mechanics.readings import Array

DISPLACEMENT, MEASURED, FITTED = ("x", "y", "theta"), ("fx", "fy", "tau"), ("fx_fit", "fy_fit", "tau_fit")
FORCES = ("f_n", "f_t")
MOST = 2000  # samples that a figure shows
LARGEST = 1e9  # what is beyond is no figure of a gripper
DIGITS = 4  # 0.1 µm, 0.1 mN
PANELS_HEIGHT, CONE_HEIGHT = 330, 400  # [px]
COLUMN_GAP = 0.06  # of the width
STYLES: dict[str, dict[str, Any]] = {
    "stiffness": {"mode": "lines", "name": "K along this axis alone", "line": {"width": 1.25, "dash": "dash"}},
    "measured": {"mode": "markers", "name": "measured", "marker": {"size": 7, "symbol": "circle", "opacity": 0.6}},
    "fitted": {"mode": "markers", "name": "fitted", "marker": {"size": 4, "symbol": "x-thin", "line": {"width": 1.25}}},
    "interval": {"mode": "lines", "name": "95 %", "fill": "toself", "opacity": 0.4, "line": {"width": 0}},
    "cone": {"mode": "lines", "name": "±µ", "line": {"width": 1.25}},
}
SILENT = ("stiffness", "interval", "cone")


def styles() -> dict[str, dict[str, Any]]:
    """How each role is drawn, in plotly's terms."""
    common = {"type": "scatter", "legendgroup": "", "hoverinfo": "skip"}
    return {
        role: {**common, "legendgroup": role, **({} if role in SILENT else {"hoverinfo": "all"}), **style}
        for role, style in STYLES.items()
    }


def elasticity_figure(found: ElasticityCalibration, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Displacement against wrench along x, y and θ, as measured and as fitted, with the slope of K's diagonal.

    ``columns`` are those of the stage's samples (SI, gocf). ``data`` and ``layout`` are plotly's; ``shown`` and
    ``recorded`` count samples, ``distance`` (3,) [N, N, N·m] is the rms from the fitted points to the measured ones,
    of all samples. Raises ValueError where there is nothing to draw.
    """
    if np.abs(found.stiffness).max() > LARGEST:
        raise ValueError("its stiffness is beyond any scale")
    samples, recorded = _finite(columns, (*DISPLACEMENT, *MEASURED, *FITTED))
    distance = np.sqrt(np.mean((samples[:, 3:6] - samples[:, 6:9]) ** 2, axis=0))
    shown = _thinned(samples)
    data: list[dict[str, Any]] = []
    layout = _layout(PANELS_HEIGHT)
    for j, ((across, unit, scale, least), (up, up_unit, up_scale, up_least)) in enumerate(
        zip(POSE, WRENCH, strict=True)
    ):
        n = "" if j == 0 else str(j + 1)
        x, measured, fitted = shown[:, j] * scale, shown[:, 3 + j] * up_scale, shown[:, 6 + j] * up_scale
        ends = np.array([x.min(), x.max()])
        slope = found.stiffness[j][j] * up_scale / scale
        hover = f"{across} %{{x:.3f}} {unit}, {up} %{{y:.3f}} {up_unit}<extra>"
        for role, along, values in (
            ("measured", x, measured),
            ("fitted", x, fitted),
            ("stiffness", ends, slope * ends),
        ):
            tip = {} if role in SILENT else {"hovertemplate": f"{hover}{role}</extra>"}
            data.append({**_trace(role, along, values, n, showlegend=j == 0), **tip})
        domain = _column(j)
        layout[f"xaxis{n}"] = {
            **{"domain": domain, "anchor": f"y{n}", "range": _range(x, least)},
            "title": {"text": f"{across} [{unit}]", "standoff": 6},
        }
        layout[f"yaxis{n}"] = {
            **{"domain": [0, 1], "anchor": f"x{n}"},
            "range": _range(np.concatenate([measured, fitted]), up_least),
        }
        layout["annotations"].append(_title(f"{up} [{up_unit}]", domain[0]))
    return {
        **{"data": data, "layout": layout, "wide": True},
        **{"shown": len(shown), "recorded": recorded, "distance": distance.tolist()},
    }


def friction_figure(found: FrictionCalibration, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Tangential against normal forces of a pair [N], the edges ±µ of its cone, and the 95 % interval as a band.

    Returns as `elasticity_figure`; ``pressed`` is the range of the normal forces [N]. Raises ValueError where there is
    nothing to draw.
    """
    low, high = found.interval
    if not -LARGEST < low <= high < LARGEST:
        raise ValueError("its interval is none")
    samples, recorded = _finite(columns, FORCES)
    shown = _thinned(samples)
    top = 1.05 * max(float(samples[:, 0].max()), 0.1)
    data = [
        _trace("interval", side * top * np.array([0, low, high, 0]), top * np.array([0, 1, 1, 0]), showlegend=side > 0)
        for side in (-1, 1)
    ]
    data.append(_trace("cone", found.mu * top * np.array([-1, 0, 1]), top * np.array([1, 0, 1])))
    points = _trace("measured", shown[:, 1], shown[:, 0])
    data.insert(0, {**points, "hovertemplate": "f_t %{x:.3f} N, f_n %{y:.3f} N<extra>measured</extra>"})
    layout = _layout(CONE_HEIGHT)
    reach = 1.08 * max(high * top, float(np.abs(samples[:, 1]).max()))
    bottom = min(0.0, float(samples[:, 0].min())) - 0.03 * top
    # one scale for both forces, so that the cone has its own angle
    layout["xaxis"] = {
        **{"domain": [0, 1], "anchor": "y", "range": _limits(-reach, reach)},
        **{"scaleanchor": "y", "title": {"text": "f<sub>t</sub> [N]", "standoff": 6}},
    }
    layout["yaxis"] = {"domain": [0, 1], "anchor": "x", "range": _limits(bottom, top)}
    layout["annotations"].append(_title("f<sub>n</sub> [N]", 0.0))
    return {
        **{"data": data, "layout": layout, "wide": False},
        **{
            "shown": len(shown),
            "recorded": recorded,
            "pressed": [float(samples[:, 0].min()), float(samples[:, 0].max())],
        },
    }


def _finite(columns: Mapping[str, Any], names: Sequence[str]) -> tuple[Array, int]:
    """The named columns (n, k), without rows that are not all finite, and how many rows there were."""
    missing = [name for name in names if name not in columns]
    if missing:
        raise ValueError(f"no column {', '.join(missing)}")
    try:
        values = np.array([columns[name] for name in names], float).T
    except (TypeError, ValueError):
        raise ValueError("its columns are not of numbers, or not of one length") from None
    if values.ndim != 2:
        raise ValueError("its columns are not of numbers, or not of one length")
    known = values[(np.abs(values) < LARGEST).all(axis=1)]  # which is false of NaN
    if not len(known):
        raise ValueError("no row of it holds numbers")
    return known, len(values)


def _thinned(samples: Array) -> Array:
    if len(samples) <= MOST:
        return samples
    return samples[np.linspace(0, len(samples) - 1, MOST).round().astype(int)]


def _trace(role: str, x: Array, y: Array, n: str = "", showlegend: bool = True) -> dict[str, Any]:
    points = {"x": np.round(x, DIGITS).tolist(), "y": np.round(y, DIGITS).tolist()}
    return {**points, "xaxis": f"x{n}", "yaxis": f"y{n}", "showlegend": showlegend, "meta": {"role": role}}


def _layout(height: int) -> dict[str, Any]:
    return {
        "height": height,
        "margin": {"l": 48, "r": 8, "t": 58, "b": 44},
        "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "top", "yref": "container"},
        "dragmode": "zoom",
        "annotations": [],
    }


def _title(text: str, x: float) -> dict[str, Any]:
    at = {"x": x, "y": 1, "xref": "paper", "yref": "paper", "xanchor": "left", "yanchor": "bottom"}
    return {"text": text, "font": {"size": 12}, "yshift": 2, "showarrow": False, **at}


def _column(j: int) -> list[float]:
    width = (1 - 2 * COLUMN_GAP) / 3
    return _limits(j * (width + COLUMN_GAP), j * (width + COLUMN_GAP) + width)


def _range(values: Array, least: float) -> list[float]:
    """Limits that hold all values with a margin, at least ``least`` apart."""
    low, high = float(values.min()), float(values.max())
    half = max(high - low, least) / 2 * 1.12
    return _limits((low + high) / 2 - half, (low + high) / 2 + half)


def _limits(low: float, high: float) -> list[float]:
    digits = DIGITS + max(0, -math.floor(math.log10(max(high - low, 1e-6))))
    return [round(low, digits), round(high, digits)]
