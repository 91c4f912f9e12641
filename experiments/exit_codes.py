"""What the command's exit code means (design §7), and what a trial's status makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any


class ExitCode(IntEnum):
    """The exit codes of `extrinsic`."""

    DONE = 0
    FELL_SHORT = 1
    BAD_INPUT = 2
    DEVICE_FAILED = 3
    STOPPED = 4
    INFEASIBLE = 5
    FAILED = 70
    """An exception that nobody has foreseen: a defect of this program or of a plug-in (EX_SOFTWARE)."""
    INTERRUPTED = 130


#: the run's status in results.json
STATUS = {
    ExitCode.DONE: "completed",
    ExitCode.FELL_SHORT: "fell_short",
    ExitCode.DEVICE_FAILED: "device_failed",
    ExitCode.STOPPED: "stopped",
    ExitCode.INFEASIBLE: "infeasible",
    ExitCode.FAILED: "failed",
    ExitCode.INTERRUPTED: "interrupted",
}
_OF_TRIAL = {
    "completed": ExitCode.DONE,
    "slipped": ExitCode.FELL_SHORT,
    "lost_contact": ExitCode.FELL_SHORT,
    "diverged": ExitCode.FELL_SHORT,
    "infeasible": ExitCode.FELL_SHORT,
    "stopped": ExitCode.STOPPED,
    "device_failed": ExitCode.DEVICE_FAILED,
}
_SEVERITY = (ExitCode.DONE, ExitCode.FELL_SHORT, ExitCode.STOPPED, ExitCode.DEVICE_FAILED)


def of_trials(trials: list[dict[str, Any]], faults: Sequence[dict[str, Any]] = ()) -> tuple[ExitCode, str]:
    """The exit code that the worst of ``trials`` and ``faults`` (rows of results.json) makes, and its reason."""
    worst, reason = ExitCode.DONE, ""
    for cell in faults:
        if cell["short"] and worst is ExitCode.DONE:
            worst, reason = ExitCode.FELL_SHORT, f"{cell['name']}: {'; '.join(cell['short'])}"
    for trial in trials:
        code = _OF_TRIAL[trial["status"]]
        if _SEVERITY.index(code) > _SEVERITY.index(worst):
            worst, reason = code, f"{trial['name']}: {trial['status']}: {trial['reason']}"
    return worst, reason
