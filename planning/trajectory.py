"""From variables to residuals, around the backend: poses, contact programs, the sensor's wrench and the losses.

Every function takes numpy or torch and any leading dimensions before the K steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mechanics import se2
from mechanics._shapes import Array, load
from mechanics.contact import gravity_wrench
from mechanics.elasticity import Elasticity
from mechanics.wrench import rotated
from planning import closure, losses
from planning.closure import Placement, Variables
from planning.problem import Form, Problem
from planning.program import FREE, STICK, ContactProgram, codes


@dataclass(frozen=True, eq=False)
class Posed:
    """A problem at some z (..., K, 5): what is known before the programs are solved.

    ``weight`` τ_g,go and, in the paper form, ``wrench`` w_ext = K x (..., K, 3): on the go about the grasp centre, axes
    of W. ``go_jacobian`` (..., K, C, 2, 3) likewise, zero for contacts with the ground, negated in P1.
    """

    variables: Variables
    placed: Placement
    go_jacobian: Array
    weight: Array
    wrench: Array | None


def pose(problem: Problem, z: Array) -> Posed:
    """Return the problem at ``z`` (..., K, 5), numpy or torch."""
    variables = closure.variables(problem, z)
    placed = closure.place(problem, variables.angle, variables.travel)
    wrench = None
    if problem.form is Form.PAPER:
        in_gocf = Elasticity(problem.stiffness).wrench(variables.v)
        wrench = rotated(in_gocf, placed.go[..., 2] + float(problem.grasp[2]))
    return Posed(variables, placed, closure.go_jacobian(problem, placed), closure.go_weight(problem, placed), wrench)


def program(problem: Problem, z: Array) -> ContactProgram:
    """Return the contact programs at ``z`` (..., K, 5), numpy or torch, the leading dimensions as one: (B·K) steps."""
    return posed_program(problem, pose(problem, z))


def posed_program(problem: Problem, posed: Posed) -> ContactProgram:
    """Return the contact programs of a posed problem, the leading dimensions as one.

    f_des of the object contacts is v in the closed form, shared evenly by those that are not free at the step; else 0.
    U is 1 but for the object's contacts in the closed form. The slack's moment is about the grasp centre and weighs
    1/ρ_go² as much.
    """
    placed, n, C = posed.placed, len(problem.contacts), len(problem.contacts) + len(problem.ground)
    modes = mode_codes(problem)
    xp, v, modes_wide, mu = load(
        "program", v=(posed.variables.v, (3,)), modes=(modes, (C,)), mu=(contact_mu(problem), (C,))
    )
    closed, two_bodies = problem.form is Form.CLOSED, problem.eo_body is not None
    weights = np.ones((C, 2))
    desired = xp.zeros_like(placed.points)
    if closed:
        # what is asked for is shared evenly by those that touch
        touching = (modes_wide[..., :n] != FREE) * 1.0
        share = touching / xp.clip(touching.sum(-1), 1.0, None)[..., None]
        asked = share[..., None] * v[..., None, :2]
        desired = xp.concat([asked, desired[..., n:, :]], axis=-2)
        weights[:n] = problem.force_weight
    _, weights, _ = load("program", weights=(weights, (C, 2)), like=(desired, (C, 2)))

    def flat(array: Any, *tail: int) -> Any:
        return array.reshape((-1, *tail))

    batch = int(np.prod(placed.go.shape[:-2]))
    fields: dict[str, Any] = {}
    if two_bodies:
        assert problem.eo_body is not None
        eo_load = gravity_wrench(problem.eo_body.mass, xp.zeros_like(placed.eo[..., :2]), problem.gravity)
        fields = {"eo_jacobian": flat(closure.eo_jacobian(placed), C, 2, 3), "eo_load": flat(eo_load, 3)}
    if posed.wrench is not None:
        slack_weights = problem.slack_weight * np.array([1.0, 1.0, problem.go_body.rho**-2])
        fields |= {
            "go_jacobian": flat(posed.go_jacobian, C, 2, 3),
            "go_load": flat(posed.wrench + posed.weight, 3),
            "slack_weights": xp.asarray(slack_weights, dtype=v.dtype, device=v.device),
        }
    return ContactProgram(
        names=contact_names(problem),
        modes=np.tile(modes, (batch, 1)),
        desired=flat(desired, C, 2),
        mu=flat(mu, C),
        weights=flat(weights, C, 2),
        relaxed=(two_bodies,) * n + (False,) * (C - n),
        **fields,
    )


def contact_names(problem: Problem) -> tuple[str, ...]:
    """Return the contacts' names, those of the go first."""
    return tuple(contact.name for contact in (*problem.contacts, *problem.ground))


