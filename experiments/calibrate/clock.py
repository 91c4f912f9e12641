"""Stage `calibrate_clock`: how much later than the arm's pose each stream is stamped, from a common motion.

The arm turns to and fro in free air. Its own angle is the reference; the wrist sensor feels the tool's weight turn, and
the camera sees the tag of the held object turn.
"""

from __future__ import annotations

import numpy as np

from estimation.clock_fit import DelayFit, fit_delay
from estimation.tag_pose import estimate_planar_pose
from experiments.calibrate import store
from experiments.calibrate.models import ClockCalibration, Delay
from experiments.calibrate.rig import Rig, at_hand
from experiments.calibrate.schema import ClockStage
from experiments.context import RunContext
from mechanics.readings import Array, Status
from mechanics.task_plane import TaskPlane

#: the second, faster motion on top of the first: what repeats itself once only has one delay
FASTER, SMALLER = 2.7, 0.35


def clock_stage(context: RunContext, stage: ClockStage) -> None:
    """Find the delays and keep them. Raises FitError where a stream does not follow the motion."""
    with at_hand(context, "the clocks") as rig:
        rig.lift_to(rig.start[1] + context.resolved.grasped.polygon.bounding_radius)
        streams = _swung(rig, stage)
        rig.home()
    arm_ns, arm = streams.pop("arm")
    fits = {name: fit_delay(arm_ns, arm, stamps, values) for name, (stamps, values) in streams.items()}
    devices = ("arm", *streams)
    context.calibrated(
        ClockCalibration(
            origin=store.origin(
                context.resolved, tuple(_device(rig, name) for name in devices), (), context.folder.path.name
            ),
            delays={name: _delay(fit) for name, fit in fits.items()},
        )
    )


def _device(rig: Rig, stream: str) -> str:
    devices = rig.devices
    return {"arm": devices.arm, "wrist": devices.force_torque("wrist"), "camera": devices.camera}[stream].name


def _delay(fit: DelayFit) -> Delay:
    return Delay(delay=fit.delay, deviation=fit.sigma)


def _swung(rig: Rig, stage: ClockStage) -> dict[str, tuple[Array, Array]]:
    """Swing, and record every stream: stamps [ns] and one number that follows the angle."""
    devices, mover, observer = rig.devices, rig.mover, rig.observer
    at = mover.pose
    rate = 2 * np.pi / stage.period
    begin = devices.clock.now_ns()
    seen: list[tuple[int, float]] = []
    last_frame = begin

    def angle(t: float) -> float:
        fade = min(1.0, t / stage.period, (stage.seconds - t) / stage.period)
        swing = np.sin(rate * t) + SMALLER * np.sin(FASTER * rate * t)
        return float(np.radians(stage.angle_deg) * fade * swing / (1 + SMALLER))

    period = 1 / rig.context.settings.control_rate
    ticks = round(stage.seconds / period)
    with rig.context.progress.steps("swing of the arm", ticks) as advance:
        for i in range(1, ticks + 1):
            t = i * period
            speed = (angle(t + 1e-4) - angle(t - 1e-4)) / 2e-4
            mover.follow(at + angle(t) * np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, speed]))
            frames = [devices.camera.capture()] if devices.clock.lockstep and i % 3 == 0 else []
            if not devices.clock.lockstep:
                frames = devices.camera.since(last_frame)
            for frame in frames:
                last_frame = frame.stamp.capture_ns
                found = estimate_planar_pose(observer.camera_model, frame.detections, observer.tags["go"])
                if frame.stamp.status is Status.OK and found is not None:
                    seen.append((last_frame, float(found.pose[2])))
            advance()
    poses = [r for r in devices.arm.since(begin) if r.stamp.status is Status.OK]
    wrenches = [r for r in devices.force_torque("wrist").since(begin) if r.stamp.status is Status.OK]
    across = TaskPlane().wrench_to_planar(np.array([r.wrench for r in wrenches]).reshape(-1, 6))[:, 0]
    return {
        "arm": (_stamps(poses), np.array([r.pose[2] for r in poses])),
        "wrist": (_stamps(wrenches), across),
        "camera": (np.array([ns for ns, _ in seen]), np.array([value for _, value in seen])),
    }


def _stamps(readings: list) -> Array:
    return np.array([r.stamp.capture_ns for r in readings])
