"""Simple planar polygons, convex or not: mass properties, boundary samples, signed distance, convex pieces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike

from mechanics.readings import Array

_RELATIVE = 1e-9  # coincidence of points and edges, relative to the polygon's extent


class PolygonError(ValueError):
    """A list of points that bounds no area. ``vertices`` are the indices (from 0) of the points at fault."""

    def __init__(self, message: str, vertices: tuple[int, ...] = ()):
        super().__init__(message)
        self.vertices = vertices


class Boundary(NamedTuple):
    """Samples of a polygon's boundary: points (M, 2), unit outward normals (M, 2), index of their face (M,).

    Face i runs from vertex i to vertex i+1. Samples stand in the middle of equal stretches of a face, never on a
    vertex, so that each has one normal; ``lengths`` (M,) is the stretch that each one stands for.
    """

    points: Array
    normals: Array
    faces: np.ndarray[Any, np.dtype[np.int64]]
    lengths: Array


@dataclass(frozen=True, eq=False)
class Polygon:
    """A simple polygon of uniform density. ``vertices`` (N, 2) [m] run counter-clockwise.

    Clockwise input is reversed. Raises PolygonError for fewer than three points, points that are not finite or
    coincide with their successor, edges that cross, touch or fold back, and for no area.
    """

    vertices: Array

    def __init__(self, vertices: ArrayLike):
        v = _checked(vertices)
        if _twice_area(v) < 0:
            v = v[::-1].copy()
        v.setflags(write=False)
        object.__setattr__(self, "vertices", v)

    @classmethod
    def _of(cls, vertices: Array) -> Polygon:
        """A polygon whose vertices are known to be good: a rigid motion must not fail on rounding."""
        self = object.__new__(cls)
        vertices.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Polygon) and np.array_equal(self.vertices, other.vertices)

    def __hash__(self) -> int:
        return hash(self.vertices.tobytes())

    def __len__(self) -> int:
        return len(self.vertices)

    @cached_property
    def area(self) -> float:
        """Enclosed area [m²], by the shoelace formula."""
        return 0.5 * _twice_area(self.vertices)

    @cached_property
    def centroid(self) -> Array:
        """Centre of area (2,) [m]: the centre of mass at uniform density."""
        origin = self.vertices[0]  # a near origin keeps the differences exact for polygons far from zero
        v = self.vertices - origin
        after = np.roll(v, -1, axis=0)
        return origin + ((v + after) * _cross(v, after)[:, None]).sum(axis=0) / (6.0 * self.area)

    @cached_property
    def radius_of_gyration(self) -> float:
        """√(I/m) [m] about the centroid, out of the plane."""
        v = self.vertices - self.centroid
        after = np.roll(v, -1, axis=0)
        second = (v * v + v * after + after * after).sum(axis=1) @ _cross(v, after) / 12.0
        return float(np.sqrt(second / self.area))

    def inertia(self, mass: float) -> float:
        """Moment of inertia [kg·m²] about the centroid, out of the plane, at uniform density."""
        return mass * self.radius_of_gyration**2

    @cached_property
    def bounding_radius(self) -> float:
        """Distance [m] of the farthest vertex from the centroid."""
        return float(np.linalg.norm(self.vertices - self.centroid, axis=1).max())

    @cached_property
    def is_convex(self) -> bool:
        """Whether no corner turns clockwise. Straight corners count as convex."""
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        lengths = np.linalg.norm(edges, axis=1)
        before = np.roll(np.arange(len(edges)), 1)
        return bool((_cross(edges[before], edges) >= -_RELATIVE * lengths[before] * lengths).all())

    @cached_property
    def normals(self) -> Array:
        """Unit outward normals (N, 2) of the faces; face i runs from vertex i to vertex i+1."""
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        return np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]

    def boundary(self, spacing: float) -> Boundary:
        """Samples along the boundary, neighbours at most ``spacing`` [m] apart along it."""
        if not (np.isfinite(spacing) and spacing > 0):
            raise ValueError(f"spacing is {spacing}; expected a positive length [m]")
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        lengths = np.linalg.norm(edges, axis=1)
        counts = np.maximum(1, np.ceil(lengths / spacing * (1 - _RELATIVE))).astype(np.int64)
        faces = np.repeat(np.arange(len(edges)), counts)
        within = np.arange(len(faces)) - np.repeat(np.cumsum(counts) - counts, counts)
        fraction = (within + 0.5) / counts[faces]
        points = self.vertices[faces] + fraction[:, None] * edges[faces]
        return Boundary(points, self.normals[faces], faces, (lengths / counts)[faces])

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance (...,) [m] of ``points`` (..., 2) to the boundary, negative inside."""
        p = np.asarray(points, dtype=float)
        if p.shape[-1:] != (2,):
            raise ValueError(f"points have shape {p.shape}; expected (..., 2)")
        a = self.vertices
        edge = np.roll(a, -1, axis=0) - a
        to_p = p[..., None, :] - a  # (..., N, 2)
        fraction = np.clip((to_p * edge).sum(axis=-1) / (edge * edge).sum(axis=-1), 0.0, 1.0)
        distance = np.linalg.norm(to_p - fraction[..., None] * edge, axis=-1).min(axis=-1)
        # Even-odd rule: a ray toward +x crosses an edge whose ends lie on either side of it, right of the point.
        starts_below = to_p[..., 1] >= 0
        straddles = starts_below != np.roll(starts_below, -1, axis=-1)
        left_of_edge = (_cross(edge, to_p) > 0) == (edge[:, 1] > 0)
        inside = np.count_nonzero(straddles & left_of_edge, axis=-1) % 2 == 1
        return np.where(inside, -distance, distance)

    def convex_pieces(self) -> list[Array]:
        """Convex polygons (n, 2), counter-clockwise, whose union is this polygon and whose interiors are disjoint.

        Constrained Delaunay triangulation, then diagonals are dropped as long as both their ends stay convex
        (Hertel–Mehlhorn: at most four times as many pieces as there can be). No vertex is added.
        """
        if self.is_convex:
            return [self.vertices.copy()]
        return [self.vertices[piece] for piece in _merged(self.vertices, _triangles(self.vertices))]

    def centred(self) -> Polygon:
        """The same shape with its centroid at the origin."""
        return Polygon._of(self.vertices - self.centroid)

    def transformed(self, pose: ArrayLike) -> Polygon:
        """The polygon, given in B, expressed in A: ``pose`` is X_AB = (x, y, θ)."""
        x, y, theta = np.asarray(pose, dtype=float)
        return Polygon._of(_rotated(self.vertices, theta) + np.array([x, y]))

    def lowest_vertices(self, theta: float = 0.0, tolerance: float = 1e-6) -> tuple[int, ...]:
        """Indices of the vertices within ``tolerance`` [m] of the lowest one, the polygon turned by ``theta``."""
        height = _rotated(self.vertices, theta)[:, 1]
        return tuple(int(i) for i in np.flatnonzero(height <= height.min() + tolerance))


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _twice_area(vertices: Array) -> float:
    v = vertices - vertices[0]
    return float(_cross(v, np.roll(v, -1, axis=0)).sum())


