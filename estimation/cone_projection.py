"""The friction-cone program of the paper's contact search, at many candidate points at once, in closed form.

*Tactile State-Estimation*: at a fixed point the contact program is a convex QP, min ‖w − Gᵀf‖² over f in the friction
cone. In the plane the cone has two rays, so that the least residual is taken in the interior, on one ray, on the
other, or by no force at all; the four are tried in turn. The norm is that of the wrench's information matrix, which
may be singular: a direction of the wrench that nothing has measured costs nothing.

Everything here is in the axes of one frame (the go's); forces are those of the environment *on* the go.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from mechanics.friction import tangent
from mechanics.readings import Array

#: two rays are one when the squared sine of their angle, as the wrench's information sees it, is below this
_ONE_RAY = 1e-12
#: the golden section
_GOLDEN = 0.6180339887498949


class ConeFit(NamedTuple):
    """The best admissible ``force`` (..., 2) [N] of each candidate, and the ``chi2`` (...) that it leaves."""

    force: Array
    chi2: Array


def cone_rays(normal: ArrayLike, mu: ArrayLike) -> Array:
    """The two edges (..., 2, 2), one a row, of the cone about ``normal`` (..., 2), which points into the go.

    Each has a unit component along the normal: a row is the force f_n = 1 N, f_t = ∓µ.
    """
    normal = np.asarray(normal, float)
    side = np.asarray(mu, float)[..., None] * tangent(normal)
    return np.stack(np.broadcast_arrays(normal - side, normal + side), axis=-2)


def square_root(information: ArrayLike) -> Array:
    """L (..., 3, 3) with LᵀL = ``information``, symmetric and positive semidefinite; it need not be regular."""
    values, vectors = np.linalg.eigh(np.asarray(information, float))
    return np.ascontiguousarray(np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2))


def project(points: ArrayLike, rays: ArrayLike, wrench: ArrayLike, root: ArrayLike, about: ArrayLike) -> ConeFit:
    """The forces in the cones at ``points`` that explain each ``wrench`` best: force (n, M, 2), χ² (n, M).

    ``points`` (M, 2) [m], ``rays`` (M, 2, 2) from `cone_rays`, ``wrench`` (n, 3) [N, N, N·m] about ``about`` (2,),
    ``root`` (3, 3) or (n, 3, 3) from `square_root`. A single wrench (3,) is answered by (M, 2) and (M,). Raises
    ValueError for shapes that do not fit.
    """
    points, rays = np.ascontiguousarray(points, float), np.ascontiguousarray(rays, float)
    wrench, root = np.asarray(wrench, float), np.asarray(root, float)
    many = np.ascontiguousarray(np.atleast_2d(wrench))
    roots = np.ascontiguousarray(root if root.ndim == 3 else root[None])
    m, n = len(points), len(many)
    if points.shape != (m, 2) or rays.shape != (m, 2, 2) or many.shape != (n, 3) or roots.shape[1:] != (3, 3):
        raise ValueError(
            f"project: expected points (M, 2), rays (M, 2, 2), wrench (n, 3), root (3, 3), received {points.shape}, "
            f"{rays.shape}, {wrench.shape}, {root.shape}"
        )
    if len(roots) not in (1, n):
        raise ValueError(f"project: expected one root or {n}, received {len(roots)}")
    force, chi2 = np.empty((n, m, 2)), np.empty((n, m))
    _project(points, rays, many, roots, np.ascontiguousarray(about, float), force, chi2)
    return ConeFit(force[0], chi2[0]) if wrench.ndim == 1 else ConeFit(force, chi2)


@njit(cache=True)
def _project(points, rays, wrenches, roots, about, force, chi2):
    for i in range(len(wrenches)):
        L = roots[i if len(roots) > 1 else 0]
        w0, w1, w2 = _whitened(L, wrenches[i, 0], wrenches[i, 1], wrenches[i, 2])
        for k in range(len(points)):
            fx, fy, c = cone_fit(L, w0, w1, w2, points[k, 0] - about[0], points[k, 1] - about[1], rays[k])
            force[i, k, 0], force[i, k, 1], chi2[i, k] = fx, fy, c


@njit(cache=True)
def _whitened(L, x, y, t):
    return (
        L[0, 0] * x + L[0, 1] * y + L[0, 2] * t,
        L[1, 0] * x + L[1, 1] * y + L[1, 2] * t,
        L[2, 0] * x + L[2, 1] * y + L[2, 2] * t,
    )


@njit(cache=True)
def cone_fit(L, w0, w1, w2, px, py, rays):
    """Force and χ² at the point (px, py) from where moments are taken; w is the whitened wrench.

    The residual is formed and squared, not subtracted from wᵀw: a fit of χ² = 1 to a force of a hundred standard
    deviations would lose four digits.
    """
    rx, ry, sx, sy = rays[0, 0], rays[0, 1], rays[1, 0], rays[1, 1]
    a0, a1, a2 = _whitened(L, rx, ry, px * ry - py * rx)
    b0, b1, b2 = _whitened(L, sx, sy, px * sy - py * sx)
    aa, bb, ab = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2, a0 * b0 + a1 * b1 + a2 * b2
    aw, bw = a0 * w0 + a1 * w1 + a2 * w2, b0 * w0 + b1 * w1 + b2 * w2
    u, v = 0.0, 0.0
    inside = False
    if aa > 0.0 and bb > 0.0:
        # the part of b across a, and of what remains of w
        share = ab / aa
        c0, c1, c2 = b0 - share * a0, b1 - share * a1, b2 - share * a2
        cc = c0 * c0 + c1 * c1 + c2 * c2
        if cc > _ONE_RAY * bb:
            v = (c0 * w0 + c1 * w1 + c2 * w2) / cc
            u = (aw - v * ab) / aa
            inside = u >= 0.0 and v >= 0.0
    if not inside:
        gain_a = aw * aw / aa if aa > 0.0 and aw > 0.0 else 0.0
        gain_b = bw * bw / bb if bb > 0.0 and bw > 0.0 else 0.0
        u, v = 0.0, 0.0
        if gain_a >= gain_b:
            if gain_a > 0.0:
                u = aw / aa
        else:
            v = bw / bb
    e0, e1, e2 = w0 - u * a0 - v * b0, w1 - u * a1 - v * b1, w2 - u * a2 - v * b2
    return u * rx + v * sx, u * ry + v * sy, e0 * e0 + e1 * e1 + e2 * e2


@njit(cache=True)
def fit_sites(start, along, length, count, rays, wrenches, roots, about, prior, fits):
    """The best point of every site for every wrench, the best sample refined by the golden section.

    A site is a straight stretch of the outline with one cone: ``start`` (S, 2), unit ``along`` (S, 2), ``length``
    (S,), zero at a vertex, ``count`` (S,) samples, ``rays`` (S, 2, 2). ``prior`` (3,) is a point and the information
    [1/m²] that the contact is there. ``fits`` (n, S, 6) receives distance along, χ² of the wrench, χ² of the prior,
    fx, fy, and the information [1/m²] that the wrench holds on the distance along.
    """
    for i in range(len(wrenches)):
        L = roots[i if len(roots) > 1 else 0]
        w = _whitened(L, wrenches[i, 0], wrenches[i, 1], wrenches[i, 2])
        for k in range(len(start)):
            best, at = inf, 0.0
            step = length[k] / count[k]
            for j in range(count[k]):
                s = (j + 0.5) * step
                cost = _cost(L, w, start[k], along[k], rays[k], about, prior, s)
                if cost < best:
                    best, at = cost, s
            if length[k] > 0.0:
                at = _refined(L, w, start[k], along[k], rays[k], about, prior, max(at - step, 0.0),
                              min(at + step, length[k]))  # fmt: skip
            x, y = start[k, 0] + at * along[k, 0], start[k, 1] + at * along[k, 1]
            fx, fy, chi2 = cone_fit(L, w[0], w[1], w[2], x - about[0], y - about[1], rays[k])
            fits[i, k, 0], fits[i, k, 1], fits[i, k, 3], fits[i, k, 4] = at, chi2, fx, fy
            fits[i, k, 2] = prior[2] * ((x - prior[0]) ** 2 + (y - prior[1]) ** 2)
            moment = along[k, 0] * fy - along[k, 1] * fx
            fits[i, k, 5] = _information_along(L, x - about[0], y - about[1], moment)


@njit(cache=True)
def _cost(L, w, start, along, rays, about, prior, s):
    x, y = start[0] + s * along[0], start[1] + s * along[1]
    _, _, chi2 = cone_fit(L, w[0], w[1], w[2], x - about[0], y - about[1], rays)
    return chi2 + prior[2] * ((x - prior[0]) ** 2 + (y - prior[1]) ** 2)


@njit(cache=True)
def _refined(L, w, start, along, rays, about, prior, low, high):
    ends = low, high
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    cost_a = _cost(L, w, start, along, rays, about, prior, a)
    cost_b = _cost(L, w, start, along, rays, about, prior, b)
    while high - low > 1e-7:
        if cost_a <= cost_b:
            high, b, cost_b = b, a, cost_a
            a = high - _GOLDEN * (high - low)
            cost_a = _cost(L, w, start, along, rays, about, prior, a)
        else:
            low, a, cost_a = a, b, cost_b
            b = low + _GOLDEN * (high - low)
            cost_b = _cost(L, w, start, along, rays, about, prior, b)
    best, at = min(cost_a, cost_b), 0.5 * (low + high)
    for end in ends:
        if _cost(L, w, start, along, rays, about, prior, end) < best:
            at = end
    return at


@njit(cache=True)
def _information_along(L, px, py, moment):
    """What the wrench says of the distance along a face, the force free: |d across both columns of the force|².

    ``moment`` [N] is what a step along the face adds to the torque. Where the cone binds the wrench says more; a
    force on its very edge cannot be told from one just inside.
    """
    c = np.empty((3, 3))
    c[0, 0], c[0, 1], c[0, 2] = _whitened(L, 1.0, 0.0, -py)
    c[1, 0], c[1, 1], c[1, 2] = _whitened(L, 0.0, 1.0, px)
    c[2, 0], c[2, 1], c[2, 2] = _whitened(L, 0.0, 0.0, moment)
    for j in range(3):
        size = c[j, 0] ** 2 + c[j, 1] ** 2 + c[j, 2] ** 2
        for _ in range(2):  # twice is enough: one pass leaves rounding where the columns are nearly parallel
            for m in range(j):
                share = c[m, 0] * c[j, 0] + c[m, 1] * c[j, 1] + c[m, 2] * c[j, 2]
                c[j, 0], c[j, 1], c[j, 2] = (
                    c[j, 0] - share * c[m, 0],
                    c[j, 1] - share * c[m, 1],
                    c[j, 2] - share * c[m, 2],
                )
        left = c[j, 0] ** 2 + c[j, 1] ** 2 + c[j, 2] ** 2
        if left <= _ONE_RAY * size:
            left = 0.0
        if j == 2:
            return left
        scale = 1.0 / sqrt(left) if left > 0.0 else 0.0
        c[j, 0], c[j, 1], c[j, 2] = c[j, 0] * scale, c[j, 1] * scale, c[j, 2] * scale
    return 0.0


@njit(cache=True)
def chi2_on(start, along, offset, length, group, rays, wrench, root, about, of, s, chi2):
    """χ² (N,) of boundary points, point i at distance ``s`` (N,) along group ``of`` (N,); ∞ where nothing can touch.

    Sites as in `fit_sites`. ``group`` (S,) is the face or vertex that a site is part of, and ``offset`` (S,) where
    on it the site begins. Of several sites at a point the best one counts.
    """
    w0, w1, w2 = _whitened(root, wrench[0], wrench[1], wrench[2])
    for i in range(len(of)):
        chi2[i] = inf
        for k in range(len(start)):
            d = s[i] - offset[k]
            if group[k] != of[i] or d < -1e-9 or d > length[k] + 1e-9:
                continue
            x, y = start[k, 0] + d * along[k, 0], start[k, 1] + d * along[k, 1]
            _, _, c = cone_fit(root, w0, w1, w2, x - about[0], y - about[1], rays[k])
            chi2[i] = min(chi2[i], c)
