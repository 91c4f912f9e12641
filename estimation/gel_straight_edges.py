"""Straight edges in a gel's shading, of whatever presses on it: creases between two facets that are lit differently.

Where no outline is known. A line is where the shading on its two sides differs most, summed along it (the notes' direct
facet contrast); then the jump is found to a fraction of a pixel in strips across it, and a line is laid through them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.gel_deformation import CLEAR_CONTRAST, GelReference, deformation
from estimation.tactile_pose import Picture, PoseStatus
from mechanics.readings import Array

Floats = NDArray[np.float32]

#: width of a facet that is looked at, and least length of an edge, as shares of the picture's width
FACET, SHORTEST = 1 / 45, 1 / 8
#: steps of the search: of the angle [rad], and the picture's scale
ANGLE_STEP, SCALE = np.radians(3.0), 0.35
#: share of an edge's contrast that it must have all along, and of the strongest edge's that others must have
ALONG, WEAKEST = 0.35, 0.35


@dataclass(frozen=True, eq=False)
class StraightEdge:
    """An edge in the picture: ``centre`` (2,) [px], ``angle`` [rad] in (−π/2, π/2] from x (right) to y (down).

    ``length`` [px]; ``contrast`` [grey levels] between its facets; ``scatter`` [px] of the strips about the line.
    """

    centre: Array
    angle: float
    length: float
    contrast: float
    scatter: float

    @property
    def ends(self) -> Array:
        """(2, 2) [px]."""
        along = 0.5 * self.length * np.array([np.cos(self.angle), np.sin(self.angle)])
        return np.stack((self.centre - along, self.centre + along))


def straight_edges(picture: Picture, reference: Picture | GelReference, most: int = 4) -> list[StraightEdge]:
    """Up to ``most`` straight edges of contact in ``picture`` (h, w, 3) bgr8, the clearest first.

    ``reference`` is the untouched gel. Empty where nothing presses, or the picture is of no use.
    """
    found = deformation(picture, reference if isinstance(reference, GelReference) else GelReference.of(reference))
    if found.status is not PoseStatus.OK:
        return []
    blurred = cv2.GaussianBlur(found.change, (0, 0), 1.2)
    share = cv2.GaussianBlur(found.seen, (0, 0), 1.2)
    change = np.asarray(blurred / np.maximum(share, 0.2)[..., None], np.float32)
    left = np.asarray(cv2.resize(change, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA), np.float32)
    edges: list[StraightEdge] = []
    for _ in range(3 * most):
        start, strength = _strongest(left)
        if strength < CLEAR_CONTRAST or len(edges) == most:
            break
        edge = _refined(change, *start)
        hidden = start if edge is None else (edge.centre, edge.angle, edge.length)
        _hide(left, *hidden)
        least = max(CLEAR_CONTRAST, WEAKEST * edges[0].contrast if edges else 0.0)
        if edge is not None and edge.contrast >= least:
            edges.append(edge)
    return edges


def _strongest(small: Floats) -> tuple[tuple[Array, float, float], float]:
    """Centre [px of the whole picture], angle and length of the line of most contrast, and that contrast."""
    h, w = small.shape[:2]
    facet = max(2, round(FACET * w))
    length = max(4, round(SHORTEST * w))
    size = int(np.ceil(np.hypot(h, w)))
    middle = 0.5 * np.array([w - 1, h - 1])
    across = np.zeros((2 * facet + 1, 1), np.float32)
    across[:facet], across[facet + 1 :] = -1 / facet, 1 / facet
    along = np.full((1, length), 1 / length, np.float32)
    best, chosen = -1.0, (np.zeros(2), 0.0)
    for angle in np.arange(0, np.pi, ANGLE_STEP):
        c, s = np.cos(angle), np.sin(angle)
        to_picture = np.array([[c, -s], [s, c]])
        offset = middle - to_picture @ np.full(2, 0.5 * (size - 1))
        M = np.column_stack((to_picture, offset))
        turned = cv2.warpAffine(small, M, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        contrast = cv2.sepFilter2D(turned, cv2.CV_32F, along, across)
        strength = (contrast * contrast).sum(axis=2)
        row, column = np.unravel_index(strength.argmax(), strength.shape)
        if strength[row, column] > best:
            best = float(strength[row, column])
            chosen = to_picture @ (column, row) + offset, float(angle)
    centre, angle = chosen
    return ((centre + 0.5) / SCALE - 0.5, angle, length / SCALE), float(np.sqrt(best))


def _refined(change: Floats, centre: Array, angle: float, length: float) -> StraightEdge | None:
    """The line through the jumps in strips about a first one; None where there is none."""
    w = change.shape[1]
    facet = FACET * w
    strip, full, scatter = 4, 0.0, 0.0
    for turn in range(4):
        t = np.array([np.cos(angle), np.sin(angle)])
        n = np.array([-t[1], t[0]])
        reach = 0.5 * w if turn else 0.5 * length + 2 * facet
        u = np.arange(-reach, reach + 1)
        s = np.arange(-2 * facet, 2 * facet + 0.26, 0.5)
        where = centre + u[:, None, None] * t + s[:, None] * n
        columns, rows = where[..., 0].astype(np.float32), where[..., 1].astype(np.float32)
        values = np.asarray(cv2.remap(change, columns, rows, cv2.INTER_LINEAR), np.float32)
        count = len(u) // strip
        profile = values[: count * strip].reshape(count, strip, len(s), 3).mean(axis=1)
        mid = u[: count * strip].reshape(count, strip).mean(axis=1)
        kernel = _jump(facet, s[1] - s[0])
        answer = np.stack([cv2.filter2D(profile[..., c], cv2.CV_32F, kernel[None, :]) for c in range(3)], axis=-1)
        # the colour in which the facets differ, from the middle of what is known
        inner = np.abs(mid) <= max(0.25 * length, 2 * strip)
        near = np.abs(s) <= facet
        mean = answer[inner][:, near].mean(axis=0)
        colour = mean[np.linalg.norm(mean, axis=-1).argmax()]
        full = float(np.linalg.norm(colour))
        if full < 0.5 * CLEAR_CONTRAST:
            return None
        clear = answer @ (colour / full)
        clear[:, ~near] = -np.inf
        peak = clear.argmax(axis=1)
        strips = np.arange(count)
        inside = (peak > 0) & (peak < len(s) - 1)
        a, b, d = (clear[strips, np.clip(peak + k, 0, len(s) - 1)] for k in (-1, 0, 1))
        inside &= np.isfinite(a) & np.isfinite(d) & (b > ALONG * full)
        bend = np.where(inside, a - 2 * b + d, -1.0)
        shift = np.where(inside, 0.5 * (np.where(inside, a, 0) - np.where(inside, d, 0)) / np.minimum(bend, -1e-6), 0.0)
        at = s[peak] + (s[1] - s[0]) * shift
        good = _connected(inside, mid, strip)
        if good.sum() < 4:
            return None
        x, y = mid[good], at[good]
        use = np.ones(len(x), bool)
        slope, level = 0.0, 0.0
        for _ in range(4):
            slope, level = np.polyfit(x[use], y[use], 1)
            r = np.abs(y - slope * x - level)
            use = r <= max(2.5 * float(np.median(r)) / 0.6745, 0.3)
        low, high = x[use].min() - 0.5 * strip, x[use].max() + 0.5 * strip
        if turn == 3:
            low, high = _ends(values, u, s, colour / full, facet, low, high)
        middle = 0.5 * (low + high)
        centre = centre + middle * t + (slope * middle + level) * n
        angle = float(angle + np.arctan(slope))
        length = float(high - low)
        scatter = float(np.sqrt(np.mean((y[use] - slope * x[use] - level) ** 2)))
    if length < SHORTEST * w:
        return None
    angle = float(np.pi / 2 - (np.pi / 2 - angle) % np.pi)
    return StraightEdge(centre, angle, length, full, scatter)


def _ends(values: Floats, u: Array, s: Array, colour: Floats, facet: float, low: float, high: float) -> Array:
    """Where along the line (u) the contrast between its sides falls to half of what it is inside of each end."""
    beyond = [values[:, (side * s > 1) & (side * s < facet)].mean(axis=1) @ colour for side in (1.0, -1.0)]
    contrast = np.convolve(beyond[0] - beyond[1], np.ones(3) / 3, "same")
    out = []
    for end, into in ((low, 1), (high, -1)):
        inner = contrast[(into * (u - end) > facet) & (into * (u - end) < 4 * facet)]
        if not len(inner):
            out.append(end)
            continue
        half = 0.5 * float(np.median(inner))
        at = int(np.argmin(np.abs(u - (end + into * 1.5 * facet))))
        while 0 < at < len(u) - 1 and contrast[at] > half:
            at -= into
        a, b = contrast[at], contrast[np.clip(at + into, 0, len(u) - 1)]
        out.append(u[at] + into * (half - a) / (b - a) if b > a else u[at])
    return np.array(out)


def _jump(facet: float, step: float) -> Floats:
    """A filter that answers with the jump between both sides, most at the jump: smooth, so that its peak is one."""
    s = np.arange(-np.ceil(facet / step), np.ceil(facet / step) + 1) * step
    kernel = np.sin(np.clip(s / facet, -1, 1) * np.pi) * (np.abs(s) <= facet)
    return np.asarray(kernel / kernel[s > 0].sum(), np.float32)


def _connected(inside: NDArray[np.bool_], mid: Array, strip: int) -> NDArray[np.bool_]:
    """The run of strips about the middle that are ``inside``, gaps of two strips allowed (a dot, dust)."""
    out = np.zeros(len(inside), bool)
    index = np.flatnonzero(inside)
    if not len(index):
        return out
    runs = np.split(index, np.flatnonzero(np.diff(index) > 3) + 1)
    # the run that holds the middle, or comes nearest to it
    nearest = min(runs, key=lambda run: (float(np.abs(mid[run]).min()) > 2 * strip, -len(run)))
    out[nearest] = True
    return out


def _hide(small: Floats, centre: Array, angle: float, length: float) -> None:
    """Take out a line's contrast, so that the next one is found."""
    along = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    a, b = ((SCALE * (centre + k * along)).round().astype(int) for k in (-1, 1))
    wide = max(3, round(4 * FACET * small.shape[1]))
    mask = cv2.line(np.zeros(small.shape[:2], np.uint8), a.tolist(), b.tolist(), 1, wide)
    small[mask > 0] = 0
