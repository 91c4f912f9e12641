"""The inner loops of the Soft Bubble, compiled: relaxation of the membrane, the walk along camera rays.

Arrays are (rows along y, columns along x) of one grid level; `drivers.sim.bubble_membrane` says what they mean. The
first use after an installation compiles them, which takes some ten seconds; afterwards they come from a cache.
"""

from __future__ import annotations

from math import ceil, floor, sqrt

import numpy as np
from numba import njit

FREE = -1.0e9
"""The obstacle [m] where there is none."""

OUTSIDE, CUT, INSIDE = 0, 1, 2
"""How a cell of the grid lies to the object's outline."""


@njit(cache=True)
def dome_height(x, y, a, b, top):
    """Height of the unpressed dome over (x, y), zero beyond its rim."""
    rest = 1.0 - (x / a) ** 2 - (y / b) ** 2
    return top * sqrt(rest) if rest > 0.0 else 0.0


@njit(cache=True, inline="always")
def _edge(outline, n):
    """Ends of edge ``n``: x, y, x, y."""
    m = n + 1 if n + 1 < len(outline) else 0
    return outline[n, 0], outline[n, 1], outline[m, 0], outline[m, 1]


@njit(cache=True)
def _arm(kind, count, i, j, k, share, value, near, face):
    """Note that the outline crosses arm ``k`` of node (i, j) at ``share`` of the spacing; the nearest crossing counts.

    Returns the number of irregular nodes; a node of which there is no room to note is left regular.
    """
    at = kind[i, j]
    if at < 0:
        return count
    if at == 0:
        if count >= len(near):
            return count
        at = count + 1
        kind[i, j] = at
        count = at
        for n in range(4):
            near[at - 1, n] = 1.0
            face[at - 1, n] = FREE
    if share < near[at - 1, k]:
        near[at - 1, k] = max(share, 0.02)
        face[at - 1, k] = value
    return count


@njit(cache=True)
def place_outline(outline, gap, spacing, dome, first, kind, rim, obstacle, near, face, far):
    """Lay an outline (N, 2) on a level: which nodes it covers, where it crosses the arms between nodes.

    ``kind`` (rows, columns) comes with −1 beyond the rim, 0 for regular and n for the n-th irregular node at the rim;
    ``rim`` is the number of those. ``gap`` is how far the apex lies above the object's face. Returns the count of
    irregular nodes. Arms are ordered −x, +x, −y, +y.
    """
    rows, columns = kind.shape
    a, b, top = dome
    x0, y0 = first
    floor_height = top - gap
    corners = len(outline)
    count = rim
    for n in range(rim):
        for k in range(4):
            near[n, k] = 1.0
            face[n, k] = FREE
    for i in range(rows):
        for j in range(columns):
            obstacle[i, j] = FREE
    row = np.empty(corners)
    for i in range(rows):
        y = y0 + i * spacing
        found = 0
        for n in range(corners):
            xs, ys, xe, ye = _edge(outline, n)
            if (ys <= y) != (ye <= y):
                x = xs + (xe - xs) * (y - ys) / (ye - ys)
                at = found
                while at > 0 and row[at - 1] > x:  # insertion: a row has a handful of crossings
                    row[at] = row[at - 1]
                    at -= 1
                row[at] = x
                found += 1
        for n in range(found):
            value = dome_height(row[n], y, a, b, top) - floor_height
            cell = (row[n] - x0) / spacing
            j = floor(cell)
            if 0 <= j < columns - 1:
                count = _arm(kind, count, i, j, 1, cell - j, value, near, face)
                count = _arm(kind, count, i, j + 1, 0, j + 1 - cell, value, near, face)
        for n in range(0, found - 1, 2):
            low = max(ceil((row[n] - x0) / spacing), 0)
            high = min(floor((row[n + 1] - x0) / spacing), columns - 1)
            for j in range(low, high + 1):
                obstacle[i, j] = dome_height(x0 + j * spacing, y, a, b, top) - floor_height
    for j in range(columns):
        x = x0 + j * spacing
        for n in range(corners):
            xs, ys, xe, ye = _edge(outline, n)
            if (xs <= x) != (xe <= x):
                y = ys + (ye - ys) * (x - xs) / (xe - xs)
                value = dome_height(x, y, a, b, top) - floor_height
                cell = (y - y0) / spacing
                i = floor(cell)
                if 0 <= i < rows - 1:
                    count = _arm(kind, count, i, j, 3, cell - i, value, near, face)
                    count = _arm(kind, count, i + 1, j, 2, i + 1 - cell, value, near, face)
    for n in range(rim, count):
        for k in range(4):
            far[n, k] = 1.0
    return count


