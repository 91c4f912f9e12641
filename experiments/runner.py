"""Runs an experiment from resolved files to the run folder, and ends in order however it ends.

A run is a transaction: after every stage and every trial results.json says what is finished, and `experiments.resume`
goes on from there.
"""

from __future__ import annotations

import gc
import json
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from rich.console import Console

from drivers.errors import DriverError
from drivers.hosting import HostProcess
from drivers.station import Hosting
from drivers.wire.log import LogWriter
from estimation.errors import FitError
from experiments import disk
from experiments.calibrate import store
from experiments.calibrate.store import Calibrations
from experiments.check import check
from experiments.context import RunContext
from experiments.exit_codes import STATUS, ExitCode, of_trials
from experiments.files import Resolved, dump_resolved
from experiments.interrupt import Interrupt
from experiments.planning.schema import PlanStage
from experiments.planning.stage import take_plan_again
from experiments.progress import Progress, outlive_terminal
from experiments.provenance import provenance
from experiments.report.build import build_report
from experiments.results_file import BEGUN, Begun
from experiments.run_folder import RunFolder, write_atomic, write_json
from experiments.run_lock import RunLock
from experiments.stages import STAGES, has_diverged, skip_stages
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem
from planning.errors import InfeasiblePlan

INTERRUPTED = "interrupted by the user"
#: where the traceback of an exception goes that nobody has foreseen
TRACEBACK = "traceback.txt"


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
    calibrations = store.load(resolved)
    check(resolved, calibrations, feasible=False)  # bad input is found before anything is written
    disk.require_room(resolved, out or Path("runs"))
    folder = RunFolder.create(resolved.experiment.name, out)
    with RunLock(folder.path):
        try:
            write_atomic(folder.experiment, dump_resolved(resolved))
        except OSError as error:
            wrong, expected = f"cannot be written: {error.strerror}", "a folder you may write to, on a disk with room"
            raise InputError([Problem(str(folder.experiment), None, "--out", wrong, expected)]) from None
        return carry_out(resolved, calibrations, folder, begun(resolved, calibrations), console, host)


def begun(resolved: Resolved, calibrations: Calibrations) -> dict[str, Any]:
    """The results of a run that begins."""
    return {
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
        "progress": {"stage": 0, "trials": 0, "t_ns": 0},
        "health": None,
        "log": None,
    }


def carry_out(
    resolved: Resolved,
    calibrations: Calibrations,
    folder: RunFolder,
    results: dict[str, Any],
    console: Console | None = None,
    host: Hosting = HostProcess,
) -> Outcome:
    """Run what ``results`` do not have yet, into ``folder``, whose lock is held; however it ends, it returns."""
    console = console or terminal(stderr=True)
    outlive_terminal(console)
    _keep_what_is_here()
    code, reason = ExitCode.DONE, ""
    with Interrupt() as interrupt:
        try:
            code, reason = _stages(resolved, calibrations, folder, results, console, interrupt, host)
        except KeyboardInterrupt:
            code, reason = ExitCode.INTERRUPTED, INTERRUPTED
        interrupt.closing()
        results["status"], results["reason"] = STATUS[code], reason
        results["finished"] = datetime.now(UTC).isoformat(timespec="seconds")
        return _finish(Outcome(code, folder, results, reason), console)


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
    """Run the stages that are left with log and station open, close both in order, and say how it ended."""
    closing, context, cut_off = ExitStack(), None, True
    try:
        log = closing.enter_context(LogWriter(folder.next_log(), flush=resolved.station.log.flush))
        log.add_attachment("experiment.yaml", "application/yaml", folder.experiment.read_bytes())
        begin = {key: results[key] for key in Begun.model_fields}
        log.add_attachment(BEGUN, "application/json", json.dumps(begin).encode())
        progress, ask, heed = Progress(console), _ask(console), interrupt.check
        context = RunContext(resolved, calibrations, folder, results, log, progress, closing, ask, heed, host)
        code, reason = _carried_out(context, interrupt)
        cut_off = code is ExitCode.DEVICE_FAILED
        interrupt.closing()
    except KeyboardInterrupt:
        code, reason = ExitCode.INTERRUPTED, INTERRUPTED
    except Exception as error:  # whatever it is: the arm is held, the log is closed, and the results say so
        interrupt.closing()
        code, reason = _ended_by(error, folder)
    interrupt.closing()
    if context is not None:
        if cut_off:
            context.event("error", reason)
        if code is ExitCode.DEVICE_FAILED and (said := _last_words(context)):
            context.event("error", f"the simulated host said: {said}")
        context.note_health()
        results["log"] = _accounts(context)
    try:
        closing.close()
    except Exception as error:  # the rest was closed all the same
        late, why = _ended_by(error, folder)
        if code in (ExitCode.DONE, ExitCode.FELL_SHORT):
            code, reason = late, why
    return code, reason


