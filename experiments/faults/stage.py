"""Runs the fault campaign: a run for each cell, and what its folder shows of how it ended."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from drivers.errors import ProtocolError
from drivers.sim.host_thread import HostThread
from drivers.wire import messages
from drivers.wire.log_reader import LogReader
from experiments.context import RunContext
from experiments.faults.inject import INJECTED
from experiments.faults.schema import Cell, FaultsStage, Moment, TimedFault
from experiments.files import Resolved
from experiments.ports import own_bus
from experiments.run_folder import RunFolder
from experiments.schema import ExecuteStage, HealthConfig, Stage
from mechanics.readings import WrenchReading
from mechanics.records import EventRecord

#: from the instant at which a fault can be noticed: two periods of the set-points
CONTROL_PERIODS = 2
#: and it can be noticed after three of the sensor's
SENSOR_PERIODS = 3
#: the force may pass its limit by this factor, by what moves on before the arm has stopped
OVERSHOOT = 1.2


@dataclass(frozen=True)
class Found:
    """What a run folder shows. Times [s] are of the station; None where there is nothing to tell."""

    status: str
    reason: str
    exit_status: str
    whole: bool
    moved_on: float | None
    force: float | None


def faults_stage(context: RunContext, stage: FaultsStage) -> None:
    """Run every cell; a row for each goes into the results, under ``faults``, and a shortfall is an event."""
    rows: list[dict[str, Any]] = context.results.setdefault("faults", [])
    cells: list[tuple[Cell, Moment]] = [(cell, moment) for cell in stage.cells for moment in cell.moments]
    with context.progress.steps("faults", len(cells)) as advance:
        for number, (cell, moment) in enumerate(cells[len(rows) :], len(rows)):
            context.heed()
            row = _row(context, stage, cell, moment, number)
            rows.append(row)
            context.save()
            if row["short"]:
                context.event("error", f"{row['name']}: {'; '.join(row['short'])}")
            advance()


def _row(context: RunContext, stage: FaultsStage, cell: Cell, moment: Moment, number: int) -> dict[str, Any]:
    name = f"{number:03d}-{cell.fault.kind}-{cell.fault.device}-{moment}"
    folder = context.folder.path / "cells" / name
    found = _found(folder, _run(context.resolved, stage, cell, moment, folder), context.resolved)
    expected = cell.expected(moment)
    return {
        "name": name,
        "fault": cell.fault.model_dump(exclude_defaults=True),
        "moment": moment,
        "expected": list(expected),
        "status": found.status,
        "reason": found.reason,
        "moved_on_s": found.moved_on,
        "force_N": found.force,
        "short": list(_shortfalls(found, expected, cell, context.resolved)),
    }


def _run(resolved: Resolved, stage: FaultsStage, cell: Cell, moment: Moment, folder: Path) -> dict[str, Any]:
    """Carry the cell out; the results as they stand in its folder."""
    from experiments import runner
    from experiments.resume import resume

    fault = TimedFault.model_validate(cell.fault.model_dump() | {"moment": moment})
    execute = ExecuteStage.model_validate(
        {"stage": "execute", "plan": stage.plan, "controllers": (stage.controller,), "faults": (fault,)}
    )
    plans: list[Stage] = [other for other in resolved.experiment.stages if getattr(other, "name", "") == stage.plan]
    health = HealthConfig(on_fault="warn")  # what a fault makes of the trial is to be seen, not its end
    experiment = resolved.experiment.model_copy(update={"stages": (*plans, execute), "health": health})
    station = resolved.station
    changed: dict[str, Any] = {"bus": own_bus(station.bus)}
    if stage.profile is not None and station.world is not None:
        changed["world"] = station.world.model_copy(update={"profile": stage.profile})
    alone = replace(resolved, experiment=experiment, station=station.model_copy(update=changed))
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".txt").open("a", encoding="utf-8") as said:
        console = Console(file=said, width=120)
        if folder.exists():  # the campaign was cut off in it
            resume(folder, None, None, console, HostThread)
        else:
            runner.run(alone, folder, console, HostThread)
    try:
        return json.loads(RunFolder(folder).results.read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def _found(path: Path, results: dict[str, Any], resolved: Resolved) -> Found:
    trials = results.get("trials") or [{"status": results.get("status", "no results"), "reason": ""}]
    whole, moved_on, force = False, None, None
    if results:
        try:
            whole, moved_on, force = _logged(RunFolder(path), resolved)
        except (OSError, ProtocolError):
            whole = False
    status, reason = trials[0]["status"], trials[0]["reason"]
    return Found(status, reason, results.get("status", ""), whole, moved_on, force)


def _logged(folder: RunFolder, resolved: Resolved) -> tuple[bool, float | None, float | None]:
    """Whether the log is whole, how long after the fault the last set-point ended, and the greatest force."""
    station = resolved.station.name
    target, wrist = f"{station}/arm/target", f"{station}/wrist_ft/wrench"
    begin: int | None = None
    force, until = 0.0, 0
    reader = LogReader(folder.log)
    for logged in reader.messages((target, wrist, "run/event")):
        if logged.topic == target:
            sent = messages.decode(logged.payload, messages.TARGET)
            until = messages.stamp_ns(sent.header.stamp) + round(sent.duration * 1e9)
            continue
        try:
            value = logged.value()
        except ProtocolError:  # a damaged reading is logged as it came
            continue
        if isinstance(value, EventRecord) and value.text.partition(": ")[2].startswith(INJECTED):
            begin = value.capture_ns
        elif isinstance(value, WrenchReading):
            force = max(force, float(np.linalg.norm(value.wrench[:3])))
    moved_on = None if begin is None else max(0, until - begin) * 1e-9
    return reader.complete, moved_on, force


def _shortfalls(found: Found, expected: tuple[str, ...], cell: Cell, resolved: Resolved) -> Iterator[str]:
    """What is not as it has to be, in sentences."""
    if found.status not in expected:
        yield f"it ended {found.status} ({found.reason or 'no reason'}), not {' or '.join(expected)}"
    if not found.exit_status or found.exit_status == "running":
        yield "its results.json is missing or does not say how it ended"
    if not found.whole:
        yield "its log cannot be read to its end"
    limit = resolved.station.devices["arm"].limits.force  # type: ignore[union-attr]
    if found.force is not None and found.force > OVERSHOOT * limit and cell.fault.kind not in ("bias", "garbage"):
        yield f"the wrist felt {found.force:.1f} N, the limit is {limit:g} N"
    if cell.stops and found.moved_on is not None:
        period = 1.0 / getattr(resolved.station.devices.get(cell.fault.device), "rate", 100.0)
        allowed = SENSOR_PERIODS * period + CONTROL_PERIODS / resolved.experiment.trial.control_rate
        if found.moved_on > allowed + 1e-9:
            yield f"the arm moved on for {found.moved_on * 1e3:.0f} ms, {allowed * 1e3:.0f} ms are allowed"
