"""Room for a run's data: looked for before the start, and missed in one sentence where it ends later."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from tempfile import TemporaryFile

from drivers.errors import DeviceFault
from experiments import registries
from experiments.calibrate import store
from experiments.calibrate.schema import CalibrationStage
from experiments.files import Resolved
from experiments.json_output import STDOUT
from experiments.schema import ExecuteStage
from experiments.setup import has_fingers
from mechanics.yaml_input import InputError, Problem

#: what has to be free besides the data that a run is expected to log [bytes]
FLOOR = 200 * 10**6
#: what a trial logs at most, as a rule [bytes]: under a law that feels through the fingers, and under any other
FELT, BLIND = 50 * 10**6, 5 * 10**6

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.ENOTDIR)


def expected(resolved: Resolved) -> int:
    """About how much a run will log [bytes]."""
    laws, total = registries.controllers(), 0
    for stage in resolved.experiment.stages:
        if isinstance(stage, ExecuteStage):
            feels = [has_fingers(resolved) and laws[name].feedback for name in stage.controllers]
            total += stage.trials * sum(FELT if one else BLIND for one in feels)
    return total


def require_room(resolved: Resolved, folder: Path) -> None:
    """Raises InputError where ``folder``, which need not exist yet, has too little room for a run."""
    there = folder.absolute()
    while not there.is_dir() and there != there.parent:
        there = there.parent
    try:
        free = shutil.disk_usage(there).free
    except OSError:  # whether it can be written is asked next
        return
    needed = FLOOR + expected(resolved)
    if free < needed:
        wrong = f"{free / 1e6:.0f} MB are free there, and the run may need {needed / 1e6:.0f} MB"
        remedy = "a folder with more room, or fewer trials at a time"
        raise InputError([Problem(str(folder), None, "--out", wrong, remedy)])


def require_writable(file: Path | None, option: str) -> None:
    """Raises InputError where ``file``, which an ``option`` names, cannot be written; leaves nothing behind."""
    if file is None or file == STDOUT:
        return
    there = file.absolute().parent
    try:
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        while not there.exists() and there != there.parent:
            there = there.parent
        with TemporaryFile(dir=there):
            pass
    except OSError as error:
        wrong, expected = f"cannot be written: {error.strerror or error}", "a file in a place you may write to"
        raise InputError([Problem(str(file), None, option, wrong, expected)]) from None


def not_kept(error: OSError, folder: Path, again: str = "") -> DeviceFault:
    """What a campaign or a table ends with whose summary cannot be written; ``again``: the command that writes it."""
    again = again or f"start again with --out {folder}"
    remedy = f"All that was run is in {folder}. Make room there, then {again}"
    return DeviceFault("disk", f"write {error.filename or folder}", error.strerror or str(error), remedy)


def require_store(resolved: Resolved) -> None:
    """Raises InputError where the run calibrates, and the folder of the station's calibrations cannot be written."""
    if not any(isinstance(stage, CalibrationStage) for stage in resolved.experiment.stages):
        return
    there = folder = store.folder_of(resolved).absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    wrong = ""
    if not there.is_dir():
        wrong = f"{there} is a file" if there != folder else "it is a file"
    elif not os.access(there, os.W_OK | os.X_OK):
        wrong = f"{there} cannot be written" if there != folder else "it cannot be written"
    if wrong:
        expected = "a folder that you may write to: calibrations of this station go there"
        raise InputError([Problem(str(folder), None, "calibration.source", wrong, expected)])


def is_full(error: OSError) -> bool:
    """Whether a disk that is full, or takes nothing more, or nothing from us, is to blame."""
    return error.errno in (*_FULL, *_FORBIDDEN)


def not_written(path: Path | str | None, why: str, run_folder: Path) -> DeviceFault:
    """What a run ends with whose files cannot be written any more."""
    remedy = f"What came before is kept. Make room there, then go on: extrinsic run --resume {run_folder}"
    return DeviceFault("disk", f"write {path or run_folder}", why, remedy)
