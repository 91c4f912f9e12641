"""The alignment step of ICP: boundary points that a finger saw, against the known outline, constrained to SE(2).

Paper, *Tactile State-Estimation*. Interface: `align(outline, seen, prior)` takes the object's `Polygon` in its own
frame, `BoundaryPoints` in ee and a `GraspPrior`, and answers with an `Alignment`: a `TactilePose` and what became of
each point. Whatever sensor the points come from, it states of them

* ``sigma``: what is independent from point to point, robustly weighted (a point that no edge explains counts nothing);
* a `Systematic` part, which no number of points averages out: each edge of the picture may lie off as a whole, and be
  turned, and the picture may lie off in the finger. It is integrated out, so that it weighs in pose and covariance.

``metric="line"`` measures across the matched edge, ``"point"`` to the nearest point of the outline, as the paper does.
Both work in the information form H = Σ Jᵀ J / σ² + P₀⁻¹ and both state the information of the lines: a point says where
its edge is, not where along it, so what only parallel sides show stays at the prior along them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.tactile_pose import GraspPrior, PoseStatus, TactilePose, left_difference, left_moved, open_directions
from mechanics.polygon import Polygon
from mechanics.readings import Array

Indices = NDArray[np.int64]

#: how far a seen edge's direction may be off for it to be taken for an edge of the outline [rad]
FACING = np.radians(35.0)
#: scale of the robust weights while the matches settle, from the first iterations to the last [m]
SETTLING = (4e-3, 4e-3, 2e-3, 2e-3, 1e-3, 1e-3, 5e-4)
#: beyond this many standard deviations a settled point counts a quarter of its weight
ROBUST = 2.5
#: least share of the points, by their information, that the outline must explain
EXPLAINED = 0.5
#: squared distance from the prior beyond which pose and prior exclude each other: χ² of three, once in 10⁶
EXCLUDED = 30.7


@dataclass(frozen=True)
class Systematic:
    """Standard deviations of what the points have in common.

    Each edge is off by ``offset`` [m] and turned by ``tilt`` [rad] about the middle of its points, on its own; the
    whole picture is off by ``shift`` [m] in x and y and by ``turn`` [rad].
    """

    offset: float = 0.15e-3
    tilt: float = np.radians(0.2)
    shift: float = 0.03e-3
    turn: float = np.radians(0.05)


@dataclass(frozen=True, eq=False)
class BoundaryPoints:
    """Points (m, 2) [m] in ee where a finger saw the object's boundary.

    ``sigma`` (m,) or one for all [m]: standard deviation across the edge, independent from point to point. ``normals``
    (m, 2): unit, out of the object, in ee; None where the sensor does not tell. ``edges`` (m,): index of the outline's
    edge (from vertex i to i + 1) where the method knows it, −1 where not; None: not of any.
    """

    points: Array
    sigma: Array
    normals: Array | None = None
    edges: Indices | None = None

    def __init__(self, points: ArrayLike, sigma: ArrayLike, normals: ArrayLike | None = None, edges: Any = None):
        points = np.array(points, float).reshape(-1, 2)
        m = len(points)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "sigma", np.broadcast_to(np.asarray(sigma, float), (m,)).copy())
        object.__setattr__(self, "normals", None if normals is None else np.array(normals, float).reshape(m, 2))
        object.__setattr__(self, "edges", None if edges is None else np.array(edges, np.int64).reshape(m))
        if not ((self.sigma > 0) & np.isfinite(self.sigma)).all():
            raise ValueError("boundary points: every sigma must be a positive length [m]")
        if not np.isfinite(points).all():
            raise ValueError("boundary points: every coordinate must be finite")

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Alignment:
    """An aligned ``pose`` and, per point (m,): its ``edges`` index (−1: none), ``residuals`` [m] across that edge.

    A residual is positive where the point lies outside the outline. ``weights`` are 1 for a point that its edge
    explains, toward 0 for one that it does not; ``explained`` is the share of the points' information that is.
    """

    pose: TactilePose
    edges: Indices = field(default_factory=lambda: np.empty(0, np.int64))
    residuals: Array = field(default_factory=lambda: np.empty(0))
    weights: Array = field(default_factory=lambda: np.empty(0))
    explained: float = 0.0


def align(
    outline: Polygon,
    seen: BoundaryPoints,
    prior: GraspPrior,
    *,
    start: ArrayLike | None = None,
    metric: Literal["line", "point"] = "line",
    systematic: Systematic = Systematic(),
    settling: tuple[float, ...] = SETTLING,
    least: int = 3,
    least_explained: float = EXPLAINED,
) -> Alignment:
    """X_ee_go that lays the ``outline`` on what was ``seen``, from ``start`` (3,) (default: the prior's pose).

    ``settling`` are the scales [m] of the robust weights in the first iterations; give few and small ones where
    ``start`` is already good. Status NO_EDGE where fewer than ``least`` points are seen; MISMATCH where the outline
    explains less than ``least_explained`` of them or the pose and the prior exclude each other.
    """
    if len(seen) < least:
        reason = f"{len(seen)} boundary points; expected at least {least}"
        return Alignment(TactilePose.unknown(prior, PoseStatus.NO_EDGE, reason))
    pose = np.array(prior.pose if start is None else start, float)
    P0 = prior.information
    for scale in (*settling, *(0.0,) * 4):
        match = _match(outline, seen, pose)
        weights = _weights(match, seen, systematic, scale)
        delta = left_difference(pose, prior.pose)
        if metric == "line":
            information, pull = _lines(match, seen, weights, systematic)
        else:
            information, pull = _points(match, seen, weights, systematic)
        step = np.asarray(np.linalg.solve(information + P0, pull - P0 @ delta), np.float64)
        pose = left_moved(pose, step)
        if scale == 0.0 and np.abs(step).max() < 1e-6:
            break
    match = _match(outline, seen, pose)
    weights = _weights(match, seen, systematic, 0.0)
    information = _blurred(_lines(match, seen, weights, systematic)[0], systematic)
    trust = seen.sigma**-2
    explained = float((trust * (weights > 0.5)).sum() / trust.sum())
    result = TactilePose(
        pose,
        np.asarray(np.linalg.inv(information + P0), np.float64),
        information,
        open_directions(information),
        edges=seen.points,
    )
    reason = _objection(explained, least_explained, left_difference(pose, prior.pose), prior)
    if reason:
        result = TactilePose.unknown(prior, PoseStatus.MISMATCH, reason)
    return Alignment(result, match.edges, match.residuals, weights, explained)


def _objection(explained: float, least: float, delta: Array, prior: GraspPrior) -> str:
    if explained < least:
        return f"the outline explains {100 * explained:.0f} % of the edges that show; is it the outline of this object?"
    squared = float(delta @ prior.information @ delta)
    if squared > EXCLUDED:
        x, y, theta = delta
        return (
            f"the edges lie {1e3 * np.hypot(x, y):.1f} mm and {np.degrees(abs(theta)):.1f}° from where the grasp "
            f"should have them, {np.sqrt(squared):.0f} standard deviations"
        )
    return ""


@dataclass(frozen=True, eq=False)
class _Match:
    """What each point (m,) is held against: its edge, that edge's normal, how far outside the point is."""

    edges: Indices
    normals: Array  # (m, 2), of the edge, in ee
    residuals: Array  # (m,) across the edge
    nearest: Array  # (m, 2) nearest point of the edge, in ee
    along: Array  # (m,) along the edge from its middle [m]


def _match(outline: Polygon, seen: BoundaryPoints, pose: Array) -> _Match:
    """Each point's nearest edge among those that face as it does; −1 where none does."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    R_T = np.array([[c, s], [-s, c]])
    a = outline.vertices @ R_T + pose[:2]
    normals = outline.normals @ R_T
    edge = np.roll(a, -1, axis=0) - a
    squared = (edge * edge).sum(axis=1)
    to_p = seen.points[:, None, :] - a  # (m, n, 2)
    fraction = np.clip((to_p * edge).sum(axis=2) / squared, 0.0, 1.0)
    gap = to_p - fraction[..., None] * edge
    distance = np.sqrt((gap * gap).sum(axis=2))
    if seen.normals is not None:
        distance = np.where(seen.normals @ normals.T > np.cos(FACING), distance, np.inf)
    if seen.edges is not None:
        known = seen.edges >= 0
        others = np.arange(len(a)) != seen.edges[:, None]
        distance = np.where(known[:, None] & others, np.inf, distance)
    edges = distance.argmin(axis=1)
    rows = np.arange(len(edges))
    matched = np.isfinite(distance[rows, edges])
    n = normals[edges]
    residuals = np.where(matched, (n * to_p[rows, edges]).sum(axis=1), np.inf)
    length = np.sqrt(squared)[edges]
    tangent = edge[edges] / length[:, None]
    along = (tangent * to_p[rows, edges]).sum(axis=1) - 0.5 * length
    # beyond its edge's ends a point has no line to be held against
    residuals[np.abs(along) > 0.5 * length + 2e-3] = np.inf
    edges = np.where(np.isfinite(residuals), edges, -1)
    return _Match(edges, n, residuals, seen.points - gap[rows, edges.clip(0)], along)


def _weights(match: _Match, seen: BoundaryPoints, systematic: Systematic, scale: float) -> Array:
    """Geman–McClure weights (m,) of the residuals, at ``scale`` [m] or what the points state, whichever is more."""
    width = np.maximum(np.hypot(ROBUST * seen.sigma, ROBUST * systematic.offset), scale)
    return (1.0 + (match.residuals / width) ** 2) ** -2.0


def _rows(normals: Array, points: Array) -> Array:
    """Minus the derivative (m, 3) of n · p by Δ of the outline about ee's origin."""
    return np.column_stack((normals, normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]))