def _rotated(points: Array, theta: float) -> Array:
    c, s = np.cos(theta), np.sin(theta)
    return points @ np.array([[c, s], [-s, c]])


def _checked(vertices: ArrayLike) -> Array:
    """The points as an (N, 2) array of their own, or PolygonError."""
    try:
        v = np.array(vertices, dtype=float)
    except (TypeError, ValueError) as e:
        raise PolygonError("the vertices are no list of points; expected [[x, y], ...]") from e
    if v.ndim != 2 or v.shape[1] != 2:
        raise PolygonError(f"the vertices have shape {v.shape}; expected (N, 2)")
    if len(v) < 3:
        raise PolygonError(f"{len(v)} vertices; expected at least 3")
    if not np.isfinite(v).all():
        i = int(np.flatnonzero(~np.isfinite(v).all(axis=1))[0])
        raise PolygonError(f"vertex {i} is not finite", (i,))
    extent = float(np.ptp(v, axis=0).max())
    edges = np.roll(v, -1, axis=0) - v
    lengths = np.linalg.norm(edges, axis=1)
    if (same := np.flatnonzero(lengths <= _RELATIVE * extent)).size:
        i, j = int(same[0]), (int(same[0]) + 1) % len(v)
        raise PolygonError(f"vertices {i} and {j} coincide; list each corner once", (i, j))
    turn = _cross(edges, np.roll(edges, -1, axis=0)) / (lengths * np.roll(lengths, -1))
    ahead = (edges * np.roll(edges, -1, axis=0)).sum(axis=1)
    if (back := np.flatnonzero((np.abs(turn) <= _RELATIVE) & (ahead < 0))).size:
        i, n = int(back[0]), len(v)
        j, k = (i + 1) % n, (i + 2) % n
        raise PolygonError(f"edge {i}–{j} folds back on edge {j}–{k}", (j, i, k))
    if (pair := _crossing(v)) is not None:
        (a, b), (c, d) = pair
        raise PolygonError(
            f"self-intersecting: edge {a}–{b} crosses edge {c}–{d} (vertices counted from 0)", (a, b, c, d)
        )
    if abs(_twice_area(v)) <= _RELATIVE * extent**2:
        raise PolygonError("the vertices enclose no area")
    return v


