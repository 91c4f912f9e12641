"""Compiled loops of `estimation.kink_fit` and `estimation.tactile_pose_strips`.

Pictures are float32 (rows, columns), all else float64 and int64. ``lines`` (n, 5) are the edges of an outline: first
vertex x, y, unit direction x, y, length [m]; outside is on their right.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def ridge_scores(picture, to_pixels, points, normals, faces, poses, reach, least, cap, level, out):
    """Score (k,) of each of ``poses`` (k, 3): how much of a ridge of ``picture`` lies under the moved outline.

    ``points``, ``normals`` (m, 2) are the outline's, in its own frame; ``to_pixels`` (3, 3) takes the frame of the
    poses to pixels. A sample's ridge is the second difference across its edge over ``reach`` [m]; it counts where the
    picture is within ``level`` of zero on the inner side: on the face. The mean of three neighbours on one of the
    ``faces`` (m,) counts above ``least`` and up to ``cap``.
    """
    rows, columns = picture.shape
    h = to_pixels
    for k in range(poses.shape[0]):
        x0, y0 = poses[k, 0], poses[k, 1]
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        total, last, before = 0.0, 0.0, 0.0
        for i in range(points.shape[0]):
            px, py = points[i, 0], points[i, 1]
            x, y = x0 + c * px - s * py, y0 + s * px + c * py
            nx = c * normals[i, 0] - s * normals[i, 1]
            ny = s * normals[i, 0] + c * normals[i, 1]
            # the homography is linear in front of its division: a step along the normal adds the same each time
            u0 = h[0, 0] * x + h[0, 1] * y + h[0, 2]
            v0 = h[1, 0] * x + h[1, 1] * y + h[1, 2]
            w0 = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            du = reach * (h[0, 0] * nx + h[0, 1] * ny)
            dv = reach * (h[1, 0] * nx + h[1, 1] * ny)
            dw = reach * (h[2, 0] * nx + h[2, 1] * ny)
            second, inner = 0.0, 0.0
            for j in range(3):
                past = j - 1.0
                over = 1.0 / (w0 + past * dw)
                u, v = (u0 + past * du) * over, (v0 + past * dv) * over
                if not (u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1):
                    inner = 1.0
                    break
                m, n = int(v), int(u)
                fu, fv = u - n, v - m
                value = (1 - fv) * ((1 - fu) * picture[m, n] + fu * picture[m, n + 1]) + fv * (
                    (1 - fu) * picture[m + 1, n] + fu * picture[m + 1, n + 1]
                )
                second += value if j != 1 else -2.0 * value
                if j == 0:
                    inner = value / level
                    if inner * inner >= 1.0:
                        break
            ridge = second * (1.0 - inner * inner) if inner * inner < 1.0 else 0.0
            if i >= 2 and faces[i] == faces[i - 2]:
                mean = (ridge + last + before) / 3.0
                if mean > least:
                    total += min(mean - least, cap)
            last, before = ridge, last
        out[k] = total


@njit(cache=True, error_model="numpy")
def pixels_about(near, beyond, to_points, to_ee, across, down, turn, points, rays, values):
    """The pixels of ``near`` (h, w), row by row, into ``points``, ``rays`` (m, 2) [m] in ee and ``values`` (m,) [m].

    ``to_points`` (3, 3) takes pixels to the face in F, ``to_ee`` (2, 3) that on to ee. A pixel's ray, of slopes
    ``across`` (w,) and ``down`` (h, 1) and turned by ``turn`` (2, 3) into F, is how far its point moves in ee as its
    depth grows by one; its value is its ``beyond`` (h, w).
    """
    b, M = to_points, to_ee
    m = 0
    for i in range(near.shape[0]):
        for j in range(near.shape[1]):
            if not near[i, j]:
                continue
            w = b[2, 0] * j + b[2, 1] * i + b[2, 2]
            x = (b[0, 0] * j + b[0, 1] * i + b[0, 2]) / w
            y = (b[1, 0] * j + b[1, 1] * i + b[1, 2]) / w
            points[m, 0] = M[0, 0] * x + M[0, 1] * y + M[0, 2]
            points[m, 1] = M[1, 0] * x + M[1, 1] * y + M[1, 2]
            x = turn[0, 0] * across[j] + turn[0, 1] * down[i, 0] + turn[0, 2]
            y = turn[1, 0] * across[j] + turn[1, 1] * down[i, 0] + turn[1, 2]
            rays[m, 0] = M[0, 0] * x + M[0, 1] * y
            rays[m, 1] = M[1, 0] * x + M[1, 1] * y
            values[m] = beyond[i, j]
            m += 1


@njit(cache=True, error_model="numpy")
def inverse_depth_plane(z, across, down, scales, w):
    """Refine the weights ``w`` (3,) of inverse depth over (1, X/z, Y/z), in place: the plane of most of the points.

    ``z`` (m,) are depths [m], ``across`` and ``down`` (m,) X/z and Y/z. A round for each of ``scales`` [m], by weights
    that end at three of it off the plane. Of inverse depth, an error of z weighs as 1/z².
    """
    H, g = np.empty((3, 3)), np.empty((3, 1))
    for scale in scales:
        H[:] = 0.0
        g[:] = 0.0
        total = 0.0
        for i in range(len(z)):
            x, y = across[i], down[i]
            off = (z[i] - 1.0 / (w[0] + w[1] * x + w[2] * y)) / (3.0 * scale)
            rest = 1.0 - off * off
            if rest <= 0.0:
                continue
            square = z[i] * z[i]
            trust = rest * rest * square * square
            total += trust
            H[0, 0] += trust
            H[1, 0] += trust * x
            H[2, 0] += trust * y
            H[1, 1] += trust * x * x
            H[2, 1] += trust * x * y
            H[2, 2] += trust * y * y
            t = trust / z[i]
            g[0, 0] += t
            g[1, 0] += t * x
            g[2, 0] += t * y
        for k in range(3):
            H[k, k] += 1e-12 * total
        w[:] = solve_positive(H, g)[:, 0]


@njit(cache=True, error_model="numpy")
def nearest_edges(points, lines, within, outside, corner, edges):
    """Index of each point's nearest edge into ``edges`` (m,).

    −1 for points (m, 2) that are farther inside than ``within`` [m] or outside than ``outside``, or within ``corner``
    of that edge's ends.
    """
    for i in range(points.shape[0]):
        best, edge, side, place = 1e9, -1, 0.0, 0.0
        for k in range(lines.shape[0]):
            rx, ry = points[i, 0] - lines[k, 0], points[i, 1] - lines[k, 1]
            along = rx * lines[k, 2] + ry * lines[k, 3]
            across = rx * lines[k, 3] - ry * lines[k, 2]
            past = max(0.0, -along, along - lines[k, 4])
            distance = across * across + past * past
            if distance < best:
                best, edge, side = distance, k, across
                place = min(along, lines[k, 4] - along)
        edges[i] = edge if place > corner and -within < side < outside else -1


@njit(cache=True, inline="always", error_model="numpy")
def _from_edge(x, y, line, own, window):
    """How far a point is along its edge and beyond it [m], and whether both lie within the window."""
    along = (x - line[0]) * line[2] + (y - line[1]) * line[3]
    a = (x - line[0]) * line[3] - (y - line[1]) * line[2]
    a -= own[0] + own[1] * (along - 0.5 * line[4])
    inside = window[2] <= along <= line[4] - window[2] and -window[0] <= a <= window[1]
    return along, a, inside


@njit(cache=True, error_model="numpy")
def kink_equations(
    points,
    rays,
    values,
    edges,
    lines,
    starts,
    width,
    slopes,
    own,
    plane,
    active,
    window,
    trust,
    gate,
    place,
    H,
    g,
    seen,
    costs,
):
    """Normal equations H (m, m), g (m,) of the kink's model, linearised at the present values.

    The model at a point (m, 2) is the ``plane`` (3,) plus, outside, s a − c a²/2, with a the distance from the edge, s
    the slope of its strip and c the curvature of its edge. ``edges`` (m,) are those of the points, −1: none. ``rays``
    (m, 2) is how far a point moves as its depth grows.
    Unknowns: the pose's Δ (3), the plane (3), then (offset, tilt, c) = ``own`` (n, 3) for each edge, then s for each
    strip; ``place`` (u,) says where each stands in H and g, −1: not at all. ``starts`` (n + 1,) number each edge's
    strips, ``width`` [m] wide, from its first vertex. ``window`` (4,) [m]: how far inside and outside points count, how
    near an edge's ends not, how far the kink is spread. ``trust`` is a point's information, ``gate`` [m] where a
    residual's weight ends.

    ``seen`` (strips, 3): sum of the residuals within, how many, and how many points are outside; ``costs`` (strips,):
    minus the logarithm of their likelihood.
    """
    n, strips = lines.shape[0], slopes.shape[0]
    seen[:] = 0.0
    costs[:] = 0.0
    # H has few entries: those of the plane and the Δ with each other, and the rows of each edge and of each strip, in
    # which an edge stands only with itself. The last column is g's
    shared, of_edge, of_strip = np.zeros((6, 7)), np.zeros((n, 3, 10)), np.zeros((strips, 11))
    J = np.empty(10)
    soft = window[3]
    for i in range(points.shape[0]):
        k = edges[i]
        if k < 0:
            continue
        x, y = points[i, 0], points[i, 1]
        tx, ty, length = lines[k, 2], lines[k, 3], lines[k, 4]
        along, a, inside = _from_edge(x, y, lines[k], own[k], window)
        if not inside:
            continue
        strip = starts[k] + min(int(along / width), starts[k + 1] - starts[k] - 1)
        s, c = slopes[strip], own[k, 2]
        level = values[i] - plane[0] - plane[1] * x - plane[2] * y
        if a < -2 * soft:
            seen[strip, 0] += level
            seen[strip, 1] += 1.0
        elif a > 0:
            seen[strip, 2] += 1.0
        if not active[strip]:
            continue
        if a <= -soft:
            at, step = 0.0, 0.0
        elif a >= soft:
            at, step = a, 1.0
        else:
            at, step = (a + soft) ** 2 / (4 * soft), (a + soft) / (2 * soft)
        stretch = 1.0
        if step > 0.0:
            # the ray goes on past the plane: what it meets is farther out
            lean = rays[i, 0] * ty - rays[i, 1] * tx
            phi = at
            for _ in range(2):
                at -= (at - phi - lean * (s * at - 0.5 * c * at * at)) / max(1.0 - lean * (s - c * at), 0.2)
            stretch = 1.0 / max(1.0 - lean * (s - c * at), 0.2)
        r = level - s * at + 0.5 * c * at * at
        rest = max(1.0 - (r / gate) ** 2, 0.0)
        costs[strip] += trust * gate * gate / 6 * (1.0 - rest * rest * rest)
        if rest == 0.0:
            continue
        weight = trust * rest * rest
        J[0], J[1], J[2] = 1.0, x, y
        # a view of a row would cost more than its sums
        for p in range(3):
            wj = weight * J[p]
            for q in range(p + 1):
                shared[p, q] += wj * J[q]
            shared[p, 6] += wj * r
        if step > 0.0:
            # an edge that moves outward by one takes one from a
            slope = (s - c * at) * step * stretch
            J[3], J[4], J[5] = -slope * ty, slope * tx, slope * (ty * y + tx * x)
            J[6], J[7], J[8] = -slope, -slope * (along - 0.5 * length), -0.5 * at * at * stretch
            J[9] = at * stretch
            for p in range(3, 6):
                wj = weight * J[p]
                for q in range(p + 1):
                    shared[p, q] += wj * J[q]
                shared[p, 6] += wj * r
            for p in range(6, 9):
                wj = weight * J[p]
                for q in range(p + 1):
                    of_edge[k, p - 6, q] += wj * J[q]
                of_edge[k, p - 6, 9] += wj * r
            wj = weight * J[9]
            for q in range(10):
                of_strip[strip, q] += wj * J[q]
            of_strip[strip, 10] += wj * r
    H[:] = 0.0
    g[:] = 0.0
    index = np.array([3, 4, 5, 0, 1, 2, 0, 0, 0, 0])
    _spread(shared, 0, index, place, H, g)
    for k in range(n):
        for p in range(3):
            index[6 + p] = 6 + 3 * k + p
        _spread(of_edge[k], 6, index, place, H, g)
        for strip in range(starts[k], starts[k + 1]):
            index[9] = 6 + 3 * n + strip
            _spread(of_strip[strip : strip + 1], 9, index, place, H, g)


@njit(cache=True, error_model="numpy")
def _spread(sums, first, index, place, H, g):
    """Put the sums of rows from ``first`` on to where their unknowns, by ``index``, stand in H and g."""
    for p in range(sums.shape[0]):
        at = place[index[first + p]]
        if at < 0:
            continue
        g[at] = sums[p, -1]
        for q in range(first + p + 1):
            to = place[index[q]]
            H[at, to] = sums[p, q]
            H[to, at] = sums[p, q]


@njit(cache=True, error_model="numpy")
def departure_costs(
    points, rays, values, edges, lines, starts, width, own, plane, active, window, trust, gate, places, costs
):
    """Cost (strips, k) of a membrane that leaves the face without a kink at ``places`` (k,) [m] beyond the edge.

    The rest is as in `kink_equations`, with s = 0.
    """
    costs[:] = 0.0
    for i in range(points.shape[0]):
        k = edges[i]
        if k < 0:
            continue
        x, y = points[i, 0], points[i, 1]
        tx, ty = lines[k, 2], lines[k, 3]
        along, a, inside = _from_edge(x, y, lines[k], own[k], window)
        if not inside:
            continue
        strip = starts[k] + min(int(along / width), starts[k + 1] - starts[k] - 1)
        if not active[strip]:
            continue
        c = own[k, 2]
        lean = rays[i, 0] * ty - rays[i, 1] * tx
        level = values[i] - plane[0] - plane[1] * x - plane[2] * y
        for j in range(places.shape[0]):
            phi = max(a - places[j], 0.0)
            at = phi
            for _ in range(2):
                at -= (at - phi + lean * 0.5 * c * at * at) / (1.0 + lean * c * at)
            rest = max(1.0 - ((level + 0.5 * c * at * at) / gate) ** 2, 0.0)
            costs[strip, j] += trust * gate * gate / 6 * (1.0 - rest * rest * rest)


@njit(cache=True, error_model="numpy")
def solve_positive(A, B):
    """X (n, k) with A X = B (n, k) for a symmetric positive definite A (n, n), by Cholesky; A and B are overwritten.

    Some tens of unknowns: a threaded BLAS costs more here than it saves.
    """
    n, k = B.shape
    for j in range(n):
        for m in range(j):
            factor = A[j, m]
            if factor != 0.0:
                for i in range(j, n):
                    A[i, j] -= A[i, m] * factor
        root = np.sqrt(A[j, j])
        for i in range(j, n):
            A[i, j] /= root
    for column in range(k):
        for i in range(n):
            total = B[i, column]
            for m in range(i):
                total -= A[i, m] * B[m, column]
            B[i, column] = total / A[i, i]
        for i in range(n - 1, -1, -1):
            total = B[i, column]
            for m in range(i + 1, n):
                total -= A[m, i] * B[m, column]
            B[i, column] = total / A[i, i]
    return B
