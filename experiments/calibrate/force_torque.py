"""Stage `calibrate_force_torque`: what hangs on the wrist sensor, weighed by turning the arm in free air."""

from __future__ import annotations

import numpy as np

from estimation.tool_identification import identify_tool
from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import ForceTorqueCalibration
from experiments.calibrate.rig import at_hand
from experiments.calibrate.schema import ForceTorqueStage
from experiments.context import RunContext


def force_torque_stage(context: RunContext, stage: ForceTorqueStage) -> None:
    """Weigh the tool and keep it. Raises FitError where the readings do not tell."""
    with at_hand(context, "the wrist force/torque sensor") as rig:
        height = rig.start[1] + context.resolved.grasped.polygon.bounding_radius
        rig.lift_to(height)  # turned, the object reaches further down
        readings, poses, objects = [], [], []
        angles = np.radians(np.linspace(*stage.angle_deg, stage.orientations))
        with context.progress.steps("orientations", len(angles)) as advance:
            for angle in angles:
                rig.mover.travel(np.array([rig.start[0], height, angle]))
                rig.rest(0.3)
                reading, _ = rig.wrist_samples(stage.seconds)
                ee = rig.observer.arm_pose()
                readings.append(reading)
                poses.append(ee)
                objects.append(rig.hanging(ee))
                advance()
        wrist = rig.devices.force_torque("wrist")
        fit = identify_tool(
            np.array(readings),
            np.array(poses),
            wrist.describe().extra["pose"],
            setup.GRAVITY,
            setup.free_air_load(context.resolved),
            np.array(objects),
        )
        rig.home()
    deviation = fit.standard_errors
    x, y = fit.p_ee_tool.tolist()
    context.calibrated(
        ForceTorqueCalibration(
            origin=store.origin(context.resolved, (wrist.name,), (), context.folder.path.name),
            device=wrist.name,
            tool_mass=fit.mass,
            tool_centre=(x, y),
            deviation=tuple(deviation[:3].tolist()),
            residual=fit.residual_rms[0],
            samples=fit.samples,
        )
    )
