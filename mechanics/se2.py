"""Planar rigid motions SE(2).

A pose X_AB = (x, y, θ) [m, m, rad] is the pose of frame B in frame A: its origin in A and its angle, counter-clockwise.
A twist is (vx, vy, ω). Every function takes numpy arrays or torch tensors with any leading dimensions (they broadcast)
and is differentiable in torch. Angles are kept as they add up, so that a trajectory stays continuous; `between` and
`log`, which measure a difference, answer with the angle in (−π, π].
"""

from __future__ import annotations

import math
from typing import Any

from mechanics._shapes import Array, load

_SERIES_BELOW = 0.3
"""Below this half angle [rad] sin(u)/u comes from its series, whose derivatives do not cancel; it is exact to 1 ulp."""


def wrap(angle: Array) -> Array:
    """Return ``angle`` (...) [rad] brought into (−π, π]; the derivative is 1 everywhere."""
    xp, angle = load("wrap", angle=(angle, ()))
    return angle - 2 * math.pi * xp.ceil((angle - math.pi) / (2 * math.pi))


def rotation(theta: Array) -> Array:
    """Return the rotation matrices (..., 2, 2) by ``theta`` (...) [rad]."""
    xp, theta = load("rotation", theta=(theta, ()))
    c, s = xp.cos(theta), xp.sin(theta)
    return xp.stack([xp.stack([c, -s], axis=-1), xp.stack([s, c], axis=-1)], axis=-2)


def matrix(X_AB: Array) -> Array:
    """Return the homogeneous matrices (..., 3, 3) of poses ``X_AB`` (..., 3)."""
    xp, X_AB = load("matrix", X_AB=(X_AB, (3,)))
    x, y, theta = _parts(X_AB)
    c, s, zero, one = xp.cos(theta), xp.sin(theta), xp.zeros_like(theta), xp.ones_like(theta)
    rows = [[c, -s, x], [s, c, y], [zero, zero, one]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def compose(X_AB: Array, X_BC: Array) -> Array:
    """Return X_AC (..., 3), the pose of C in A; angles add."""
    xp, X_AB, X_BC = load("compose", X_AB=(X_AB, (3,)), X_BC=(X_BC, (3,)))
    x, y, theta = _parts(X_AB)
    u, v, phi = _parts(X_BC)
    c, s = xp.cos(theta), xp.sin(theta)
    return xp.stack([x + c * u - s * v, y + s * u + c * v, theta + phi], axis=-1)


def inverse(X_AB: Array) -> Array:
    """Return X_BA (..., 3), the pose of A in B."""
    xp, X_AB = load("inverse", X_AB=(X_AB, (3,)))
    x, y, theta = _parts(X_AB)
    c, s = xp.cos(theta), xp.sin(theta)
    return xp.stack([-c * x - s * y, s * x - c * y, -theta], axis=-1)


def between(X_WA: Array, X_WB: Array) -> Array:
    """Return X_AB (..., 3), the pose of B as A sees it, with its angle in (−π, π]."""
    xp, X_WA, X_WB = load("between", X_WA=(X_WA, (3,)), X_WB=(X_WB, (3,)))
    x, y, theta = _parts(X_WA)
    u, v, phi = _parts(X_WB)
    c, s = xp.cos(theta), xp.sin(theta)
    return xp.stack([c * (u - x) + s * (v - y), c * (v - y) - s * (u - x), wrap(phi - theta)], axis=-1)


def exp(twist: Array) -> Array:
    """Return the pose (..., 3) reached by following the body ``twist`` (..., 3) for unit time."""
    xp, twist = load("exp", twist=(twist, (3,)))
    vx, vy, omega = _parts(twist)
    half = omega / 2
    ratio = _sine_ratio(xp, half)
    along, across = ratio * xp.cos(half), ratio * xp.sin(half)  # sin ω / ω and (1 − cos ω) / ω without cancellation
    return xp.stack([along * vx - across * vy, across * vx + along * vy, omega], axis=-1)


def log(pose: Array) -> Array:
    """Return the body twist (..., 3) with ω in (−π, π] whose `exp` is ``pose`` (..., 3)."""
    xp, pose = load("log", pose=(pose, (3,)))
    x, y, theta = _parts(pose)
    theta = wrap(theta)
    half = theta / 2
    stretch = xp.cos(half) / _sine_ratio(xp, half)
    return xp.stack([stretch * x + half * y, stretch * y - half * x, theta], axis=-1)


def adjoint(X_AB: Array) -> Array:
    """Return (..., 3, 3), which takes a twist seen in B (axes and origin of B) to the same twist seen in A."""
    xp, X_AB = load("adjoint", X_AB=(X_AB, (3,)))
    x, y, theta = _parts(X_AB)
    c, s, zero, one = xp.cos(theta), xp.sin(theta), xp.zeros_like(theta), xp.ones_like(theta)
    rows = [[c, -s, y], [s, c, -x], [zero, zero, one]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def interpolate(X_WA: Array, X_WB: Array, s: Array) -> Array:
    """Return the pose (..., 3) at fraction ``s`` (...) of the geodesic from A (s = 0) to B (s = 1), the short way."""
    xp, X_WA, X_WB, s = load("interpolate", X_WA=(X_WA, (3,)), X_WB=(X_WB, (3,)), s=(s, ()))
    return compose(X_WA, exp(xp.expand_dims(s, axis=-1) * log(between(X_WA, X_WB))))


def transform(X_AB: Array, p_BoP_B: Array) -> Array:
    """Return p_AoP_A (..., 2): points given in B, as seen in A [m]."""
    _, X_AB, p_BoP_B = load("transform", X_AB=(X_AB, (3,)), p_BoP_B=(p_BoP_B, (2,)))
    return X_AB[..., :2] + rotate(X_AB[..., 2], p_BoP_B)


def rotate(theta: Array, vector: Array) -> Array:
    """Return vectors (..., 2) turned by ``theta`` (...) [rad]."""
    xp, theta, vector = load("rotate", theta=(theta, ()), vector=(vector, (2,)))
    c, s = xp.cos(theta), xp.sin(theta)
    x, y = vector[..., 0], vector[..., 1]
    return xp.stack([c * x - s * y, s * x + c * y], axis=-1)


def _parts(pose: Array) -> tuple[Array, Array, Array]:
    return pose[..., 0], pose[..., 1], pose[..., 2]


def _sine_ratio(xp: Any, u: Array) -> Array:
    """Return sin(u)/u, smooth through 0 in value and in every derivative that torch takes."""
    small = xp.abs(u) < _SERIES_BELOW
    q = u * u
    series = 1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72 * (1 - q / 110 * (1 - q / 156)))))
    safe = xp.where(small, xp.ones_like(u), u)  # the branch not taken must stay finite: torch differentiates both
    return xp.where(small, series, xp.sin(safe) / safe)
