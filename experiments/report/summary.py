"""The run in words and rows: verdict, facts, error tables, what the log holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

COMPLETED = {"completed", "done", "ok", "success"}
SHORT = {"fell_short", "short", "shortfall", "slipped", "lost_contact", "diverged"}
ABORTING = {"stopped", "device_failed"}  # trials that end so take the run with them (exit codes 3 and 4)

# key in M of results.json, column head, unit, decimals
AGGREGATES = (
    ("go_pose_mm", "Pose error, grasped object", "mm", 3),
    ("eo_pose_mm", "Pose error, extrinsic object", "mm", 3),
    ("wrench_N", "Wrench error", "N", 3),
)
COMPONENTS = (
    ("fx_N", "fx", "N", 3),
    ("fy_N", "fy", "N", 3),
    ("tau_Nmm", "τ", "N·mm", 2),
    ("x_mm", "x", "mm", 3),
    ("y_mm", "y", "mm", 3),
    ("theta_deg", "θ", "deg", 3),
)
SOURCES = ("measured", "truth", "paper")


@dataclass(frozen=True)
class Verdict:
    """How the run ended: ``level`` is completed, short or aborted; ``headline`` and ``detail`` say it in words."""

    level: str
    headline: str
    detail: str


def words(status: Any) -> str:
    """A status as people write it: ``lost_contact`` → lost contact."""
    return str(status).replace("_", " ") if status else "unknown"


def verdict(results: Mapping[str, Any], calibrations: int | None = None) -> Verdict:
    """The verdict of a run from its results.json (design §6, §7): the run's own status and those of its trials.

    ``calibrations``: how many were made, for a run that was to make nothing else.
    """
    trials = _trials(results)
    status = str(results.get("status") or "")
    done = sum(trial.get("status") in COMPLETED for trial in trials)
    count = f"{done} of {len(trials)} trial{'s' * (len(trials) != 1)} completed" if trials else "no trial was executed"
    if calibrations is not None and not trials:
        count = (
            f"{calibrations or 'no'} calibration{'s' * (calibrations > 1)} {'were' if calibrations > 1 else 'was'} made"
        )
    if slid := sum(bool(finger_slip(trial)) for trial in trials):
        count += f", in {slid} of them the object slipped in the fingers"
    reason = str(results.get("reason") or "").strip().rstrip(".")
    tail = f": {reason}." if reason else "."
    failed = next((trial for trial in trials if trial.get("status") in ABORTING), None)
    if not status:
        return Verdict("aborted", "Aborted", f"results.json does not say how the run ended; {count}.")
    if status == "running":
        return Verdict("aborted", "Aborted", f"{count}; the run was cut off while it was running{tail}")
    if status not in COMPLETED | SHORT:
        return Verdict("aborted", "Aborted", f"{count}; the run ended with status “{words(status)}”{tail}")
    if failed is not None:
        return Verdict("aborted", "Aborted", f"{count}; a trial ended with status “{words(failed['status'])}”{tail}")
    if done < len(trials) or status in SHORT:
        return Verdict("short", "Fell short", count + tail)
    return Verdict("completed", "Completed", count + tail)


def finger_slip(trial: Mapping[str, Any]) -> str:
    """What a trial's row says of the object having slipped in the fingers; empty where it has not."""
    found = mapping(trial.get("finger_slip"))
    return str(found.get("reason") or "the object slipped in the fingers") if found.get("detected") is True else ""


def level(status: Any) -> str:
    """The verdict level of one trial's status."""
    return "completed" if status in COMPLETED else "aborted" if status in ABORTING or not status else "short"


