"""Grasped object sliding: the grasped object slides over the ground on the corner it stands on."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from planning.problem import Form, Limits, LossWeights
from planning.skills import on_ground, stance
from planning.skills.base import (
    Angle,
    Disturbance,
    PositiveRamp,
    Scene,
    Skill,
    SkillParameters,
    SkillTask,
    Steps,
    ramp,
    register,
)
from planning.skills.on_object import slip_of_travel


class SlidingParameters(SkillParameters):
    """Grasped sliding.

    ``travel_mm`` how far the corner slides, to the right (negative: to the left); ``angle_deg`` the go's tilt,
    counter-clockwise; ``force`` the normal force of the ground on the go [N], one figure or first and last: friction
    adds µ times it, against the motion; ``steps`` how many waypoints; ``contact_x`` [m] where on the ground the corner
    begins; ``disturbance`` [N] that the contact has to bear.
    """

    travel_mm: Annotated[float, Field(ge=-2000, le=2000)] = 40.0
    angle_deg: Angle = 40.0
    force: PositiveRamp = (4.0, 4.0)
    steps: Steps = 20
    contact_x: float = 0.0
    disturbance: Disturbance = 0.0


@register
class GraspedSliding(Skill):
    """The go's lowest corner, or the face it lies on, slips on the ground."""

    name: ClassVar[str] = "grasped_sliding"
    Parameters = SlidingParameters

    @staticmethod
    def task(
        parameters: SlidingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps, held = parameters.steps, scene.held
        mode = slip_of_travel(parameters.travel_mm)
        f_n = ramp(parameters.force, steps)
        theta = np.full(steps, np.deg2rad(parameters.angle_deg))
        return on_ground.grounded_task(
            GraspedSliding.name,
            held,
            stance.lowest_points(held.vertices, float(theta[0])),
            theta,
            parameters.contact_x + ramp((0.0, parameters.travel_mm * 1e-3), steps),
            mode,
            np.column_stack([f_n, mode.slip_sign * held.mu * f_n]),
            parameters.disturbance,
            form,
            weights,
            limits,
        )
