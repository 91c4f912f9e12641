"""What the station measures at a settled instant: the arm gives ee, tags the objects, the wrist sensor the wrench."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np

from control.reads import Read, Reads
from control.witness import TableWitness
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.interfaces import Arm, ForceTorqueSensor, TactileSensor, TagCamera
from estimation.finger_slip import Drift, FingerSlip
from estimation.force_torque import FreeAirLoad, WristSensor, mean_wrench
from estimation.state import State, StateEstimator
from estimation.tactile_pose import PoseStatus, TactilePoseEstimator, fuse
from estimation.tag_pose import TagPose, estimate_planar_pose
from estimation.tool_identification import Agreement
from estimation.wrench_errors import ForceTorqueErrors, Zero
from mechanics import se2, wrench
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import Array, Status, TagDetection
from mechanics.records import ContactBelief, PlanarState

#: older readings of arm and wrist are not gone through when the state is asked for anew [ns]
_RECENT = 500_000_000


@dataclass(frozen=True)
class Finger:
    """A tactile finger and the method that reads its pictures."""

    sensor: TactileSensor
    method: TactilePoseEstimator


@dataclass
class Observer:
    """Reads the devices and turns readings into poses and wrenches in W. Never sees the plant's truth.

    ``tags`` maps a body (``table``, ``go``, ``eo``) to the tags it carries; ``grasp`` is X_go_gocf; ``window_ns`` is
    how far back wrench readings are averaged. With ``fingers`` and a ``state`` estimator of this grasp, `estimate`
    learns the go's pose from ``tactile_frames`` pictures of each finger, and never from its tag. Without ``fingers``
    the ``state`` takes the tags. ``witness`` is the sensor under the table, where there is one.
    """

    arm: Arm
    wrist: ForceTorqueSensor
    camera: TagCamera
    camera_model: CameraModel
    tags: dict[str, tuple[TagGeometry, ...]]
    wrist_sensor: WristSensor
    grasp: Array
    window_ns: int
    frames: int = 1
    fingers: tuple[Finger, ...] = ()
    state: StateEstimator | None = None
    tactile_frames: int = 1
    witness: TableWitness | None = None
    reads: Reads = field(default_factory=Reads)
    #: called once a look at the devices is over, with what it was, what it was given or found, and what it went by
    note: Callable[[str, dict[str, Any], list[Read]], None] | None = None
    #: the state behind the newest `estimate` from the fingers
    felt: State | None = None
    #: how the object lies in the fingers otherwise than in free air, by the newest look at both; None: nobody knows
    drift: Drift | None = None
    _heard_ns: int = -1
    _zero: Zero | None = None
    _seen: dict[str, tuple[int, TagPose]] = field(default_factory=dict)
    _looking: bool = False
    _told: PlanarState | None = None
    _known: State | None = None

    def __post_init__(self) -> None:
        # one that goes by the go's tag, and one by what the fingers feel
        self._by_tag, self._by_touch = (
            None if self.state is None else FingerSlip(self.grasp, self.state.elasticity) for _ in range(2)
        )

    @contextmanager
    def _look(self, act: str, told: dict[str, Any] | None = None) -> Iterator[dict[str, Any]]:
        """A look at the devices, of which others may be parts; it is noted however it ends."""
        told = {} if told is None else told
        if self._looking or self.note is None:
            yield told
            return
        self._looking = True
        self.reads.begin()
        try:
            yield told
        finally:
            self._looking = False
            self.note(act, told, self.reads.end())

    def see(self, bodies: tuple[str, ...]) -> dict[str, TagPose | None]:
        """Poses in W of the named bodies from fresh camera frames; None where none of its tags was seen."""
        with self._look("see") as told:
            told["bodies"] = list(bodies)
            found = self._see(bodies)
            told["found"] = {body: None if pose is None else pose.pose.tolist() for body, pose in found.items()}
            return found

    def _see(self, bodies: tuple[str, ...]) -> dict[str, TagPose | None]:
        detections: list[TagDetection] = []
        frames = [self.reads.capture(self.camera) for _ in range(self.frames)]
        trusted = [frame for frame in frames if frame.stamp.status is Status.OK]
        if not trusted:
            _distrust(self.camera.name, "see the tags", frames[-1].stamp.status)
        for frame in trusted:
            detections += frame.detections
        found = {
            body: estimate_planar_pose(self.camera_model, tuple(detections), self.tags.get(body, ())) for body in bodies
        }
        at = trusted[-1].stamp.capture_ns
        self._seen |= {body: (at, pose) for body, pose in found.items() if pose is not None}
        return found

    def arm_pose(self) -> Array:
        """X_W_ee (3,) now. Raises DeviceFault where the arm's own reading is not to be trusted."""
        reading = self.reads.latest(self.arm)
        if reading.stamp.status is not Status.OK:
            _distrust(self.arm.name, "read its pose", reading.stamp.status)
        return reading.pose

    def mean_reading(self) -> Array:
        """Mean (6,) of the wrist readings of the last window."""
        now = self.reads.latest(self.wrist).stamp.capture_ns
        readings = self.reads.since(self.wrist, now - self.window_ns)
        try:
            return mean_wrench(readings)
        except ValueError as reason:
            raise DeviceTimeout(
                self.wrist.name, "average the wrench", str(reason), "Check the sensor's status and cable"
            ) from None

    def measure(self) -> PlanarState:
        """Everything at this instant; the arm should be at rest."""
        with self._look("measure"):
            return self._measure()

    def _measure(self) -> PlanarState:
        ee = self.arm_pose()
        reading = self.mean_reading()
        seen = self.see(("go", "eo"))
        go = None if seen["go"] is None else seen["go"].pose
        eo = None if seen["eo"] is None else seen["eo"].pose
        grasp_centre = se2.compose(ee if go is None else go, np.zeros(3) if go is None else self.grasp)
        found = PlanarState(ee, go, eo, self.wrist_sensor.wrench_on_go(reading, ee, grasp_centre[:2]))
        drift = None if self._by_tag is None else self._by_tag.drift(found)
        self.drift = self.drift if drift is None and self.fingers else drift  # they were felt right before
        return found

    def estimate(self) -> PlanarState:
        """What controllers act on, at this instant: from the fingers and the elasticity where there are fingers.

        The wrench is about the grasp centre on the go, as plans and `measure` have it, by the go's pose as felt. An
        object that lies millimetres off in the fingers turns under another torque about the point where they are.

        Raises DeviceFault where no finger has seen the object since the grasp.
        """
        with self._look("estimate"):
            return self.measure() if self.state is None or not self.fingers else self._estimate(self.state)

    def _estimate(self, state: StateEstimator) -> PlanarState:
        for _ in range(self.tactile_frames):
            self._feel(state)
        extrinsic = self.see(("eo",))["eo"] if self.tags.get("eo") else None
        self._push_tag(state, "eo")
        now = state.state()
        if "tactile" not in now.ages:
            raise DeviceFault(
                ", ".join(finger.sensor.name for finger in self.fingers),
                "feel the grasped object",
                f"{now.status.value}: {now.reason}" if now.reason else now.status.value,
                "See to the fingers and the grasp, or take the pose from tags: --set trial.go_pose=tags",
            )
        self.felt = now
        self._told = self._planar(now, None if extrinsic is None else extrinsic.pose)
        self.drift = None if self._by_touch is None else self._by_touch.drift(self._told, now.go_covariance)
        return self._told

    def _feel(self, state: StateEstimator) -> None:
        """Take in one picture of each finger, and what arm and wrist have said until then."""
        pictures = [self.reads.capture(finger.sensor) for finger in self.fingers]
        self._hear(state)
        at = pictures[0].stamp.capture_ns
        prior = state.expected(at)
        found = fuse(prior, [f.method.estimate(image, prior) for f, image in zip(self.fingers, pictures, strict=True)])
        state.push_tactile(at, prior, found)

    def _hear(self, state: StateEstimator) -> None:
        """Take in what arm and wrist have said of late."""
        newest = self.reads.latest(self.arm)
        after = max(self._heard_ns, newest.stamp.capture_ns - _RECENT)
        poses, wrenches = [*self.reads.since(self.arm, after), newest], self.reads.since(self.wrist, after)
        for pose in poses:
            state.push_pose(pose)
        for reading in wrenches:
            state.push_wrench(reading)
        self._heard_ns = max([after, *(r.stamp.capture_ns for r in (*poses, *wrenches))])

    def _push_tag(self, state: StateEstimator, body: str) -> None:
        """Take in where a body's tags were seen last, once."""
        seen = self._seen.pop(body, None)
        if seen is not None:
            state.push_tag(body, *seen)

    def _planar(self, now: State, eo: Array | None) -> PlanarState:
        """A whole state as plans and `measure` have it: the wrench about the planned grasp centre on the go."""
        on_go = wrench.about(now.wrench, now.centre, se2.compose(now.go, self.grasp)[:2])
        return PlanarState(now.ee, now.go, eo, on_go)

    def state_now(self) -> State | None:
        """The whole state at a settled instant, after `measure`; None without a ``state`` estimator.

        It is the one that controllers were told of where there are fingers, and the tags' otherwise.
        """
        if self.state is None or self.fingers:
            return self.felt
        self._hear(self.state)
        for body in ("go", "eo"):
            self._push_tag(self.state, body)
        return self.state.state()

    def contact(self) -> ContactBelief | None:
        """Where the go is believed to be touched, of `state_now`; None where nobody looks for it."""
        with self._look("contact") as told:
            self._known = now = self.state_now()
            if now is not None:
                told["state"] = now.told()
        if now is None or now.contact is None:
            return None
        found = now.contact.hypotheses
        points = np.array([one.point for one in found]).reshape(-1, 2)
        return ContactBelief(now.contact.status.value, points, np.array([one.weight for one in found]))

    @property
    def estimated(self) -> PlanarState | None:
        """The state behind the newest `contact`, which takes no look of its own; None without a ``state`` estimator.

        From the fingers where there are some, as `estimate` told it, else from arm, wrist, tags and elasticity.
        """
        if self.fingers or self._known is None:
            return self._told
        return self._planar(self._known, self._known.eo)

    def second_opinion(self, measured: PlanarState) -> Agreement | None:
        """What the sensor under the table says of the wrench in ``measured``; None where it says nothing."""
        if self.witness is None or self._zero is None:
            return None
        now, X_W_s = self.wrist.latest().stamp.capture_ns, se2.compose(measured.ee, self.wrist_sensor.X_ee_s)
        readings = max(1, len(self.wrist.since(now - self.window_ns)))
        # its torque is of no interest here, so the load is told about any point
        load = wrench.rotated(measured.wrench * [1.0, 1.0, 0.0], -X_W_s[2])
        own = self._zero.covariance(ForceTorqueErrors(), self.wrist_sensor, now, measured.ee, load, readings)[:2, :2]
        R = se2.rotation(X_W_s[2])
        return self.witness.compare(now, measured.wrench, R @ own @ R.T)

    @property
    def slip(self) -> str:
        """What is known of the object slipping in the fingers in this grasp; empty where it has not."""
        return self.felt.reason if self.felt is not None and self.felt.status is PoseStatus.SLIPPED else ""

    def zero(self, load: FreeAirLoad, X_W_go: Array, *, seen: bool = True) -> None:
        """Take the offsets in free air: the wrist's, under the weight of a go at ``X_W_go`` alone, and the table's.

        How the go lies in the fingers from then on is held against how it does here; its tag tells only if ``seen``.
        """
        with self._look("zero", {"X_W_go": np.asarray(X_W_go, float).tolist()}):
            ee = self.arm_pose()
            self.wrist_sensor = self.wrist_sensor.zeroed(self.mean_reading(), ee, X_W_go, self.grasp, load)
            now = self.reads.latest(self.wrist).stamp.capture_ns
        self._zero = Zero(now, ee)
        if self.state is not None:
            self.state.wrist, self.state.zero = self.wrist_sensor, self._zero
        if self.witness is not None:
            self.witness.zero(now)
        weight = load.wrench_on_go(X_W_go, se2.compose(X_W_go, self.grasp)[:2])
        if self._by_tag is not None:
            self._by_tag.hangs(PlanarState(ee, X_W_go if seen else None, None, weight))
        if self._by_touch is not None and self.felt is not None and self._told is not None:
            self._by_touch.hangs(self._told, self.felt.go_covariance)


def _distrust(device: str, asked: str, status: Status) -> NoReturn:
    raise DeviceFault(device, asked, f"its readings are {status.name.lower()}", "See to the device, then run again")
