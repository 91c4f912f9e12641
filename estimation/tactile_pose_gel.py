"""The held object's pose and the gel's shear from a GelSlim's colour picture, to a fraction of a pixel.

Notes on tactile images: matched filter, then steps of the shading in strips, then point-to-line alignment in the
information form. The dots under the face give the shear, and how deep the gel is pressed in: the face lies so much
nearer to the camera, which moves its edges in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from estimation.alignment import Alignment, BoundaryPoints, Systematic, align
from estimation.gel_deformation import GelDeformation, GelReference, deformation, distrusted
from estimation.gel_edges import Flat, Plane, Steps, best_poses, boundary
from estimation.gel_markers import GelShear, MarkerTracker, on_plane
from estimation.tactile_pose import FingerModel, GraspPrior, PoseStatus, TactilePose, left_difference
from mechanics import se2
from mechanics.polygon import Polygon
from mechanics.readings import Array, ImageReading

#: what the edges of a picture have in common (rounding of the object's own edges, dots beside them, lens), as errors in
#: simulation come out: a tenth of a pixel of `PIXEL` [m], and in proportion where pixels are larger
PIXEL = 0.141e-3
SYSTEMATIC = Systematic(offset=0.013e-3, tilt=np.radians(0.04), shift=0.01e-3, turn=np.radians(0.02))
#: the same while the depth of the face is only as described, or no dots tell it: a third of a millimetre nearer draws
#: edges apart by a tenth of one
SHALLOW = Systematic(offset=0.06e-3, tilt=np.radians(0.1), shift=0.02e-3, turn=np.radians(0.03))
LOOSE = Systematic(offset=0.15e-3)
#: pitch of the dots [px] below which they and edges cannot be told apart: then a step may be off by a pixel or two
COARSEST = 7.0
#: poses that differ by less are the same (m, m, rad)
SAME = (0.1e-3, 0.1e-3, np.radians(0.3))
#: the first search for steps about the matched filter's pose, and the second about the aligned one [m]
FIRST_REACH, SECOND_REACH = 1.2e-3, 0.4e-3
#: least scatter of a step [m]: pixels are not points
STEP_FLOOR = 0.007e-3
#: how far inside and outside the outline a wall reaches [m], and the least share of what shows that must lie there
WALL, SHOWN = (0.6e-3, 4e-3), 0.85
#: share of what shows along the outline, and of strips with an edge less those without, that leave no doubt
CLEARLY, CLEARLY_SHOWN = 0.95, 0.5
#: share of the indentation that dots must show for a face that fills the view
FILLED = 0.4


@dataclass(frozen=True, eq=False)
class GelReading:
    """All that one picture says: the ``pose`` of the object and the ``shear`` of the gel since the grasp."""

    pose: TactilePose
    shear: GelShear

    def slip(self, earlier: GelReading) -> tuple[Array, float]:
        """How far the object has moved on the gel since an ``earlier`` reading: Δ (3,), and its square in σ (χ² of 3).

        The gel carries the object along by its shear; what else the object's pose has changed by is slip. Along what
        either picture does not show, the square knows only the prior's spread.
        """
        carried = se2.compose(self.shear.pose, se2.between(earlier.shear.pose, earlier.pose.pose))
        delta = left_difference(self.pose.pose, carried)
        delta[2] = se2.wrap(delta[2])
        C = self.pose.covariance + earlier.pose.covariance + self.shear.covariance + earlier.shear.covariance
        return delta, float(delta @ np.linalg.solve(C, delta))


class TactilePoseGel:
    """Facet contrast in strips, for a gel with or without dots; keeps nothing between pictures.

    ``outline`` is the object's polygon in its own frame. Raises ValueError for a finger whose reference is no picture.
    """

    name: ClassVar[str] = "gel facets"

    def __init__(self, finger: FingerModel, outline: Polygon):
        self.finger, self.outline = finger, outline
        self.reference = GelReference.of_finger(finger)
        self.tracker = MarkerTracker(finger, self.reference.dots)
        self.plane = Plane.of(finger, self.tracker.indentation)
        coarse = max(1.0, self.plane.step / PIXEL)
        self._exact, self._shallow = (_times(s, coarse) for s in (SYSTEMATIC, SHALLOW))
        if (self.reference.pitch or np.inf) < COARSEST:
            self._exact = self._shallow = _times(SHALLOW, 1.5 * self.plane.step / SHALLOW.offset)

    def estimate(self, image: ImageReading, prior: GraspPrior) -> TactilePose:
        """X_ee_go from one image; what it does not show stays as ``prior`` has it."""
        return self.read(image, prior).pose

    def read(self, image: ImageReading, prior: GraspPrior, guess: ArrayLike = (0.0, 0.0, 0.0)) -> GelReading:
        """Pose and shear; ``guess`` (3,) is a former X of gocf in ee, from which the dots are followed."""
        doubt = distrusted(image)
        if doubt is not None:
            return self._nothing(prior, *doubt)
        found = deformation(image.image, self.reference)
        if found.status is PoseStatus.NO_CONTACT:
            return self._without_edges(found, prior, guess)
        if found.status is not PoseStatus.OK:
            return self._nothing(prior, found.status, found.reason)
        flat = Flat.of(found, self.plane)
        best: tuple[float, TactilePose, GelShear] | None = None
        tried: list[Array] = []
        for start in best_poses(flat, self.finger, self.outline, prior):
            first = self._roughly(flat, start, prior)
            if first.status is PoseStatus.OK:
                if any((np.abs(left_difference(first.pose, other)) < SAME).all() for other in tried):
                    continue
                tried.append(first.pose)
            score, clear, pose, shear = self._finely(found, flat, first, prior, guess)
            if best is None or score > best[0]:
                best = score, pose, shear
            if clear:
                break
        assert best is not None
        return GelReading(best[1], best[2])

    def _roughly(self, flat: Flat, start: Array, prior: GraspPrior) -> TactilePose:
        """The matched filter's pose, after a wide search for steps."""
        rough = boundary(flat, self.finger, self.outline, start, FIRST_REACH)
        return self._settled(rough, prior, start, self.plane.height, LOOSE, (1e-3, 3e-4)).pose

    def _finely(
        self, found: GelDeformation, flat: Flat, first: TactilePose, prior: GraspPrior, guess: ArrayLike
    ) -> tuple[float, bool, TactilePose, GelShear]:
        """How well a rough pose explains the picture, whether it leaves no doubt, the exact pose, and the shear.

        How well: strips with an edge, less those without one where one should be. No doubt: nearly all strips have
        one, and nearly all that shows lies along the outline.
        """
        if first.status is not PoseStatus.OK:
            return -np.inf, False, first, self.tracker.none(first.reason)
        steps = boundary(flat, self.finger, self.outline, first.pose, SECOND_REACH)
        shear = self._shear(found, first.pose, guess)
        # the edges lie on the face's plane; how near to the camera that is, the dots under it say
        aligned = self._settled(steps, prior, first.pose, shear.depth, self._exact if shear.known else self._shallow)
        score = 2.0 * float((aligned.weights > 0.5).sum()) - steps.looked
        if aligned.pose.status is not PoseStatus.OK:
            return -np.inf, False, aligned.pose, shear
        along = self._along_outline(found, aligned.pose.pose)
        if along < SHOWN:
            reason = f"{100 * along:.0f} % of what shows lies along the outline; is it the outline of this object?"
            return -np.inf, False, TactilePose.unknown(prior, PoseStatus.MISMATCH, reason), shear
        return score, along > CLEARLY and score > CLEARLY_SHOWN * steps.looked, aligned.pose, shear

    def _along_outline(self, found: GelDeformation, pose: Array) -> float:
        """Share of the tilted surface that lies where the outline's walls are."""
        at = np.argwhere(found.patch[::5, ::5])[:, ::-1] * 5.0
        if not len(at):
            return 0.0
        p = self.finger.in_ee(on_plane(self.finger, at, self.plane.height))
        distance = self.outline.transformed(pose).signed_distance(p)
        return float(((distance > -WALL[0]) & (distance < WALL[1])).mean())

    def _settled(
        self,
        steps: Steps,
        prior: GraspPrior,
        start: Array,
        depth: float,
        systematic: Systematic,
        settling: tuple[float, ...] = (),
    ) -> Alignment:
        """The alignment of steps that lie on the plane at ``depth``."""
        foot, distance = self.finger.camera.X_WC[:2, 3], float(self.finger.camera.X_WC[2, 3])
        share = (distance - depth) / (distance - self.plane.height)
        seen = BoundaryPoints(
            self.finger.in_ee(foot + share * (steps.points - foot)),
            np.maximum(steps.sigma, STEP_FLOOR),
            self.finger.in_ee(steps.normals) - self.finger.in_ee(np.zeros(2)),
            steps.edges,
        )
        return align(self.outline, seen, prior, start=start, systematic=systematic, settling=settling)

    def _shear(self, found: GelDeformation, pose: Array, guess: ArrayLike) -> GelShear:
        dots = found.dots
        if not len(dots):
            return self.tracker.none("the gel has no dots")
        seen = self.finger.in_ee(on_plane(self.finger, dots.centres, self.plane.height))
        return self.tracker.shear(dots, self.outline.transformed(pose).signed_distance(seen), guess)

    def _without_edges(self, found: GelDeformation, prior: GraspPrior, guess: ArrayLike) -> GelReading:
        """The shading is that of the untouched gel: nothing presses, or a face that fills the view."""
        shear = self.tracker.shear(found.dots, None, guess)
        if shear.known and shear.depth > FILLED * self.tracker.indentation:
            reason = "the face fills the whole view: none of its edges shows"
            return GelReading(TactilePose.unknown(prior, PoseStatus.NO_EDGE, reason), shear)
        return self._nothing(prior, PoseStatus.NO_CONTACT, found.reason)

    def _nothing(self, prior: GraspPrior, status: PoseStatus, reason: str) -> GelReading:
        return GelReading(TactilePose.unknown(prior, status, reason), self.tracker.none(reason))


def _times(systematic: Systematic, share: float) -> Systematic:
    return Systematic(
        systematic.offset * share, systematic.tilt * share, systematic.shift * share, systematic.turn * share
    )