def facts(data: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label and value of what identifies the run; a fact that was not recorded says so."""
    results = mapping(data.get("results"))
    station, provenance = results.get("station"), mapping(results.get("provenance"))
    world = mapping(mapping(station).get("world"))
    profile = results.get("profile") or mapping(station).get("profile") or world.get("profile")
    name = mapping(station).get("name") if isinstance(station, Mapping) else station
    seed = results.get("seed")
    pairs = [
        ("Experiment", _name(results.get("experiment"))),
        ("Station", name),
        ("Profile", profile or provenance.get("profile")),
        ("Seed", seed),
        ("Git", _git(provenance.get("git"))),
        ("Created", data.get("created")),
    ]
    return [(label, str(value) if value not in (None, "") else "not recorded") for label, value in pairs]


def _name(value: Any) -> Any:
    return value.get("name") if isinstance(value, Mapping) else value


def _git(value: Any) -> str:
    if not isinstance(value, Mapping):
        return str(value or "")
    commit = str(value.get("commit") or value.get("revision") or value.get("hash") or "")
    return f"{commit[:12]}{' (with local changes)' if value.get('dirty') else ''}" if commit else ""


def error_table(results: Mapping[str, Any], paper: Any = None) -> dict[str, Any]:
    """Rows of the error tables; ``heads``, ``sources`` and ``component_sources`` name only what some trial has.

    ``paper`` may hold ``{"source": text, "rows": {trial name: M}}``: figures of the paper to show beside.
    Each row's ``aggregates[key][source]`` and ``components[source][key]`` is (mean, std) as text, or None.
    """
    trials, beside = _trials(results), mapping(mapping(paper).get("rows"))
    figures = [
        {"measured": trial.get("measured"), "truth": trial.get("truth"), "paper": beside.get(str(trial.get("name")))}
        for trial in trials
    ]
    component_sources = _told(figures, [c[0] for c in COMPONENTS])
    heads = [h for h in AGGREGATES if h[0] != "eo_pose_mm" or any(_has(f, h[0]) for f in figures)]
    sources = _told(figures, [h[0] for h in heads])
    rows = []
    for trial, figure in zip(trials, figures, strict=True):
        status = trial.get("status")
        row = {
            "name": str(trial.get("name") or "unnamed"),
            "skill": words(trial.get("skill")),
            "controller": words(trial.get("controller")),
            "status": words(status),
            "level": level(status),
            "reason": "; ".join(filter(None, (str(trial.get("reason") or ""), finger_slip(trial)))),
            "aggregates": {h[0]: {s: _figure(figure[s], h[0], h[3]) for s in sources} for h in heads},
            "components": {s: {c[0]: _figure(figure[s], c[0], c[3]) for c in COMPONENTS} for s in component_sources},
        }
        rows.append(row)
    source = str(mapping(paper).get("source") or "the paper")
    return {
        **{"heads": heads, "sources": sources, "components": COMPONENTS, "component_sources": component_sources},
        **{"rows": rows, "paper": source},
    }


def _told(figures: list[dict[str, Any]], keys: list[str]) -> list[str]:
    """The sources to show: the paper only where it has one of these figures."""
    return [s for s in SOURCES if s != "paper" or any(_has({s: f[s]}, key) for f in figures for key in keys)]


def _has(figure: Mapping[str, Any], key: str) -> bool:
    return any(mapping(mapping(m).get(key)).get("mean") is not None for m in figure.values())


def _figure(values: Any, key: str, decimals: int) -> tuple[str, str | None] | None:
    entry = mapping(mapping(values).get(key))
    mean, std = entry.get("mean"), entry.get("std")
    if not is_number(mean):
        return None
    return f"{mean:.{decimals}f}", f"{std:.{decimals}f}" if is_number(std) else None


def is_number(value: Any) -> TypeGuard[int | float]:
    """Whether ``value`` is a figure, which a truth value is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def duration(seconds: float) -> str:
    """A time [s] to three digits, with its unit."""
    return f"{seconds * 1e3:.3g} ms" if abs(seconds) < 1 else f"{seconds:.3g} s"


def log_summary(log: Any, trials: int) -> dict[str, Any] | None:
    """What the log holds, per topic and in sum; None where there is no log.

    ``ending`` other than ``complete`` says how the log broke off; it is optional, as is ``torn`` (true for one that
    was cut off somewhere).
    """
    source = mapping(log)
    ending = str(source.get("ending") or ("the end is missing" if source.get("torn") else "complete"))
    if not source or not (source.get("bytes") or source.get("messages")):
        return None
    counts = {str(k): int(v) for k, v in mapping(source.get("messages")).items() if is_number(v)}
    seconds, size, lost = (v if is_number(v := source.get(key)) else None for key in ("seconds", "bytes", "lost"))
    return {
        "file": str(source.get("file") or "log.mcap"),
        "total": f"{sum(counts.values()):,}",
        "lost": None if lost is None else int(lost),
        "size": None if size is None else f"{size / 1e6:.2f} MB",
        "per_trial": None if size is None or not trials else f"{size / 1e6 / trials:.2f} MB",
        "seconds": None if seconds is None else f"{seconds:.1f} s",
        "torn": "" if ending == "complete" else f"The log was not closed in order: {ending.rstrip('.')}.",
        "topics": [(t, f"{n:,}", f"{n / seconds:.1f}" if seconds else "–") for t, n in sorted(counts.items())],
    }


def event_rows(events: Any) -> list[dict[str, str]]:
    """Time [s] as text, level and words of each event, in the order given."""
    rows = []
    for event in events if isinstance(events, list | tuple) else []:
        source = mapping(event)
        t = source.get("t")
        severity = str(source.get("level") or "info")
        rows.append(
            {
                "t": f"{t:.2f}" if is_number(t) else "–",
                "level": severity if severity in ("info", "warning", "error") else "info",
                "text": str(source.get("text") or ""),
            }
        )
    return rows


def plan_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """The plans of results.json as text: name, skill, planner, steps, queries, time, loss, status."""
    keys = ("name", "skill", "planner", "steps", "queries", "time_s", "loss", "status")
    found = results.get("plans")
    plans = [mapping(plan) for plan in found] if isinstance(found, list) else []
    return [{key: f"{v:.4g}" if isinstance(v := plan.get(key), float) else _plain(v) for key in keys} for plan in plans]


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Dotted path and text of every leaf of a nested mapping; a list of plain values is one leaf."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        for index, item in enumerate(value):
            yield from leaves(item, f"{path}[{index}]")
    else:
        yield path, _plain(value)


def _plain(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(f"[{_plain(item)}]" if isinstance(item, list) else _plain(item) for item in value)
    return str(value)


def listed(value: Any) -> list[Any]:
    """``value`` as a list where it is a list, a tuple or an array, else an empty one."""
    return list(value) if isinstance(value, list | tuple | np.ndarray) else []


def mapping(value: Any) -> Mapping[str, Any]:
    """``value`` where it is a mapping, else an empty one: what a torn file does not hold."""
    return value if isinstance(value, Mapping) else {}


def _trials(results: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    trials = results.get("trials")
    return [mapping(trial) for trial in trials] if isinstance(trials, list | tuple) else []
