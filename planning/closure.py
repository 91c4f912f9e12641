"""Where everything is: the go's pose from the variables by closure of the contact, contact points and normals.

With X_W_E the eo's pose (P2: the environment's), e the touched face's outward normal turned by −90° and θ_go = θ_E +
angle, the first contact closes by construction:

    corner on face:  C_W = X_W_E (p_eo + travel e),  o_go = C_W − R(θ_go) p_go
    face on corner:  C_W = X_W_E (p_eo),             o_go = C_W − R(θ_go) (p_go + travel e)

A further contact is at its corner, wherever that is. A contact's normal points into the body acted on (P1: the eo, P2:
the go): it is the face's outward normal if that body does not own the face, else its negative. For every touch and for
P1 and P2 alike, travel that grows is ``slip-`` (`mechanics.friction`), travel that shrinks ``slip+``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mechanics import se2
from mechanics._shapes import Array, load
from mechanics.contact import gravity_wrench, jacobian
from mechanics.elasticity import Elasticity
from mechanics.friction import tangent
from mechanics.wrench import rotated
from planning.problem import ANGLE, TRAVEL, Form, ObjectContact, Problem, Touch

UP = (0.0, 1.0)


class Variables(NamedTuple):
    """z in SI: ``angle`` (..., K) [rad], ``travel`` (..., K) [m], ``v`` (..., K, 3) [N, N, –] or [m, m, rad]."""

    angle: Array
    travel: Array
    v: Array


@dataclass(frozen=True, eq=False)
class Placement:
    """``go`` and ``eo`` (..., K, 3); ``points`` and ``normals`` (..., K, C, 2) in W, the object contacts first, then
    those with the ground; ``grasp`` (..., K, 2) the grasp centre in W."""

    go: Array
    eo: Array
    points: Array
    normals: Array
    grasp: Array


def variables(problem: Problem, z: Array) -> Variables:
    """Return what ``z`` (..., K, 5) stands for."""
    _, z, scale = load("variables", z=(z, (5,)), scale=(problem.scale, (5,)))
    y = z * scale
    return Variables(y[..., ANGLE], y[..., TRAVEL], y[..., 2:])


def place(problem: Problem, angle: Array, travel: Array) -> Placement:
    """Return where everything is at ``angle`` [rad] and ``travel`` [m] (..., K)."""
    xp, angle, travel, eo = load("place", angle=(angle, ()), travel=(travel, ()), eo=(problem.eo, (3,)))
    first = problem.contacts[0]
    p_go, p_eo = _fixed(xp, first.p_go, travel), _fixed(xp, first.p_eo, travel)
    along = travel[..., None] * _fixed(xp, tangent(first.normal), travel)
    if first.touch is Touch.CORNER_ON_FACE:
        C, p_go = se2.transform(eo, p_eo + along), p_go + 0 * along
    else:
        C, p_go = se2.transform(eo, p_eo + 0 * along), p_go + along
    theta = eo[..., 2] + angle
    origin = C - se2.rotate(theta, p_go)
    go = xp.concat([origin, theta[..., None]], axis=-1)

    points, normals = [C], [_normal(problem, first, eo, theta)]
    for contact in problem.contacts[1:]:
        corner_of_go = contact.touch is Touch.CORNER_ON_FACE
        points.append(se2.transform(go, contact.p_go) if corner_of_go else se2.transform(eo, contact.p_eo))
        normals.append(_normal(problem, contact, eo, theta))
    for ground in problem.ground:
        points.append(se2.transform(eo, ground.p_eo))
        normals.append(xp.broadcast_to(_fixed(xp, UP, travel), C.shape))
    grasp = se2.transform(go, problem.grasp[:2])
    return Placement(go, eo, xp.stack(points, axis=-2), xp.stack(normals, axis=-2), grasp)


def eo_jacobian(placed: Placement) -> Array:
    """Return J (..., K, C, 2, 3) of every contact on the eo, moments about its origin, axes of W."""
    return jacobian(placed.normals, placed.points - placed.eo[..., None, :2])


def go_jacobian(problem: Problem, placed: Placement) -> Array:
    """Return J (..., K, C, 2, 3) of every contact on the go, moments about the grasp centre, axes of W.

    Negated in P1, where the go gets −f, and zero for contacts of the eo with the ground.
    """
    sign = [-1.0 if problem.eo_body else 1.0] * len(problem.contacts) + [0.0] * len(problem.ground)
    _, J, sign = load(
        "go_jacobian",
        J=(jacobian(placed.normals, placed.points - placed.grasp[..., None, :]), (2, 3)),
        sign=(sign, ()),
    )
    return sign[..., None, None] * J


def go_weight(problem: Problem, placed: Placement) -> Array:
    """Return τ_g,go (..., K, 3), the go's weight about the grasp centre, axes of W."""
    return gravity_wrench(problem.go_body.mass, placed.go[..., :2] - placed.grasp, problem.gravity)


def sensor_wrench(weight: Array, J_go: Array, forces: Array) -> Array:
    """Return w_ext = −τ_g,go − Σ J_goᵀ f (..., K, 3), which balances the go under ``forces`` (..., K, C, 2)."""
    return -weight - (J_go * forces[..., None]).sum(-2).sum(-2)


def nominal_start(problem: Problem) -> np.ndarray:
    """Return z (K, 5) at the nominal values. v is the wished force; in the paper form the displacement that balances
    the go under it."""
    v = np.zeros((problem.steps, 3))
    if problem.form is Form.CLOSED:
        v[:, :2] = sum(contact.wish for contact in problem.contacts)
    else:
        placed = place(problem, problem.angle, problem.travel)
        forces = np.zeros(placed.points.shape)
        for c, contact in enumerate(problem.contacts):
            forces[:, c] = contact.wish
        w = sensor_wrench(go_weight(problem, placed), go_jacobian(problem, placed), forces)
        v = Elasticity(problem.stiffness).displacement(rotated(w, -(placed.go[:, 2] + problem.grasp[2])))
    return np.column_stack([problem.angle, problem.travel, v]) / problem.scale


def _normal(problem: Problem, contact: ObjectContact, eo: Array, theta_go: Array) -> Array:
    """Return (..., K, 2) in W, into the body acted on."""
    eo_owns_face = contact.touch is Touch.CORNER_ON_FACE
    eo_acted_on = problem.eo_body is not None
    theta = eo[..., 2] if eo_owns_face else theta_go
    return se2.rotate(theta, -contact.normal if eo_owns_face == eo_acted_on else contact.normal)


def _fixed(xp: Any, value: Any, like: Array) -> Array:
    """A constant of the problem as an array like ``like``."""
    return xp.asarray(np.array(value, dtype=np.float64), dtype=like.dtype, device=like.device)
