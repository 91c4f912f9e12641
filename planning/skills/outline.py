"""Places on the outline of a polygon: faces, corners, and which face is where.

Outlines (V, 2) run counter-clockwise; face i leads from vertex i to vertex i+1. Along a face, e is its outward normal
turned by −90°: against the sense in which the outline runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics.polygon import Polygon
from mechanics.readings import Array

#: how far [m] a point that is given in millimetres may lie off the outline
ON_OUTLINE = 0.5e-3
#: a contact this close [m] to the end of its face counts as a corner
CORNER = 0.1e-3


@dataclass(frozen=True, eq=False)
class Place:
    """A ``point`` (2,) [m] on face number ``face``, whose outward unit normal is ``normal`` (2,).

    ``before`` and ``after`` [m] are how far the face goes on along −e and along +e.
    """

    point: Array
    face: int
    normal: Array
    before: float
    after: float


def straightened(vertices: Array) -> Array:
    """Return the outline (V', 2), counter-clockwise, without vertices in the middle of a straight face."""
    v = Polygon(vertices).vertices
    into, out = v - np.roll(v, 1, axis=0), np.roll(v, -1, axis=0) - v
    turn = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
    return v[np.abs(turn) > 1e-9 * np.linalg.norm(into, axis=1) * np.linalg.norm(out, axis=1)]


def normals(vertices: Array) -> Array:
    """Return the outward unit normals (V, 2) of the faces."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    return np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]


def on_face(vertices: Array, face: int, share: float = 0.5) -> Place:
    """Return the place at ``share`` of a face's length, counted along e."""
    a, b = vertices[face], vertices[(face + 1) % len(vertices)]
    length = float(np.linalg.norm(b - a))
    return Place(b + share * (a - b), face, normals(vertices)[face], share * length, (1 - share) * length)


def nearest(vertices: Array, point_mm: tuple[float, float], name: str, body: str) -> Place:
    """Return the place nearest to ``point_mm`` [mm] in the body's frame.

    Raises ValueError, which begins with ``name``, where the point lies off the outline or on a corner.
    """
    p = np.asarray(point_mm) * 1e-3
    a = vertices
    edge = np.roll(vertices, -1, axis=0) - a
    share = np.clip(((p - a) * edge).sum(axis=1) / (edge * edge).sum(axis=1), 0.0, 1.0)
    away = np.linalg.norm(a + share[:, None] * edge - p, axis=1)
    face = int(away.argmin())
    if away[face] > ON_OUTLINE:
        raise ValueError(
            f"{name}: expected a point on the outline of {body}, received ({point_mm[0]:g}, {point_mm[1]:g}) mm, which"
            f" lies {away[face] * 1e3:.3g} mm off it"
        )
    place = on_face(vertices, face, 1 - float(share[face]))
    if min(place.before, place.after) < CORNER:
        raise ValueError(
            f"{name}: expected a point on a face of {body}, received ({point_mm[0]:g}, {point_mm[1]:g}) mm, which is"
            " its corner: keep off it, or let a face of the other body touch it"
        )
    return place


def corner(vertices: Array, point_mm: tuple[float, float], name: str, body: str) -> int:
    """Return the vertex at ``point_mm`` [mm]. Raises ValueError, which begins with ``name``, where there is none."""
    away = np.linalg.norm(vertices - np.asarray(point_mm) * 1e-3, axis=1)
    if away.min() > ON_OUTLINE:
        there = ", ".join(f"({x:g}, {y:g})" for x, y in (vertices * 1e3).round(2))
        raise ValueError(
            f"{name}: expected a corner of {body}, one of {there} mm, received ({point_mm[0]:g}, {point_mm[1]:g}) mm"
        )
    return int(away.argmin())


def is_convex_corner(vertices: Array, i: int) -> bool:
    """Whether the outline turns left at vertex ``i``: only such a corner can touch a face."""
    into, out = vertices[i] - vertices[i - 1], vertices[(i + 1) % len(vertices)] - vertices[i]
    return bool(into[0] * out[1] - into[1] * out[0] > 0)


def facing(vertices: Array, direction: Array) -> int:
    """Return the face that looks most nearly along ``direction`` (2,); of several, the one farthest along it."""
    along = normals(vertices) @ direction
    middles = (vertices + np.roll(vertices, -1, axis=0)) / 2
    best = np.flatnonzero(along > along.max() - 1e-6)
    return int(best[(middles[best] @ direction).argmax()])
