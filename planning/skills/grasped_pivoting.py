"""Grasped object pivoting: the grasped object turns about the corner it stands on, at constant or ramped force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from mechanics.readings import Array
from planning.skills import stance
from planning.skills.base import PositiveRamp, Skill, SkillParameters, ramp, register
from planning.task import Task

Angle = Annotated[float, Field(ge=-180, le=180)]


class PivotingParameters(SkillParameters):
    """Grasped pivoting.

    ``angle_deg`` the go's first and last tilt, counter-clockwise; ``force`` the normal force of the ground on the
    go [N], one figure or first and last; ``steps`` how many waypoints; ``contact_x`` [m] where on the ground the corner
    stands.
    """

    angle_deg: tuple[Angle, Angle] = (10.0, 35.0)
    force: PositiveRamp = (4.0, 4.0)
    steps: int = Field(default=20, ge=1, le=10_000)
    contact_x: float = 0.0


@register
class GraspedPivoting(Skill):
    """The go turns about its lowest corner, which sticks and must stay the lowest."""

    name: ClassVar[str] = "grasped_pivoting"
    Parameters: ClassVar[type[SkillParameters]] = PivotingParameters

    @staticmethod
    def task(
        parameters: PivotingParameters,
        *,
        polygon_vertices: Sequence[Sequence[float]] | Array,
        mass: float,
        grasp: Sequence[float] | Array,
        stiffness: Sequence[Sequence[float]] | Array,
        mu: float,
        gravity: float = 9.81,
    ) -> Task:
        """Return the task; see `planning.skills.base.Skill.task`."""
        vertices = stance.checked_vertices(polygon_vertices)
        theta = np.deg2rad(ramp(parameters.angle_deg, parameters.steps))
        corner = stance.pivot_corner(vertices, theta)
        force = np.column_stack([ramp(parameters.force, len(theta)), np.zeros(len(theta))])
        return Task(
            skill=GraspedPivoting.name,
            go=stance.standing_pose(corner, theta, parameters.contact_x),
            contacts=stance.sticking_ground_contacts(corner[None], mu, force),
            X_go_gocf=np.asarray(grasp, dtype=np.float64),
            mass=mass,
            stiffness=np.asarray(stiffness, dtype=np.float64),
            gravity=gravity,
        )
