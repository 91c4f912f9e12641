"""What a tactile image says of the pose of the held object, whatever method reads it.

A method turns an image and a prior into a `TactilePose`; `fuse` joins those of several fingers. Everything is in the
information form: an image adds Jᵀ J / σ² to the prior's P₀⁻¹, so what it does not show stays as the prior has it, and
says so.

Errors of a pose are left perturbations about the end-effector's origin, in its axes: X_true = Δ ∘ X, with
Δ = (x, y, θ). There the grasp centre is at rest under a turn, so that the angle's error does not leak into (x, y).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import cos, sin
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics import se2
from mechanics.camera import CameraModel
from mechanics.readings import Array, ImageReading

Picture = NDArray[np.uint8] | NDArray[np.uint16]

#: length by which angles are scaled where directions of a pose are compared [m]: half of what a finger sees
ANGLE_LENGTH = 0.03
#: a direction is unobserved when the image alone leaves a standard deviation beyond this [m, with θ scaled]: what is
#: called observed is then beyond 1 mm or 2° once in a hundred times at most
UNOBSERVED_BEYOND = 0.0004


class PoseStatus(StrEnum):
    """Whether a tactile pose can be believed, and if not, why not."""

    OK = "ok"
    #: nothing presses on the finger
    NO_CONTACT = "no_contact"
    #: something presses, and no edge of it shows: too shallow, or it fills the whole view
    NO_EDGE = "no_edge"
    #: the picture is one colour or one depth: a covered lens, a sensor without light
    BLANK = "blank"
    #: too much of the picture is at the end of its range
    SATURATED = "saturated"
    #: part of the picture is missing or of another moment
    TORN = "torn"
    #: edges show, and they are not those of the outline
    MISMATCH = "mismatch"
    #: the reading itself is not to be trusted (stale, invalid)
    UNTRUSTED = "untrusted"
    #: the object has moved in the fingers by what no elasticity explains
    SLIPPED = "slipped"


@dataclass(frozen=True, eq=False)
class GraspPrior:
    """Where the object is believed to lie before the image is read.

    ``pose`` (3,) is X_ee_go; ``covariance`` (3, 3) [m², m·rad, rad²] that of Δ (module docstring).
    """

    pose: Array
    covariance: Array = field(default_factory=lambda: np.diag([0.003, 0.003, np.radians(4.0)]) ** 2)

    @property
    def information(self) -> Array:
        """P₀⁻¹ (3, 3)."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)


@dataclass(frozen=True, eq=False)
class TactilePose:
    """The held object's ``pose`` X_ee_go (3,) and what is known of its error Δ (module docstring).

    ``covariance`` (3, 3) is that of image and prior together; ``information`` (3, 3) that of the image alone, zero
    where it says nothing; ``unobserved`` (k, 3) are orthonormal directions of (x, y, θ · `ANGLE_LENGTH`) which the
    image alone leaves open beyond `UNOBSERVED_BEYOND`. With a ``status`` other than OK the pose is the prior's.
    ``edges`` (m, 2) [m] are the boundary points that were seen, in ee, for whoever draws them.
    """

    pose: Array
    covariance: Array
    information: Array
    unobserved: Array
    status: PoseStatus = PoseStatus.OK
    reason: str = ""
    edges: Array = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def unknown(cls, prior: GraspPrior, status: PoseStatus, reason: str) -> TactilePose:
        """The prior, with the reason why the image adds nothing to it."""
        return cls(prior.pose, prior.covariance, np.zeros((3, 3)), np.eye(3), status, reason)


class TactilePoseEstimator(Protocol):
    """One way to read one finger's image."""

    name: ClassVar[str]

    def estimate(self, image: ImageReading, prior: GraspPrior) -> TactilePose:
        """The pose from one image. Never raises for what an image may show: that is a status."""
        ...