def _lines(match: _Match, seen: BoundaryPoints, weights: Array, systematic: Systematic) -> tuple[Array, Array]:
    """Information (3, 3) and pull (3,) of residuals across the edges, offset and tilt of each edge integrated out."""
    on = match.edges >= 0
    edges, along, r = match.edges[on], match.along[on], match.residuals[on]
    J = _rows(match.normals[on], seen.points[on])
    W = weights[on] / seen.sigma[on] ** 2
    information, pull = (J * W[:, None]).T @ J, (J * W[:, None]).T @ r
    for edge in np.unique(edges):
        own = edges == edge
        w = W[own]
        middle = (w * along[own]).sum() / max(w.sum(), 1e-30)
        B = np.column_stack((np.full(own.sum(), systematic.offset), systematic.tilt * (along[own] - middle)))
        JB = (J[own] * w[:, None]).T @ B
        inner = np.linalg.inv(np.eye(2) + (B * w[:, None]).T @ B)
        information -= JB @ inner @ JB.T
        pull -= JB @ inner @ ((B * w[:, None]).T @ r[own])
    return information, pull


def _points(match: _Match, seen: BoundaryPoints, weights: Array, systematic: Systematic) -> tuple[Array, Array]:
    """Information and pull of the residuals to the nearest points of the outline: the paper's L2 distance."""
    on = match.edges >= 0
    q = match.nearest[on]
    W = weights[on] / (seen.sigma[on] ** 2 + systematic.offset**2)
    gap = seen.points[on] - q
    information, pull = np.zeros((3, 3)), np.zeros(3)
    for axis in range(2):
        J = _rows(np.broadcast_to(np.eye(2)[axis], q.shape), q)
        information += (J * W[:, None]).T @ J
        pull += (J * W[:, None]).T @ gap[:, axis]
    return information, pull


def _blurred(information: Array, systematic: Systematic) -> Array:
    """The information that is left when the whole picture may lie off: (I⁻¹ + C)⁻¹, for a singular I as well."""
    loose = np.diag([systematic.shift**-2, systematic.shift**-2, systematic.turn**-2])
    return information - information @ np.linalg.solve(information + loose, information)
