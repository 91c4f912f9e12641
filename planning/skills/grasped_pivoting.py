"""Grasped object pivoting: the grasped object turns about the corner it stands on, at constant or ramped force."""

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


class PivotingParameters(SkillParameters):
    """Grasped pivoting.

    ``angle_deg`` the go's first and last tilt, counter-clockwise; ``force`` the normal force of the ground on the
    go [N] and ``tangential`` its force along +x, each one figure or first and last; ``steps`` how many waypoints;
    ``contact_x`` [m] where on the ground the corner stands; ``disturbance`` [N] that the contact has to bear.
    """

    angle_deg: tuple[Angle, Angle] = (10.0, 35.0)
    force: PositiveRamp = (4.0, 4.0)
    tangential: Ramp = (0.0, 0.0)
    steps: Steps = 20
    contact_x: float = 0.0
    disturbance: Disturbance = 0.0


@register
class GraspedPivoting(Skill):
    """The go turns about its lowest corner, which sticks and must stay the lowest."""

    name: ClassVar[str] = "grasped_pivoting"
    Parameters = PivotingParameters

    @staticmethod
    def task(
        parameters: PivotingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps = parameters.steps
        theta = np.deg2rad(ramp(parameters.angle_deg, steps))
        return on_ground.grounded_task(
            GraspedPivoting.name,
            scene.held,
            stance.pivot_corner(scene.held.vertices, theta)[None],
            theta,
            np.full(steps, parameters.contact_x),
            Mode.STICK,
            np.column_stack([ramp(parameters.force, steps), ramp(parameters.tangential, steps)]),
            parameters.disturbance,
            form,
            weights,
            limits,
        )
