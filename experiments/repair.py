"""Mends a run that was killed: its torn logs beside themselves, results.json and the report from what they hold.

What a log cannot tell (how a law went on, the sensor under the table) stays None in a row that was made from it, which
says so (``rebuilt``): a run that is resumed runs that trial again. Rows that the run itself had written stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Attachment
from rich.console import Console
from rich.markup import escape

from drivers.errors import ProtocolError
from drivers.wire.log_reader import LogReader
from drivers.wire.log_repair import Account, repair_log
from experiments.calibrate import store
from experiments.calibrate.store import Calibrations
from experiments.exit_codes import STATUS, ExitCode
from experiments.files import Resolved, load
from experiments.metrics import contact_of, errors_of
from experiments.planning.files import FOLDER as PLANS
from experiments.progress import Progress
from experiments.report.build import build_report
from experiments.report.collect import plan_of
from experiments.report.logged import LoggedTrial, Logs, read_logs
from experiments.results_file import BEGUN, Begun, ShownResults, parse_json, read_json
from experiments.run_folder import RunFolder, write_atomic, write_json
from experiments.run_lock import RunLock
from experiments.runner import begun
from mechanics.yaml_input import InputError
from planning.plan import Plan
from planning.plan_file import SUFFIX, PlanFileError
from planning.plan_file import load as load_plan

#: rows are made from waypoints and the ends of trials: of the plant's truth nothing is needed [Hz]
_NO_TRUTH = 1e-3


@dataclass(frozen=True)
class Repair:
    """What was found and done: the ``accounts`` of the logs, the names of trials ``rebuilt`` from them and of one that
    was ``cut_off``, and whether there was nothing to do (``healthy``) or nothing left to do (``done_before``).
    """

    folder: RunFolder
    accounts: tuple[Account, ...]
    rebuilt: tuple[str, ...]
    cut_off: tuple[str, ...]
    healthy: bool
    done_before: bool
    flush: float

    def lines(self) -> list[str]:
        """What a person should know."""
        if self.healthy:
            return [f"{self.folder.path}: every log was closed in order and results.json is whole: nothing to mend"]
        told = [line for account in self.accounts for line in _told(account, self.flush)]
        if self.done_before:
            return [*told, f"{self.folder.path} was mended before; nothing has changed"]
        told += [f"results.json: {name} rebuilt from the log" for name in self.rebuilt]
        told += [f"results.json: {name} was cut off and has no figures" for name in self.cut_off]
        told.append(f"to go on with it: extrinsic run --resume {self.folder.path}")
        return [*told, f"results: {self.folder.results}", f"report:  {self.folder.report}"]


def repair(path: Path, progress: Progress | None = None) -> Repair:
    """Mend the run folder at ``path``; a healthy one, and one that was mended before, is left as it is.

    Raises InputError for what is no run folder and for a run that still goes on, DeviceFault where another file lies
    in a mended log's place.
    """
    if not RunFolder(path).logs():
        RunFolder.open(path)
    with RunLock(path):
        return _repair(_opened(path), progress or Progress(Console(quiet=True)))


def _repair(folder: RunFolder, progress: Progress) -> Repair:
    resolved = load(str(folder.experiment))
    accounts = tuple(_mended(log) for log in folder.written_logs())
    results = _results(folder)
    whole = results is not None and results["status"] != "running"
    torn = any(account.ending != "complete" for account in accounts)
    told = {"logs": [_row_of(account) for account in accounts]}
    before = whole and results is not None and (results.get("repair") == told or not torn)
    rebuilt: list[str] = []
    logs = Logs()
    if not before:
        with progress.share("read the log") as heard:
            logs = read_logs(folder, _NO_TRUTH, heard)
        results = results or _begun(folder, resolved)
        rebuilt = _add_trials(results, logs, resolved)
        if not whole:
            _end(results, folder, logs, accounts)
        results["repair"] = told
        write_json(folder.results, results)
    if not before or not folder.report.is_file():
        with progress.share("make the report") as heard:
            build_report(folder, heard)
    cut_off = tuple(trial.begin.trial for trial in logs.trials if trial.end is None)
    healthy = before and not torn
    return Repair(folder, accounts, tuple(rebuilt), cut_off, healthy, before, resolved.station.log.flush)


def say(repaired: Repair, console: Console) -> None:
    """Print what was found and done."""
    for line in repaired.lines():
        console.print(escape(line), soft_wrap=True, highlight=False)


# -- the folder --------------------------------------------------------------------------------------------------------


def _opened(path: Path) -> RunFolder:
    """The run folder; where its experiment is missing, the one that its log carries is put there."""
    folder = RunFolder(path)
    if not folder.experiment.is_file():
        for log in folder.logs():
            try:
                found = LogReader(log).attachments().get(folder.experiment.name)
            except (ProtocolError, OSError):
                continue
            if found is not None:
                write_atomic(folder.experiment, found.decode("utf-8", errors="replace"))
                break
    return RunFolder.open(path)


def _mended(log: Path) -> Account:
    try:
        return repair_log(log)
    except ProtocolError as error:  # killed before the first byte was on the disk
        return Account(log, f"{error.got}: nothing was in it yet")


def _results(folder: RunFolder) -> dict[str, Any] | None:
    """What results.json says; what is no results moves aside, so that it is not lost either."""
    if not folder.results.is_file():
        return None
    found = read_json(folder.results, ShownResults)
    if found is not None:
        return found
    aside, number = folder.path / "results.damaged.json", 1
    while aside.exists():
        aside, number = folder.path / f"results.damaged.{number}.json", number + 1
    folder.results.rename(aside)
    return None


# -- results.json ------------------------------------------------------------------------------------------------------


def _begun(folder: RunFolder, resolved: Resolved) -> dict[str, Any]:
    """The results of a run of which no results.json is left, without its trials."""
    unknown = {"execute_wall_s": None, "execute_station_s": None}
    known = {"plans": _plans(folder), "timing": unknown}
    return begun(resolved, _calibrations(folder)) | _known_at_its_begin(folder) | known


def _known_at_its_begin(folder: RunFolder) -> dict[str, Any]:
    """What the first log that can be read carries of it; of one that carries nothing, when it was begun."""
    for log in folder.logs():
        begun_at = None
        try:
            for record in LogReader(log).records():
                if isinstance(record, Attachment):
                    if record.name == BEGUN and (found := parse_json(record.data, Begun)) is not None:
                        return {key: found[key] for key in Begun.model_fields}
                    begun_at = begun_at or _instant(record.create_time * 1e-9)
        except ProtocolError:
            continue
        if begun_at is not None:
            return {"started": begun_at, "provenance": None}
    return {"started": None, "provenance": None}


def _instant(seconds: float) -> str | None:
    try:
        return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError, OSError):
        return None


def _calibrations(folder: RunFolder) -> Calibrations:
    """Those that the run itself made."""
    found = Calibrations()
    for file in sorted(folder.calibration.glob("*.yaml")):
        try:
            calibration = store.read(file)
        except InputError:
            continue
        if calibration.name == file.stem:  # one under the time it was made has been replaced
            found.add(calibration, file)
    return found


def _plans(folder: RunFolder) -> list[dict[str, Any]]:
    """The plans that the run left, the oldest first."""
    rows: list[dict[str, Any]] = []
    for file in sorted((folder.path / PLANS).glob(f"*{SUFFIX}"), key=lambda f: (f.stat().st_mtime_ns, f.name)):
        try:
            plan = load_plan(file)
        except PlanFileError:
            continue
        figures = {
            key: getattr(plan, key) for key in ("name", "skill", "planner", "steps", "queries", "loss", "status")
        }
        rows.append({**figures, "file": str(file.relative_to(folder.path)), "time_s": plan.time_s})
    return rows


def _add_trials(results: dict[str, Any], logs: Logs, resolved: Resolved) -> list[str]:
    """Add a row for every trial that the logs saw end and the results do not have; their names."""
    known = {trial["name"] for trial in results["trials"]}
    added: list[str] = []
    for trial in logs.trials:
        name, plan = trial.begin.trial, plan_of(trial)
        if trial.end is not None and plan is not None and name not in known:
            results["trials"].append(_row(trial, plan, resolved))
            known.add(name)
            added.append(name)
    return added


def _row(trial: LoggedTrial, plan: Plan, resolved: Resolved) -> dict[str, Any]:
    """A trial as `experiments.stages` writes it, from its waypoints; None for what only the run itself knew."""
    assert trial.end is not None
    grasped, extrinsic = resolved.grasped, resolved.extrinsic if plan.eo is not None else None
    rho_go = grasped.polygon.radius_of_gyration
    rho_eo = None if extrinsic is None else extrinsic.polygon.radius_of_gyration
    number = trial.begin.trial.rpartition("-")[2]
    errors = {w: errors_of(trial.waypoints, w, rho_go, rho_eo, rho_go) for w in ("measured", "truth")}
    return {
        "name": trial.begin.trial,
        "skill": trial.begin.skill,
        "planner": plan.planner,
        "controller": trial.begin.controller,
        "go_pose": None,
        "grasped_object": grasped.name,
        "extrinsic_object": None if extrinsic is None else extrinsic.name,
        "sensor": resolved.sensor.name,
        "trial": int(number) if number.isdecimal() else 0,
        "status": trial.end.status,
        "reason": trial.end.reason,
        "deviation": None,
        **errors,
        "contact": contact_of(trial.waypoints, plan, grasped.polygon),
        "witness": None,
        "finger_slip": None,
        "rebuilt": True,
    }


def _end(results: dict[str, Any], folder: RunFolder, logs: Logs, accounts: tuple[Account, ...]) -> None:
    """Say how a run ended that could not say so itself."""
    cut = [trial.begin.trial for trial in logs.trials if trial.end is None]
    results["status"] = STATUS[ExitCode.INTERRUPTED]
    results["reason"] = f"the run was cut off{f' in {cut[-1]}' if cut else ''}; mended from its log"
    last = max((log.stat().st_mtime for log in folder.written_logs() if log.is_file()), default=None)
    results["finished"] = None if last is None else _instant(last)
    if accounts:
        results["log"] = {
            "file": folder.logs()[-1].name,
            "messages": logs.counts,
            "published": {},
            "lost": None,
        }


def _row_of(account: Account) -> dict[str, Any]:
    return {
        "log": account.log.name,
        "mended": None if account.mended is None else account.mended.name,
        "ending": account.ending,
        "messages": sum(account.kept.values()),
        "lost_in_mid_file": sum(account.lost.values()) + account.nameless,
        "gap_s": account.gap_ns * 1e-9,
        "seconds": (account.last_ns - account.first_ns) * 1e-9,
        "breaks": [{"at": b.at, "until": b.until, "why": b.why} for b in account.breaks],
    }


def _told(account: Account, flush: float) -> list[str]:
    """One log in words: how it broke off, what was kept, what was lost."""
    count, topics = sum(account.kept.values()), len(account.kept)
    kept = f"{count} messages on {topics} topics, {(account.last_ns - account.first_ns) * 1e-9:.2f} s"
    if account.ending == "complete":
        return [f"{account.log.name}: complete, {kept}"]
    if account.mended is None:
        return [f"{account.log.name}: {account.ending}"]
    lines = [f"{account.log.name}: {account.ending}; mended as {account.mended.name}", f"    kept: {kept}"]
    for cut in account.breaks[:-1] if account.breaks[-1].until == account.log.stat().st_size else account.breaks:
        lines.append(f"    lost: bytes {cut.at} to {cut.until} ({cut.why})")
    missing = sum(account.lost.values())
    if missing or account.nameless or account.gap_ns:
        where = f"at least {missing} messages within {account.gap_ns * 1e-9:.2f} s in mid-file"
        nameless = f", and {account.nameless} whose topic is not known any more" if account.nameless else ""
        lines.append(f"    lost: {where}{nameless}")
    last = account.last_ns * 1e-9
    lines.append(f"    lost: at the end what was not on the disk yet, at most {flush:g} s behind t = {last:.2f} s")
    return lines
