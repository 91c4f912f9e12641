"""Relative pivoting: the go turns about its contact with the extrinsic object, which does not move."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from planning.problem import Form, Limits, LossWeights
from planning.skills import on_object
from planning.skills.base import Angle, PositiveRamp, Ramp, Scene, Skill, SkillTask, ramp, register


class RelativePivotingParameters(on_object.LyingParameters):
    """Relative pivoting.

    ``tilt_deg`` the go's first and last tilt to the face (or from square to the corner's bisector), counter-clockwise;
    ``force`` the normal force on the eo [N] and ``tangential`` that along the contact's tangent, each one figure or
    first and last; By default the contact is in the middle of the
    face that looks up.
    """

    tilt_deg: tuple[Angle, Angle] = (10.0, 40.0)
    force: PositiveRamp = (3.0, 3.0)
    tangential: Ramp = (0.0, 0.0)


@register
class RelativePivoting(Skill):
    """The go's corner sticks to the eo, and the eo to the ground."""

    name: ClassVar[str] = "relative_pivoting"
    Parameters = RelativePivotingParameters
    needs_extrinsic: ClassVar[bool] = True

    @staticmethod
    def task(
        parameters: RelativePivotingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps = parameters.steps
        wish = np.column_stack([ramp(parameters.force, steps), ramp(parameters.tangential, steps)])
        tilt = np.deg2rad(ramp(parameters.tilt_deg, steps))
        return on_object.standing_still(RelativePivoting.name, parameters, scene, tilt, wish, form, weights, limits)
