"""Where a flat face ends in a gel's shading: a jump from the untouched colour to that of the wall beside the face.

Two steps, both on a picture that is laid flat (`Flat`). `best_poses`: a matched filter, the outline moved over the
picture within the prior until jumps lie under its sides. `boundary`: in strips across each side, the step is fitted
to a fraction of a pixel (the notes' direct facet contrast).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import erf

from estimation.gel_deformation import CONTRAST, GelDeformation
from estimation.gel_markers import on_plane
from estimation.tactile_pose import FingerModel, GraspPrior, left_moved
from mechanics.polygon import Polygon
from mechanics.readings import Array

Floats = NDArray[np.float32]

#: length of a strip along a side, and what is kept from corners, where the wall turns [m]
STRIP, CORNER = 2e-3, 0.7e-3
#: lengths over which the wall beside a face may rise: its shape is a mixture of both [m]
WALLS = (0.5e-3, 1.6e-3)
#: blur of lens, coat and edge [m], 1 σ
BLUR = 0.09e-3
#: jump of the shading that makes an edge [grey levels], and by how much it has to improve the fit (χ²)
LEAST_JUMP, LEAST_GAIN = 0.6 * CONTRAST, 30.0
#: strips in which a side must show, and the least share of those in view
FEWEST_STRIPS, SHOWN = 2, 0.4
#: spacing of the outline's samples [m]; steps of the search in (m, m, rad)
SAMPLE, COARSE = 1.2e-3, (0.9e-3, 0.9e-3, np.radians(2.0))
COARSE_PIXEL = 0.42e-3
#: how many standard deviations of the prior the search goes, and the largest that it covers
WITHIN, MOST_SPREAD = 3.8, (5e-3, 5e-3, np.radians(7.0))
#: poses that differ by less are the same
APART = np.array([2.5e-3, 2.5e-3, np.radians(4.0)])
#: what an outline's sample costs that has no jump, as a share of a full one
ABSENCE = 0.3


@dataclass(frozen=True, eq=False)
class Plane:
    """The lay of a finger's view on the plane that the face presses to: a grid of ``step`` [m] in F from ``low`` (2,).

    ``columns`` and ``rows`` (n, m) are the pixels that its nodes are seen at.
    """

    low: Array
    step: float
    height: float
    columns: Floats
    rows: Floats

    @classmethod
    def of(cls, finger: FingerModel, height: float) -> Plane:
        """For the plane ``height`` [m] above the gel at rest."""
        camera = finger.camera
        w, h = camera.width - 1.0, camera.height - 1.0
        t = np.linspace(0, 1, 21)
        rim = np.concatenate([np.column_stack(p) for p in ((w * t, 0 * t), (w * t, 0 * t + h))])
        rim = np.concatenate((rim, np.column_stack((0 * t, h * t)), np.column_stack((0 * t + w, h * t))))
        seen = on_plane(finger, rim, height)
        low, high = seen.min(axis=0), seen.max(axis=0)
        step = float((high - low)[0] / w)
        x, y = (np.arange(low[i], high[i], step) for i in (0, 1))
        nodes = np.stack((*np.meshgrid(x, y), np.full((len(y), len(x)), height)), axis=-1)
        pixels = camera.project(nodes).astype(np.float32)
        return cls(low, step, height, np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1]))

    def lay(self, picture: Floats) -> Floats:
        """``picture`` (h, w[, c]) on the grid, 0 outside of it."""
        return np.asarray(cv2.remap(picture, self.columns, self.rows, cv2.INTER_LINEAR), np.float32)


@dataclass(frozen=True, eq=False)
class Flat:
    """A deformation laid flat: ``layers`` (n, m, 4), its change in three channels and what is seen of it (0 to 1)."""

    plane: Plane
    layers: Floats
    noise: float
    slopes: Floats
    coarse: float

    @classmethod
    def of(cls, found: GelDeformation, plane: Plane) -> Flat:
        """Lay it; ``slopes`` (n', m', 3) is the gradient of how clearly the shading differs, and where there is any."""
        layers = plane.lay(np.asarray(cv2.merge((*cv2.split(found.change), found.seen)), np.float32))
        clear = found.size / (found.size + 2 * CONTRAST)
        flat = plane.lay(np.asarray(cv2.GaussianBlur(clear, (0, 0), 1.5), np.float32))
        every = max(1, round(COARSE_PIXEL / plane.step))
        inside = (plane.columns >= 0) & (plane.rows >= 0)
        inside &= (plane.columns <= found.seen.shape[1] - 1) & (plane.rows <= found.seen.shape[0] - 1)
        small = cv2.resize(flat, None, fx=1 / every, fy=1 / every, interpolation=cv2.INTER_AREA)
        there = cv2.resize(inside.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        there = cv2.erode(there, np.ones((5, 5), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        by_x = cv2.Sobel(small, cv2.CV_32F, 1, 0, scale=0.25)
        by_y = cv2.Sobel(small, cv2.CV_32F, 0, 1, scale=0.25)
        slopes = np.asarray(cv2.merge((by_x, by_y, np.asarray(there, np.float32))), np.float32)
        return cls(plane, layers, found.noise, slopes, every * plane.step)


def best_poses(flat: Flat, finger: FingerModel, outline: Polygon, prior: GraspPrior, count: int = 3) -> Iterator[Array]:
    """Up to ``count`` poses X_ee_go (3,) that lay the outline's sides on jumps of the shading, the best first."""
    sides = outline.boundary(SAMPLE)
    origin = finger.in_finger(np.zeros(2))
    p = finger.in_finger(_moved(prior.pose, sides.points)) - origin
    n = _directions(finger, prior.pose, sides.normals)
    # Δ about the ee's origin, in the finger's axes
    plane = finger.X_ee_F[np.ix_((0, 2), (0, 1))]
    T = np.zeros((3, 3))
    T[:2, :2], T[2, 2] = plane.T, np.sign(np.linalg.det(plane))
    H = T @ prior.information @ T.T
    spread = np.minimum(np.sqrt(np.diag(T @ prior.covariance @ T.T)), MOST_SPREAD)
    reach = WITHIN * spread
    steps = [max(1, int(np.ceil(r / s))) for r, s in zip(reach, COARSE, strict=True)]
    dx, dy, da = (r * np.arange(-k, k + 1) / k for r, k in zip(reach, steps, strict=True))
    low = flat.plane.low + 0.5 * (flat.coarse - flat.plane.step)
    # what no motion brings into view needs no look
    size = flat.coarse * np.array(flat.slopes.shape[1::-1])
    far = np.maximum(low - origin - p, p - (low + size - origin)).max(axis=1)
    near = far < np.hypot(reach[0], reach[1]) + np.linalg.norm(p, axis=1) * np.sin(min(reach[2], 1.0))
    p, n = p[near], n[near]

    def scores(dx: Array, dy: Array, da: Array) -> Floats:
        return _scores(flat.slopes, p, n, origin - low, flat.coarse, dx, dy, da, H, WITHIN**2)

    found: list[Array] = []
    rough = scores(dx, dy, da)
    order = np.argpartition(rough.ravel(), -300)[-300:] if rough.size > 300 else np.arange(rough.size)
    order = order[np.argsort(rough.ravel()[order])[::-1]]
    for i, j, k in zip(*np.unravel_index(order, rough.shape), strict=True):
        delta = np.array([dx[k], dy[j], da[i]])
        if any((np.abs(delta - other) < APART).all() for other in found):
            continue
        found.append(delta)
        for fine in (0.5, 0.25):
            x, y, a = (d + fine * s * np.arange(-1, 2) for d, s in zip(delta, COARSE, strict=True))
            closer = scores(x, y, a)
            at = np.unravel_index(closer.argmax(), closer.shape)
            delta = np.array([x[at[2]], y[at[1]], a[at[0]]])
        yield left_moved(prior.pose, T.T @ delta)
        if len(found) == count:
            break