@njit(cache=True, inline="always")
def _side(d, beyond, n, k, near, face, far):
    """Length (in spacings) and value of the nearer of an arm's ends that holds the membrane up more."""
    if (face[n, k] - d) * far[n, k] > (beyond - d) * near[n, k]:
        return near[n, k], face[n, k]
    return far[n, k], beyond


@njit(cache=True, inline="always")
def _irregular(d, i, j, n, near, face, far):
    """Weights' sum and weighted neighbours of the unequal-armed Laplacian (Shortley–Weller), times the spacing²."""
    here = d[i, j]
    west, vw = _side(here, d[i, j - 1], n, 0, near, face, far)
    east, ve = _side(here, d[i, j + 1], n, 1, near, face, far)
    south, vs = _side(here, d[i - 1, j], n, 2, near, face, far)
    north, vn = _side(here, d[i + 1, j], n, 3, near, face, far)
    along, across = 2.0 / (west + east), 2.0 / (south + north)
    weight = along * (1.0 / west + 1.0 / east) + across * (1.0 / south + 1.0 / north)
    return weight, along * (vw / west + ve / east) + across * (vs / south + vn / north)


@njit(cache=True)
def relax(d, obstacle, rhs, load, spacing, kind, span, near, face, far, sweeps):
    """Projected red-black Gauss–Seidel for ∇²d = load + rhs, d ≥ obstacle; ``span`` (rows, 2) bounds each row."""
    square = spacing * spacing
    rows = len(kind)
    for sweep in range(2 * sweeps):
        for i in range(1, rows - 1):
            low, high = span[i]
            here, below, above = d[i], d[i - 1], d[i + 1]
            wall, source, kinds = obstacle[i], rhs[i], kind[i]
            for j in range(low + ((low + i + sweep) & 1), high, 2):
                n = kinds[j]
                if n == 0:
                    around, weight = here[j - 1] + here[j + 1] + below[j] + above[j], 0.25
                else:
                    weight, around = _irregular(d, i, j, n - 1, near, face, far)
                    weight = 1.0 / weight
                here[j] = max(weight * (around - square * (load + source[j])), wall[j])


@njit(cache=True)
def residual(d, rhs, load, spacing, kind, span, near, face, far, out):
    """What is left of the equation, load + rhs − ∇²d; where the membrane is held it is what the face carries.

    At an irregular node it is scaled to the weight of a regular one.
    """
    square = spacing * spacing
    rows = len(kind)
    for i in range(1, rows - 1):
        low, high = span[i]
        for j in range(low, high):
            n = kind[i, j]
            if n == 0:
                around = d[i, j - 1] + d[i, j + 1] + d[i - 1, j] + d[i + 1, j]
                out[i, j] = load + rhs[i, j] - (around - 4.0 * d[i, j]) / square
            else:
                weight, around = _irregular(d, i, j, n - 1, near, face, far)
                out[i, j] = (load + rhs[i, j] - (around - weight * d[i, j]) / square) * min(1.0, 4.0 / weight)


