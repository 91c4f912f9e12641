"""What the station measures at a settled instant: the arm gives ee, tags the objects, the wrist sensor the wrench."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from drivers.errors import DeviceFault, DeviceTimeout
from drivers.interfaces import Arm, ForceTorqueSensor, TactileSensor, TagCamera
from estimation.force_torque import FreeAirLoad, WristSensor, mean_wrench
from estimation.state import State, StateEstimator
from estimation.tactile_pose import PoseStatus, TactilePoseEstimator, fuse
from estimation.tag_pose import TagPose, estimate_planar_pose
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import Array, Status, TagDetection
from mechanics.records import PlanarState


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
    learns the go's pose from ``tactile_frames`` pictures of each finger, and never from its tag.
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
    #: the state behind the newest `estimate` from the fingers
    felt: State | None = None
    _heard_ns: int = -1

    def see(self, bodies: tuple[str, ...]) -> dict[str, TagPose | None]:
        """Poses in W of the named bodies from fresh camera frames; None where none of its tags was seen."""
        detections: list[TagDetection] = []
        frames = [self.camera.capture() for _ in range(self.frames)]
        trusted = [frame for frame in frames if frame.stamp.status is Status.OK]
        if not trusted:
            _distrust(self.camera.name, "see the tags", frames[-1].stamp.status)
        for frame in trusted:
            detections += frame.detections
        return {
            body: estimate_planar_pose(self.camera_model, tuple(detections), self.tags.get(body, ())) for body in bodies
        }

    def arm_pose(self) -> Array:
        """X_W_ee (3,) now. Raises DeviceFault where the arm's own reading is not to be trusted."""
        reading = self.arm.latest()
        if reading.stamp.status is not Status.OK:
            _distrust(self.arm.name, "read its pose", reading.stamp.status)
        return reading.pose

    def mean_reading(self) -> Array:
        """Mean (6,) of the wrist readings of the last window."""
        now = self.wrist.latest().stamp.capture_ns
        readings = self.wrist.since(now - self.window_ns)
        try:
            return mean_wrench(readings)
        except ValueError as reason:
            raise DeviceTimeout(
                self.wrist.name, "average the wrench", str(reason), "Check the sensor's status and cable"
            ) from None

    def measure(self) -> PlanarState:
        """Everything at this instant; the arm should be at rest."""
        ee = self.arm_pose()
        reading = self.mean_reading()
        seen = self.see(("go", "eo"))
        go = None if seen["go"] is None else seen["go"].pose
        eo = None if seen["eo"] is None else seen["eo"].pose
        grasp_centre = se2.compose(ee if go is None else go, np.zeros(3) if go is None else self.grasp)
        wrench = self.wrist_sensor.wrench_on_go(reading, ee, grasp_centre[:2])
        return PlanarState(ee, go, eo, wrench)

    def estimate(self) -> PlanarState:
        """What controllers act on, at this instant: from the fingers and the elasticity where there are fingers.

        Raises DeviceFault where no finger has seen the object since the grasp.
        """
        if self.state is None or not self.fingers:
            return self.measure()
        for _ in range(self.tactile_frames):
            self._feel(self.state)
        extrinsic = self.see(("eo",))["eo"] if self.tags.get("eo") else None
        now = self.state.state()
        if "tactile" not in now.ages:
            raise DeviceFault(
                ", ".join(finger.sensor.name for finger in self.fingers),
                "feel the grasped object",
                f"{now.status.value}: {now.reason}" if now.reason else now.status.value,
                "See to the fingers and the grasp, or take the pose from tags: --set trial.go_pose=tags",
            )
        self.felt = now
        return PlanarState(now.ee, now.go, None if extrinsic is None else extrinsic.pose, now.wrench)

    def _feel(self, state: StateEstimator) -> None:
        """Take in one picture of each finger, and what arm and wrist have said until then."""
        pictures = [finger.sensor.capture() for finger in self.fingers]
        readings = [*self.arm.since(self._heard_ns), self.arm.latest()]
        for pose in readings:
            state.push_pose(pose)
        wrenches = self.wrist.since(self._heard_ns)
        for wrench in wrenches:
            state.push_wrench(wrench)
        heard = [r.stamp.capture_ns for r in (*readings, *wrenches)]
        self._heard_ns = max([self._heard_ns, *heard])
        at = pictures[0].stamp.capture_ns
        prior = state.expected(at)
        found = fuse(prior, [f.method.estimate(image, prior) for f, image in zip(self.fingers, pictures, strict=True)])
        state.push_tactile(at, prior, found)

    @property
    def slip(self) -> str:
        """What is known of the object slipping in the fingers in this grasp; empty where it has not."""
        return self.felt.reason if self.felt is not None and self.felt.status is PoseStatus.SLIPPED else ""

    def zero(self, load: FreeAirLoad, X_W_go: Array) -> None:
        """Take the wrist sensor's offset in free air, with the go at ``X_W_go`` and only its weight on the sensor."""
        ee = self.arm_pose()
        self.wrist_sensor = self.wrist_sensor.zeroed(self.mean_reading(), ee, X_W_go, self.grasp, load)
        if self.state is not None:
            self.state.wrist = self.wrist_sensor


def _distrust(device: str, asked: str, status: Status) -> NoReturn:
    raise DeviceFault(device, asked, f"its readings are {status.name.lower()}", "See to the device, then run again")
