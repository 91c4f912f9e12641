"""Planar wrenches (fx, fy, τ) [N, N, N·m]: a force and a torque about a point, in the axes of a frame.

The torque is counter-clockwise. Numpy or torch, any leading dimensions. A wrench and a twist about the same point in
the same axes pair to a power: fx·vx + fy·vy + τ·ω.
"""

from __future__ import annotations

from mechanics import se2
from mechanics._shapes import Array, load


def about(wrench: Array, p_from: Array, p_to: Array) -> Array:
    """Return ``wrench`` (..., 3), given about ``p_from``, about ``p_to``; points (..., 2) [m] in the wrench's axes."""
    xp, wrench, p_from, p_to = load("about", wrench=(wrench, (3,)), p_from=(p_from, (2,)), p_to=(p_to, (2,)))
    arm = p_from - p_to
    fx, fy, torque = wrench[..., 0], wrench[..., 1], wrench[..., 2]
    return xp.stack([fx, fy, torque + arm[..., 0] * fy - arm[..., 1] * fx], axis=-1)


def rotated(wrench_B: Array, theta_AB: Array) -> Array:
    """Return the wrench (..., 3) in the axes of A, given it in the axes of B, about the same point.

    ``theta_AB`` (...) [rad] is the angle of B in A.
    """
    xp, wrench_B, theta_AB = load("rotated", wrench_B=(wrench_B, (3,)), theta_AB=(theta_AB, ()))
    force = se2.rotate(theta_AB, wrench_B[..., :2])
    return xp.concat([force, wrench_B[..., 2:]], axis=-1)


def transform(X_AB: Array, wrench_B: Array) -> Array:
    """Return the wrench (..., 3) about A's origin in A's axes, given it about B's origin in B's axes."""
    xp, X_AB, wrench_B = load("transform", X_AB=(X_AB, (3,)), wrench_B=(wrench_B, (3,)))
    turned = rotated(wrench_B, X_AB[..., 2])
    return about(turned, X_AB[..., :2], xp.zeros_like(X_AB[..., :2]))
