"""Static in contact: the grasped object stands still while the force on the ground changes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from planning.skills import stance
from planning.skills.base import Held, PositiveRamp, Ramp, Skill, SkillParameters, ramp, register
from planning.task import Task


class StaticParameters(SkillParameters):
    """Static in contact.

    ``angle_deg`` the go's tilt, counter-clockwise; ``force`` the normal force of the ground on the go [N], first and
    last; ``tangential`` its force along +x [N], first and last; ``steps`` how many waypoints; ``contact_x`` [m] where
    on the ground the corner stands (the left one of a face).
    """

    angle_deg: float = Field(default=15.0, ge=-180, le=180)
    force: PositiveRamp = (3.0, 5.0)
    tangential: Ramp = (0.0, 0.0)
    steps: int = Field(default=20, ge=1, le=10_000)
    contact_x: float = 0.0


@register
class GraspedStatic(Skill):
    """The go stands on its lowest corner, or flat on a face whose two ends share the force evenly."""

    name: ClassVar[str] = "grasped_static"
    Parameters: ClassVar[type[SkillParameters]] = StaticParameters

    @staticmethod
    def task(parameters: StaticParameters, held: Held) -> Task:
        """Return the task; see `planning.skills.base.Skill.task`."""
        theta = np.full(parameters.steps, np.deg2rad(parameters.angle_deg))
        points = stance.lowest_points(held.vertices, theta[0])
        force = np.column_stack([ramp(parameters.force, len(theta)), ramp(parameters.tangential, len(theta))])
        go = stance.standing_pose(points[0], theta, parameters.contact_x)
        return held.task(GraspedStatic.name, go, stance.sticking_ground_contacts(points, held.mu, force))