def contact_mu(problem: Problem) -> Array:
    """Return µ (C,) in the order of `contact_names`."""
    return np.array([contact.mu for contact in (*problem.contacts, *problem.ground)])


def mode_codes(problem: Problem) -> np.ndarray[Any, np.dtype[np.int8]]:
    """Return the modes (K, C) as codes, in the order of `contact_names`."""
    return codes([contact.modes for contact in (*problem.contacts, *problem.ground)]).T


def sensor(problem: Problem, posed: Posed, forces: Array) -> tuple[Array, Array]:
    """Return the sensor's wrench on the go about the grasp centre in axes of W, and X_W_ee, (..., K, 3) each.

    ``forces`` (..., K, C, 2). The closed form balances the go, the paper form displaces the end-effector by x.
    """
    elasticity, go = Elasticity(problem.stiffness), posed.placed.go
    if posed.wrench is not None:
        return posed.wrench, se2.compose(se2.compose(go, problem.grasp), posed.variables.v)
    wrench = closure.sensor_wrench(posed.weight, posed.go_jacobian, forces)
    return wrench, elasticity.ee_pose(go, problem.grasp, wrench)


def residuals(problem: Problem, posed: Posed, forces: Array) -> dict[str, Array]:
    """Return each loss's residuals (..., K, r), or (..., K−1, 3), weighted so that their squares sum to the loss.

    ``forces`` (..., K, C, 2). A loss of weight 0, or with nothing to measure, is left out.
    """
    weights, limits, rho, K = problem.weights, problem.limits, problem.go_body.rho, problem.steps
    n, y, go = len(problem.contacts), posed.variables, posed.placed.go
    xp, of_object, code = load(
        "residuals", forces=(forces[..., :n, :], (n, 2)), modes=(mode_codes(problem)[:, :n], (n,))
    )
    wrench, ee = sensor(problem, posed, forces)

    found: dict[str, Array] = {}
    if problem.eo_body is not None:
        nothing = xp.zeros_like(of_object[..., 0])
        found["cone"] = xp.where(code == STICK, losses.cone(of_object), nothing)
        found["pull"] = xp.where(code == FREE, nothing, losses.pull(of_object))
    wish = sum(contact.wish for contact in problem.contacts)
    found["force"] = losses.contact_force(of_object.sum(-2), wish)
    if weights.penetration:
        found["penetration"] = losses.penetration(y.angle, problem.angle_limits)
    if posed.wrench is not None:
        lacks = wrench - closure.sensor_wrench(posed.weight, posed.go_jacobian, forces)
        found["slack"] = losses.slack(lacks, rho)
    found["track"] = losses.track(y.angle, y.travel, problem.angle, problem.travel, rho)
    if K > 1:
        found["smooth"] = losses.smooth(go, rho)
    if limits.workspace is not None:
        found["workspace"] = losses.workspace(ee, limits.workspace)
    if limits.arm is not None:
        found["joints"] = losses.joints(ee, limits.arm)
    if limits.force is not None or limits.torque is not None:
        found["sensor"] = losses.sensor(wrench, limits.force, limits.torque)
    return {
        name: (getattr(weights, name) / (K - 1 if name == "smooth" else K)) ** 0.5 * value
        for name, value in found.items()
        if getattr(weights, name) > 0
    }
