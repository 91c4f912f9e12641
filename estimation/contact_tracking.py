"""The contact from state to state: the particle filter, and the ground and the object that the go can touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimation.contact_filter import ContactFilter
from estimation.contact_location import ContactEstimate
from estimation.contact_sites import Surface, faces_seen_by, ground_seen_by
from estimation.contact_wrench import EnvironmentWrench, loosened
from mechanics import se2
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: keeps a covariance regular along what the pose does not change: far below any sensor's noise
_REGULAR = np.diag([1e-4, 1e-4, 1e-5]) ** 2


@dataclass
class ContactTracker:
    """Follows the contact of one grasped object; ``particles`` is the filter on its outline.

    ``mu`` holds the friction by pair (``go-ground``, ``go-eo``), where it differs from the filter's; ``eo_outline`` the
    extrinsic object's, in its own frame. Not thread-safe.
    """

    particles: ContactFilter
    mu: Mapping[str, float]
    eo_outline: Polygon | None = None
    _newest: tuple[int, ContactEstimate] | None = None

    def at(
        self, capture_ns: int, go: Array, covariance: Array, eo: Array | None, measured: EnvironmentWrench
    ) -> ContactEstimate:
        """The contact at an instant, from the wrench (3,) that the environment exerts on a go at ``go`` (3,) in W.

        ``covariance`` (3, 3) is of the go's pose, as a left perturbation about the point that ``measured`` is about,
        in axes of go; ``eo`` (3,) the pose in W of the extrinsic object, where it was seen. An instant before
        the newest one is answered by its wrench alone: the filter does not go back.
        """
        measured = loosened(measured, _by_pose(measured.wrench, covariance) + _REGULAR)
        around = self._surroundings(go, eo)
        newest = self._newest
        if newest is None or capture_ns > newest[0]:
            seconds = 0.0 if newest is None else (capture_ns - newest[0]) * 1e-9
            found = self.particles.update(seconds, measured, around)
            self._newest = capture_ns, found
            return found
        return newest[1] if capture_ns == newest[0] else self.particles.locator.locate(measured, around)

    def _surroundings(self, go: Array, eo: Array | None) -> list[Surface]:
        around = [ground_seen_by(go, self.mu.get("go-ground"))]
        if self.eo_outline is not None and eo is not None:
            around += faces_seen_by(se2.between(go, eo), self.eo_outline, self.mu.get("go-eo"))
        return around


def _by_pose(wrench: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of a ``wrench`` (3,) from that of the pose of the body that it is told in, about one point.

    A body that lies (dx, dy, dθ) from where it is believed feels the same force turned back, and about another point.
    """
    fx, fy, _ = wrench
    J = np.array([[0.0, 0.0, fy], [0.0, 0.0, -fx], [-fy, fx, 0.0]])
    return J @ covariance @ J.T
