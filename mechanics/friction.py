"""Coulomb friction at a point contact: modes, cones and projections.

**The sign convention, stated once.** At a contact the unit normal n points *into the body acted on*, and the tangent t
is n turned by −90°: t = (n_y, −n_x). A contact force f = (f_n, f_t) is the other body's force on the body acted on;
f_n ≥ 0 pushes. Modes say what the *other* body does as the acted-on body's contact point sees it:

* ``stick``: nothing; |f_t| ≤ µ f_n;
* ``slip+``: it moves along +t and drags the body along: f_t = +µ f_n;
* ``slip-``: it moves along −t: f_t = −µ f_n;
* ``free``: there is no contact: f = 0.

The acted-on body is the extrinsic object in P1 (the grasped object gets −f) and the grasped object in P2. On the ground
n = (0, 1) and t = (1, 0): a body that slides to the right sees the ground move along −t, which is ``slip-``, and is
held back by f_t = −µ f_n. ``slip+`` is the paper's ṡ⁻.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mechanics._shapes import Array, load


class Mode(StrEnum):
    """What a contact does; signs as in the module's convention."""

    STICK = "stick"
    SLIP_POSITIVE = "slip+"
    SLIP_NEGATIVE = "slip-"
    FREE = "free"

    @property
    def slip_sign(self) -> int:
        """+1 for ``slip+``, −1 for ``slip-``, otherwise 0: f_t = sign · µ f_n where it slips."""
        return {Mode.SLIP_POSITIVE: 1, Mode.SLIP_NEGATIVE: -1}.get(self, 0)


class ConeRows(NamedTuple):
    """A mode's linear description of f = (f_n, f_t): ``inequality`` @ f ≥ 0 and ``equality`` @ f = 0."""

    inequality: NDArray[np.float64]
    equality: NDArray[np.float64]


def tangent(normal: Array) -> Array:
    """Return t (..., 2), the normal turned by −90°."""
    xp, normal = load("tangent", normal=(normal, (2,)))
    return xp.stack([normal[..., 1], -normal[..., 0]], axis=-1)


def cone_rows(mode: Mode, mu: float) -> ConeRows:
    """Return the rows that ``mode`` puts on (f_n, f_t) at a contact with friction coefficient ``mu``."""
    if not mu >= 0:
        raise ValueError(f"cone_rows: mu: expected a number ≥ 0, received {mu}")
    if mode is Mode.STICK:
        return ConeRows(np.array([[mu, -1.0], [mu, 1.0], [1.0, 0.0]]), np.empty((0, 2)))
    if mode is Mode.FREE:
        return ConeRows(np.empty((0, 2)), np.eye(2))
    return ConeRows(np.array([[1.0, 0.0]]), np.array([[-mode.slip_sign * mu, 1.0]]))


def cone_margin(force: Array, mu: Array) -> Array:
    """Return the signed distance (...) [N] of ``force`` (..., 2) to the boundary of the cone: positive inside."""
    xp, force, mu = load("cone_margin", force=(force, (2,)), mu=(mu, ()))
    normal, side = force[..., 0], xp.abs(force[..., 1])
    to_edge = (mu * normal - side) / xp.sqrt(1 + mu * mu)
    beyond_apex = normal + mu * side < 0
    safe = xp.where(beyond_apex, normal * normal + side * side, xp.ones_like(normal))
    return xp.where(beyond_apex, -xp.sqrt(safe), to_edge)


def in_cone(force: Array, mu: Array, tolerance: float = 0.0) -> Array:
    """Return whether (...) each ``force`` (..., 2) lies in the cone, or within ``tolerance`` [N] of it."""
    return cone_margin(force, mu) >= -tolerance


def required_friction(force: Array) -> Array:
    """Return |f_t| / f_n (...), the least µ that carries ``force`` (..., 2): 0 for no force, ∞ for one that pulls."""
    xp, force = load("required_friction", force=(force, (2,)))
    normal, side = force[..., 0], xp.abs(force[..., 1])
    pushes = normal > 0
    ratio = side / xp.where(pushes, normal, xp.ones_like(normal))
    nothing = (normal == 0) & (side == 0)
    return xp.where(pushes, ratio, xp.where(nothing, xp.zeros_like(side), xp.full_like(side, xp.inf)))


def project_to_cone(force: Array, mu: Array, weights: Array = (1.0, 1.0)) -> Array:
    """Return the point (..., 2) of the friction cone that is nearest to ``force`` (..., 2).

    Nearest in ½ Σ w (Δf)²; ``weights`` (..., 2) are those of (f_n, f_t), positive.
    """
    xp, force, mu, weights = load("project_to_cone", force=(force, (2,)), mu=(mu, ()), weights=(weights, (2,)))
    edge = _project_to_edge(xp, force, xp.sign(force[..., 1]) * mu, weights)
    inside = xp.abs(force[..., 1]) <= mu * force[..., 0]
    return xp.where(inside[..., None], force, edge)


def project_to_mode(force: Array, mode: Mode, mu: Array, weights: Array = (1.0, 1.0)) -> Array:
    """Return the force (..., 2) that ``mode`` admits nearest to ``force`` (..., 2); weights as in `project_to_cone`."""
    if mode is Mode.STICK:
        return project_to_cone(force, mu, weights)
    xp, force, mu, weights = load("project_to_mode", force=(force, (2,)), mu=(mu, ()), weights=(weights, (2,)))
    if mode is Mode.FREE:
        return xp.zeros_like(force)
    return _project_to_edge(xp, force, mode.slip_sign * mu, weights)


def _project_to_edge(xp, force: Array, slope: Array, weights: Array) -> Array:
    """Return the nearest point of the ray {(s, slope·s): s ≥ 0}."""
    wn, wt = weights[..., 0], weights[..., 1]
    along = (wn * force[..., 0] + wt * slope * force[..., 1]) / (wn + wt * slope * slope)
    along = xp.where(along > 0, along, xp.zeros_like(along))
    return xp.stack([along, slope * along], axis=-1)