@njit(cache=True)
def coarsen(d, left, load, spacing, kind, span, near, face, far, obstacle, coarse, before, rhs):
    """Set up the coarse problem (full approximation): ``coarse`` and ``before`` take d, ``rhs`` its right-hand side.

    ``left`` is the fine residual, ``spacing`` and the arms are the coarse level's.
    """
    square = spacing * spacing
    rows = len(kind)
    for i in range(1, rows - 1):
        low, high = span[i]
        for j in range(low, high):
            coarse[i, j] = before[i, j] = d[2 * i, 2 * j]
    for i in range(1, rows - 1):
        low, high = span[i]
        for j in range(low, high):
            n = kind[i, j]
            if n == 0:
                around = before[i, j - 1] + before[i, j + 1] + before[i - 1, j] + before[i + 1, j]
                value = (around - 4.0 * before[i, j]) / square
            else:
                weight, around = _irregular(before, i, j, n - 1, near, face, far)
                value = (around - weight * before[i, j]) / square
            p, q = 2 * i, 2 * j
            if d[p, q] <= obstacle[p, q]:
                mean = left[p, q]
            else:
                mean = 0.0
                for r in range(-1, 2):
                    for c in range(-1, 2):
                        if d[p + r, q + c] > obstacle[p + r, q + c]:
                            mean += left[p + r, q + c] / ((1 + abs(r)) * (1 + abs(c)) * 4)
            rhs[i, j] = value + mean - load


@njit(cache=True)
def correct(d, obstacle, span, coarse, before, share):
    """Add ``share`` of the coarse correction, linear between coarse nodes, where the membrane is not held.

    Returns the largest change.
    """
    rows = len(d)
    largest = 0.0
    for i in range(1, rows - 1):
        low, high = span[i]
        p = i >> 1
        for j in range(low, high):
            q = j >> 1
            if d[i, j] <= obstacle[i, j]:
                continue
            step = coarse[p, q] - before[p, q]
            if j & 1:
                step += coarse[p, q + 1] - before[p, q + 1]
                if i & 1:
                    step += coarse[p + 1, q] - before[p + 1, q] + coarse[p + 1, q + 1] - before[p + 1, q + 1]
                    step *= 0.25
                else:
                    step *= 0.5
            elif i & 1:
                step = 0.5 * (step + coarse[p + 1, q] - before[p + 1, q])
            new = max(d[i, j] + share * step, obstacle[i, j])
            largest = max(largest, abs(new - d[i, j]))
            d[i, j] = new
    return largest


@njit(cache=True)
def volume(d, spacing, span):
    """∫ d dA."""
    total = 0.0
    for i in range(len(d)):
        low, high = span[i]
        for j in range(low, high):
            total += d[i, j]
    return total * spacing * spacing


@njit(cache=True)
def settle(d, obstacle, rhs, load, spacing, kind, span, near, face, far, gas, offset, feedback, rounds, tolerance):
    """Solve the coarsest level with the gas: load = gas (∫d + offset) goes along. Returns the load.

    ``feedback`` = gas ∫∫ of the dome's Green function bounds how the volume answers to the load.
    """
    for _ in range(rounds):
        relax(d, obstacle, rhs, load, spacing, kind, span, near, face, far, 4)
        wanted = gas * (volume(d, spacing, span) + offset)
        step = (wanted - load) / (1.0 + feedback)
        load += step
        if abs(step) < tolerance:
            break
    return load


