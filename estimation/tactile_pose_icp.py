"""The paper's own tactile pose (*Tactile State-Estimation*): edges of the contact, aligned point to point.

Canny finds the edges in a picture of where the finger touches, and the alignment step of ICP lays the outline on them
by the L2 distance of corresponding points. The baseline that the better methods stand beside: where the contact ends
without an edge of the object, Canny sees one all the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.alignment import BoundaryPoints, Systematic, align
from estimation.deformation import DepthReader, Unusable
from estimation.tactile_pose import FingerModel, GraspPrior, TactilePose
from mechanics.polygon import Polygon
from mechanics.readings import Array, ImageReading

#: what a pixel of an edge is good for [m], and what its edge is
SIGMA, SYSTEMATIC = 1e-3, Systematic(offset=0.7e-3, tilt=np.radians(1.5), shift=0.1e-3, turn=np.radians(0.2))
#: Canny's thresholds [grey levels] and the blur before it [pixels]
LOW, HIGH, BLUR = 40.0, 120.0, 1.5


class ContactView(Protocol):
    """Where a finger touches, as a picture."""

    @property
    def picture(self) -> NDArray[np.uint8]:
        """(h, w): 255 where the finger lies on the object, 0 where it does not."""
        ...

    def points(self, pixels: ArrayLike) -> Array:
        """Points (..., 2) [m] in the finger's x and y of pixels (..., 2), column and row."""
        ...


ContactReader = Callable[[ImageReading], ContactView | Unusable]
"""What turns a finger's reading into where it touches, or says why it cannot."""


class CannyIcp:
    """Canny edges of the contact, point-to-point alignment."""

    name: ClassVar[str] = "Canny + point-to-point ICP"

    def __init__(self, finger: FingerModel, outline: Polygon, contact: ContactReader | None = None):
        """``outline`` in the object's frame; ``contact`` reads the finger's pictures, a Soft Bubble's by default.

        Raises ValueError where it is missing and the finger's pictures are not depths.
        """
        self._finger, self._outline = finger, outline
        self._contact = DepthReader(finger).read if contact is None else contact

    def estimate(self, image: ImageReading, prior: GraspPrior) -> TactilePose:
        """As `TactilePoseEstimator.estimate`."""
        view = self._contact(image)
        if isinstance(view, Unusable):
            return TactilePose.unknown(prior, view.status, view.reason)
        smooth = cv2.GaussianBlur(view.picture, (0, 0), BLUR)
        rows, columns = np.nonzero(cv2.Canny(smooth, LOW, HIGH))
        points = self._finger.in_ee(view.points(np.column_stack((columns, rows))))
        seen = BoundaryPoints(points, SIGMA)
        return align(self._outline, seen, prior, metric="point", systematic=SYSTEMATIC, least_explained=0.0).pose
