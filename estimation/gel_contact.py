"""A gel's deformation as a picture for the paper's own edge detector (`estimation.tactile_pose_icp`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.deformation import Unusable
from estimation.gel_deformation import CLEAR_CONTRAST, GelReference, deformation, distrusted
from estimation.gel_markers import on_plane
from estimation.tactile_pose import FingerModel, PoseStatus
from mechanics.readings import Array, ImageReading


@dataclass(frozen=True, eq=False)
class GelContactView:
    """The deformation field: how far the shading is from that of the untouched gel.

    ``picture`` (h, w): 0 where the surface is level, 255 where its shading differs by three times a clear contrast. A
    flat face is level as well: what shows is the wall beside it, whose inner side is the object's edge.
    """

    picture: NDArray[np.uint8]
    finger: FingerModel
    height: float

    def points(self, pixels: ArrayLike) -> Array:
        """Points (..., 2) [m] in the finger's x and y of ``pixels`` (..., 2), on the plane of the face."""
        return on_plane(self.finger, pixels, self.height)


class GelContact:
    """Turns a gel finger's readings into their `GelContactView`, or says why it cannot."""

    def __init__(self, finger: FingerModel):
        """Raises ValueError for a finger whose reference is no picture of a gel."""
        self._finger = finger
        self._reference = GelReference.of_finger(finger)
        self._height = 1e-3 * float(finger.described.get("indentation_mm", 0.8))

    def read(self, image: ImageReading) -> GelContactView | Unusable:
        """What the picture shows of the contact."""
        doubt = distrusted(image)
        if doubt is not None:
            return Unusable(*doubt)
        found = deformation(image.image, self._reference)
        if found.status is not PoseStatus.OK:
            return Unusable(found.status, found.reason)
        shade = np.clip(found.size * (255 / (3 * CLEAR_CONTRAST)), 0, 255)
        return GelContactView(shade.astype(np.uint8), self._finger, self._height)
