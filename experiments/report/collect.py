"""From a run folder to the report's data: everything is read back from the log, the verdicts from results.json."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DriverError
from drivers.interfaces import Description
from drivers.log_health import LogHealth
from drivers.replay.contents import contents_of
from experiments.calibrate.models import friction_name, tag_name
from experiments.calibrate.samples import load_samples
from experiments.calibrate.store import prints
from experiments.files import Resolved, load
from experiments.paper import beside
from experiments.progress import Heard, unheard
from experiments.report import convergence, device_health
from experiments.report.logged import LoggedTrial, read_logs
from experiments.report.pictures import Pictures
from experiments.results_file import ShownResults, read_json
from experiments.run_folder import RunFolder
from mechanics import se2
from mechanics.records import PlanarState, TrialRecord
from mechanics.yaml_input import InputError, Problem
from planning.plan import Plan

SECOND = 1e-9
#: kinds of devices that take pictures, in the order in which these are shown
IMAGERS = ("tactile", "tag_camera")


def collect(folder: RunFolder, heard: Heard = unheard) -> dict[str, Any]:
    """The data that `experiments.report.page.render` takes, from what lies in ``folder``, torn or whole.

    ``heard`` is called with the share of the logs that has been read.

    Raises InputError when the folder's experiment or its results cannot be read.
    """
    resolved = load(str(folder.experiment))
    results = _results(folder)
    known = results.get("calibration") or {}
    files, pictures, health = folder.logs(), Pictures(), LogHealth()
    log = read_logs(folder, resolved.experiment.report.playback_rate, heard, pictures=pictures, health=health)
    devices, lockstep = _devices(folder)
    origin_ns = 0 if lockstep else log.begin_ns or 0  # in lockstep station time begins with the run
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
        "events": [
            {"t": (event.capture_ns - origin_ns) * SECOND, "level": event.level, "text": event.text}
            for event in log.events
        ],
        "health": device_health.told(health, devices, lockstep=lockstep, origin_ns=origin_ns),
        "imagers": [name for kind in IMAGERS for name, said in devices.items() if said.kind == kind],
        "plans": convergence.found(folder.path, results.get("plans") or []),
        "paper": beside(results.get("trials", [])),
        "calibration": {
            "made": [file.stem for file in sorted(folder.calibration.glob("*.yaml")) if file.stem in known],
            "samples": {file.stem: _samples(file) for file in sorted(folder.calibration.glob("*.csv"))},
            "nominal": _nominal(resolved),
            "only": all(stage.stage.startswith("calibrate_") for stage in resolved.experiment.stages),
        },
    }


def _devices(folder: RunFolder) -> tuple[dict[str, Description], bool]:
    """What the log's devices say of themselves, and whether time stood still while somebody waited."""
    try:
        found = contents_of(folder.path)
    except DriverError:
        return {}, False
    return found.devices, found.lockstep


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


def _trial(trial: LoggedTrial, grasp: Any) -> dict[str, Any]:
    begin, end = trial.begin, trial.end
    start_ns = begin.capture_ns
    return {
        "name": begin.trial,
        "skill": begin.skill,
        "controller": begin.controller,
        "status": "unfinished" if end is None else end.status,
        "reason": "the log breaks off here" if end is None else end.reason,
        "pictures": [strip.json(start_ns) for strip in trial.pictures.values()],
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
                "mu": float(plan.contact_mu[c]),
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
