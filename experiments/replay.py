"""Estimates a recorded run again, with the code of today, from the streams in its log: `extrinsic replay RUN`.

The devices are those of `drivers.replay`, behind the interfaces that a run reads, and the observer is a run's own. The
log has what every look at the devices went by (`mechanics.records.LookRecord`); each is taken again in its turn.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from control.observe import Finger, Observer
from control.reads import R, Read, Reads
from drivers.errors import DeviceTimeout, DriverError, NotConnected
from drivers.interfaces import ImagingSensor, Sensor
from drivers.replay import PlayedDevices, Recording
from drivers.wire.log_reader import Logged
from estimation.state import NoState
from experiments import setup
from experiments.calibrate.store import Calibrations
from experiments.exit_codes import ExitCode
from experiments.files import Resolved, load
from experiments.fingers import fingers
from experiments.json_output import put
from experiments.looks import BEGIN
from experiments.progress import Heard, Progress, unheard
from experiments.run_folder import RunFolder
from experiments.terminal import terminal
from mechanics import se2
from mechanics.readings import Array
from mechanics.records import ContactBelief, LookRecord, PlanarState, TrialRecord, WaypointRecord
from mechanics.yaml_input import InputError, Problem

#: figures that differ by less are the same: another processor rounds otherwise [m, rad, N, N·m]
SAME = 1e-9
#: what a log has room for of a sequence number
_LOGGED = 0xFFFFFFFF
T = TypeVar("T")
_UNITS = {"mm": 1e3, "deg": float(np.degrees(1.0)), "N": 1.0, "Nmm": 1e3}


@dataclass(frozen=True)
class Again:
    """A waypoint as it was ``recorded`` and as it is estimated today; None where that failed, for the ``reason``."""

    recorded: WaypointRecord
    measured: PlanarState | None
    estimated: PlanarState | None
    contact: ContactBelief | None
    reason: str = ""

    def differences(self) -> dict[str, float]:
        """The largest differences of ``measured`` and ``estimated`` poses [mm, deg] and wrenches [N, Nmm].

        ``contact_mm`` is how far the places of contact are apart. Infinite where only one of both is there.
        """
        worst = dict.fromkeys((*_UNITS, "contact_mm"), 0.0)
        pairs = [(self.recorded.measured, self.measured), (self.recorded.estimated, self.estimated)]
        for was, now in pairs:
            for unit, value in _apart(was, now).items():
                worst[unit] = max(worst[unit], value)
        worst["contact_mm"] = 1e3 * _contact_apart(self.recorded.contact, self.contact)
        return worst

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        scale = {**_UNITS, "contact_mm": 1e3}
        return all(value <= SAME * scale[unit] for unit, value in self.differences().items())


def estimates(folder: RunFolder, heard: Heard = unheard) -> list[Again]:
    """Every waypoint of a run's trials, estimated again, in their order. What was run again counts once.

    ``heard`` is called with the share of the log that has been played.

    Raises InputError for a run without a log, and for one whose log does not say when it looked at its devices.
    """
    resolved = load(str(folder.experiment))
    try:
        recording = Recording(folder.path)
        with recording.devices(resolved.station) as devices:
            estimator = _Estimator(resolved, devices)
            records: deque[Logged] = deque()
            stop = recording.listen(records.append)
            going = True
            while going:
                going = recording.step()
                while records:
                    estimator.take(records.popleft())
                    heard(recording.share)
            stop()
    except NotConnected as error:
        raise InputError([Problem(str(folder.path), None, "RUN", error.got, error.remedy)]) from None
    if not estimator.looked:
        wrong = "its log does not say when the run looked at its devices: no trial is in it, or an older version's"
        raise InputError([Problem(str(folder.path), None, "RUN", wrong, "a run of this version, with a trial")])
    return estimator.found


class _Rereads(Reads):
    """Reads again what a look went by; what was not read then, as it is by now."""

    def __init__(self) -> None:
        super().__init__()
        self._left: dict[str, deque[Read]] = {}

    def look(self, reads: Sequence[Read]) -> None:
        """The reads of the look that comes now."""
        self._left = {}
        for read in reads:
            self._left.setdefault(read.source, deque()).append(read)

    def latest(self, sensor: Sensor[R]) -> R:
        read = self._next(sensor)
        return super().latest(sensor) if read is None else self._found(sensor, read)

    def since(self, sensor: Sensor[R], capture_ns: int) -> list[R]:
        read, readings = self._next(sensor), super().since(sensor, capture_ns)
        return readings if read is None else [r for r in readings if r.stamp.capture_ns <= read.capture_ns]

    def capture(self, sensor: ImagingSensor[R]) -> R:
        return self.latest(sensor)

    def _next(self, sensor: Sensor) -> Read | None:
        left = self._left.get(sensor.name)
        return left.popleft() if left else None

    @staticmethod
    def _found(sensor: Sensor[R], read: Read) -> R:
        for reading in sensor.since(read.capture_ns - 1):
            stamp = reading.stamp
            if stamp.capture_ns == read.capture_ns and stamp.sequence == read.sequence & _LOGGED:
                return reading
        got = f"reading {read.sequence}, of t = {read.capture_ns * 1e-9:.6f} s, is not in the log"
        raise DeviceTimeout(sensor.name, "read it again", got, "What a log has lost cannot be estimated again")


class _Estimator:
    """Takes a run's records in their order. ``looked`` says whether there was a look among them."""

    def __init__(self, resolved: Resolved, devices: PlayedDevices):
        self.found: list[Again] = []
        self.looked = False
        self._resolved, self._devices = resolved, devices
        self._settings = resolved.experiment.trial
        self._reads = _Rereads()
        self._fingers: tuple[Finger, ...] | None = None
        self._known = setup.believed(resolved, Calibrations())
        self._observer: Observer | None = None
        self._seen: dict[str, tuple[list[float] | None, Array | None]] = {}  # a body's pose then and now
        self._forget()

    def _forget(self) -> None:
        self._measured: PlanarState | None = None
        self._estimated: PlanarState | None = None
        self._contact: ContactBelief | None = None
        self._reason = ""

    def take(self, logged: Logged) -> None:
        """One of the run's records, as it is played."""
        record = logged.value()
        if isinstance(record, TrialRecord) and not record.status:
            self._observer = None
            self._forget()
            self.found = [again for again in self.found if again.recorded.trial != record.trial]
        elif isinstance(record, LookRecord):
            try:
                self._look(record)
            except (DriverError, NoState) as error:  # as it may have been in the run
                self._reason = str(error)
        elif isinstance(record, WaypointRecord):
            estimated = None if record.estimated is None else self._estimated
            self.found.append(Again(record, self._measured, estimated, self._contact, self._reason))
            self._forget()

    def _look(self, look: LookRecord) -> None:
        try:
            told = json.loads(look.told)
            self._reads.look([Read(*one) for one in zip(look.sources, look.stamps, look.sequences, strict=True)])
            if look.act == "fingers":
                self._fingers = fingers(self._resolved, self._devices)
            elif look.act == "warm_up":
                setup.warm_up(self._resolved, self._known, self._fingers or (), self._reads)
            elif look.act == BEGIN:
                self.looked = True
                self._begin(told)
            elif self._observer is not None:
                self._act(self._observer, look.act, told)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, NoState):
                raise
            wrong = f"its look at t = {look.capture_ns * 1e-9:.3f} s cannot be read: {error}"
            raise InputError([Problem("log", None, look.act, wrong, "a log of this version")]) from error

    def _begin(self, told: dict[str, Any]) -> None:
        """A trial's observer, as `experiments.stages` makes it."""
        resolved, played = self._resolved, self._devices
        there = resolved if told["extrinsic"] else replace(resolved, extrinsic=None)
        self._known = setup.believed(resolved, Calibrations.of_told(told["calibration"]))
        felt = ()
        if told["fingers"]:
            felt = self._fingers = fingers(resolved, played) if self._fingers is None else self._fingers
        self._observer = setup.observer(there, played, self._settings, self._known, felt)
        self._observer.reads, self._observer.witness = self._reads, None
        self._seen.clear()

    def _act(self, observer: Observer, act: str, told: dict[str, Any]) -> None:
        if act == "see":
            seen = observer.see(tuple(told["bodies"]))
            found = told.get("found", {})
            self._seen |= {body: (found.get(body), None if p is None else p.pose) for body, p in seen.items()}
        elif act == "zero":
            then, now = self._seen.get("go", (None, None))
            # under the go as it was seen: as it is seen today
            given = now if now is not None and then == told["X_W_go"] else np.array(told["X_W_go"], float)
            observer.zero(setup.free_air_load(self._resolved), given)
        elif act == "measure":
            self._measured = observer.measure()
        elif act == "estimate":
            self._estimated = observer.estimate()
        elif act == "contact":
            self._contact = observer.contact()
            self._estimated = observer.estimated


