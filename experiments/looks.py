"""What a run notes of its looks at the devices, so that they can be taken again (`experiments.replay`)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from control.observe import Observer
from control.reads import Read
from mechanics.records import LookRecord

if TYPE_CHECKING:
    from experiments.context import RunContext

#: a trial's observer is made; what it is told is what it believes
BEGIN = "begin"


def note(context: RunContext, observer: Observer, trial: str, *, extrinsic: bool) -> None:
    """Have the looks of a trial's ``observer`` noted in the log, after what it is made of.

    ``extrinsic`` says whether there is an extrinsic object.
    """

    def noted(act: str, told: dict[str, Any], reads: list[Read]) -> None:
        write(context, trial, act, told, reads)

    told = {
        "fingers": bool(observer.fingers),
        "extrinsic": extrinsic,
        "calibration": context.calibrations.told(),
    }
    noted(BEGIN, told, [])
    observer.note = noted


def write(
    context: RunContext, trial: str, act: str, told: dict[str, Any] | None = None, reads: Sequence[Read] = ()
) -> None:
    """Note one look. Raises DeviceFault where the log cannot be written."""
    sources, stamps, sequences = zip(*reads, strict=True) if reads else ((), (), ())
    context.write(LookRecord(context.now_ns(), trial, act, json.dumps(told or {}), sources, stamps, sequences))
