"""Runs an experiment from resolved files to the run folder, and ends in order however it ends."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from rich.console import Console

from drivers.errors import CommandRefused, DriverError
from drivers.hosting import HostProcess
from drivers.station import Hosting
from drivers.wire.log import LogWriter
from estimation.errors import FitError
from experiments.calibrate import store
from experiments.calibrate.store import Calibrations
from experiments.check import check
from experiments.context import RunContext
from experiments.exit_codes import STATUS, ExitCode, of_trials
from experiments.files import Resolved, dump_resolved
from experiments.interrupt import Interrupt
from experiments.progress import Progress
from experiments.provenance import provenance
from experiments.report.build import build_report
from experiments.run_folder import RunFolder, write_atomic, write_json
from experiments.stages import STAGES, has_diverged, skip_stages
from planning.errors import InfeasiblePlan

INTERRUPTED = "interrupted by the user"


@dataclass(frozen=True)
class Outcome:
    """How a run ended and where it lies."""

    exit_code: ExitCode
    folder: RunFolder
    results: dict[str, Any]
    reason: str = ""


def run(
    resolved: Resolved, out: Path | None = None, console: Console | None = None, host: Hosting = HostProcess
) -> Outcome:
    """Run an experiment. Raises InputError before anything was started; every later end is in the outcome.

    ``host`` serves a simulated station that does not run yet. A process of its own keeps its crash from this one.
    """
    console = console or Console(stderr=True)
    _keep_what_is_here()
    calibrations = store.load(resolved)
    check(resolved, calibrations, feasible=False)  # bad input is found before anything is written
    folder = RunFolder.create(resolved.experiment.name, out)
    write_atomic(folder.experiment, dump_resolved(resolved))
    results: dict[str, Any] = {
        "schema": 1,
        "status": "running",
        "reason": "",
        "experiment": resolved.experiment.name,
        "station": resolved.station.name,
        "profile": None if resolved.station.world is None else resolved.station.world.profile,
        "seed": resolved.experiment.seed,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "provenance": provenance(),
        "calibration": calibrations.told(),
        "plans": [],
        "trials": [],
        "not_run": [],
        "tables": [],
        "timing": {"execute_wall_s": 0.0, "execute_station_s": 0.0},
    }
    with Interrupt() as interrupt:
        try:
            code, reason = _stages(resolved, calibrations, folder, results, console, interrupt, host)
        except KeyboardInterrupt:
            code, reason = ExitCode.INTERRUPTED, INTERRUPTED
        interrupt.closing()
        results["status"], results["reason"] = STATUS[code], reason
        results["finished"] = datetime.now(UTC).isoformat(timespec="seconds")
        outcome = Outcome(code, folder, results, reason)
        _finish(outcome, console)
    return outcome


@cache
def _keep_what_is_here() -> None:
    """What was imported stays: to look through it for garbage, again and again, costs seconds of a run."""
    gc.freeze()


def _stages(
    resolved: Resolved,
    calibrations: Calibrations,
    folder: RunFolder,
    results: dict[str, Any],
    console: Console,
    interrupt: Interrupt,
    host: Hosting,
) -> tuple[ExitCode, str]:
    """Run all stages with log and station open, close both in order, and say how it ended."""
    progress = Progress(console)
    code, reason = ExitCode.DONE, ""
    with ExitStack() as closing:
        log = closing.enter_context(LogWriter(folder.log, flush=resolved.station.log.flush))
        log.add_attachment("experiment.yaml", "application/yaml", folder.experiment.read_bytes())
        ask, heed = _ask(console), interrupt.check
        context = RunContext(resolved, calibrations, folder, results, log, progress, closing, ask, heed, host)
        context.save()
        try:
            for done, stage in enumerate(resolved.experiment.stages, 1):
                STAGES[stage.stage](context, stage)
                interrupt.check()
                code, reason = of_trials(results["trials"])
                if code in (ExitCode.DEVICE_FAILED, ExitCode.STOPPED) or has_diverged(results["trials"]):
                    skip_stages(context, resolved.experiment.stages[done:])
                    break
        except InfeasiblePlan as error:
            code, reason = ExitCode.INFEASIBLE, str(error)
        except FitError as error:
            code, reason = ExitCode.FELL_SHORT, f"the calibration found no answer: {error}"
            context.event("error", reason)
        except CommandRefused as error:
            code, reason = ExitCode.DEVICE_FAILED, str(error)
        except DriverError as error:
            code, reason = ExitCode.DEVICE_FAILED, str(error)
        except KeyboardInterrupt:
            code, reason = ExitCode.INTERRUPTED, INTERRUPTED
        interrupt.closing()
        if code in (ExitCode.INFEASIBLE, ExitCode.INTERRUPTED, ExitCode.DEVICE_FAILED):
            context.event("error", reason)
        if code is ExitCode.DEVICE_FAILED and (said := _last_words(context)):
            context.event("error", f"the simulated host said: {said}")
        results["health"] = _health(context)
        results["log"] = _accounts(context, log)
    return code, reason


def _last_words(context: RunContext) -> str:
    """What the host that this run started has said, to the end of it."""
    host = None if context.opened is None else context.opened.host
    return "" if host is None else host.last_words()


def _health(context: RunContext) -> dict[str, Any] | None:
    """How well the simulated plant was; what was not well is an event, too. None where nothing was simulated."""
    devices = context.opened
    if devices is None or devices.simulation is None:
        return None
    try:
        health = devices.simulation.health()
    except DriverError:  # it has died, and the run's own error says so
        return None
    for flag in health["flags"]:
        context.event("warning", f"the simulated plant: {flag}")
    return health


def _accounts(context: RunContext, log: LogWriter) -> dict[str, Any]:
    """What was logged beside what was published, per topic; ``lost`` is the difference."""
    published: dict[str, int] = {}
    devices = context.opened
    if devices is not None and devices.simulation is not None:
        try:
            published = devices.simulation.counts()
        except DriverError:
            published = {}
    log.drain()
    logged = log.counts
    lost = sum(max(0, count - logged.get(topic, 0)) for topic, count in published.items()) + log.overflows
    return {"file": context.folder.log.name, "messages": logged, "published": published, "lost": lost}


def _finish(outcome: Outcome, console: Console) -> None:
    """Results and report; a report that cannot be made never takes the results with it."""
    write_json(outcome.folder.results, outcome.results)
    try:
        build_report(outcome.folder)
    except Exception as error:  # the run is over and its data are safe: say it and go on
        console.print(f"[yellow]the report could not be made: {error}[/]\n  extrinsic report {outcome.folder.path}")


def _ask(console: Console) -> Callable[[str], bool]:
    def ask(what: str) -> bool:
        if not sys.stdin.isatty():
            return False
        console.print(f"[yellow]{what}[/]\nReset the scene, then press Enter; type q and Enter to end the run.")
        return sys.stdin.readline().strip().lower() != "q"

    return ask
