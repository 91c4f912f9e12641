"""The cubic in time from one pose and twist to another, along which arms go to their set-points."""

from __future__ import annotations

from mechanics.readings import Array

#: pose (3,) and twist (3,) at an instant, the angle unwrapped
State = tuple[Array, Array]


def cubic(start: State, goal: State, T: float, s: float) -> State:
    """Pose and twist (3,) at the share ``s`` of the time ``T`` [s] that the way from ``start`` to ``goal`` takes."""
    (p, v), (q, w) = start, goal
    h = s - 1
    pose = (1 + 2 * s) * h * h * p + s * h * h * T * v + s * s * (3 - 2 * s) * q + s * s * h * T * w
    return pose, 6 * s * h * (p - q) / T + h * (3 * s - 1) * v + s * (3 * s - 2) * w