@njit(cache=True)
def _scores(slopes, p, n, origin, step, dx, dy, da, H, farthest):
    """Log likelihood (a, y, x) of motions of the samples ``p`` with normals ``n``, up to a constant."""
    rows, columns = slopes.shape[0], slopes.shape[1]
    out = np.empty((len(da), len(dy), len(dx)), np.float32)
    px, py, nx, ny = np.empty(len(p)), np.empty(len(p)), np.empty(len(p)), np.empty(len(p))
    for i in range(len(da)):
        c, s = np.cos(da[i]), np.sin(da[i])
        for m in range(len(p)):
            px[m] = (c * p[m, 0] - s * p[m, 1] + origin[0]) / step + 0.5
            py[m] = (s * p[m, 0] + c * p[m, 1] + origin[1]) / step + 0.5
            nx[m] = c * n[m, 0] - s * n[m, 1]
            ny[m] = s * n[m, 0] + c * n[m, 1]
        for j in range(len(dy)):
            for k in range(len(dx)):
                d0, d1, d2 = dx[k], dy[j], da[i]
                q = H[0, 0] * d0 * d0 + H[1, 1] * d1 * d1 + H[2, 2] * d2 * d2
                q += 2 * (H[0, 1] * d0 * d1 + H[0, 2] * d0 * d2 + H[1, 2] * d1 * d2)
                if q > farthest:
                    out[i, j, k] = -np.inf
                    continue
                total = 0.0
                u, v = d0 / step, d1 / step
                for m in range(len(p)):
                    x, y = px[m] + u, py[m] + v
                    if x < 0 or y < 0 or x >= columns or y >= rows:
                        continue
                    cell = slopes[int(y), int(x)]
                    if cell[2] == 0:
                        continue
                    jump = 4.0 * (nx[m] * cell[0] + ny[m] * cell[1])
                    total += min(max(jump, -0.3), 1.0) - ABSENCE
                out[i, j, k] = total - 0.5 * q
    return out


