"""Extrinsic pushing: the go sticks to the side of the extrinsic object and pushes it over the ground."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, PositiveFloat

from mechanics import se2
from mechanics.friction import Mode
from planning.problem import Form, Limits, LossWeights, Touch
from planning.skills import on_object, outline
from planning.skills.base import Angle, Disturbance, Ramp, Scene, Skill, SkillTask, ramp, register


class ExtrinsicPushingParameters(on_object.LyingParameters):
    """Extrinsic pushing.

    ``distance_mm`` how far the eo goes, to the right (negative: to the left). ``height`` where the contact is on the
    side that is pushed, as a share of that face's length from its lower end, unless ``contact_mm`` says it.
    ``tilt_deg`` the go's tilt to the face, counter-clockwise; by default 45°, to that side which has the go upright.
    ``tangential`` the force along the contact's tangent [N], one figure or first and last. The normal force is what the
    ground's friction takes; ``force`` [N] asks for a figure, and is refused where the friction takes another.
    ``disturbance`` [N] of shear that the contact has to bear: the ground's friction leaves no other.
    """

    distance_mm: on_object.Millimetres = 30.0
    height: Annotated[float, Field(gt=0, lt=1)] = 0.75
    tilt_deg: Angle | None = None
    force: PositiveFloat | None = None
    tangential: Ramp = (0.0, 0.0)
    disturbance: Disturbance = 0.4


@register
class ExtrinsicPushing(Skill):
    """The go sticks to the eo, whose face slips on the ground."""

    name: ClassVar[str] = "extrinsic_pushing"
    Parameters = ExtrinsicPushingParameters
    needs_extrinsic: ClassVar[bool] = True

    @staticmethod
    def task(
        parameters: ExtrinsicPushingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        extrinsic, steps = on_object.extrinsic_of(scene, ExtrinsicPushing.name), parameters.steps
        vertices = outline.straightened(extrinsic.vertices)
        lies = on_object.lying(vertices, np.deg2rad(parameters.eo_angle_deg), parameters.ground_x)
        right = parameters.distance_mm >= 0
        mode = Mode.SLIP_NEGATIVE if right else Mode.SLIP_POSITIVE

        side = outline.facing(vertices, se2.rotate(-lies.eo[2], np.array([-1.0 if right else 1.0, 0.0])))
        # seen from outside, e leads up the left side and down the right one
        place = outline.on_face(vertices, side, parameters.height if right else 1 - parameters.height)
        upper = (side if right else side + 1) % len(vertices)
        upright = -45.0 if right else 45.0
        if parameters.kind is Touch.FACE_ON_CORNER:
            upright = 0.0
        tilt = upright if parameters.tilt_deg is None else parameters.tilt_deg
        met = on_object.meeting(parameters, scene, np.deg2rad(tilt), place, upper)

        eo = np.tile(lies.eo, (steps, 1))
        eo[:, 0] += ramp((0.0, parameters.distance_mm * 1e-3), steps)
        statics = on_object.pushed(scene, eo, met, lies.ends, (on_object.LEFT, on_object.RIGHT), mode)
        f_t = ramp(parameters.tangential, steps)
        f_n = statics.pushing(f_t) if parameters.force is None else np.full(steps, parameters.force)
        wish = np.column_stack([f_n, f_t])
        statics.check(wish)
        problem = on_object.problem(
            ExtrinsicPushing.name,
            scene,
            met,
            statics,
            angle=np.full(steps, met.angle),
            travel=np.zeros(steps),
            mode=Mode.STICK,
            wish=wish,
            turns=False,
            form=form,
            weights=weights,
            limits=limits,
        )
        # on the ground's cone a push can only change along its edge
        along = np.array([mode.slip_sign * extrinsic.mu_ground, 1.0])
        push = np.tile(along / np.linalg.norm(along), (steps, 1))
        return SkillTask(problem, parameters.disturbance, push)