@njit(cache=True)
def outer_values(d, obstacle, span, ghost, cells):
    """What bilinear interpolation needs near the outline, where the slope jumps.

    ``cells`` says how each cell lies to the outline by its corners. ``ghost`` is d, but where a node is held inside the
    outline next to one outside, the membrane of the outer side goes on in a straight line.
    """
    rows, columns = d.shape
    for i in range(rows):
        for j in range(columns):
            ghost[i, j] = d[i, j]
    for i in range(rows - 1):
        for j in range(columns - 1):
            covered = 0
            for p in range(2):
                for q in range(2):
                    if obstacle[i + p, j + q] > FREE:
                        covered += 1
            cells[i, j] = OUTSIDE if covered == 0 else (INSIDE if covered == 4 else CUT)
    for i in range(2, rows - 2):
        low, high = span[i]
        for j in range(max(low, 2), min(high, columns - 2)):
            if obstacle[i, j] <= FREE or d[i, j] > obstacle[i, j] + 1e-6:
                continue
            total, found = 0.0, 0
            for diagonal in range(2):
                for p in range(-1, 2):
                    for q in range(-1, 2):
                        if abs(p) + abs(q) != 1 + diagonal:
                            continue
                        if obstacle[i + p, j + q] <= FREE and obstacle[i + 2 * p, j + 2 * q] <= FREE:
                            total += 2.0 * d[i + p, j + q] - d[i + 2 * p, j + 2 * q]
                            found += 1
                if found > 0:
                    ghost[i, j] = total / found
                    break


@njit(cache=True, inline="always")
def _covers(outline, x, y):
    inside = False
    corners = len(outline)
    for n in range(corners):
        xs, ys, xe, ye = _edge(outline, n)
        if (ys <= y) != (ye <= y) and x < xs + (xe - xs) * (y - ys) / (ye - ys):
            inside = not inside
    return inside


@njit(cache=True, inline="always")
def surface(x, y, d, ghost, cells, outline, face_height, spacing, dome, first):
    """Height of the pressed membrane over (x, y)."""
    a, b, top = dome
    height = dome_height(x, y, a, b, top)
    if height <= 0.0:
        return 0.0
    u, v = (x - first[0]) / spacing, (y - first[1]) / spacing
    j, i = int(u), int(v)
    u -= j
    v -= i
    cell = cells[i, j]
    covered = cell == INSIDE or (cell == CUT and _covers(outline, x, y))
    source = ghost if cell == CUT and not covered else d
    low = source[i, j] + u * (source[i, j + 1] - source[i, j])
    high = source[i + 1, j] + u * (source[i + 1, j + 1] - source[i + 1, j])
    height -= low + v * (high - low)
    return min(height, face_height) if covered else height


@njit(cache=True)
def look(rays, reference, d, ghost, cells, outline, face_height, spacing, dome, first, base, shift, out):
    """Depth (rows, columns) [m] along the camera's rays; NaN where the reference has none. ``out`` starts it.

    ``rays`` is (x per column), (y per row): slopes; the surface is z = base + height. The secant method, kept within
    the bracket from the rim's plane to the deepest of reference and face.
    """
    across, down = rays
    tolerance = 2e-6
    for i in range(len(down)):
        for j in range(len(across)):
            deepest = reference[i, j]
            if not deepest > 0.0:
                out[i, j] = np.nan
                continue
            rx, ry = across[j], down[i]
            z = out[i, j]
            if not z > base:
                z = deepest
            value = (
                z - base - surface(rx * z - shift, ry * z, d, ghost, cells, outline, face_height, spacing, dome, first)
            )
            low, high = base, deepest + 0.02
            slope = 1.0
            for _ in range(40):
                if value > 0.0:
                    high = min(high, z)
                else:
                    low = max(low, z)
                if abs(value) < tolerance:
                    break
                step = z - value / slope
                if not low < step < high:
                    step = 0.5 * (low + high)
                before, z_before = value, z
                z = step
                value = (
                    z
                    - base
                    - surface(rx * z - shift, ry * z, d, ghost, cells, outline, face_height, spacing, dome, first)
                )
                slope = (value - before) / (z - z_before) if z != z_before else 1.0
                if slope <= 0.0:
                    slope = 1.0
            out[i, j] = z


@njit(cache=True)
def quantise(depth, unit, out):
    """Depth [m] in units, rounded; 0 where there is none or it does not fit."""
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            value = depth[i, j] / unit + 0.5
            out[i, j] = np.uint16(value) if 0.0 < value < 65535.0 else np.uint16(0)