def _carried_out(context: RunContext, interrupt: Interrupt) -> tuple[ExitCode, str]:
    """The stages in their order; those that are finished already are only remembered."""
    stages, results = context.resolved.experiment.stages, context.results
    finished = results["progress"]["stage"]
    for stage in stages[:finished]:
        if isinstance(stage, PlanStage):
            take_plan_again(context, stage)
    context.save()
    if results.get("resumed"):
        context.event("info", f"resumed after {len(results['trials'])} trials")
    for number, stage in enumerate(stages[finished:], finished + 1):
        STAGES[stage.stage](context, stage)
        interrupt.check()
        code, reason = of_trials([*results["trials"], *results.get("rehearsals", ())])
        if code in (ExitCode.DEVICE_FAILED, ExitCode.STOPPED) or has_diverged(results["trials"]):
            skip_stages(context, stages[number:])
            return code, reason
        context.stage_done(number)
    return of_trials([*results["trials"], *results.get("rehearsals", ())], results.get("faults", ()))


def _ended_by(error: Exception, folder: RunFolder) -> tuple[ExitCode, str]:
    """The exit code and the sentence of a run that ``error`` ended."""
    match error:
        case InfeasiblePlan():
            return ExitCode.INFEASIBLE, str(error)
        case FitError():
            return ExitCode.FELL_SHORT, f"the calibration found no answer: {error}"
        case DriverError():
            return ExitCode.DEVICE_FAILED, str(error)
        case OSError() if disk.is_full(error):
            said = disk.not_written(error.filename, error.strerror or str(error), folder.path)
            return ExitCode.DEVICE_FAILED, str(said)
    where = folder.path / TRACEBACK
    try:
        with where.open("a", encoding="utf-8") as file:
            file.write("".join(traceback.format_exception(error)))
    except OSError:
        traceback.print_exception(error)
    said = f"{type(error).__name__}: {error}"
    return ExitCode.FAILED, f"{said}. This is a defect, of extrinsic or of a plug-in; report it with {where}"


def _last_words(context: RunContext) -> str:
    """What the host that this run started has said, to the end of it."""
    host = None if context.opened is None else context.opened.host
    return "" if host is None else host.last_words()


def _accounts(context: RunContext) -> dict[str, Any]:
    """What was logged beside what was published, per topic; ``lost`` is the difference, ``gaps`` what never came."""
    published: Mapping[str, int] = {}
    devices, log = context.opened, context.log
    try:
        if devices is not None and devices.simulation is not None:
            published = devices.simulation.counts()
        log.drain()
    except DriverError:  # the station has died, or the log: the run's own error says so
        pass
    logged = log.counts
    lost = sum(max(0, count - logged.get(topic, 0)) for topic, count in published.items()) + log.overflows
    return {"file": log.path.name, "messages": logged, "published": published, "lost": lost, "gaps": dict(log.gaps)}


def _finish(outcome: Outcome, console: Console) -> Outcome:
    """Results and report; a report that cannot be made never takes the results with it."""
    try:
        write_json(outcome.folder.results, outcome.results)
    except OSError as error:
        why = disk.not_written(outcome.folder.results, error.strerror or str(error), outcome.folder.path)
        console.print(f"[red]{why}[/]", soft_wrap=True, highlight=False)
        outcome = replace(outcome, exit_code=ExitCode.DEVICE_FAILED, reason=outcome.reason or str(why))
    try:
        build_report(outcome.folder)
    except Exception as error:  # the run is over and its data are safe: say it and go on
        console.print(f"[yellow]the report could not be made: {error}[/]\n  extrinsic report {outcome.folder.path}")
    return outcome


def what_next(outcome: Outcome) -> list[str]:
    """The commands that help after a run that did not end as it should, a line each."""
    folder, station = outcome.folder.path, outcome.results["station"]
    go_on = f"go on with it: extrinsic run --resume {folder}"
    match outcome.exit_code:
        case ExitCode.INTERRUPTED:
            return [go_on]
        case ExitCode.DEVICE_FAILED:
            return [f"how the devices are: extrinsic status {station}", go_on]
        case ExitCode.STOPPED:
            return [f"once the reason is gone: extrinsic recover {station}", go_on]
        case ExitCode.INFEASIBLE:
            return [f"what the task needs: extrinsic check {folder / 'experiment.yaml'}"]
    return []


def _ask(console: Console) -> Callable[[str], bool]:
    def ask(what: str) -> bool:
        if not sys.stdin.isatty():
            return False
        console.print(f"[yellow]{what}[/]\nReset the scene, then press Enter; type q and Enter to end the run.")
        return sys.stdin.readline().strip().lower() != "q"

    return ask