@dataclass(frozen=True, eq=False)
class Steps:
    """Jumps found in strips across an outline's sides: where, which way is out, how well, and on which side.

    ``points`` (m, 2) [m] and ``normals`` (m, 2) in F, ``sigma`` (m,) [m], ``edges`` (m,); ``looked`` counts the strips
    that were in view.
    """

    points: Array
    normals: Array
    sigma: Array
    edges: NDArray[np.int64]
    looked: int


def boundary(flat: Flat, finger: FingerModel, outline: Polygon, pose: Array, reach: float) -> Steps:
    """Where the shading jumps within ``reach`` [m] of the sides of the outline at ``pose`` (3,)."""
    middles, tangents, normals, edges = _strips(outline)
    p = finger.in_finger(_moved(pose, middles))
    n, t = _directions(finger, pose, normals), _directions(finger, pose, tangents)
    plane = flat.plane
    s = plane.step * np.arange(-np.ceil((reach + 0.9e-3) / plane.step), np.ceil((reach + 1.6e-3) / plane.step) + 1)
    rows, columns = plane.columns.shape
    high = plane.low + plane.step * np.array([columns, rows])
    near = ((p > plane.low - STRIP) & (p < high + STRIP)).all(axis=1)
    p, n, t, edges = p[near], n[near], t[near], edges[near]
    u = plane.step * (np.arange(round(STRIP / plane.step)) - 0.5 * (round(STRIP / plane.step) - 1))
    where = p[:, None, None] + u[:, None, None] * t[:, None, None] + s[:, None] * n[:, None, None]
    where = ((where - plane.low) / plane.step).astype(np.float32)
    k = len(p)
    if not k:
        return Steps(p, n, np.empty(0), edges, 0)
    values = cv2.remap(
        flat.layers,
        where[..., 0].reshape(k * len(u), -1),
        where[..., 1].reshape(k * len(u), -1),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    ).reshape(k, len(u), len(s), 4)
    seen = np.where(values[..., 3] > 0.95, values[..., 3], 0)
    weight = seen.sum(axis=1)
    profile = (values[..., :3] * seen[..., None]).sum(axis=1) / np.maximum(weight, 1e-3)[..., None]
    shifts = 0.25 * plane.step * np.arange(-np.ceil(4 * reach / plane.step), np.ceil(4 * reach / plane.step) + 1)
    template = _template(s.tobytes(), shifts.tobytes())
    best, sse, flat_sse, curvature, jump, data = _fit(template, profile.astype(float), weight.astype(float))
    in_view = data > 0.4 * len(s) * len(u) * 0.5
    variance = np.maximum(flat.noise**2, sse / np.maximum(3 * (weight > 0).sum(axis=1) - 7, 1))
    gain = (flat_sse - sse) / variance
    inner = (best > 0) & (best < len(shifts) - 1)
    good = in_view & inner & (gain > LEAST_GAIN) & (jump > LEAST_JUMP) & (curvature > 0)
    # a side that shows in one strip, or in few of those in view, is none: what is one goes on
    many, few = (np.bincount(edges[which], minlength=len(outline)) for which in (good, in_view))
    good &= ((many >= FEWEST_STRIPS) & (many >= SHOWN * few))[edges]
    at = shifts[np.clip(best.round().astype(int), 0, len(shifts) - 1)] + (best - best.round()) * (shifts[1] - shifts[0])
    sigma = np.sqrt(2 * variance[good] / curvature[good]) * (shifts[1] - shifts[0])
    return Steps(p[good] + at[good, None] * n[good], n[good], sigma, edges[good], int(in_view.sum()))


@lru_cache(maxsize=8)
def _template(s_bytes: bytes, shifts_bytes: bytes) -> Array:
    """Shapes (shifts, s, 3) of the profile across an edge at each shift: level, and two walls that rise from it."""
    s, shifts = np.frombuffer(s_bytes), np.frombuffer(shifts_bytes)
    d = s - shifts[:, None]
    out = np.ones((*d.shape, 3))
    for i, wall in enumerate(WALLS):
        a, z = BLUR / wall, d / BLUR
        # e^(−d/wall) beyond the edge under a Gaussian blur
        out[..., 1 + i] = 0.5 * np.exp(np.minimum(0.5 * a * a - d / wall, 50)) * (1 + erf((z - a) / np.sqrt(2)))
    return out


