"""Grasped object pivoting: the grasped object turns about the corner it stands on, at constant or ramped force."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from planning.skills import stance
from planning.skills.base import Held, PositiveRamp, Skill, SkillParameters, ramp, register
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
    def task(parameters: PivotingParameters, held: Held) -> Task:
        """Return the task; see `planning.skills.base.Skill.task`."""
        theta = np.deg2rad(ramp(parameters.angle_deg, parameters.steps))
        corner = stance.pivot_corner(held.vertices, theta)
        force = np.column_stack([ramp(parameters.force, len(theta)), np.zeros(len(theta))])
        go = stance.standing_pose(corner, theta, parameters.contact_x)
        return held.task(GraspedPivoting.name, go, stance.sticking_ground_contacts(corner[None], held.mu, force))
