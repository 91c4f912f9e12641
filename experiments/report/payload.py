"""What the page carries as data: free of NaN, rounded to what a screen can show, thinned to a size budget.

Poses are (x, y, θ) in W, wrenches (fx, fy, τ) of the sensor on the go; SI, as they came. Anything that is missing,
torn off or not finite becomes None, and the page leaves it out.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from experiments.report.summary import listed, mapping

MODES = ("stick", "slip+", "slip-", "free")
SERIES = ("ee", "go", "eo", "wrench")
BUDGET = 2_800_000  # bytes of data; with plotly's 4.8 MB the page stays under 8 MB
FIGURE = 13_000  # bytes that the traces of a trial add
FEWEST = 25  # frames that a playback keeps however many trials there are
DIGITS = 6  # 1 µm, 1 µrad, 1 µN: finer than any pixel


def clean(value: Any, digits: int | None = None) -> Any:
    """A JSON-able copy: arrays to lists, what is not finite to None, what JSON does not know to its text."""
    if isinstance(value, Mapping):
        return {str(key): clean(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return clean(value.tolist(), digits)
    if isinstance(value, list | tuple):
        return [clean(item, digits) for item in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value if digits is None else round(value, digits)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def encode(value: Any) -> str:
    """Compact JSON that is inert inside a script element, whatever the names in it say."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def build(data: Mapping[str, Any], reserved: int = 0) -> dict[str, Any]:
    """The page's data: objects (outlines, body frame), grasp X_go_gocf, and per trial its waypoints and playback.

    ``reserved``: bytes of the budget that the page needs for other things.
    """
    objects = mapping(data.get("objects"))
    trials = [mapping(trial) for trial in listed(data.get("trials"))]
    out = {
        "objects": {role: _object(objects.get(role)) for role in ("go", "eo")},
        "grasp": _vector(data.get("grasp"), 3) or [0.0, 0.0, 0.0],
        "modes": MODES,
        "trials": [_trial(trial) for trial in trials],
    }
    _thin(out["trials"], BUDGET - reserved)
    return out


def _number(value: Any) -> float | None:
    if value is None or isinstance(value, bool | str):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return round(number, DIGITS) if math.isfinite(number) else None


def _vector(value: Any, size: int) -> list[float] | None:
    numbers = [_number(item) for item in listed(value)[:size]]
    known = [number for number in numbers if number is not None]
    return known if len(known) == size else None


def _object(value: Any) -> dict[str, Any] | None:
    if not isinstance(value, Mapping):
        return None
    vertices = [vertex for item in listed(value.get("vertices")) if (vertex := _vector(item, 2)) is not None]
    return {"name": str(value.get("name") or ""), "vertices": vertices}


def _series(value: Any, count: int) -> dict[str, list[list[float] | None] | None] | None:
    """``ee``, ``go``, ``eo``, ``wrench``: each ``count`` vectors or None; None altogether where nothing is known."""
    source, out = mapping(value), {}
    for key in SERIES:
        rows = [_vector(row, 3) for row in listed(source.get(key))[:count]]
        rows += [None] * (count - len(rows))
        out[key] = rows if any(row is not None for row in rows) else None
    return out if any(rows is not None for rows in out.values()) else None


def _contact(value: Any) -> list[Any] | None:
    """[x, y, fx, fy, index of the mode, name, nx, ny, µ]; an unknown mode is drawn as free, a missing force as none.

    The normal and µ end the list where both are known, of planned contacts; the name where it has one.
    """
    source = mapping(value)
    point = _vector(source.get("point"), 2)
    if point is None:
        return None
    mode = source.get("mode")
    index = MODES.index(mode) if mode in MODES else MODES.index("free")
    force = _vector(source.get("force"), 2) or [0.0, 0.0]
    name, normal, mu = str(source.get("name") or ""), _vector(source.get("normal"), 2), _number(source.get("mu"))
    if normal is not None and mu is not None and mu >= 0:
        return [*point, *force, index, name, *normal, mu]
    return [*point, *force, index, *([name] if name else [])]


def _contacts(value: Any, count: int) -> list[list[list[Any]]]:
    steps = [[c for item in listed(step) if (c := _contact(item)) is not None] for step in listed(value)[:count]]
    return steps + [[] for _ in range(count - len(steps))]


def _times(value: Any, count: int) -> tuple[list[float], list[bool]]:
    """Instants of the waypoints [s] and which of them were reached; those that were not follow at the usual step."""
    known = [_number(t) for t in listed(value)[:count]]
    known += [None] * (count - len(known))
    reached = [t is not None for t in known]
    instants = [t for t in known if t is not None]
    steps = [b - a for a, b in pairwise(instants) if b > a]
    step = statistics.median(steps) if steps else 1.0
    times: list[float] = []
    for t in known:
        times.append(t if t is not None else round(times[-1] + step, DIGITS) if times else 0.0)
    return times, reached