@njit(cache=True)
def _fit(template, profile, weight):
    """Weighted least squares of each strip's profile (k, s, 3) by each shift of the template, channel by channel.

    Answers with the best shift's (fractional) index, the sums of squares there and of a level alone, the curvature
    per index squared, the jump of all channels, and the weight of the data.
    """
    shifts, length = template.shape[0], template.shape[1]
    k = len(profile)
    best, least, alone = np.zeros(k), np.empty(k), np.empty(k)
    curvature, jump, data = np.zeros(k), np.zeros(k), np.zeros(k)
    errors = np.empty(shifts)
    A, b = np.empty((3, 3)), np.empty((3, 3))
    for strip in range(k):
        w = weight[strip]
        total = w.sum()
        data[strip] = total
        squares, level = 0.0, np.zeros(3)
        for i in range(length):
            for c in range(3):
                v = profile[strip, i, c]
                squares += w[i] * v * v
                level[c] += w[i] * v
        alone[strip] = squares - (level**2).sum() / max(total, 1e-9)
        least[strip] = alone[strip]
        if total < 1e-6:
            continue
        chosen = -1
        for shift in range(shifts):
            A[:] = 0.0
            b[:] = 0.0
            for i in range(length):
                if w[i] == 0.0:
                    continue
                f1, f2 = template[shift, i, 1], template[shift, i, 2]
                A[0, 0] += w[i]
                A[0, 1] += w[i] * f1
                A[0, 2] += w[i] * f2
                A[1, 1] += w[i] * f1 * f1
                A[1, 2] += w[i] * f1 * f2
                A[2, 2] += w[i] * f2 * f2
                for c in range(3):
                    v = w[i] * profile[strip, i, c]
                    b[0, c] += v
                    b[1, c] += v * f1
                    b[2, c] += v * f2
            # ridge: two walls of which data show one must not fight each other
            ridge = 1e-3 * A[0, 0] + 1e-9
            a00, a11, a22 = A[0, 0] + 1e-9, A[1, 1] + ridge, A[2, 2] + ridge
            a01, a02, a12 = A[0, 1], A[0, 2], A[1, 2]
            det = a00 * (a11 * a22 - a12 * a12) - a01 * (a01 * a22 - a12 * a02) + a02 * (a01 * a12 - a11 * a02)
            i00, i01, i02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
            i11, i12, i22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
            won, size = 0.0, 0.0
            for c in range(3):
                x0 = (i00 * b[0, c] + i01 * b[1, c] + i02 * b[2, c]) / det
                x1 = (i01 * b[0, c] + i11 * b[1, c] + i12 * b[2, c]) / det
                x2 = (i02 * b[0, c] + i12 * b[1, c] + i22 * b[2, c]) / det
                won += x0 * b[0, c] + x1 * b[1, c] + x2 * b[2, c]
                size += (x1 + x2) ** 2
            errors[shift] = squares - won
            if chosen < 0 or errors[shift] < errors[chosen]:
                chosen = shift
                jump[strip] = np.sqrt(size)
        least[strip] = errors[chosen]
        best[strip] = chosen
        if 0 < chosen < shifts - 1:
            bend = errors[chosen - 1] - 2 * errors[chosen] + errors[chosen + 1]
            if bend > 0:
                best[strip] += 0.5 * (errors[chosen - 1] - errors[chosen + 1]) / bend
                curvature[strip] = bend
    return best, least, alone, curvature, jump, data


def _strips(outline: Polygon) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Middles (k, 2), tangents and normals of strips along the sides, in the object's frame, and their edges (k,)."""
    a, b = outline.vertices, np.roll(outline.vertices, -1, axis=0)
    lengths = np.linalg.norm(b - a, axis=1)
    middles, edges = [], []
    for i, length in enumerate(lengths):
        count = int((length - 2 * CORNER) / STRIP)
        if count < 1:
            continue
        at = 0.5 * length + STRIP * (np.arange(count) - 0.5 * (count - 1))
        middles.append(a[i] + at[:, None] * (b[i] - a[i]) / length)
        edges += [i] * count
    index = np.array(edges, np.int64)
    tangents = ((b - a) / lengths[:, None])[index]
    where = np.concatenate(middles) if middles else np.empty((0, 2))
    return where, tangents, outline.normals[index], index


def _moved(pose: Array, points: Array) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def _directions(finger: FingerModel, pose: Array, directions: Array) -> Array:
    """Directions (k, 2) of the object's frame, at ``pose`` in ee, as those of F."""
    return finger.in_finger(_moved(np.array([0.0, 0.0, pose[2]]), directions)) - finger.in_finger(np.zeros(2))
