"""From a run folder to the report's data: everything is read back from the log, the verdicts from results.json."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire.log_reader import LogReader
from experiments.calibrate.models import friction_name, tag_name
from experiments.calibrate.samples import load_samples
from experiments.calibrate.store import prints
from experiments.files import Resolved, load
from experiments.paper import beside
from experiments.progress import Heard, unheard
from experiments.results_file import ShownResults, read_json
from experiments.run_folder import RunFolder
from mechanics import se2
from mechanics.readings import TruthReading
from mechanics.records import EventRecord, PhaseRecord, PlanarState, TrialRecord, WaypointRecord
from mechanics.yaml_input import InputError, Problem
from planning.plan import Plan

SECOND = 1e-9
_TELL = 1000  # messages


@dataclass
class LoggedTrial:
    """A trial as the log has it; ``end`` is None where the log breaks off within it."""

    begin: TrialRecord
    end: TrialRecord | None = None
    waypoints: list[WaypointRecord] = field(default_factory=list)
    phases: list[PhaseRecord] = field(default_factory=list)
    truths: list[TruthReading] = field(default_factory=list)


@dataclass
class Logs:
    """What the logs of a run folder say, one after the other; ``ending`` says how the first broke off that did."""

    trials: list[LoggedTrial] = field(default_factory=list)
    events: list[EventRecord] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    length_ns: int = 0
    ending: str = "there is no log"
    current: LoggedTrial | None = None


def collect(folder: RunFolder, heard: Heard = unheard) -> dict[str, Any]:
    """The data that `experiments.report.page.render` takes, from what lies in ``folder``, torn or whole.

    ``heard`` is called with the share of the logs that has been read.

    Raises InputError when the folder's experiment or its results cannot be read.
    """
    resolved = load(str(folder.experiment))
    results = _results(folder)
    known = results.get("calibration") or {}
    log, files = read_logs(folder, resolved.experiment.report.playback_rate, heard), folder.logs()
    mended = [told for told in (results.get("repair") or {"logs": []})["logs"] if told["ending"] != "complete"]
    if log.ending == "complete" and mended:
        log.ending = f"{mended[0]['ending']}; what was whole has been mended"
    bodies = {"go": resolved.grasped, "eo": resolved.extrinsic}
    return {
        "title": resolved.experiment.name,
        "created": results.get("started"),
        "results": results,
        "objects": {
            role: None if shape is None else {"name": shape.name, "vertices": shape.polygon.vertices.tolist()}
            for role, shape in bodies.items()
        },
        "grasp": resolved.grasp.tolist(),
        "trials": [_trial(trial, resolved.grasp) for trial in log.trials],
        "log": {
            "file": ", ".join(file.name for file in files) or folder.log.name,
            "bytes": sum(file.stat().st_size for file in files),
            "messages": log.counts,
            "lost": (results.get("log") or {}).get("lost"),
            "seconds": log.length_ns * SECOND,
            "ending": log.ending,
        },
        "events": [{"t": event.capture_ns * SECOND, "level": event.level, "text": event.text} for event in log.events],
        "paper": beside(results.get("trials", [])),
        "calibration": {
            "made": [file.stem for file in sorted(folder.calibration.glob("*.yaml")) if file.stem in known],
            "samples": {file.stem: _samples(file) for file in sorted(folder.calibration.glob("*.csv"))},
            "nominal": _nominal(resolved),
            "only": all(stage.stage.startswith("calibrate_") for stage in resolved.experiment.stages),
        },
    }


def _results(folder: RunFolder) -> dict[str, Any]:
    """What results.json says; nothing where there is none. Raises InputError for one that is damaged."""
    if not folder.results.is_file():
        return {}
    found = read_json(folder.results, ShownResults)
    if found is None:
        repair = f"extrinsic repair {folder.path} rebuilds it from the log"
        raise InputError([Problem(str(folder.results), None, "", "no results can be read in it", repair)])
    return found


def _samples(file: Path) -> dict[str, Any] | str:
    """Columns by name, or what is wrong with the file."""
    try:
        return load_samples(file)
    except (OSError, ValueError, csv.Error):
        return "it is no table of numbers"


def _nominal(resolved: Resolved) -> list[dict[str, Any]]:
    """What a run takes for true until it is calibrated, by the calibration that would say otherwise."""
    go, sensor, objects = resolved.grasped.name, resolved.sensor, prints(resolved)
    of = {body: print_.split()[0] for body, print_ in objects.items()}
    frictions = [
        {
            "name": friction_name(pair, objects),
            "kind": "friction",
            "of": " on ".join(of.get(body, body) for body in pair.split("-")),
            "figures": [mu],
        }
        for pair, mu in resolved.friction.items()
    ]
    stiffness = np.diag(sensor.stiffness).tolist()
    return [
        {
            "name": f"elasticity-{sensor.name}-{go}",
            "kind": "elasticity",
            "of": f"{sensor.name} on {go}",
            "figures": stiffness,
        },
        *frictions,
        *({"name": kind, "kind": kind} for kind in ("force_torque", "camera", "clock")),
        *(
            {"name": tag_name(go, tag.id), "kind": "tag", "of": f"tag {tag.id} on {go}"}
            for tag in resolved.grasped.all_tags
        ),
    ]


def read_logs(folder: RunFolder, rate: float, heard: Heard = unheard) -> Logs:
    """One pass over the logs of a run; truth is thinned to ``rate`` [Hz] on the way. ``heard`` as in `collect`.

    Of a trial that was run again, in the same log or in that of the run that went on, the last attempt counts.
    """
    log, files = Logs(), folder.logs()
    for number, file in enumerate(files):
        log.current = None
        ending = _read(file, log, rate, lambda share, before=number: heard((before + share) / len(files)))
        if log.ending in ("complete", "there is no log"):
            log.ending = ending
    return log


def _read(file: Path, log: Logs, rate: float, heard: Heard) -> str:
    """Add what is in one file; how it ends."""
    try:
        reader = LogReader(file)
    except ProtocolError as error:
        return error.got
    last_ns = next_truth = 0
    for count, message in enumerate(reader.messages()):
        if count % _TELL == 0:
            heard(reader.share)
        log.counts[message.topic] = log.counts.get(message.topic, 0) + 1
        last_ns = max(last_ns, message.publish_ns)
        is_truth = message.topic.endswith("/world/truth")
        if is_truth and message.publish_ns < next_truth:
            continue
        if not is_truth and not message.topic.startswith("run/"):
            continue
        try:
            value = message.value()
        except ProtocolError:
            continue
        if isinstance(value, TruthReading):
            next_truth = message.publish_ns + round(1e9 / rate) - 1
        _file(log, value)
    log.length_ns += last_ns
    return reader.ending


def _file(log: Logs, value: object) -> None:
    current = log.current
    if isinstance(value, EventRecord):
        log.events.append(value)
    elif isinstance(value, TrialRecord):
        if value.status and current is not None:
            current.end, log.current = value, None
        elif not value.status:
            log.current = LoggedTrial(value)
            if log.trials and log.trials[-1].begin.trial == value.trial:
                log.trials.pop()
            log.trials.append(log.current)
    elif current is None:
        return
    elif isinstance(value, WaypointRecord):
        current.waypoints.append(value)
    elif isinstance(value, PhaseRecord):
        current.phases.append(value)
    elif isinstance(value, TruthReading):
        current.truths.append(value)


def _trial(trial: LoggedTrial, grasp: Any) -> dict[str, Any]:
    begin, end = trial.begin, trial.end
    start_ns = begin.capture_ns
    return {
        "name": begin.trial,
        "skill": begin.skill,
        "controller": begin.controller,
        "status": "unfinished" if end is None else end.status,
        "reason": "the log breaks off here" if end is None else end.reason,
        "waypoints": _waypoints(trial, start_ns),
        "playback": _playback(trial, start_ns) if trial.truths else _from_waypoints(trial, start_ns),
    }


def _states(states: Iterable[PlanarState | None]) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {"ee": [], "go": [], "eo": [], "wrench": []}
    for state in states:
        for name, series in out.items():
            value = None if state is None else getattr(state, name)
            series.append(None if value is None else value.tolist())
    return out


def _waypoints(trial: LoggedTrial, start_ns: int) -> dict[str, Any]:
    points = trial.waypoints
    simulated = any(point.truth is not None for point in points)
    contacts: list[list[dict[str, Any]]] = [[] for _ in points]
    plan = plan_of(trial)
    if plan is not None:
        contacts = [planned_contacts(plan, point.step) for point in points]
    return {
        "t": [(point.capture_ns - start_ns) * SECOND for point in points],
        "planned": _states(point.planned for point in points),
        "measured": _states(point.measured for point in points),
        "truth": _states(point.truth for point in points) if simulated else None,
        "contacts": contacts,
    }


def plan_of(trial: LoggedTrial) -> Plan | None:
    """The plan that a trial executed; None where it was torn off, or made by a version that wrote plans otherwise."""
    return None if trial.end is None else plan_in(trial.end)


def plan_in(end: TrialRecord) -> Plan | None:
    """As `plan_of`, from the record of a trial's end."""
    try:
        return Plan.from_dict(json.loads(end.plan)) if end.plan else None
    except (ValueError, RecursionError):
        return None


