"""From the messages of a log or a live station to a Rerun recording.

Paths: ``trials/<trial>/…`` has what belongs to a trial, ``station/…`` everything else. Under either lie ``scene``,
``wrench``, ``pose`` and ``images``; the raw readings of sensors and arm are always under ``station``.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.finger_frames import DEPTH_UNIT
from drivers.wire import topics
from drivers.wire.codec import decode_diagnostics, decode_target, jpeg_of
from drivers.wire.log_reader import Logged
from experiments.report.collect import plan_in, planned_contacts
from experiments.view import figures, traces
from experiments.view.scene import Bodies, Scene
from experiments.view.sheet import At, Sheet
from mechanics import se2, wrench
from mechanics.readings import (
    Array,
    GripperReading,
    ImageReading,
    PoseReading,
    TagReading,
    TruthReading,
    WrenchReading,
)
from mechanics.records import (
    EventRecord,
    LookRecord,
    PhaseRecord,
    PlanarState,
    TrialRecord,
    WaypointRecord,
)

STATION = "station"
_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


@dataclass
class Scope:
    """What was shown of a trial, or of the station outside of one."""

    path: str
    name: str
    scene: Scene
    waypoints: list[tuple[At, int]] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    sources: set[str] = field(default_factory=set)
    status: str = "unfinished"
    spreads: int = 0


class Show:
    """Takes messages one after the other. ``scopes`` are those that have anything, ``counts`` messages per topic."""

    def __init__(self, sheet: Sheet, bodies: Bodies):
        import rerun as rr

        self._rr, self._sheet, self._bodies = rr, sheet, bodies
        self.scopes: dict[str, Scope] = {}
        self.counts: Counter[str] = Counter()
        self.unreadable = 0
        self.sensors: set[str] = set()
        self.arms: set[str] = set()
        self._depths: dict[str, tuple[float, float]] = {}
        self._scope = self._station()
        self._state: dict[str, Any] = {}
        self._takers: dict[type, Callable[[Any, str], None]] = {
            TruthReading: self._truth,
            WrenchReading: self._wrench,
            PoseReading: self._pose,
            GripperReading: self._gripper,
            ImageReading: self._image,
            TagReading: self._tags,
            TrialRecord: self._trial,
            PhaseRecord: self._phase,
            WaypointRecord: self._waypoint,
            EventRecord: self._event,
            LookRecord: self._look,
        }

    @property
    def trials(self) -> list[Scope]:
        """The trials in their order."""
        return [scope for scope in self.scopes.values() if scope.path != STATION]

    def restage(self, bodies: Bodies) -> None:
        """Other bodies stand on the table."""
        self._bodies = bodies
        for scope in self.scopes.values():
            scope.scene.redraw(bodies)

    def take(self, logged: Logged) -> None:
        """Show one message; one that cannot be read is counted."""
        self.counts[logged.topic] += 1
        device, stream = topics.device_and_stream(logged.topic)
        try:
            if stream == "target":
                self._target(logged, device)
            elif stream == "safety":
                self._safety(logged)
            elif stream == "image" and self._jpeg(logged, device):
                return
            elif stream not in ("status", "reference"):
                value = logged.value()
                self._takers.get(type(value), lambda *_: None)(value, device)
        except ProtocolError:
            self.unreadable += 1

    # -- a trial -------------------------------------------------------------------------------------------------------

    def _station(self) -> Scope:
        return self._opened(STATION, "station")

    def _opened(self, path: str, name: str) -> Scope:
        scope = self.scopes.get(path)
        if scope is None:
            scope = self.scopes[path] = Scope(path, name, Scene(self._sheet, f"{path}/scene", self._bodies))
        return scope

    def _trial(self, record: TrialRecord, _: str) -> None:
        at, rr = At(record.capture_ns), self._rr
        if not record.status:
            path, name, again = self._trial_path(record.trial), record.trial, 1
            while path in self.scopes:  # a resumed run runs the trial again that it was cut off in
                again += 1
                name = f"{record.trial} ({again})"
                path = self._trial_path(name)
            self._scope, self._state = self._opened(path, name), {}
            self._sheet.log("log/trials", at, rr.TextLog(f"{name} begins: {record.skill}, {record.controller}"))
            return
        level = "INFO" if record.status == "completed" else "WARN"
        told = f"{self._scope.name} {record.status}{': ' if record.reason else ''}{record.reason}"
        self._sheet.log("log/trials", at, rr.TextLog(told, level=level))
        self._scope.status = record.status
        plan = plan_in(record)
        if plan is not None:
            for when, step in self._scope.waypoints:
                if 0 <= step < plan.steps:
                    self._scope.scene.contacts("planned", when, planned_contacts(plan, step))
        self._scope = self._station()

    def _trial_path(self, name: str) -> str:
        return f"trials/{self._rr.escape_entity_path_part(name)}"

    def _phase(self, record: PhaseRecord, _: str) -> None:
        at = At(record.capture_ns, self._next_step() if self._scope.waypoints else None)
        self._sheet.log("log/phases", at, self._rr.TextLog(f"{record.trial}: {record.phase}"))

    def _event(self, record: EventRecord, _: str) -> None:
        level = _LEVELS.get(record.level, "INFO")
        self._sheet.log("log/events", At(record.capture_ns), self._rr.TextLog(record.text, level=level))

    def _look(self, record: LookRecord, _: str) -> None:
        """How sure the state was: the next waypoint's."""
        if record.act != "contact":
            return
        try:
            told = json.loads(record.told).get("state", {})
            self._state = {name: np.asarray(value, float) for name, value in told.items()}
        except (ValueError, TypeError, AttributeError, RecursionError):
            self._state = {}

    def _waypoint(self, record: WaypointRecord, _: str) -> None:
        scope = self._scope
        at = At(record.capture_ns, record.step)
        scope.waypoints.append((at, record.step))
        estimated, state = record.estimated, self._state
        self._state = {}
        if estimated is None and {"ee", "go", "wrench", "centre"} <= state.keys():
            grasped = se2.compose(state["go"], self._bodies.grasp)[:2]
            on_go = wrench.about(state["wrench"], state["centre"], grasped)
            estimated = PlanarState(state["ee"], state["go"], state.get("eo"), on_go)
        said = {"planned": record.planned, "measured": record.measured, "estimated": estimated}
        for source, planar in said.items():
            if planar is not None:
                self._say(scope, source, at, planar)
        if record.truth is not None:  # on the station's clock the plant itself has told, and all the time
            self._say(scope, "truth", At(waypoint=record.step), record.truth)
        go = estimated.go if estimated is not None else record.measured.go
        if record.contact is not None and go is not None:
            scope.scene.belief(at, go, record.contact)
        if estimated is not None:
            self._spread(scope, at, estimated, state)

    def _say(self, scope: Scope, source: str, at: At, state: PlanarState) -> None:
        scope.sources.add(source)
        scope.scene.state(source, at, state)
        traces.state(self._sheet, scope.path, source, at, state)

    def _spread(self, scope: Scope, at: At, estimated: PlanarState, state: dict[str, Array]) -> None:
        if estimated.go is not None and "go_covariance" in state and "ee" in state:
            covariance = figures.position_covariance(state["ee"], estimated.go, state["go_covariance"])
            scope.scene.spread(at, "go", estimated.go[:2], covariance)
            scope.spreads += 1
        if "eo_covariance" in state and "eo" in state:
            scope.scene.spread(at, "eo", state["eo"][:2], state["eo_covariance"][:2, :2])
        if "wrench_covariance" in state and estimated.go is not None:
            lever = state["centre"] - se2.compose(estimated.go, self._bodies.grasp)[:2]
            traces.band(self._sheet, scope.path, at, estimated.wrench, state["wrench_covariance"], lever)

    # -- readings ------------------------------------------------------------------------------------------------------

    def _truth(self, reading: TruthReading, _: str) -> None:
        at = At(reading.stamp.capture_ns)
        state = PlanarState(reading.ee, reading.go, reading.eo, reading.wrench)
        self._say(self._scope, "truth", at, state)
        self._scope.scene.contacts("truth", at, reading.contacts)

    def _wrench(self, reading: WrenchReading, device: str) -> None:
        self.sensors.add(device)
        traces.sensor(self._sheet, f"{STATION}/sensors/{device}", At(reading.stamp.capture_ns), reading.wrench)

    def _pose(self, reading: PoseReading, device: str) -> None:
        at = At(reading.stamp.capture_ns)
        traces.pose(self._sheet, f"{STATION}/{device}/pose", at, reading.pose, device)
        if reading.child == "ee":
            self.arms.add(device)
            self._station().scene.body("measured", "ee", at, reading.pose)

    def _target(self, logged: Logged, device: str) -> None:
        capture_ns, pose = decode_target(logged.payload)
        traces.pose(self._sheet, f"{STATION}/{device}/target", At(capture_ns), pose, "target")

    def _gripper(self, reading: GripperReading, device: str) -> None:
        traces.gripper(self._sheet, f"{STATION}/{device}", At(reading.stamp.capture_ns), reading)

    def _safety(self, logged: Logged) -> None:
        capture_ns, parts = decode_diagnostics(logged.payload)
        for level, told in parts:
            name = ("INFO", "WARN", "ERROR")[min(level, 2)]
            self._sheet.log("log/safety", At(capture_ns), self._rr.TextLog(told, level=name))

    def _next_step(self) -> int | None:
        """The waypoint that a picture of this moment belongs to: the one that will be measured next."""
        if self._scope.path == STATION:
            return None
        return self._scope.waypoints[-1][1] + 1 if self._scope.waypoints else 0

    def _image_path(self, device: str) -> str:
        if device not in self._scope.images:
            self._scope.images.append(device)
        return f"{self._scope.path}/images/{self._rr.escape_entity_path_part(device)}"

    def _jpeg(self, logged: Logged, device: str) -> bool:
        """Show a compressed picture with its bytes as they are; False for one that is sent otherwise."""
        if not logged.type_name.endswith("/CompressedImage"):
            return False
        data = jpeg_of(logged.payload)
        if data is None:
            return False
        at = At(logged.publish_ns, self._next_step())
        self._sheet.log(self._image_path(device), at, self._rr.EncodedImage(contents=data, media_type="image/jpeg"))
        return True

    def _image(self, reading: ImageReading, device: str) -> None:
        at, rr = At(reading.stamp.capture_ns, self._next_step()), self._rr
        picture: Any
        if reading.encoding == "16UC1":
            shown = self._depths.setdefault(device, _depths(reading.image))
            picture = rr.DepthImage(reading.image, meter=1.0 / DEPTH_UNIT, colormap="viridis", depth_range=shown)
        else:
            model = rr.ColorModel.L if reading.encoding == "mono8" else rr.ColorModel.BGR
            picture = rr.Image(reading.image, color_model=model)
        self._sheet.log(self._image_path(device), at, picture)

    def _tags(self, reading: TagReading, device: str) -> None:
        at, found = At(reading.stamp.capture_ns, self._next_step()), reading.detections
        strips = [np.concatenate([tag.corners, tag.corners[:1]]) + 0.5 for tag in found]  # pixels' centres
        labels = [str(tag.id) for tag in found]
        drawn = self._rr.LineStrips2D(strips, labels=labels, colors=[traces.TAG] * len(found))
        self._sheet.log(f"{self._image_path(device)}/tags", at, drawn)


def _depths(image: NDArray[Any]) -> tuple[float, float]:
    """The depths to show in colours: of the first picture, without the pixels that saw nothing."""
    seen = image[image > 0]
    low, high = np.percentile(seen, (0.5, 99.5)) if seen.size else (0.0, 1.0)
    return float(low), max(float(high), float(low) + 1.0)