def _crossing(vertices: Array) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The first two edges, not neighbours, that have a point in common."""
    n = len(vertices)
    edges = [shapely.LineString(ends) for ends in np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1)]
    first, second = shapely.STRtree(edges).query(edges, predicate="intersects")
    gap = (second - first) % n
    found = np.flatnonzero((first < second) & (gap != 1) & (gap != n - 1))
    if not found.size:
        return None
    k = found[np.lexsort((second[found], first[found]))[0]]
    i, j = int(first[k]), int(second[k])
    return (i, (i + 1) % n), (j, (j + 1) % n)


def _triangles(vertices: Array) -> list[list[int]]:
    """Indices of the corners of a constrained Delaunay triangulation, each triangle counter-clockwise."""
    index = {(x, y): i for i, (x, y) in enumerate(vertices.tolist())}
    out: list[list[int]] = []
    for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(vertices))):
        corners = [index[x, y] for x, y in shapely.get_coordinates(triangle)[:3].tolist()]
        twice = _twice_area(vertices[corners])
        if twice != 0:
            out.append(corners if twice > 0 else corners[::-1])
    return out


def _merged(vertices: Array, pieces: list[list[int]]) -> list[list[int]]:
    """Pieces joined across shared edges, longest first, wherever the union stays convex."""
    owner = {edge: k for k, piece in enumerate(pieces) for edge in _edges(piece)}
    diagonals = [(a, b) for a, b in owner if a < b and (b, a) in owner]
    diagonals.sort(key=lambda e: (-float(np.linalg.norm(vertices[e[0]] - vertices[e[1]])), e))
    living = dict(enumerate(pieces))
    for a, b in diagonals:
        left, right = owner[a, b], owner[b, a]
        p, q = living[left], living[right]
        # p runs b … a and then along the diagonal; q runs a … b.
        p, q = _starting_at(p, b), _starting_at(q, a)
        joined = p + q[1:-1]
        if _turns_left(vertices, p[-2], a, q[1]) and _turns_left(vertices, q[-2], b, p[1]):
            living[left] = joined
            del living[right]
            owner.update(dict.fromkeys(_edges(joined), left))
    return list(living.values())


def _edges(piece: list[int]) -> list[tuple[int, int]]:
    return list(zip(piece, piece[1:] + piece[:1], strict=True))


def _starting_at(piece: list[int], vertex: int) -> list[int]:
    at = piece.index(vertex)
    return piece[at:] + piece[:at]


def _turns_left(vertices: Array, before: int, at: int, after: int) -> bool:
    a, b = vertices[at] - vertices[before], vertices[after] - vertices[at]
    return bool(_cross(a, b) >= -1e-12 * np.linalg.norm(a) * np.linalg.norm(b))