@dataclass(frozen=True, eq=False)
class FingerModel:
    """What an estimator knows of a finger: its camera, where it looks from, and the untouched picture.

    ``camera`` has the finger's frame F as its world: x right and y up as one sees the object from the finger, z out
    of the object into the finger; the origin lies at the apex of the untouched skin. ``X_ee_F`` (4, 4) is F in ee,
    whose 3-D axes are X right, Y away from the viewer, Z up. ``reference`` is the untouched picture, encoded as the
    finger's readings are. ``described`` is what else the device says of itself (``describe().extra``).
    """

    sensor: str
    camera: CameraModel
    X_ee_F: Array
    reference: Picture
    described: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, described: Mapping[str, Any], reference: Picture) -> FingerModel:
        """From a tactile device's ``describe().extra`` and its `reference`. Raises ValueError for what is missing."""
        for key in ("sensor", "camera", "X_ee_finger"):
            if key not in described:
                raise ValueError(f"tactile finger: its description lacks {key!r}; the estimator needs it")
        camera = CameraModel.from_dict(described["camera"])
        if reference.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"tactile finger: the reference is {reference.shape[1]} x {reference.shape[0]} pixels, its camera "
                f"{camera.width} x {camera.height}; take the reference anew"
            )
        return cls(described["sensor"], camera, np.array(described["X_ee_finger"], float), reference, described)

    def in_ee(self, p_F: ArrayLike) -> Array:
        """Points (..., 2) of F's x-y plane as points (..., 2) of ee's task plane."""
        p_F = np.asarray(p_F, float)
        plane = self.X_ee_F[np.ix_((0, 2), (0, 1))]
        return p_F @ plane.T + self.X_ee_F[(0, 2), 3]

    def in_finger(self, p_ee: ArrayLike) -> Array:
        """Points (..., 2) of ee's task plane as points (..., 2) of F; the inverse of `in_ee`."""
        plane = self.X_ee_F[np.ix_((0, 2), (0, 1))]
        return (np.asarray(p_ee, float) - self.X_ee_F[(0, 2), 3]) @ plane  # orthogonal


def open_directions(information: Array, beyond: float = UNOBSERVED_BEYOND) -> Array:
    """Orthonormal directions (k, 3) of (x, y, θ · `ANGLE_LENGTH`) which ``information`` (3, 3) of Δ leaves open.

    Open is a direction whose standard deviation by the image alone is beyond ``beyond`` [m].
    """
    scale = np.array([1.0, 1.0, 1 / ANGLE_LENGTH])
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    return vectors[:, values < beyond**-2].T.copy()


def fuse(prior: GraspPrior, poses: Sequence[TactilePose]) -> TactilePose:
    """One pose from those that several fingers gave under the same ``prior``, which counts once.

    A finger that is not OK adds nothing; where none is, the first one's status stands.
    """
    good = [pose for pose in poses if pose.status is PoseStatus.OK]
    if not good:
        return poses[0] if poses else TactilePose.unknown(prior, PoseStatus.NO_CONTACT, "no finger has looked")
    if len(good) == 1:
        return good[0]
    P0 = prior.information
    total = P0 + np.sum([pose.information for pose in good], axis=0)
    # each posterior is (P0 + I)⁻¹ I d from the prior, with d what the image alone says; undo the prior, add up
    offsets = np.array([left_difference(pose.pose, prior.pose) for pose in good])
    pulled = np.sum([(P0 + pose.information) @ d for pose, d in zip(good, offsets, strict=True)], axis=0)
    mean = np.linalg.solve(total, pulled)
    information = np.sum([pose.information for pose in good], axis=0)
    return replace(
        good[0],
        pose=left_moved(prior.pose, mean),
        covariance=np.linalg.inv(total),
        information=information,
        unobserved=open_directions(information),
        edges=np.concatenate([pose.edges for pose in good]),
    )


def left_difference(pose: Array, origin: Array) -> Array:
    """Δ (3,) with ``pose`` = Δ ∘ ``origin``."""
    # in scalars, as `se2` would have it: asked for thousands of times a trial
    (x, y, theta), (u, v, phi) = pose.tolist(), origin.tolist()
    c, s = cos(phi), sin(phi)
    u, v = -c * u - s * v, s * u - c * v
    c, s = cos(theta), sin(theta)
    return np.array([x + c * u - s * v, y + s * u + c * v, theta - phi])


def left_moved(pose: Array, delta: Array) -> Array:
    """Δ ∘ ``pose``, (..., 3) for ``delta`` (..., 3)."""
    if delta.ndim > 1:
        return se2.compose(delta, pose)
    (x, y, theta), (u, v, phi) = delta.tolist(), pose.tolist()
    c, s = cos(theta), sin(theta)
    return np.array([x + c * u - s * v, y + s * u + c * v, theta + phi])
