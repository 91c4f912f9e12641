"""The gel of a tactile finger under the flat face of an object: how its surface is pressed in and carried along.

Coordinates are the finger's: x and y in the gel's undeformed surface (x right, y up as its camera sees them), z from
there into the gel, toward the camera. The face presses the gel to a uniform depth. Beside it the surface rises again as
a layer does that resists both pressing and shear (Pasternak's foundation): exponentially with the distance from the
edge. The surface sticks to the face and moves with it as one rigid body; around the face that motion dies away.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfc

from mechanics.polygon import Polygon
from mechanics.readings import Array
from mechanics.se2 import compose, inverse, rotation, transform

Floats = NDArray[Any]
"""Single or double precision: results have that of the points, so that pictures cost half."""

_SPACING = 0.25e-3  # of the table of distances [m]; between its nodes a distance from a straight edge is exact
_MARGIN = 24e-3  # around the face [m]; further away nothing of it is felt: five times the reach of shear


@dataclass(frozen=True)
class GelPad:
    """The gel's figures [m]. ``wall`` is the length over which the surface rises beside a face.

    ``rounding`` is the standard deviation of the blur that rounds the surface off at the edge (the object's own edge
    and the reflecting coat). ``reach`` is the length over which tangential motion dies away, ``push`` the tangential
    motion away from the face as a share of the depth. ``deepest`` is the largest depth for which the wall does not
    overhang in the camera's view. The wall is set to the width of contact edges in pictures of a real GelSlim, the
    rounding to how sharp an edge is in those of a GelSight; reach and push to how the GelSlim's markers move outward
    around a pressed ball.
    """

    wall: float = 0.9e-3
    rounding: float = 0.05e-3
    reach: float = 4.8e-3
    push: float = 0.1
    deepest: float = 1.2e-3

    def profile(self, distance: Floats) -> tuple[Floats, Floats]:
        """Depth over the face's depth, and its derivative [1/m], at a signed ``distance`` from the edge (out > 0).

        It is min(1, e^(−s/wall)) under a Gaussian blur.
        """
        a, s = self.rounding / self.wall, np.maximum(distance, -50 * self.wall) * float(np.sqrt(0.5) / self.rounding)
        a *= float(np.sqrt(0.5))
        wall = np.exp(a * a - 2 * a * s) * erfc(a - s)
        return 0.5 * (erfc(s) + wall), wall * (-0.5 / self.wall)


class Face:
    """Signed distances from a polygon (out > 0) and their gradient, interpolated in a table that is made once."""

    def __init__(self, outline: ArrayLike):
        polygon = Polygon(outline)
        low, high = polygon.vertices.min(axis=0) - _MARGIN, polygon.vertices.max(axis=0) + _MARGIN
        # nodes at whole multiples of the spacing from the lowest vertex: there an edge along an axis lies on them
        counts = np.ceil((high - low) / _SPACING).astype(int) + 1
        x, y = (low[i] + _SPACING * np.arange(counts[i]) for i in (0, 1))
        distance = np.concatenate(
            [polygon.signed_distance(np.stack(np.meshgrid(x, rows), axis=-1)) for rows in np.array_split(y, 16)]
        )
        by_y, by_x = np.gradient(distance, _SPACING)
        self._low = low
        self._table = np.stack((distance, by_x, by_y), axis=-1).astype(np.float32)

    def distance(self, X_face_P: Array, points: Floats) -> tuple[Floats, Floats]:
        """Distance (...) [m] and its gradient (..., 2) at ``points`` (..., 2), all in a frame P.

        ``X_face_P`` (3,) is its pose in the face's frame. Distances are good to a few µm beside straight edges, to a
        tenth of a millimetre within a node of a corner. Beyond the table's margin they are those at its border.
        """
        shape, turn = points.shape[:-1], rotation(X_face_P[2])
        kind = points.dtype
        at = points.reshape(-1, 2) @ (turn.T / _SPACING).astype(kind)
        at += ((X_face_P[:2] - self._low) / _SPACING).astype(kind)
        columns = 128  # OpenCV takes pictures no longer than 2¹⁵ pixels, so a list of points is folded into one
        folded = np.zeros((2, -(-len(at) // columns) * columns), np.float32)
        folded[:, : len(at)] = at.T
        x, y = folded.reshape(2, -1, columns)
        found = cv2.remap(self._table, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found = found.reshape(-1, 3)[: len(at)]
        gradient = found[:, 1:].astype(kind) @ turn.astype(kind)
        return found[:, 0].astype(kind).reshape(shape), gradient.reshape(*shape, 2)


@lru_cache(maxsize=8)
def _face(outline: bytes) -> Face:
    return Face(np.frombuffer(outline).reshape(-1, 2))


class PressedGel:
    """The gel under a face: ``outline`` (N, 2) [m] at ``X_F_face`` (3,), pressed in by ``depth`` [m].

    ``X_F_grasp`` (3,) is where the frame that the face's points were grasped in is now; it was at (0, 0, 0) when they
    met the gel. So a point of the gel under the face is carried along from m to X_F_grasp · m.
    """

    def __init__(self, pad: GelPad, outline: ArrayLike, X_F_face: Array, X_F_grasp: Array, depth: float):
        self.pad, self.depth = pad, depth
        self._face = _face(np.ascontiguousarray(outline, dtype=float).tobytes())
        self._X_F_grasp = np.asarray(X_F_grasp, float)
        self._X_face_F = inverse(np.asarray(X_F_face, float))
        self._X_face_material = compose(self._X_face_F, self._X_F_grasp)

    def distance(self, points: Floats) -> tuple[Floats, Floats]:
        """Distance (...) [m] of ``points`` (..., 2) from the face (out > 0), and its gradient (..., 2)."""
        return self._face.distance(self._X_face_F, points)

    def height(self, points: Floats) -> tuple[Floats, Floats]:
        """How far the surface is pressed in (...) [m] at ``points`` (..., 2), and its gradient (..., 2)."""
        return self.height_at(*self.distance(points))

    def height_at(self, distance: Floats, gradient: Floats) -> tuple[Floats, Floats]:
        """The same where the distance from the face and its gradient are known."""
        share, slope = self.pad.profile(distance)
        return self.depth * share, (self.depth * slope)[..., None] * gradient

    def carried(self, material: Array) -> Array:
        """Where the points of the surface are (..., 3) [m] that are at ``material`` (..., 2) in the gel at rest."""
        pad = self.pad
        distance, outward = self._face.distance(self._X_face_material, material)
        outside = np.maximum(distance, 0.0)
        tail = np.exp(-_MARGIN / pad.reach)  # so that it ends where the table does
        fading = np.maximum((np.exp(-outside / pad.reach) - tail) / (1 - tail), 0.0)[..., None]
        pushed = pad.push * self.depth * (1 - np.exp(-outside / pad.wall))[..., None] * outward
        moved = material + (transform(self._X_F_grasp, material) - material + pushed) * fading
        return np.concatenate((moved, self.height(moved)[0][..., None]), axis=-1)


def at_rest(material: Array) -> Array:
    """Where the points (..., 2) of the surface are (..., 3) when nothing touches it."""
    return np.concatenate((material, np.zeros((*material.shape[:-1], 1))), axis=-1)