# -- what differs ------------------------------------------------------------------------------------------------------


def _apart(was: PlanarState | None, now: PlanarState | None) -> dict[str, float]:
    """Largest differences of two states, by unit; infinite where only one is there."""
    if was is None and now is None:
        return {}
    if was is None or now is None:
        return dict.fromkeys(_UNITS, float("inf"))
    poses = [_pose_apart(getattr(was, name), getattr(now, name)) for name in ("ee", "go", "eo")]
    force = np.abs(was.wrench - now.wrench)
    return {
        "mm": 1e3 * max(pose[0] for pose in poses),
        "deg": float(np.degrees(max(pose[1] for pose in poses))),
        "N": float(force[:2].max()),
        "Nmm": 1e3 * float(force[2]),
    }


def _pose_apart(was: Array | None, now: Array | None) -> tuple[float, float]:
    if was is None and now is None:
        return 0.0, 0.0
    if was is None or now is None:
        return float("inf"), float("inf")
    return float(np.hypot(*(was - now)[:2])), abs(float(se2.wrap(was[2] - now[2])))


def _contact_apart(was: ContactBelief | None, now: ContactBelief | None) -> float:
    if was is None and now is None:
        return 0.0
    if was is None or now is None or was.status != now.status or was.points.shape != now.points.shape:
        return float("inf")
    return float(np.abs(was.points - now.points).max(initial=0.0))


