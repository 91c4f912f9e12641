"""Tactile pose of a Soft Bubble by the kink of its membrane at the edges of the held face.

A matched filter finds where a ridge of the membrane's second difference lies under the outline; from there
`estimation.kink_fit` fits the kink itself, to a fraction of a pixel.
"""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np

from estimation import strip_kernels as kernels
from estimation.alignment import EXCLUDED
from estimation.contact_memory import ContactMemory
from estimation.deformation import Deformation, DepthReader, Unusable
from estimation.kink_fit import KinkFit
from estimation.tactile_pose import (
    FingerModel,
    GraspPrior,
    PoseStatus,
    TactilePose,
    left_difference,
    left_moved,
    open_directions,
)
from mechanics import se2
from mechanics.polygon import Polygon
from mechanics.readings import Array, ImageReading

#: distance of the outline's samples under which a ridge is looked for [m]
SPACING = 2e-3
#: steps of the first grid of poses [m, m, rad] and how far it goes [standard deviations of the prior]
STEPS, REACH = np.array([1.5e-3, 1.5e-3, np.radians(2.5)]), 3.5
#: most steps of that grid to one side
MOST_STEPS = 10
#: second difference that counts as much as one unit of −ln likelihood [m]: a few tenths of a pixel's noise
RIDGE = 2e-4
#: most of the flat patch that may lie outside the outline, and how far outside that is [m]
MOST_OUTSIDE, FAR_OUTSIDE = 0.08, 5e-3
#: most of the bulge that may lie inside the outline, and how far inside and how high that is [m]
MOST_INSIDE, FAR_INSIDE, BULGE = 0.3, 3e-3, 0.5e-3
_NEIGHBOURS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