def planned_contacts(plan: Plan, step: int) -> list[dict[str, Any]]:
    """The planned contacts at a step, forces in W: f_n along the normal, f_t along the normal turned by −90°."""
    out = []
    for c, name in enumerate(plan.contact_names):
        normal, (f_n, f_t) = plan.contact_normals[step, c], plan.contact_forces[step, c]
        force = f_n * normal + f_t * se2.rotate(np.array(-np.pi / 2), normal)
        out.append(
            {
                "name": name,
                "point": plan.contact_points[step, c].tolist(),
                "normal": normal.tolist(),
                "force": force.tolist(),
                "mode": plan.contact_modes[step][c].value,
            }
        )
    return out


def _phase_at(trial: LoggedTrial, capture_ns: int) -> str:
    before = [phase.phase for phase in trial.phases if phase.capture_ns <= capture_ns]
    return before[-1] if before else ""


def _playback(trial: LoggedTrial, start_ns: int) -> dict[str, Any]:
    """The plant's own motion."""
    truths = trial.truths
    return {
        "source": "truth",
        "t": [(truth.stamp.capture_ns - start_ns) * SECOND for truth in truths],
        **_states(PlanarState(truth.ee, truth.go, truth.eo, truth.wrench) for truth in truths),
        "contacts": [
            [
                {"point": c.point.tolist(), "force": c.force.tolist(), "mode": c.mode, "on": c.on, "by": c.by}
                for c in truth.contacts
            ]
            for truth in truths
        ],
        "phase": [_phase_at(trial, truth.stamp.capture_ns) for truth in truths],
    }


def _from_waypoints(trial: LoggedTrial, start_ns: int) -> dict[str, Any]:
    """Without truth, as on hardware: what was measured at the waypoints."""
    points = trial.waypoints
    return {
        "source": "estimate",
        "t": [(point.capture_ns - start_ns) * SECOND for point in points],
        **_states(point.measured for point in points),
        "contacts": [[] for _ in points],
        "phase": [_phase_at(trial, point.capture_ns) for point in points],
    }
