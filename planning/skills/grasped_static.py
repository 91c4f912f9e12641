"""Static in contact: the grasped object stands still while the force on the ground changes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from mechanics.friction import Mode
from planning.problem import Form, Limits, LossWeights
from planning.skills import on_ground, stance
from planning.skills.base import (
    Angle,
    Disturbance,
    PositiveRamp,
    Ramp,
    Scene,
    Skill,
    SkillParameters,
    SkillTask,
    Steps,
    ramp,
    register,
)


class StaticParameters(SkillParameters):
    """Static in contact.

    ``angle_deg`` the go's tilt, counter-clockwise; ``force`` the normal force of the ground on the go [N], first and
    last; ``tangential`` its force along +x [N], first and last; ``steps`` how many waypoints; ``contact_x`` [m] where
    on the ground the corner stands (the left one of a face); ``disturbance`` [N] that the contact has to bear.
    """

    angle_deg: Angle = 15.0
    force: PositiveRamp = (3.0, 5.0)
    tangential: Ramp = (0.0, 0.0)
    steps: Steps = 20
    contact_x: float = 0.0
    disturbance: Disturbance = 0.0


@register
class GraspedStatic(Skill):
    """The go stands on its lowest corner, or flat on a face whose two ends share the force evenly."""

    name: ClassVar[str] = "grasped_static"
    Parameters = StaticParameters

    @staticmethod
    def task(
        parameters: StaticParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps = parameters.steps
        theta = np.full(steps, np.deg2rad(parameters.angle_deg))
        return on_ground.grounded_task(
            GraspedStatic.name,
            scene.held,
            stance.lowest_points(scene.held.vertices, float(theta[0])),
            theta,
            np.full(steps, parameters.contact_x),
            Mode.STICK,
            np.column_stack([ramp(parameters.force, steps), ramp(parameters.tangential, steps)]),
            parameters.disturbance,
            form,
            weights,
            limits,
        )
