"""Where on the outline of the grasped object a contact may lie, and which cone its force is in.

On a face touched by another body's corner the force lies about the face's own normal. At a vertex it lies about the
normal of the *other* body's face; where that body is not known, anywhere in the fan of cones between the two faces
that meet there. A dent cannot be touched by a face, and is no site.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.cone_projection import cone_rays
from mechanics import se2
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: a fan of cones beyond this would be no cone [rad]
_WIDEST = np.radians(179.0)
#: an exterior angle below this is no corner [rad]
_STRAIGHT = 1e-6
#: how far the pose of the go may turn a surface before it no longer faces a vertex, or no longer lies flat on a face
FACING = np.radians(10.0)
FLAT = np.radians(5.0)


@dataclass(frozen=True, eq=False)
class Surface:
    """A straight face of another body, in the go's frame at its present pose.

    ``centre`` (2,) [m] and the unit outward ``normal`` (2,); the face reaches ``half_length`` [m] either way. ``mu``
    is the friction of this pair, where it differs from the locator's.
    """

    centre: Array
    normal: Array
    half_length: float = np.inf
    mu: float | None = None

    @property
    def ends(self) -> Array:
        """The corners (2, 2) between which the face lies; none (0, 2) of an endless one."""
        if not np.isfinite(self.half_length):
            return np.empty((0, 2))
        side = self.half_length * np.array([self.normal[1], -self.normal[0]])
        return np.array([self.centre - side, self.centre + side])

    def distance(self, points: Array) -> Array:
        """Distance (...,) [m] of ``points`` (..., 2) from the face, on either side of it."""
        off = points - self.centre
        beyond = np.abs(off @ np.array([self.normal[1], -self.normal[0]])) - self.half_length
        return np.hypot(off @ self.normal, np.maximum(beyond, 0.0))


def ground_seen_by(X_W_go: Array, mu: float | None = None) -> Surface:
    """The ground, y = 0 of W, in the frame of a go at ``X_W_go`` (3,)."""
    X_go_W = se2.inverse(X_W_go)
    below = se2.transform(X_go_W, np.array([X_W_go[0], 0.0]))
    return Surface(below, se2.rotate(X_go_W[2], np.array([0.0, 1.0])), mu=mu)


def faces_seen_by(X_go_B: Array, outline: Polygon, mu: float | None = None) -> list[Surface]:
    """The faces of a body B, ``outline`` in its own frame, as the go sees them."""
    moved = outline.transformed(X_go_B)
    after = np.roll(moved.vertices, -1, axis=0)
    half = np.linalg.norm(after - moved.vertices, axis=1) / 2
    middle = (moved.vertices + after) / 2
    return [Surface(c, n, float(h), mu) for c, n, h in zip(middle, moved.normals, half, strict=True)]


@dataclass(frozen=True, eq=False)
class Sites:
    """Straight stretches of the outline, each with one cone; a vertex is a stretch of no length.

    ``start`` (S, 2) [m], unit ``along`` (S, 2), ``length`` (S,) [m], ``count`` (S,) samples, ``rays`` (S, 2, 2).
    ``group`` (S,) is the index of the face, or that of the vertex plus the number of faces; ``offset`` (S,) [m] is
    where on its face a site begins.
    """

    start: Array
    along: Array
    offset: Array
    length: Array
    count: NDArray[np.int64]
    rays: Array
    group: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.start)

    def samples(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Site (M,), distance along it (M,) and the length (M,) that it stands for, of every sample."""
        site = np.repeat(np.arange(len(self)), self.count)
        within = np.arange(len(site)) - np.repeat(np.cumsum(self.count) - self.count, self.count)
        step = self.length / self.count
        return site, (within + 0.5) * step[site], step[site]


def face_sites(outline: Polygon, mu: float, spacing: float) -> Sites:
    """Every face of the outline, whole, with the cone about its own inward normal."""
    edges = np.roll(outline.vertices, -1, axis=0) - outline.vertices
    length = np.linalg.norm(edges, axis=1)
    return Sites(
        outline.vertices.copy(),
        edges / length[:, None],
        np.zeros(len(edges)),
        length,
        np.maximum(1, np.ceil(length / spacing)).astype(np.int64),
        np.ascontiguousarray(cone_rays(-outline.normals, mu)),
        np.arange(len(edges), dtype=np.int64),
    )


