"""How every device fared over a run: from the log's account to what the report's table says, worst values and when."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from drivers.health import CONFIRMED, WORDS
from drivers.interfaces import Description
from drivers.log_health import LogHealth, Worst
from experiments.report.summary import duration, is_number, mapping, words

NANO = 1e-9
#: silences that are longer than a device's usual ones by this [s] are marked
_PATIENCE = 0.1
#: less than this share of the declared rate is marked
_SHARE = 0.9
#: of what gates or events say of a device the table has so many
_MOST = 3


def told(
    health: LogHealth, devices: Mapping[str, Description], *, lockstep: bool, origin_ns: int
) -> dict[str, list[dict[str, Any]]]:
    """``streams``, ``silent`` devices of which the log has no reading, and ``gates``, JSON-able.

    Times are in seconds since ``origin_ns``.
    """

    def worst(found: Worst | None) -> dict[str, float] | None:
        return None if found is None else {"value": found.value, "t": (found.at_ns - origin_ns) * NANO}

    streams = []
    for stream in health.streams(devices, lockstep=lockstep):
        conditions = [
            {"says": WORDS.get(status, words(status.name.lower())), "count": count, "t": (since - origin_ns) * NANO}
            for status, (count, since) in stream.conditions.items()
        ]
        plain = asdict(stream) | {key: worst(getattr(stream, key)) for key in ("silence", "age", "gap")}
        streams.append(plain | {"conditions": conditions})
    gates = [
        asdict(gate) | {"troubles": [[(at - origin_ns) * NANO, text] for at, text in gate.troubles]}
        for gate in health.gates()
    ]
    silent = [
        {"device": name, "kind": devices[name].kind, "on_request": asked}
        for name, asked in health.silent(devices, lockstep=lockstep).items()
    ]
    return {"streams": streams, "silent": silent, "gates": gates}


def section(health: Any, events: Any) -> dict[str, Any] | None:
    """Rows of the table, and whether there are ``ages``; None where the log says nothing of devices.

    A figure is (text, when, whether it is marked); ``notes`` are lines. ``events`` are those of the report: one that
    has a device's name with a colon behind it is that device's.
    """
    source = mapping(health)
    streams = [mapping(stream) for stream in source.get("streams") or []]
    silent = [mapping(device) for device in source.get("silent") or []]
    if not streams and not silent:
        return None
    gates = {str(gate.get("device")): gate for gate in map(mapping, source.get("gates") or [])}
    rows, named = [], set()
    for stream in streams:
        device = str(stream.get("device"))
        first = device not in named
        named.add(device)
        rows.append(_row(stream, device, _of_device(device, gates.get(device), events) if first else []))
    for device in silent:
        name = str(device.get("device"))
        asked = bool(device.get("on_request"))
        rate = ("on request", "", False) if asked else ("none", "", True)
        bare = {"device": name, "of": words(device.get("kind")), "messages": "0", "rate": rate}
        nothing = dict.fromkeys(("silence", "age", "gaps"), ("–", "", False))
        why = "nobody asked it for a reading" if asked else "the log has no reading of it"
        rows.append({**bare, **nothing, "notes": [why, *_of_device(name, gates.get(name), events)], "well": asked})
    return {"rows": rows, "ages": any(row["age"][0] != "–" for row in rows), "troubled": _troubled(rows)}


def _row(stream: Mapping[str, Any], device: str, notes: list[str]) -> dict[str, Any]:
    declared, rate = stream.get("declared"), stream.get("rate")
    known = declared if is_number(declared) and declared > 0 else None
    late = (CONFIRMED / known if known else 0.0) + _PATIENCE
    slow = known is not None and is_number(rate) and rate < _SHARE * known
    lost = stream.get("lost") or 0
    gap = mapping(stream.get("gap"))
    conditions = [
        f"{entry.get('says')}: {entry.get('count'):,} readings, the first at {entry.get('t'):.2f} s"
        for entry in map(mapping, stream.get("conditions") or [])
    ]
    kind = words(stream.get("kind")) if stream.get("kind") else ""
    silence, age = _lasting(stream.get("silence"), late), _lasting(stream.get("age"), _PATIENCE)
    row = {
        "device": device,
        "of": ", ".join(filter(None, (kind, words(stream.get("stream"))))),
        "messages": f"{stream.get('messages') or 0:,}",
        "rate": (_rate(rate, known, stream), f"declared {known:g}" if known else "", slow),
        "silence": silence,
        "age": age,
        "gaps": (f"{lost:,}", f"at most {gap.get('value'):,} {_when(gap)}", True) if lost else ("0", "", False),
        "notes": [*conditions, *notes],
    }
    return {**row, "well": not (conditions or lost or slow or silence[2] or age[2])}


def _rate(rate: Any, declared: float | None, stream: Mapping[str, Any]) -> str:
    if stream.get("on_request"):
        return "on request"
    return f"{rate:.4g}" if is_number(rate) else "–"


def _lasting(worst: Any, most: float) -> tuple[str, str, bool]:
    value = mapping(worst).get("value")
    if not is_number(value):
        return "–", "", False
    return duration(value), _when(mapping(worst)), value > most


def _when(worst: Mapping[str, Any]) -> str:
    return f"at {worst['t']:.2f} s" if is_number(worst.get("t")) else ""


def _of_device(device: str, gate: Mapping[str, Any] | None, events: Any) -> list[str]:
    """What its gates and the run's events say of a device, the first few of each."""
    lines: list[str] = []
    if gate is not None:
        refused = mapping(gate.get("refused"))
        by = ", ".join(f"{number:,} by {name}" for name, number in refused.items())
        lines.append(f"its gates refused set-points: {by}" if by else "its gates refused nothing")
        lines += _first([f"{text}, at {t:.2f} s" for t, text in gate.get("troubles") or []])
    told_of = [mapping(event) for event in events or []] if isinstance(events, list | tuple) else []
    named = re.compile(rf"(^|[\s;(]){re.escape(device)}:")
    about = [(str(event["text"]), event.get("t") or 0.0) for event in told_of if named.search(str(event.get("text")))]
    return lines + _first([f"{text.removeprefix(f'{device}:').strip()}, at {t:.2f} s" for text, t in about])


def _first(lines: list[str]) -> list[str]:
    return lines if len(lines) <= _MOST else [*lines[:_MOST], f"and {len(lines) - _MOST} more of its kind"]


def _troubled(rows: list[dict[str, Any]]) -> str:
    """What is to be said before the table."""
    troubled = list(dict.fromkeys(row["device"] for row in rows if not row["well"]))
    if not troubled:
        return "Every device spoke as it says of itself, and no message is missing from the log."
    return f"Not all was well with {', '.join(troubled)}; what was not is marked."
