"""What stands between the tag camera and the tags: the gripper's finger on the viewer's side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics.readings import Array

#: half width and half height [m] of a finger, seen by the tag camera: what its own camera sees of the membrane or gel
FINGER_HALF_SIZE = {"soft_bubble": (0.039, 0.050), "gelslim": (0.024, 0.019)}


@dataclass(frozen=True, slots=True)
class Screen:
    """An opaque box over the rectangle of ``half_size`` [m] about the origin of a frame at ``X_W`` (3,) in the plane.

    It reaches from ``back`` to ``front`` [m] in front of the task plane, toward the viewer.
    """

    X_W: Array
    half_size: tuple[float, float]
    back: float = 0.010
    front: float = 0.060

    @property
    def corners(self) -> Array:
        """The rectangle's corners (4, 2) in its own frame, counter-clockwise."""
        return np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * self.half_size
