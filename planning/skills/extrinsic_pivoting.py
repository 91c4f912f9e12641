"""Extrinsic pivoting: the go turns the extrinsic object about a vertex that sticks to the ground."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from mechanics import se2
from mechanics.friction import Mode
from mechanics.readings import Array
from planning.problem import Form, Limits, LossWeights, Touch
from planning.skills import on_object, outline, pivot_choice
from planning.skills.base import Angle, Disturbance, PositiveRamp, Scene, Skill, SkillTask, Steps, ramp, register
from planning.skills.support import Pushed
from planning.skills.touch import Meeting

#: a first turn of up to this [deg] is reached from the face the eo lies on; a larger one begins where the eo is tilted
FROM_FLAT = 1.0

Turn = Annotated[float, Field(ge=0, le=90)]


class ExtrinsicPivotingParameters(on_object.TouchParameters):
    """Extrinsic pivoting.

    ``pivot`` the end of the eo's lower face that it turns about: ``right`` turns it clockwise. ``angle_deg`` how far it
    is turned from lying at the first and the last step; a first turn of more than 1° begins with a tilted object, which
    something else has to hold until the go does. ``eo_angle_deg`` the angle at which it lies. ``force`` the normal
    force on the eo [N], one figure or first and last: its tangential part is what balances the weight about the pivot.
    ``from_apex_mm`` puts the contact this far from the highest corner, on the face away from the pivot, unless
    ``contact_mm`` says where; with neither, the contact is where the friction cones leave most room. ``tilt_deg`` the
    go's tilt to the face (or from square to the corner's bisector), counter-clockwise; by default the one of 10° to 30°
    to either side whose force passes nearest to the grasp centre. ``turns`` lets the optimiser change the tilt along
    the way, by default where that leaves the force's direction as it is: with a corner of the go on a face of the eo.
    ``ground_x`` [m] is where on the ground the pivot is. ``disturbance`` [N] of the go's force along contact→pivot,
    more and less, that the contacts have to bear.
    """

    pivot: Literal["right", "left"] = "right"
    angle_deg: tuple[Turn, Turn] = (0.3, 25.0)
    eo_angle_deg: Angle = 0.0
    force: PositiveRamp = (3.0, 3.0)
    from_apex_mm: PositiveFloat | None = None
    tilt_deg: Angle | None = None
    turns: bool | None = None
    steps: Steps = 40
    disturbance: Disturbance = 2.0


@register
class ExtrinsicPivoting(Skill):
    """The go sticks to the eo, and the pivot to the ground."""

    name: ClassVar[str] = "extrinsic_pivoting"
    Parameters = ExtrinsicPivotingParameters
    needs_extrinsic: ClassVar[bool] = True

    @staticmethod
    def task(
        parameters: ExtrinsicPivotingParameters,
        scene: Scene,
        form: Form = Form.CLOSED,
        weights: LossWeights = LossWeights(),
        limits: Limits = Limits(),
    ) -> SkillTask:
        """Return the task; see `planning.skills.base.Skill.task`."""
        extrinsic = on_object.extrinsic_of(scene, ExtrinsicPivoting.name)
        vertices = outline.straightened(extrinsic.vertices)
        lies = on_object.lying(vertices, np.deg2rad(parameters.eo_angle_deg), 0.0)
        right = parameters.pivot == "right"
        pivot = lies.ends[1 if right else 0]
        turned = np.deg2rad(ramp(parameters.angle_deg, parameters.steps)) * (-1 if right else 1)
        theta = lies.eo[2] + turned
        _check_pivot(vertices, pivot, theta)
        f_n = ramp(parameters.force, parameters.steps)
        name = on_object.RIGHT if right else on_object.LEFT

        def statics_of(met: Meeting) -> Pushed:
            eo = _about(pivot, theta, parameters.ground_x)
            return on_object.pushed(scene, eo, met, pivot[None], (name,), Mode.STICK)

        turns = parameters.kind is Touch.CORNER_ON_FACE if parameters.turns is None else parameters.turns
        met = pivot_choice.choose(parameters, scene, lies.eo[2], right, f_n, statics_of)
        statics = statics_of(met)
        wish = statics.balancing(f_n)

        def problem_of(statics: Pushed, wish: Array):
            return on_object.problem(
                ExtrinsicPivoting.name,
                scene,
                met,
                statics,
                angle=np.full(len(statics.eo), met.angle),
                travel=np.zeros(len(statics.eo)),
                mode=Mode.STICK,
                wish=wish,
                turns=turns,
                form=form,
                weights=weights,
                limits=limits,
            )

        problem = problem_of(statics, wish)
        statics.check(wish)
        rest = None
        if from_flat := parameters.angle_deg[0] <= FROM_FLAT:
            # full force at rest just lifts the far end
            single = replace(statics, eo=_about(pivot, lies.eo[2:], parameters.ground_x), point=statics.point[:1])
            single = replace(single, normal=statics.normal[:1])
            at_rest = single.balancing(f_n[:1])
            flat = replace(
                single, ground=lies.ends, names=(on_object.LEFT, on_object.RIGHT), modes=(Mode.STICK, Mode.STICK)
            )
            rest = problem_of(flat, at_rest)
            flat.check(at_rest)
        return SkillTask(
            problem,
            parameters.disturbance,
            on_object.toward(statics),
            rest=rest,
            back=True,
            supported=not from_flat,
        )


def _about(pivot: Array, theta: Array, ground_x: float) -> Array:
    """Poses X_W_eo (K, 3) at angles ``theta`` (K,) with the point ``pivot`` (2,) at (ground_x, 0)."""
    away = se2.rotate(theta, pivot)
    return np.column_stack([ground_x - away[:, 0], -away[:, 1], theta])


def _check_pivot(vertices: Array, pivot: Array, theta: Array) -> None:
    """Raise ValueError naming ``angle_deg`` and the step where another corner of the eo is below its pivot."""
    for k, angle in enumerate(theta):
        heights = se2.rotate(float(angle), vertices - pivot)[:, 1]
        if heights.min() < -1e-6:
            lowest = vertices[int(heights.argmin())] * 1e3
            raise ValueError(
                f"angle_deg: step {k}: expected the object to turn about ({pivot[0] * 1e3:.4g}, {pivot[1] * 1e3:.4g})"
                f" mm, but its corner ({lowest[0]:.4g}, {lowest[1]:.4g}) mm is lower there: shorten the motion"
            )
