"""Static in contact: the go stands still on the extrinsic object while its force on it changes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from planning.problem import Form, Limits, LossWeights
from planning.skills import on_object
from planning.skills.base import Angle, PositiveRamp, Ramp, Scene, Skill, SkillTask, ramp, register


class StaticInContactParameters(on_object.LyingParameters):
    """Static in contact with an extrinsic object.

    ``tilt_deg`` the go's tilt to the face (or from square to the corner's bisector), counter-clockwise; ``force`` the
    normal force on the eo [N], first and last; ``tangential`` its force along the contact's tangent (the normal into
    the eo turned by −90°) [N], first and last; By default the
    contact is in the middle of the face that looks up.
    """

    tilt_deg: Angle = 20.0
    force: PositiveRamp = (3.0, 5.0)
    tangential: Ramp = (0.0, 0.0)


@register
class StaticInContact(Skill):
    """The go sticks to the eo, and the eo to the ground."""

    name: ClassVar[str] = "static_in_contact"
    Parameters = StaticInContactParameters
    needs_extrinsic: ClassVar[bool] = True

    @staticmethod
    def task(
        parameters: StaticInContactParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        steps = parameters.steps
        wish = np.column_stack([ramp(parameters.force, steps), ramp(parameters.tangential, steps)])
        tilt = np.full(steps, np.deg2rad(parameters.tilt_deg))
        return on_object.standing_still(StaticInContact.name, parameters, scene, tilt, wish, form, weights, limits)
