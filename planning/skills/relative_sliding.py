"""Relative sliding: the go slides along the extrinsic object, which does not move."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from planning.problem import Form, Limits, LossWeights
from planning.skills import on_object
from planning.skills.base import Angle, PositiveRamp, Scene, Skill, SkillTask, ramp, register


class RelativeSlidingParameters(on_object.LyingParameters):
    """Relative sliding.

    ``travel_mm`` how far the contact moves on the touched face, along the face's outward normal turned by −90° (to the
    right on a face that looks up; negative: the other way); it is centred on the contact point. ``tilt_deg`` as in
    static in contact; ``force`` the normal force on the eo [N], one figure or first and last: friction adds µ times
    it.
    """

    travel_mm: on_object.Millimetres = 30.0
    tilt_deg: Angle = 20.0
    force: PositiveRamp = (3.0, 3.0)


@register
class RelativeSliding(Skill):
    """The go slips on the eo, which sticks to the ground."""

    name: ClassVar[str] = "relative_sliding"
    Parameters = RelativeSlidingParameters
    needs_extrinsic: ClassVar[bool] = True

    @staticmethod
    def task(
        parameters: RelativeSlidingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps, half = parameters.steps, parameters.travel_mm * 0.5e-3
        mode = on_object.slip_of_travel(half)
        f_n = ramp(parameters.force, steps)
        mu = on_object.extrinsic_of(scene, RelativeSliding.name).mu_object
        wish = np.column_stack([f_n, mode.slip_sign * mu * f_n])
        tilt = np.full(steps, np.deg2rad(parameters.tilt_deg))
        return on_object.standing_still(
            RelativeSliding.name, parameters, scene, tilt, wish, form, weights, limits, ramp((-half, half), steps), mode
        )
