"""What a run knew of its station in rows and captions: calibrations in use, and where nominal figures were used."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from pydantic import ValidationError

from experiments.calibrate.models import (
    Calibration,
    CameraCalibration,
    ClockCalibration,
    ElasticityCalibration,
    ForceTorqueCalibration,
    FrictionCalibration,
    TagCalibration,
)
from experiments.report import calibration as figures
from experiments.report.summary import leaves, mapping, words

KINDS: dict[str, type[Calibration]] = {
    "elasticity": ElasticityCalibration,
    "friction": FrictionCalibration,
    "force_torque": ForceTorqueCalibration,
    "camera": CameraCalibration,
    "tag": TagCalibration,
    "clock": ClockCalibration,
}
TITLES = {
    "elasticity": "Elasticity",
    "friction": "Friction",
    "force_torque": "Tool on the wrist sensor",
    "camera": "Camera",
    "tag": "Tag on the object",
    "clock": "Clocks",
}
DRAWN = (ElasticityCalibration, FrictionCalibration)
AXES, WRENCH_AXES = ("x", "y", "θ"), ("fx [N]", "fy [N]", "τ [N·m]")
K_UNITS = ("N/m", "N/m", "N·m/rad")
NBSP = "\u00a0"
FINEST, LARGEST = 9, 1e7  # decimals, and the size from which a figure has an exponent

#: one figure in words: symbol, its index, value, unit
Item = tuple[str, str, str, str]


def section(known: Any, run: Any) -> dict[str, Any] | None:
    """Rows, figures and problems of the page's calibration section; None where there is nothing to tell.

    ``known`` is results.json's ``calibration``: by name what the file says, and its ``file``. ``run`` may hold
    ``samples``: by name the columns beside a calibration in the run folder, or the text of what is wrong with them;
    ``made``: names of those that this run made; ``nominal``: name, kind, of and figures of what the run would have used
    a calibration for (see `collect`).
    """
    run, known = mapping(run), mapping(known)
    samples, made = mapping(run.get("samples")), run.get("made")
    made = {str(name) for name in made} if isinstance(made, list) else set()
    rows, drawn, problems = [], [], []
    for name, entry in known.items():
        found = _read(entry)
        if found is None:
            rows.append(_unread(name, entry))
            continue
        rows.append(_row(name, found, entry, name in made))
        if not isinstance(found, DRAWN) or not (name in samples or name in made):
            continue
        try:
            drawn.append({**_figure(found, samples.get(name)), "name": name})
        except ValueError as error:
            problems.append(f"{name}.csv could not be drawn: {error}. Its figure is left out.")
    listed = run.get("nominal")
    nominal = [mapping(use) for use in listed] if isinstance(listed, list) else []
    rows += [_nominal(use) for use in nominal if use.get("name") not in known]
    if not rows:
        return None
    order = list(TITLES)
    rows.sort(key=lambda row: order.index(row["kind"]) if row["kind"] in order else len(order))
    drawn.sort(key=lambda figure: not figure["wide"])
    return {"rows": rows, "figures": drawn, "problems": problems}


def _read(entry: Any) -> Calibration | None:
    """The calibration that an entry holds; None for what this version does not know."""
    fields = {key: value for key, value in mapping(entry).items() if key != "file"}
    model = KINDS.get(str(fields.get("kind")))
    try:
        return None if model is None else model.model_validate(fields)
    except (ValidationError, TypeError, ArithmeticError):
        return None


def _figure(found: ElasticityCalibration | FrictionCalibration, columns: Any) -> dict[str, Any]:
    if columns is None:
        raise ValueError("it is missing")
    if not isinstance(columns, Mapping):
        raise ValueError(str(columns))
    if isinstance(found, FrictionCalibration):
        figure = figures.friction_figure(found, columns)
        return {**figure, "caption": _friction_caption(found, figure)}
    figure = figures.elasticity_figure(found, columns)
    return {**figure, "caption": _elasticity_caption(found, figure)}


def _elasticity_caption(found: ElasticityCalibration, figure: Mapping[str, Any]) -> dict[str, Any]:
    facts = [
        ("Samples", _count(found.samples, figure)),
        ("Method", words(found.method)),
        ("K is the secant at", f"{found.amplitude * 1e3:.2f} mm"),
        ("Stiffening", f"{rounded(found.stiffening * 0.1, 2)} % per mm" if found.stiffening else "none"),
        ("Hysteresis", f"{found.hysteresis * 100:.0f} % of K" if found.hysteresis else "none"),
        ("Creep", f"{found.creep * 100:.0f} % of K in {rounded(found.creep_time, 2)} s" if found.creep else "none"),
        ("Residual of the fit, rms", _wrench(found.residual)),
        ("Measured to fitted as drawn, rms", _wrench(figure["distance"])),
        ("χ² per degree of freedom", rounded(found.chi2, 3)),
    ]
    return {
        "title": f"Elasticity of {_of(found)}",
        "text": "Displacement of the end-effector in gocf against the wrench of the sensor on the object, measured and "
        "by the fitted law at rest at the same displacements. Each panel shows one component of samples that moved in "
        "all three, so coupling takes them off the line. The fit's own residual is smaller where it also found "
        "hysteresis, creep or drift.",
        "facts": facts,
        "matrix": [
            (WRENCH_AXES[i], [plus_minus(found.stiffness[i][j], found.deviation[i][j]) for j in range(3)])
            for i in range(3)
        ],
    }


def _friction_caption(found: FrictionCalibration, figure: Mapping[str, Any]) -> dict[str, Any]:
    low, high = figure["pressed"]
    return {
        "title": f"Friction of {_of(found)}",
        "text": f"µ = {_interval(found)}, from {_count(found.samples, figure)} samples of random motion in contact "
        f"under {low:.1f} N to {high:.1f} N. The cone is drawn from zero; the fit lets its tip be off by what "
        "a tare leaves.",
        "facts": [],
        "matrix": None,
    }


def _count(used: int, figure: Mapping[str, Any]) -> str:
    """Samples that were used, and those drawn where these are fewer than recorded."""
    shown, recorded = figure["shown"], figure["recorded"]
    text = f"{used:,}"
    if recorded != used:
        text += f" of {recorded:,}"
    return text if shown == recorded else f"{text} ({shown:,} drawn)"


def _wrench(values: Sequence[float]) -> str:
    fx, fy, tau = values
    return f"{rounded(fx, 2)}{NBSP}N, {rounded(fy, 2)}{NBSP}N, {rounded(tau * 1e3, 2)}{NBSP}N·mm"


def _of(found: Calibration) -> str:
    """What a calibration is of, by its devices and objects."""
    objects = {role: print_.split(maxsplit=1)[0] for role, print_ in found.origin.objects.items() if print_.strip()}
    if isinstance(found, ElasticityCalibration):
        return f"{found.sensor} on {objects.get('go', 'an unnamed object')}"
    if isinstance(found, FrictionCalibration):
        return " on ".join(objects.get(body, body) for body in found.pair.split("-"))
    if isinstance(found, TagCalibration):
        return f"tag {found.id} on {objects.get('go', 'an unnamed object')}"
    return found.device if isinstance(found, ForceTorqueCalibration | CameraCalibration) else ""


def _items(found: Calibration) -> tuple[list[Item], str]:
    """The figures of a calibration, and what they rest on."""
    if isinstance(found, ElasticityCalibration):
        diagonal = [
            ("K", axis * 2, plus_minus(found.stiffness[i][i], found.deviation[i][i]), K_UNITS[i])
            for i, axis in enumerate(AXES)
        ]
        return diagonal, f"{found.samples:,} samples, residual {_wrench(found.residual)}"
    if isinstance(found, FrictionCalibration):
        return [("µ", "", _interval(found), "")], f"{found.samples:,} samples"
    if isinstance(found, ForceTorqueCalibration):
        mass, *deviation = found.deviation
        centre = [
            ("centre", axis, plus_minus(p * 1e3, s * 1e3), "mm")
            for axis, p, s in zip(AXES, found.tool_centre, deviation, strict=False)
        ]
        basis = f"{found.samples:,} samples, residual {rounded(found.residual, 2)}{NBSP}N; centre in ee"
        return [("mass", "", plus_minus(found.tool_mass, mass), "kg"), *centre], basis
    if isinstance(found, CameraCalibration):
        focal = plus_minus(float(found.model.K[0, 0]), found.focal_deviation)
        return [
            ("focal length", "", focal, "px")
        ], f"{found.views:,} views, residual {rounded(found.residual_px, 2)}{NBSP}px"
    if isinstance(found, TagCalibration):
        scales = ((1e3, "mm"), (1e3, "mm"), (180 / math.pi, "deg"))
        return [
            (axis, "", plus_minus(p * scale, s * scale), unit)
            for axis, p, s, (scale, unit) in zip(AXES, found.pose, found.deviation, scales, strict=True)
        ], ""
    return [
        (name, "", plus_minus(found.delays[name].delay * 1e3, found.delays[name].deviation * 1e3), "ms")
        for name in sorted(found.delays)
    ], "delay behind the arm's stamps"


def _row(name: str, found: Calibration, entry: Any, made: bool) -> dict[str, Any]:
    items, basis = _items(found)
    return {
        **{"kind": found.kind, "title": TITLES[found.kind], "of": _of(found), "found": items, "basis": basis},
        **{"made": _date(found.origin.made), "by": "in this run" if made else _earlier(found), "nominal": False},
        **{"file": str(mapping(entry).get("file") or f"{name}.yaml"), "leaves": []},
    }


def _earlier(found: Calibration) -> str:
    return f"run {found.origin.run}" if found.origin.run else "in an earlier run"


def _unread(name: str, entry: Any) -> dict[str, Any]:
    """A row for what is no calibration of this version: all that it says, as it says it."""
    told = list(leaves({key: value for key, value in entry.items() if key != "file"} if mapping(entry) else entry))
    return {
        **{"kind": "", "title": name, "of": "", "found": [], "basis": "no calibration that this version can read"},
        **{"made": [], "by": "", "nominal": False, "leaves": told},
        "file": str(mapping(entry).get("file") or ""),
    }


def _nominal(use: Mapping[str, Any]) -> dict[str, Any]:
    """A row for what was not calibrated, with the figures that stand in."""
    kind = str(use.get("kind"))
    values = use.get("figures")
    values = [v for v in values if isinstance(v, int | float)] if isinstance(values, list) else []
    items: list[Item] = []
    if kind == "elasticity" and len(values) == 3:
        items = [("K", axis * 2, rounded(v), unit) for axis, v, unit in zip(AXES, values, K_UNITS, strict=True)]
    elif kind == "friction" and len(values) == 1:
        items = [("µ", "", rounded(values[0]), "")]
    stand_in = {
        "elasticity": "as the sensor's description says",
        "friction": "as the objects' descriptions or the experiment say",
        "force_torque": "as the wrist sensor describes it",
        "camera": "as the camera describes itself",
        "tag": "as the object's description says",
        "clock": "stamps are taken as they come",
    }
    return {
        **{"kind": kind, "title": TITLES.get(kind, kind), "of": str(use.get("of") or ""), "found": items},
        **{"basis": stand_in.get(kind, ""), "made": [], "by": "", "file": "", "nominal": True, "leaves": []},
    }


def plus_minus(value: float, sigma: float) -> str:
    """``value ± sigma``: sigma with two digits that count, the value as far as it is known.

    >>> plus_minus(2579.17, 12.18), plus_minus(-0.00024, 0.00054)
    ('2579 ± 12', '−0.00024 ± 0.00054')
    """
    if not (math.isfinite(sigma) and sigma > 0):
        return rounded(value)
    decimals = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    if decimals > FINEST or max(abs(value), sigma) >= LARGEST:
        return f"{_minus(f'{value:.6g}')} ± {_minus(f'{sigma:.2g}')}"
    return f"{_minus(f'{value:.{max(0, decimals)}f}')} ± {sigma:.{max(0, decimals)}f}"


def rounded(value: float, digits: int = 4) -> str:
    """``value`` with so many digits that count, without an exponent where it can be read without.

    >>> rounded(1875.92), rounded(123.4, 2), rounded(0.0123, 2)
    ('1876', '123', '0.012')
    """
    if not math.isfinite(value):
        return _minus(str(value))
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    if decimals > FINEST or abs(value) >= LARGEST:
        return _minus(f"{value:.{digits}g}")
    text = f"{value:.{max(0, decimals)}f}"
    return _minus(text.rstrip("0").rstrip(".") if "." in text else text)


def _interval(found: FrictionCalibration) -> str:
    low, high = found.interval
    width = abs(high - low) / 2
    decimals = min(FINEST, max(3, 1 - math.floor(math.log10(width)))) if 0 < width < LARGEST else 3
    return f"{found.mu:.{decimals}f} [{_minus(f'{low:.{decimals}f}')}, {_minus(f'{high:.{decimals}f}')}]"


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _date(made: datetime) -> list[str]:
    """Day and time."""
    try:
        made = made.replace(tzinfo=UTC) if made.tzinfo is None else made.astimezone(UTC)
    except OverflowError:  # the first or the last day of all
        return [str(made)]
    return [f"{made:%Y-%m-%d}", f"{made:%H:%M} UTC"]