def sites(
    outline: Polygon, mu: float, spacing: float, near: float, surroundings: Sequence[Surface] | None, only_near: bool
) -> Sites:
    """Where the go can be touched.

    A vertex within ``near`` [m] of a surface that faces it has the surface's cone. Without ``only_near`` every face
    is a site as well, with its own cone, and so is every other vertex, with a fan. With it only what the surroundings
    can reach is left: those vertices, and of the faces the stretch that a surface's end or a surface parallel to it
    comes near to.
    """
    faces = face_sites(outline, mu, spacing)
    surfaces = surroundings or ()
    stretches = _within_reach(faces, outline, mu, spacing, near, surfaces) if only_near else faces
    return _joined(stretches, _vertex_sites(outline, mu, near, surfaces, fans=not only_near))


def corners(outline: Polygon) -> NDArray[np.bool_]:
    """Which vertices (N,) stick out, so that another body's face can touch them."""
    return _turn(outline) > _STRAIGHT


def _turn(outline: Polygon) -> Array:
    """The exterior angle (N,) [rad] at every vertex, negative in a dent."""
    after = outline.normals
    before = np.roll(after, 1, axis=0)
    return np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))


def _vertex_sites(outline: Polygon, mu: float, near: float, surfaces: Sequence[Surface], fans: bool) -> Sites:
    turn = _turn(outline)
    before = np.roll(outline.normals, 1, axis=0)
    middle = np.arctan2(before[:, 1], before[:, 0]) + turn / 2  # where the corner points, as an angle
    rays, owner = [], []
    for v in np.flatnonzero(turn > _STRAIGHT):
        touching = []
        for surface in surfaces:
            against = np.arctan2(-surface.normal[1], -surface.normal[0])
            faced = abs(se2.wrap(against - middle[v])) <= turn[v] / 2 + FACING
            if faced and surface.distance(outline.vertices[v]) <= near:
                touching.append(cone_rays(surface.normal, mu if surface.mu is None else surface.mu))
        if not touching and fans:
            half = min(turn[v] / 2 + np.arctan(mu), _WIDEST / 2)
            angles = middle[v] + np.pi + np.array([half, -half])
            touching = [np.stack([np.cos(angles), np.sin(angles)], axis=-1)]
        rays += touching
        owner += [v] * len(touching)
    k = len(owner)
    points = outline.vertices[owner] if k else np.empty((0, 2))
    return Sites(
        points,
        np.zeros((k, 2)),
        np.zeros(k),
        np.zeros(k),
        np.ones(k, np.int64),
        np.array(rays).reshape(k, 2, 2),
        np.array(owner, np.int64) + len(outline),
    )


def _within_reach(
    faces: Sites, outline: Polygon, mu: float, spacing: float, near: float, surfaces: Sequence[Surface]
) -> Sites:
    """The stretches of the faces that the surfaces' ends, or surfaces parallel to a face, come near to."""
    found: list[Sites] = []
    for i in range(len(faces)):
        a, t, whole = faces.start[i], faces.along[i], faces.length[i]
        for surface in surfaces:
            friction = mu if surface.mu is None else surface.mu
            spans: list[tuple[float, float]] = []
            for end in surface.ends:
                s = float((end - a) @ t)
                if np.hypot((end - a) @ outline.normals[i], max(-s, s - whole, 0.0)) <= near:
                    spans.append((s - near, s + near))
            if outline.normals[i] @ surface.normal <= -np.cos(FLAT):
                # flat: the pressure's centre may lie anywhere on the shadow of the other face
                s = (surface.centre - a) @ t
                middle = a + np.clip(s, 0.0, whole) * t
                if surface.distance(middle) <= near:
                    spans.append((s - surface.half_length, s + surface.half_length))
            for low, high in _union(spans, whole):
                found.append(_stretch(faces, i, low, high, spacing, cone_rays(-outline.normals[i], friction)))
    return _joined(*found) if found else _nothing()


def _union(spans: list[tuple[float, float]], whole: float) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for low, high in sorted((max(low, 0.0), min(high, whole)) for low, high in spans):
        if out and low <= out[-1][1]:
            out[-1] = (out[-1][0], max(high, out[-1][1]))
        elif high > low:
            out.append((low, high))
    return out


def _stretch(faces: Sites, i: int, low: float, high: float, spacing: float, rays: Array) -> Sites:
    part = Sites(*(getattr(faces, name)[i : i + 1] for name in Sites.__dataclass_fields__))
    return replace(
        part,
        start=part.start + low * part.along,
        offset=np.array([low]),
        length=np.array([high - low]),
        count=np.array([max(1, int(np.ceil((high - low) / spacing)))], np.int64),
        rays=rays[None],
    )


def _joined(*parts: Sites) -> Sites:
    return Sites(*(np.concatenate([getattr(p, name) for p in parts]) for name in Sites.__dataclass_fields__))


def _nothing() -> Sites:
    none, indices = np.empty(0), np.empty(0, np.int64)
    return Sites(np.empty((0, 2)), np.empty((0, 2)), none, none, indices, np.empty((0, 2, 2)), indices)
