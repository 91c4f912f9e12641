"""What the skills of a grasped object on the ground share: the problem P2."""

from __future__ import annotations

import numpy as np

from mechanics import se2
from mechanics.friction import Mode
from mechanics.readings import Array
from planning.problem import Form, Limits, LossWeights, ObjectContact, Problem, Touch
from planning.skills import stance, touch
from planning.skills.base import Held, SkillTask

FLAT_ROOM = 0.2
"""[rad] that are named as admissible to either side of a face on the ground, whose angle nothing may change."""


def grounded_task(
    skill: str,
    held: Held,
    points: Array,
    theta: Array,
    contact_x: Array,
    mode: Mode,
    wish: Array,
    disturbance: float,
    form: Form,
    weights: LossWeights,
    limits: Limits,
) -> SkillTask:
    """Return the task of a go that touches the ground with its ``points`` (1 or 2, 2), at tilts ``theta`` (K,) [rad].

    The first point is at ``contact_x`` (K,) [m], ``wish`` (K, 2) [N] is the ground's force on the go, which two points
    share evenly. P2: the environment is the ground, whose frame is W; nothing but the force is left to choose.
    """
    steps = len(theta)
    names = ("corner",) if len(points) == 1 else ("left corner", "right corner")
    spread = se2.rotate(float(theta[0]), points - points[0])
    contacts = tuple(
        ObjectContact(
            name=name,
            touch=Touch.CORNER_ON_FACE,
            p_go=point,
            p_eo=np.array([contact_x[0] + aside, 0.0]),
            normal=np.array(stance.GROUND_NORMAL),
            modes=(mode,) * steps,
            mu=held.mu,
            wish=wish / len(points),
        )
        for name, point, aside in zip(names, points, spread[:, 0], strict=True)
    )
    if len(points) == 1:
        angle_limits = np.array([touch.room_above_ground(held.vertices, points[0], 0.0, at) for at in theta])
    else:
        angle_limits = theta[:, None] + np.array([-1.0, 1.0]) * FLAT_ROOM
    problem = Problem(
        skill=skill,
        form=form,
        eo=np.zeros((steps, 3)),
        eo_body=None,
        go_body=held.body,
        grasp=held.grasp,
        stiffness=held.stiffness,
        contacts=contacts,
        ground=(),
        angle=theta,
        travel=contact_x - contact_x[0],
        free=np.tile(np.array([False, False, True, True, form is Form.PAPER]), (steps, 1)),
        angle_limits=angle_limits,
        weights=weights,
        limits=limits,
        gravity=held.gravity,
    )
    # what the force may vary by: along the normal, or where it slips along the edge of its cone
    push = np.tile([mode.slip_sign * held.mu, 1.0] / np.hypot(mode.slip_sign * held.mu, 1.0), (steps, 1))
    return SkillTask(problem, disturbance, push)
