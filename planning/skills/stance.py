"""How a tilted polygon stands on the ground y = 0: on which of its points, and where."""

from __future__ import annotations

import numpy as np

from mechanics import se2
from mechanics.readings import Array

LEVEL = 1e-6
"""Vertices this close in height [m] are equally low."""

GROUND_NORMAL = (0.0, 1.0)


def lowest_points(vertices: Array, theta: float) -> Array:
    """Return the go's points (1, 2) or (2, 2), in its frame, that touch the ground when it is tilted by ``theta``.

    One corner, or both ends of the lowest face, left one first as seen in W.
    """
    turned = se2.rotate(theta, vertices)
    low = np.flatnonzero(turned[:, 1] <= turned[:, 1].min() + LEVEL)
    ends = [low[turned[low, 0].argmin()], low[turned[low, 0].argmax()]]
    if turned[ends[1], 0] - turned[ends[0], 0] <= LEVEL:
        return vertices[ends[:1]]
    return vertices[ends]


def pivot_corner(vertices: Array, theta: Array) -> Array:
    """Return the one vertex (2,), in the go's frame, on which the go stands at every tilt ``theta`` (K,) [rad].

    Raises ValueError naming ``angle_deg`` and the step where the go stands on a face, or on another corner.
    """
    corner: Array | None = None
    for k, angle in enumerate(theta):
        points = lowest_points(vertices, float(angle))
        if len(points) > 1:
            raise ValueError(
                f"angle_deg: step {k} ({np.rad2deg(angle):.4g}°): expected the go to stand on one corner, but a face"
                " lies on the ground there: keep the whole motion to one side of this angle"
            )
        if corner is None:
            corner = points[0]
        elif not np.array_equal(points[0], corner):
            raise ValueError(
                f"angle_deg: step {k} ({np.rad2deg(angle):.4g}°): expected the go to stay on the corner"
                f" {_spelled(corner)} of step 0, but {_spelled(points[0])} is lower there: shorten the motion"
            )
    assert corner is not None
    return corner


def standing_pose(vertex: Array, theta: Array, contact_x: float) -> Array:
    """Return X_W_go (K, 3) at tilts ``theta`` (K,) with the go's point ``vertex`` (2,) held at (contact_x, 0)."""
    theta = np.atleast_1d(np.asarray(theta, dtype=np.float64))
    offset = se2.rotate(theta, vertex)
    return np.column_stack([contact_x - offset[:, 0], -offset[:, 1], theta])


def _spelled(point: Array) -> str:
    return f"({point[0] * 1e3:.4g}, {point[1] * 1e3:.4g}) mm"
