"""A recorded run, torn or whole, as a Rerun recording."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivers.errors import ProtocolError
from drivers.replay.contents import EXPERIMENT
from drivers.wire.log_reader import LogReader
from experiments.files import Resolved, load
from experiments.results_file import ShownResults, read_json
from experiments.run_folder import RunFolder
from experiments.view.layout import layout
from experiments.view.scene import Bodies
from experiments.view.sheet import Sheet
from experiments.view.show import STATION, Show
from mechanics.yaml_input import InputError, Problem

if TYPE_CHECKING:
    import rerun as rr

LIBRARY = "extrinsic"
"""What our logs say that they were written by."""

_SPAN = 5_000_000_000
"""So much time is written at once [ns]."""

_OURS = "a run's folder or its log.mcap, as `extrinsic run` leaves them"


@dataclass(frozen=True)
class Recorded:
    """What there is of a run: its ``files`` in their order, its experiment where that is known, how it ended."""

    name: str
    files: tuple[Path, ...]
    resolved: Resolved | None
    results: dict = field(default_factory=dict)


def recorded(path: Path) -> Recorded:
    """Look at a run folder, or at a log by itself.

    Raises InputError for a folder that is no run's, for an experiment that cannot be read, and for a log of another
    program.
    """
    if path.is_file():
        refuse_foreign(path)
        return Recorded(path.name, (path,), _attached(path))
    folder = RunFolder.open(path)
    files = tuple(folder.logs())
    for file in files:
        refuse_foreign(file, alone=False)
    results = read_json(folder.results, ShownResults) if folder.results.is_file() else None
    return Recorded(path.resolve().name, files, load(str(folder.experiment)), results or {})


def refuse_foreign(file: Path, *, alone: bool = True) -> None:
    """Raise InputError for a log that another program wrote, and for a file that is no log where it is all there is.

    One that breaks off before it says who wrote it may be ours.
    """
    try:
        library = LogReader(file).library()
    except (ProtocolError, OSError) as error:
        if not alone:
            return  # a run that was killed before the first byte was on the disk; what else there is can be shown
        got = error.got if isinstance(error, ProtocolError) else str(error)
        raise InputError([Problem(str(file), None, "RUN", got, _OURS)]) from None
    if library is not None and library != LIBRARY:
        wrong = f"another program's log: it was written by {library or 'one that does not say its name'!r}"
        raise InputError([Problem(str(file), None, "RUN", wrong, f"{_OURS}; Rerun itself opens others: rerun FILE")])


def _attached(file: Path) -> Resolved | None:
    """The experiment that a log carries."""
    text = LogReader(file).attachments().get(EXPERIMENT)
    if text is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / EXPERIMENT
        copy.write_bytes(text)
        return load(str(copy))


def bodies_of(resolved: Resolved | None) -> Bodies:
    """The outlines of an experiment's objects."""
    if resolved is None:
        return Bodies({}, np.zeros(3))
    shapes = {"go": resolved.grasped, "eo": resolved.extrinsic}
    return Bodies({role: s.polygon.vertices for role, s in shapes.items() if s is not None}, resolved.grasp)


def write(run: Recorded, recording: rr.RecordingStream, tell: Callable[[str], None] = lambda _: None) -> list[str]:
    """Write the run into ``recording`` with its layout; returns what there is to say of it, a line each.

    ``tell`` is told which file is being read.
    """
    import rerun as rr

    sheet = Sheet(recording, clock=run.resolved is not None and not _lockstep(run.resolved))
    show = Show(sheet, bodies_of(run.resolved))
    endings = []
    for file in run.files:
        tell(f"reading {file.name} ({file.stat().st_size / 1e6:.0f} MB)")
        endings.append((file.name, _read(file, show, sheet)))
    sheet.flush()
    lines = account(run, show, endings)
    sheet.still("overview", rr.TextDocument(overview(run, show, lines), media_type="text/markdown"))
    recording.send_blueprint(layout(show))
    return lines


def _read(file: Path, show: Show, sheet: Sheet) -> str:
    """Show one file; how it ends. What a viewer gets it gets in the order of time."""
    written = 0
    try:
        reader = LogReader(file)
        for logged in reader.messages():
            show.take(logged)
            if logged.publish_ns - written > _SPAN:
                sheet.flush()
                written = logged.publish_ns
    except ProtocolError as error:
        return error.got
    return reader.ending


def _lockstep(resolved: Resolved) -> bool:
    world = resolved.station.world
    return world is not None and world.clock == "lockstep"


def account(run: Recorded, show: Show, endings: list[tuple[str, str]]) -> list[str]:
    """What there is in a run and what is missing."""
    waypoints = sum(len(scope.waypoints) for scope in show.trials)
    lines = [f"{len(show.trials)} trials, {waypoints} waypoints, {sum(show.counts.values())} messages"]
    if not run.files:
        lines.append("there is no log: the run ended before it wrote one")
    lines += [f"{name}: {ending}; what was whole is shown" for name, ending in endings if ending != "complete"]
    repair = run.results.get("repair") or {"logs": []}
    lines += [f"{told['log']} was mended: {told['ending']}" for told in repair["logs"] if told["ending"] != "complete"]
    status = run.results.get("status")
    if status not in (None, "completed"):
        reason = run.results.get("reason")
        lines.append(f"the run is {status}{f': {reason}' if reason else ''}")
    cut = [scope.name for scope in show.trials if scope.status == "unfinished"]
    lines += [f"{name} is unfinished: the log breaks off in it" for name in cut]
    if show.unreadable:
        lines.append(f"{show.unreadable} messages could not be read")
    if waypoints and not any(scope.spreads for scope in show.trials):
        lines.append("the log has no covariances: it is of an older version, or nothing was estimated")
    return lines


def overview(run: Recorded, show: Show, lines: list[str]) -> str:
    """The run in a few lines of Markdown."""
    results = run.results
    known = [("experiment", results.get("experiment")), ("station", results.get("station"))]
    known += [("seed", results.get("seed")), ("started", results.get("started")), ("status", results.get("status"))]
    told = [f"# {run.name}", "", *(f"* {name}: {value}" for name, value in known if value is not None)]
    told += [f"* {line}" for line in lines]
    if show.trials:
        told += ["", "| trial | status | waypoints | pictures |", "|---|---|---|---|"]
        told += [
            f"| {scope.name} | {scope.status} | {len(scope.waypoints)} | {', '.join(scope.images)} |"
            for scope in show.trials
        ]
    told += ["", _LEGEND]
    return "\n".join(told)


_LEGEND = f"""\
Grey: planned. Teal: measured, through tags and wrist. Purple: estimated, with ellipses and bands of 2 σ. Blue, and
orange for the extrinsic object: the plant's truth. Force arrows: 10 mm per newton. A contact's dot: green sticks,
orange and red slip. Timelines: `station_time`, and `waypoint` within a trial. Outside of trials: `{STATION}`."""
