"""Compiled loops of `drivers.tags.refine_corners`: where the edges of black squares run in a grey picture.

An edge is looked for along normals of the line between two rough corners. Corners run counter-clockwise as seen, so in
pixel axes (y down) the outside of an edge lies on the side of (−along_y, along_x). The first use after an installation
compiles these in some seconds; afterwards they come from a cache.
"""

from __future__ import annotations

from math import floor

import numpy as np
from numba import njit

#: grey levels between black and white, below which there is no edge
FAINTEST = 8.0
#: how far a sample may lie off a straight level of grey, and a point off its edge, and still count [grey levels, px]
LEVEL_SLACK, EDGE_SLACK = 2.0, 0.01
#: where the profiles of an edge are shifted to, as shares of a step: multiples of this, modulo one
GOLDEN = 0.6180339887


@njit(cache=True, error_model="numpy")
def edge_points(image, start, along, length, reach, steps, points, valid):
    """Fill ``points`` (n, 4, m, 2) [px] with where m normals of each edge cross it, and ``valid`` with which do.

    ``start``, ``along`` (n, 4, 2) and ``length`` (n, 4) are the edges; each normal is sampled in ``steps`` steps within
    ``reach`` (n,) [px] of its foot in ``image`` (h, w). An edge lies where the grey values on both sides of it balance
    between the levels of black and white, each a straight line along the edge.
    """
    height, width = image.shape
    count = points.shape[2]
    ends = max(1, steps // 6)
    at, black, white, total = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for i in range(points.shape[0]):
        step = 2 * reach[i] / steps
        margin = reach[i] + 1.0
        for e in range(4):
            ax, ay = along[i, e]
            ok = valid[i, e]
            for j in range(count):
                at[j] = margin + (length[i, e] - 2 * margin) * (j + 0.5) / count
                x0, y0 = start[i, e, 0] + at[j] * ax, start[i, e, 1] + at[j] * ay
                begin = _shift(j, step) - reach[i]
                low = high = sum_ = 0.0
                ok[j] = True
                for k in range(steps):
                    s = step * (k + 0.5) + begin
                    x, y = x0 - s * ay, y0 + s * ax
                    if not (x >= 0 and y >= 0 and x <= width - 1 and y <= height - 1):
                        ok[j] = False
                        break
                    column, row = min(int(x), width - 2), min(int(y), height - 2)
                    fx, fy = x - column, y - row
                    upper = image[row, column] * (1 - fx) + image[row, column + 1] * fx
                    lower = image[row + 1, column] * (1 - fx) + image[row + 1, column + 1] * fx
                    grey = upper * (1 - fy) + lower * fy
                    sum_ += grey
                    if k < ends:
                        low += grey
                    if k >= steps - ends:
                        high += grey
                black[j], white[j], total[j] = low / ends, high / ends, sum_
            b0, b1 = _straight(at, black, ok, LEVEL_SLACK)
            w0, w1 = _straight(at, white, ok, LEVEL_SLACK)
            for j in range(count):
                offset = 0.0
                if ok[j]:
                    dark = b0 + b1 * at[j]
                    contrast = w0 + w1 * at[j] - dark
                    offset = reach[i] + _shift(j, step) - step * (total[j] - steps * dark) / contrast
                    if not (contrast > FAINTEST and abs(offset) < reach[i]):
                        ok[j], offset = False, 0.0
                points[i, e, j, 0] = start[i, e, 0] + at[j] * ax - offset * ay
                points[i, e, j, 1] = start[i, e, 1] + at[j] * ay + offset * ax


@njit(cache=True, error_model="numpy")
def edge_lines(points, valid, start, along, origin, direction):
    """Fill ``origin`` and ``direction`` (n, 4, 2) with the straight edges through the ``valid`` of the ``points``.

    ``start`` and ``along`` (n, 4, 2) are the edges as they were thought to be. Points that lie off their line are not
    ``valid`` any more.
    """
    count = points.shape[2]
    t, r = np.empty(count), np.empty(count)
    for i in range(points.shape[0]):
        for e in range(4):
            ax, ay = along[i, e]
            for j in range(count):
                x, y = points[i, e, j, 0] - start[i, e, 0], points[i, e, j, 1] - start[i, e, 1]
                t[j], r[j] = x * ax + y * ay, y * ax - x * ay
            off, slope = _straight(t, r, valid[i, e], EDGE_SLACK)
            origin[i, e, 0], origin[i, e, 1] = start[i, e, 0] - off * ay, start[i, e, 1] + off * ax
            direction[i, e, 0], direction[i, e, 1] = ax - slope * ay, ay + slope * ax


@njit(cache=True, error_model="numpy")
def _shift(j, step):
    """Shifting each profile by a part of a step keeps an edge that runs along the pixel grid from a common rounding."""
    turn = j * GOLDEN
    return step * (turn - floor(turn) - 0.5)


@njit(cache=True, error_model="numpy")
def _straight(t, y, valid, slack):
    """The straight line through y(t): its value at t = 0 and its slope; ``valid`` then tells what it rests on.

    Four rounds drop what lies beyond three median distances (outliers on a fifth of an edge pull the line, but not
    that far); then everything within six comes back, since noise alone would have been trimmed as well. Nothing within
    ``slack`` is dropped.
    """
    count = len(t)
    kept, distance, ranked = valid.copy(), np.empty(count), np.empty(count)
    at_zero, slope = _least_squares(t, y, kept)
    last = False
    for turn in range(5):
        # once a round drops nothing, the rounds like it would not either
        last = last or turn == 4
        n = 0
        for j in range(count):
            distance[j] = abs(y[j] - (at_zero + slope * t[j]))
            if kept[j]:
                ranked[n] = distance[j]
                n += 1
        if n == 0:
            break
        limit = max((6.0 if last else 3.0) * _ranked(ranked, n, (n - 1) // 2), slack)
        same = True
        for j in range(count):
            stays = (valid[j] if last else kept[j]) and distance[j] <= limit
            same = same and stays == kept[j]
            kept[j] = stays
        if not same:
            at_zero, slope = _least_squares(t, y, kept)
        if last:
            break
        last = same
    valid[:] = kept
    return at_zero, slope


@njit(cache=True, error_model="numpy")
def _least_squares(t, y, valid):
    """Least-squares value at t = 0 and slope of y(t) over the valid samples; zero where there are none."""
    n = 0
    mean_t = mean_y = 0.0
    for j in range(len(t)):
        if valid[j]:
            n += 1
            mean_t += t[j]
            mean_y += y[j]
    if n == 0:
        return 0.0, 0.0
    mean_t /= n
    mean_y /= n
    spread = slope = 0.0
    for j in range(len(t)):
        if valid[j]:
            dt = t[j] - mean_t
            spread += dt * dt
            slope += dt * y[j]
    if spread > 0:
        slope /= spread
    return mean_y - slope * mean_t, slope


@njit(cache=True, error_model="numpy")
def _ranked(values, n, k):
    """The value of rank ``k`` (from 0) among the first ``n``, by quickselect; numpy's own compiles for ten seconds."""
    low, high = 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return values[k]


def warm() -> None:
    """Compile the loops, or load them from the cache."""
    corners = np.array([[[8.0, 24.0], [24.0, 24.0], [24.0, 8.0], [8.0, 8.0]]])
    along = (np.roll(corners, -1, axis=1) - corners) / 16
    points, valid = np.empty((1, 4, 16, 2)), np.empty((1, 4, 16), bool)
    picture = np.zeros((32, 32), np.uint8)
    picture.setflags(write=False)  # as they all come
    edge_points(picture, corners, along, np.full((1, 4), 16.0), np.ones(1), 8, points, valid)
    edge_lines(points, valid, corners, along, np.empty((1, 4, 2)), np.empty((1, 4, 2)))