def _waypoints(value: Any) -> dict[str, Any] | None:
    source = mapping(value)
    parts = [mapping(source.get(part)) for part in ("planned", "measured", "truth")]
    count = max(
        [len(listed(source.get("t")))] + [len(listed(part.get(key))) for part in parts for key in SERIES], default=0
    )
    if not count:
        return None
    times, reached = _times(source.get("t"), count)
    planned, measured, truth = (_series(part, count) for part in parts)
    for found in (measured, truth):
        _take_turn(found, planned)
    return {
        "t": times,
        "reached": reached,
        "planned": planned,
        "measured": measured,
        "truth": truth,
        "contacts": _contacts(source.get("contacts"), count),
    }


def _take_turn(found: dict[str, Any] | None, planned: dict[str, Any] | None) -> None:
    """Bring the angles of ``found`` to the turn that lies nearest the plan's: 181° beside a plan of 179°, not −179°."""
    for key in ("ee", "go", "eo"):
        for row, plan in zip((found or {}).get(key) or [], (planned or {}).get(key) or [], strict=False):
            if row is not None and plan is not None:
                row[2] = round(row[2] + math.tau * round((plan[2] - row[2]) / math.tau), DIGITS)


def _playback(value: Any, waypoints: dict[str, Any] | None) -> dict[str, Any] | None:
    """The recorded frames in the order of time; from the waypoints where no frame was recorded."""
    source = mapping(value)
    stamps = [_number(t) for t in listed(source.get("t"))]
    frames = sorted((t, i) for i, t in enumerate(stamps) if t is not None)
    series = _series(source, len(stamps))
    if not frames or series is None:
        return _stepwise(waypoints)
    order = [i for _, i in frames]
    contacts = _contacts(source.get("contacts"), len(stamps))
    labels = [str(label or "") for label in listed(source.get("phase"))]
    phases = list(zip([t for t, _ in frames], [labels[i] if i < len(labels) else "" for i in order], strict=True))
    return {
        "t": [t for t, _ in frames],
        **{key: None if rows is None else [rows[i] for i in order] for key, rows in series.items()},
        "contacts": [contacts[i] for i in order],
        "source": str(source.get("source") or "unknown"),
        "phases": _phases(phases),
        "recorded": len(frames),
    }


def _phases(labelled: Sequence[tuple[float, str]]) -> list[list[Any]]:
    """[[name, from, to] …] of the runs of equal labels, each lasting until the next begins."""
    runs = [(name, next(iter(run))[0]) for name, run in groupby(labelled, key=lambda item: item[1])]
    ends = [start for _, start in runs[1:]] + [labelled[-1][0]]
    return [[name, start, end] for (name, start), end in zip(runs, ends, strict=True) if name]


def _stepwise(waypoints: dict[str, Any] | None) -> dict[str, Any] | None:
    if waypoints is None:
        return None
    for source in ("truth", "measured", "planned"):
        if waypoints[source] is not None:
            return {
                "t": list(waypoints["t"]),
                **waypoints[source],
                "contacts": waypoints["contacts"] if source == "planned" else [[] for _ in waypoints["t"]],
                "source": f"{source}, waypoints only",
                "phases": [],
                "recorded": 0,
            }
    return None


def _trial(trial: Mapping[str, Any]) -> dict[str, Any]:
    waypoints = _waypoints(trial.get("waypoints"))
    text = {key: str(trial.get(key) or "") for key in ("name", "skill", "controller", "status", "reason")}
    return {**text, "waypoints": waypoints, "playback": _playback(trial.get("playback"), waypoints)}


def _thin(trials: list[dict[str, Any]], budget: int) -> None:
    """Thin the frames evenly where all playbacks together exceed the budget; the page says how many are shown."""
    playbacks = [trial["playback"] for trial in trials if trial["playback"] is not None]
    size = sum(len(encode(playback)) for playback in playbacks)
    room = budget - sum(len(encode(trial["waypoints"])) + FIGURE for trial in trials)
    if size <= room:
        return
    for playback in playbacks:
        count = len(playback["t"])
        target = min(count, max(FEWEST, int(count * room / size)))
        keep = np.unique(np.linspace(0, count - 1, target).round().astype(int)).tolist()
        for key in ("t", "contacts", *SERIES):
            if playback[key] is not None:
                playback[key] = [playback[key][i] for i in keep]
