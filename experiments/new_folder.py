"""A new experiment's folder, as `extrinsic init` makes it: an experiment, its station, schemas and a README."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from string import Template

from experiments import __version__, shipped
from experiments.editors import MODELINE, SCHEMAS
from experiments.files import load
from mechanics.yaml_input import InputError, Problem, nearest, one_of, read_yaml

EXPERIMENT, STATION, README = "experiment.yaml", "station.yaml", "README.md"
#: what a folder of this kind is edited with; tables and profiles have schemas, too (`extrinsic schema`)
EDITED = ("experiment", "station", "object")
#: what a run leaves behind is data: it is not kept beside the code
IGNORED = "runs/\n"
TEMPLATE = Path(__file__).with_suffix(".md")


def new_folder(folder: Path, experiment: str, station: str) -> None:
    """Fill ``folder``, which is new or empty, with copies of a shipped experiment and a shipped station.

    The copy of the experiment names the copy of the station. Raises InputError, and leaves what was there: everything
    is made aside first.
    """
    source = _one_of(shipped.experiments(), shipped.FOLDER, experiment, "--experiment")
    devices = _one_of(shipped.stations(), shipped.STATIONS, station, "--station")
    load(str(source), str(devices))  # the two may not suit each other
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            wrong = "there is something there already"
            raise InputError([Problem(str(folder), None, "DIR", wrong, "a new or an empty folder")])
        where = folder if folder.exists() else folder.absolute().parent
        where.mkdir(parents=True, exist_ok=True)
        aside = where / f".extrinsic-init.{os.getpid()}"
        try:
            aside.mkdir()
            _fill(aside, source, devices, folder.absolute().name)
            if folder.exists():  # a shell may stand in it: it stays the same folder
                _move(aside, folder)
            else:
                aside.rename(folder)
        finally:
            shutil.rmtree(aside, ignore_errors=True)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        reason = error.strerror if isinstance(error, OSError) else str(error)
        wrong, expected = f"cannot be written: {reason}", "a folder you may write to, on a disk with room"
        raise InputError([Problem(repr(str(folder))[1:-1], None, "DIR", wrong, expected)]) from None


def _one_of(known: Iterable[str], folder: Path, name: str, option: str) -> Path:
    names = list(known)
    if name not in names:
        wrong = f"{name!r} is not shipped"
        raise InputError([Problem("init", None, option, wrong, one_of(names), nearest(name, names))])
    return folder / f"{name}.yaml"


def _fill(folder: Path, experiment: Path, station: Path, name: str) -> None:
    text, count = re.subn(r"(?m)^station: \S+$", f"station: {STATION}", _headed(experiment, "experiment"))
    assert count == 1, f"{experiment} does not name its station in a line of its own"
    simulated = "world" in read_yaml(station).data
    bring_up = "extrinsic check-device station.yaml wrist_ft   # bring up this device, and each other one, first\n"
    fields = {
        "name": name,
        "experiment": experiment.stem,
        "station": station.stem,
        "version": __version__,
        "bring_up": "" if simulated else bring_up,
    }
    readme = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(fields)
    texts = {EXPERIMENT: text, STATION: _headed(station, "station"), README: readme, ".gitignore": IGNORED}
    for file, content in texts.items():
        (folder / file).write_text(content, encoding="utf-8")
    (folder / "schemas").mkdir()
    for kind in EDITED:
        shutil.copyfile(SCHEMAS / f"{kind}.json", folder / "schemas" / f"{kind}.json")


def _headed(file: Path, kind: str) -> str:
    """The text of a shipped file, its schema beside it."""
    first, _, rest = file.read_text(encoding="utf-8").partition("\n")
    assert first.startswith(MODELINE), f"{file} does not begin with its schema"
    return f"{MODELINE}schemas/{kind}.json\n{rest}"


def _move(aside: Path, folder: Path) -> None:
    """Everything in ``aside`` into ``folder``, or nothing."""
    moved: list[Path] = []
    try:
        for part in sorted(aside.iterdir()):
            moved.append(part.rename(folder / part.name))
    except OSError:
        for part in moved:
            part.rename(aside / part.name)
        raise