# -- the command -------------------------------------------------------------------------------------------------------


def main(folder: RunFolder, json_file: Path | None, check: bool, console: Console) -> ExitCode:
    """Show what was estimated then and now; the exit code says whether it is the same, if that was asked.

    Where there is no waypoint nothing is the same.

    Raises InputError for what cannot be estimated again.
    """
    with Progress(terminal(stderr=True)).share("estimate again") as heard:
        found = estimates(folder, heard)
    for trial in dict.fromkeys(again.recorded.trial for again in found):
        console.print(_table(trial, [again for again in found if again.recorded.trial == trial]), "")
    differing = [again for again in found if not again.same]
    figures = (f"{value:.3g} {unit.replace('contact_mm', 'mm of contact')}" for unit, value in largest(found).items())
    said = f"{len(found)} waypoints estimated again, {len(differing)} differ; at most {', '.join(figures)}"
    console.print(said, soft_wrap=True, highlight=False)
    put(json_file, as_json(found))
    return ExitCode.FELL_SHORT if check and (differing or not found) else ExitCode.DONE


def _table(trial: str, found: Sequence[Again]) -> Table:
    """A trial's estimates as recorded; where they differ, those of today below."""
    table = Table(title=escape(trial), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("", justify="right")
    table.add_column("")
    table.add_column(escape("object [mm, mm, deg]"), justify="right", no_wrap=True)
    table.add_column(escape("wrench [N, N, Nmm]"), justify="right", no_wrap=True)
    table.add_column("apart")
    for again in found:
        was = again.recorded
        for what, then, now in (
            ("measured", was.measured, again.measured),
            ("estimated", was.estimated, again.estimated),
        ):
            if then is not None or now is not None:
                apart = [f"{value:.3g} {unit}" for unit, value in _apart(then, now).items()]
                table.add_row(str(was.step), what, *_both(then, now, _object, _wrench), again.reason or _or_same(apart))
        if was.contact is not None or again.contact is not None:
            apart = [f"{1e3 * _contact_apart(was.contact, again.contact):.3g} mm"]
            table.add_row(str(was.step), "touched", *_both(was.contact, again.contact, _place), "", _or_same(apart))
    return table


def _both(then: T | None, now: T | None, *told: Callable[[T | None], str]) -> Iterator[str]:
    """What is told of both, one below the other; once where it is the same."""
    for tell in told:
        yield "\n".join(dict.fromkeys((tell(then), tell(now))))


def _or_same(apart: Sequence[str]) -> str:
    return "same" if all(figure.startswith("0 ") for figure in apart) else ", ".join(apart)


def _object(state: PlanarState | None) -> str:
    if state is None or state.go is None:
        return "-" if state is None else "not seen"
    return f"{1e3 * state.go[0]:.3f} {1e3 * state.go[1]:.3f} {np.degrees(state.go[2]):.3f}"


def _wrench(state: PlanarState | None) -> str:
    return "-" if state is None else f"{state.wrench[0]:.3f} {state.wrench[1]:.3f} {1e3 * state.wrench[2]:.1f}"


def _place(contact: ContactBelief | None) -> str:
    point = None if contact is None else contact.point
    if contact is None or point is None:
        return "-" if contact is None else contact.status
    return f"{1e3 * point[0]:.2f} {1e3 * point[1]:.2f}"


# -- as figures --------------------------------------------------------------------------------------------------------


def as_json(found: Sequence[Again]) -> dict[str, Any]:
    """All of it, SI; ``differences`` in their units, None where only one of both is there."""
    return {
        "same": all(again.same for again in found),
        "largest": _finite(largest(found)),
        "waypoints": [
            {
                "trial": again.recorded.trial,
                "step": again.recorded.step,
                "same": again.same,
                "reason": again.reason,
                "recorded": _told(again.recorded.measured, again.recorded.estimated, again.recorded.contact),
                "again": _told(again.measured, again.estimated, again.contact),
                "differences": _finite(again.differences()),
            }
            for again in found
        ],
    }


def largest(found: Sequence[Again]) -> dict[str, float]:
    """The largest difference of all waypoints, by unit."""
    worst = dict.fromkeys((*_UNITS, "contact_mm"), 0.0)
    for again in found:
        worst = {unit: max(worst[unit], value) for unit, value in again.differences().items()}
    return worst


def _told(measured: PlanarState | None, estimated: PlanarState | None, contact: ContactBelief | None) -> dict[str, Any]:
    return {
        "measured": _state(measured),
        "estimated": _state(estimated),
        "contact": None
        if contact is None
        else {"status": contact.status, "points": contact.points.tolist(), "weights": contact.weights.tolist()},
    }


def _state(state: PlanarState | None) -> dict[str, Any] | None:
    if state is None:
        return None
    parts = {"ee": state.ee, "go": state.go, "eo": state.eo, "wrench": state.wrench}
    return {name: None if value is None else value.tolist() for name, value in parts.items()}


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in figures.items()}
