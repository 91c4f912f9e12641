"""Goes on with a run that was cut off: `extrinsic run --resume RUN`.

What is finished stays: plans, calibrations, and every trial whose row stands in results.json. The trial or the stage
that was under way is run again whole, into a log of its own. Since a part of a run does not depend on those before it
(`experiments.context.RunContext.begin`), it ends with the figures of a run that nothing has disturbed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field
from rich.console import Console
from rich.markup import escape
from ruamel.yaml import YAML

from drivers.hosting import HostProcess
from drivers.station import Hosting
from experiments import disk
from experiments.calibrate import store
from experiments.calibrate.store import Calibrations
from experiments.check import check
from experiments.exit_codes import STATUS, ExitCode
from experiments.files import Resolved, dump_resolved, load
from experiments.planning.files import own_plan
from experiments.planning.schema import PlanStage
from experiments.provenance import provenance
from experiments.results_file import Results, read_json
from experiments.run_folder import RunFolder
from experiments.run_lock import RunLock
from experiments.runner import Outcome, begun, carry_out
from experiments.stages import CUT_OFF, has_diverged
from experiments.terminal import terminal
from mechanics.yaml_input import InputError, Problem

#: so many differences of an experiment are named
SHOWN = 3


class _Progress(BaseModel):
    stage: int = Field(ge=0)
    trials: int = Field(ge=0)
    t_ns: int = Field(ge=0)


class _Resumable(Results):
    """What a run can go on from."""

    progress: _Progress


def resume(
    run: Path,
    experiment: str | None = None,
    station: str | None = None,
    console: Console | None = None,
    host: Hosting = HostProcess,
) -> Outcome:
    """Go on with the run in the folder ``run``, and end as an undisturbed one; a finished one ends as it did.

    Raises InputError where there is no run, where another process still runs it, or where ``experiment`` (with
    ``station``), if it is given, is not the experiment of the run. ``host`` as `experiments.runner.run` has it.
    """
    console = console or terminal(stderr=True)
    folder = RunFolder.open(run)
    resolved = load(str(folder.experiment))
    _refuse_another(resolved, folder, experiment, station)
    with RunLock(run):
        results = _results(folder)
        if results is not None and _is_finished(results, resolved):
            console.print(f"{escape(str(run))}: finished already, as {results['status']}", soft_wrap=True)
            return Outcome(_code(results), folder, results, results.get("reason", ""))
        calibrations = store.load(resolved) if results is None else _calibrations(results, folder)
        own = [] if results is None else [row for row in results["plans"] if "from" in row]
        check(resolved, calibrations, feasible=False, own={row["from"]: run / row["file"] for row in own})
        disk.require_room(resolved, run)
        if results is None:
            results = begun(resolved, calibrations)
        _take_up(results, resolved, folder)
        for line in _changed(results["provenance"] or {}):
            console.print(f"[yellow]warning: {escape(line)}[/]", soft_wrap=True)
        return carry_out(resolved, calibrations, folder, results, console, host)


def refuse_besides(options: Mapping[str, object]) -> None:
    """Raises InputError for an option that was given with ``--resume``: the run has its settings and its place."""
    for option, given in options.items():
        if given:
            wrong = "a resumed run goes on as it began, where it lies"
            raise InputError([Problem("--resume", None, option, wrong, f"--resume without {option}")])


def _refuse_another(resolved: Resolved, folder: RunFolder, experiment: str | None, station: str | None) -> None:
    if experiment is None:
        if station is not None:
            wrong, expected = "a resumed run goes on at its own station", "--resume without --station"
            raise InputError([Problem("--resume", None, "--station", wrong, expected)])
        return
    given = load(experiment, station)
    found = list(_differences(_plain(dump_resolved(resolved)), _plain(dump_resolved(given))))
    if found:
        wrong = "; ".join(f"{key} is {here} in the run, and {there} here" for key, here, there in found[:SHOWN])
        more = f"; and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
        expected = f"the experiment of the run, or none: extrinsic run --resume {folder.path}"
        raise InputError([Problem(experiment, None, "--resume", wrong + more, expected)])


def _plain(text: str) -> Any:
    return YAML(typ="safe").load(text)


def _differences(ours: Any, theirs: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two trees of YAML differ: the dotted key, and what stands there in each."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for name in [*ours, *(name for name in theirs if name not in ours)]:
            yield from _differences(ours.get(name), theirs.get(name), f"{key}.{name}" if key else str(name))
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            yield from _differences(one, other, f"{key}.{i}")
    elif ours != theirs:
        yield key, ours, theirs


def _results(folder: RunFolder) -> dict[str, Any] | None:
    """What the run had written; None where it had not come so far, or nothing can go on from it."""
    found = read_json(folder.results, _Resumable)
    return found if found is not None and found["progress"]["trials"] <= len(found["trials"]) else None


def _calibrations(results: dict[str, Any], folder: RunFolder) -> Calibrations:
    """What the run knew. Raises InputError where that cannot be read."""
    try:
        return Calibrations.of_told(results["calibration"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        wrong = f"cannot be read: {str(error).splitlines()[0]}"
        expected = "the calibrations as the run has written them; without them, run the experiment anew"
        raise InputError([Problem(str(folder.results), None, "calibration", wrong, expected)]) from None


def _is_finished(results: dict[str, Any], resolved: Resolved) -> bool:
    """Whether nothing is left to do: every stage has run, or what ended the run would end it again."""
    if results["status"] == STATUS[ExitCode.INFEASIBLE] or has_diverged(results["trials"]):
        return True
    return results["status"] in (STATUS[ExitCode.DONE], STATUS[ExitCode.FELL_SHORT]) and results["progress"][
        "stage"
    ] >= len(resolved.experiment.stages)


def _code(results: dict[str, Any]) -> ExitCode:
    return next((code for code, status in STATUS.items() if status == results["status"]), ExitCode.FELL_SHORT)


def _take_up(results: dict[str, Any], resolved: Resolved, folder: RunFolder) -> None:
    """Make the results those of a run under way, without what was cut off. Raises InputError for a lost plan."""
    # a row that was put together from a log lacks what only the run itself knew: such a trial runs again, too
    while results["trials"] and (results["trials"][-1].get("rebuilt") or results["trials"][-1]["status"] in CUT_OFF):
        results["trials"].pop()
    if "rehearsals" in results:
        results["rehearsals"] = [row for row in results["rehearsals"] if row["status"] not in CUT_OFF]
    finished = resolved.experiment.stages[: results["progress"]["stage"]]
    made = {stage.name for stage in finished if isinstance(stage, PlanStage)}
    results["plans"] = [row for row in results["plans"] if "from" in row or row["name"] in made]
    for row in results["plans"]:
        own_plan(folder.path / row["file"])
    results.update(status="running", reason="", not_run=[])
    results.pop("finished", None)
    at = datetime.now(UTC).isoformat(timespec="seconds")
    taken = {"at": at, "finished_trials": len(results["trials"]), "log": folder.next_log().name}
    results.setdefault("resumed", []).append(taken)


def _changed(before: dict[str, Any]) -> Iterator[str]:
    """What is not as it was when the run began, and may change its figures."""
    now = provenance()
    for key, was in before.items():
        if key in now and now[key] != was:
            yield f"{key} is {now[key]} now, and was {was} when the run began: its figures may differ"