class RidgeStrips:
    """Matched filter on the ridge, then the kink fitted in strips.

    Whether anything presses is told over time (`estimation.contact_memory`) where pictures come in their order; a first
    picture is read by itself. Poses do not depend on the pictures before.
    """

    name: ClassVar[str] = "ridge + kink in strips"

    def __init__(self, finger: FingerModel, outline: Polygon):
        """``outline`` in the object's frame. Raises ValueError for a finger whose pictures are not depths."""
        self._finger, self._outline = finger, outline
        self._reader = DepthReader(finger, ContactMemory())
        self._boundary = outline.boundary(SPACING)

    def estimate(self, image: ImageReading, prior: GraspPrior) -> TactilePose:
        """As `TactilePoseEstimator.estimate`."""
        field = self._reader.read(image)
        if isinstance(field, Unusable):
            return TactilePose.unknown(prior, field.status, field.reason)
        starts = self.coarse(field, prior)
        first = self._refined(field, prior, starts[0])
        if first.status is PoseStatus.OK or len(starts) == 1:
            return first
        second = self._refined(field, prior, starts[1])
        return second if second.status is PoseStatus.OK else first

    def coarse(self, field: Deformation, prior: GraspPrior) -> list[Array]:
        """Poses X_ee_go (3,) under which most of a ridge lies, the best one first; at most two."""
        finger = self._finger
        origin = finger.in_finger(np.zeros(2))
        to_finger = np.eye(3)
        to_finger[:2, :2] = (finger.in_finger(np.eye(2)) - origin).T
        to_finger[:2, 2] = origin
        to_pixels = field.to_pixels @ to_finger
        sigma = 0.8e-3 / field.pitch
        smooth = cv2.GaussianBlur(field.beyond, (0, 0), sigma)
        # of a second difference of three means over 4π sigma² pixels each
        noise = field.noise * np.sqrt(6 * min(field.alike / (4 * np.pi * sigma**2), 1.0))
        least = 1.5 * noise / np.sqrt(3)  # samples count by three
        shown = self._may_show(field, prior)
        P0 = prior.information

        def score(deltas: Array, reach: float) -> Array:
            out = np.empty(len(deltas))
            kernels.ridge_scores(
                smooth, to_pixels, self._boundary.points[shown], self._boundary.normals[shown],
                self._boundary.faces[shown], left_moved(prior.pose, deltas), reach, least, 3 * RIDGE, 2 * RIDGE, out
            )  # fmt: skip
            return out / RIDGE - 0.5 * np.einsum("ki,ij,kj->k", deltas, P0, deltas)

        grid = _grid(prior.covariance)
        best = grid[np.argsort(score(grid, 2.5e-3))[-6:]]
        for share in (0.5, 0.25):
            trial = np.unique((best[:, None] + share * _NEIGHBOURS * STEPS).reshape(-1, 3), axis=0)
            order = np.argsort(score(trial, 2e-3))
            best = trial[order[-6:]]
        away = np.abs((trial[order] - best[-1]) / STEPS).max(axis=1)
        others = trial[order][away > 1.0]
        return [left_moved(prior.pose, delta) for delta in (best[-1], *others[-1:])]

    def _may_show(self, field: Deformation, prior: GraspPrior) -> np.ndarray:
        """Which of the outline's samples may be near the flat patch, for any pose that the prior allows."""
        rows, columns = np.nonzero(field.flat)
        corners = np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]], float)
        patch = self._finger.in_ee(field.points(corners))
        reach = REACH * np.sqrt(np.diag(prior.covariance))
        points = se2.transform(prior.pose, self._boundary.points)
        slack = max(reach[:2]) + reach[2] * np.linalg.norm(points, axis=1, keepdims=True) + 2e-3
        return ((points > patch.min(axis=0) - slack) & (points < patch.max(axis=0) + slack)).all(axis=1)

    def _refined(self, field: Deformation, prior: GraspPrior, start: Array) -> TactilePose:
        """The pose at which the membrane kinks at the outline's edges."""
        fit = KinkFit(self._finger, self._outline, field, prior, start)
        if not fit.solve():
            return TactilePose.unknown(prior, PoseStatus.NO_EDGE, "the membrane leaves the face without a kink")
        delta = left_difference(fit.pose, prior.pose)
        squared = float(delta @ prior.information @ delta)
        if squared > EXCLUDED:
            reason = f"the edges are {np.sqrt(squared):.0f} standard deviations from where the grasp should have them"
            return TactilePose.unknown(prior, PoseStatus.MISMATCH, reason)
        reason = self._contradiction(field, fit.pose)
        if reason:
            return TactilePose.unknown(prior, PoseStatus.MISMATCH, reason)
        information = fit.information
        return TactilePose(
            fit.pose,
            np.asarray(np.linalg.inv(information + prior.information), np.float64),
            information,
            open_directions(information),
            edges=fit.kinks,
        )

    def _contradiction(self, field: Deformation, pose: Array) -> str:
        """What of the picture the outline at this pose cannot explain; empty where there is nothing."""
        placed = self._outline.transformed(pose)
        rows, columns = np.nonzero(field.flat[::4, ::4])
        p_ee = self._finger.in_ee(field.points(4.0 * np.column_stack((columns, rows))))
        outside = float((placed.signed_distance(p_ee) > FAR_OUTSIDE).mean())
        if outside > MOST_OUTSIDE:
            return f"{100 * outside:.0f} % of what lies flat on the finger is outside the outline"
        size = 2 * round(6e-3 / field.pitch) + 1
        about = cv2.dilate(field.flat.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool)
        bulge = (cv2.blur(field.beyond, (5, 5)) > BULGE) & about
        rows, columns = np.nonzero(bulge[::2, ::2])
        if len(rows) > 20:
            p_ee = self._finger.in_ee(field.points(2.0 * np.column_stack((columns, rows))))
            inside = float((placed.signed_distance(p_ee) < -FAR_INSIDE).mean())
            if inside > MOST_INSIDE:
                return f"{100 * inside:.0f} % of where the membrane bulges past the face is inside the outline"
        return ""


def _grid(covariance: Array) -> Array:
    """Offsets (k, 3) within `REACH` of a prior, `STEPS` apart; more where the prior is very wide."""
    extent = REACH * np.sqrt(np.diag(covariance))
    steps = np.maximum(STEPS, extent / MOST_STEPS)
    axes = [np.arange(-c, c + 1) * step for c, step in zip(np.ceil(extent / steps).astype(int), steps, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), grid.T)
    # the grid's own steps are let in, however narrow the prior is
    return grid[(np.square(whitened).sum(axis=0) < REACH**2) | (np.abs(grid / STEPS).max(axis=1) < 1.5)]
