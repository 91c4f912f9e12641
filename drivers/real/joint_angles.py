"""Joint angles that put a serial arm's flange somewhere, within the limits of its joints."""

from __future__ import annotations

from collections.abc import Callable
from math import acos, sin

import numpy as np

from mechanics.readings import Array

#: a pose is reached within these [m, rad]; no step of the iteration is longer [rad]
CLOSE, TURNED, LONGEST = 1e-4, 1e-3, 0.3
_DAMPING = 1e-4
_STEPS = 60


def joint_angles(
    forward: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    start: Array,
    goal: Array,
    limits: tuple[Array, Array],
) -> tuple[Array, bool]:
    """Joint angles (n,) [rad] at ``goal`` X_O_F (4, 4), sought from ``start`` (n,), and whether they are there.

    ``forward(q)`` is X_O_F (4, 4), ``jacobian(q)`` (6, n) its derivative, velocity above angular velocity, in O.
    Damped least squares, Δq = Jᵀ(J Jᵀ + λ)⁻¹ e, each step cut off at the ``limits`` (low (n,), high (n,)).
    """
    low, high = limits
    q = np.clip(start, low, high)
    for _ in range(_STEPS):
        error = pose_error(forward(q), goal)
        if np.linalg.norm(error[:3]) < CLOSE and np.linalg.norm(error[3:]) < TURNED:
            return q, True
        J = jacobian(q)
        # a joint that rests at its limit and is pushed against it does not take part
        step = _damped(J, error)
        stuck = ((q <= low) & (step < 0)) | ((q >= high) & (step > 0))
        if stuck.any():
            step = _damped(np.where(stuck, 0.0, J), error)
        q = np.clip(q + step * min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-12)), low, high)
    return q, False


def _damped(J: Array, error: Array) -> Array:
    return J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), error)


def pose_error(X: Array, goal: Array) -> Array:
    """What leads from ``X`` (4, 4) to ``goal`` (4, 4): translation and rotation vector (6,) in their common frame."""
    R = goal[:3, :3] @ X[:3, :3].T
    axial = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    angle = acos(float(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0)))
    scale = angle / sin(angle) if 1e-6 < angle < np.pi - 1e-6 else 1.0
    return np.concatenate([goal[:3, 3] - X[:3, 3], scale * axial])
