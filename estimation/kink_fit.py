"""The kink of a Soft Bubble's membrane at the edges of a face, fitted in strips across them.

Within an edge the membrane lies on the face's plane, beyond it it leaves at an angle and bends back: the pressed
membrane's −∇²z is that of the untouched one plus what the gas adds, and along a straight edge it does not bend. So the
height past the plane is s a − c a²/2 with a the distance from the edge: s of each strip, smooth along the edge, c of
each edge, known but for the gas. All strips are fitted at once with the pose, by Gauss–Newton with weights that end at
four standard deviations; what strips, edges and plane have of their own is integrated out of the pose's information.

Where a membrane that leaves the face smoothly explains the pixels nearly as well, there is no edge: it is dropped.
"""

from __future__ import annotations

from functools import cache
from math import cos, sin

import cv2
import numpy as np

from estimation import strip_kernels as kernels
from estimation.alignment import Systematic
from estimation.deformation import Deformation
from estimation.tactile_pose import FingerModel, GraspPrior, left_difference, left_moved
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: how far inside and outside an edge the kink is fitted, and how near its ends not [m]
WITHIN, OUTSIDE, CORNER = 3.5e-3, 4.5e-3, 1.5e-3
#: width of a strip [m]
WIDTH = 2e-3
#: least slope with which the membrane leaves an edge that counts
LEAST_SLOPE = 0.08
#: standard deviation of the slopes' second difference from strip to strip, and (1, −2, 1)ᵀ (1, −2, 1)
SLOPE_BEND, BEND = 0.05, np.outer((1.0, -2.0, 1.0), (1.0, -2.0, 1.0))
#: a slope to begin with
USUAL_SLOPE = 0.3
#: by how much the gas curves the membrane more than it was [1/m], how far that may be from it, and an edge's own
PRESSURE, PRESSURE_SPREAD, CURVATURE_SPREAD = 45.0, 30.0, 20.0
#: what is left of the plane's offset [m] and tilt
PLANE_SPREAD = np.array([0.1e-3, np.radians(0.3), np.radians(0.3)])
#: by how much a kink must explain an edge's pixels better than none [logarithm of the likelihood]
LEAST_GAIN = 12.0
#: where a membrane without a kink may leave the face [m]
DEPARTURES = np.arange(-3.0, 3.1, 0.5) * 1e-3
#: the membrane is no plane and no paraboloid to better than this
SYSTEMATIC = Systematic(offset=0.06e-3, tilt=np.radians(0.1), shift=0.03e-3, turn=np.radians(0.05))


class KinkFit:
    """One picture's fit in progress, from ``pose`` (3,) = X_ee_go on."""

    def __init__(self, finger: FingerModel, outline: Polygon, field: Deformation, prior: GraspPrior, pose: Array):
        self.pose = pose
        self._finger, self._vertices, self._field, self._prior = finger, outline.vertices, field, prior
        self._n = len(self._vertices)
        self._next = np.roll(np.arange(self._n), -1)
        self._lines = self._lines_at(pose)
        sides = self._vertices[self._next] - self._vertices
        strips = np.ceil(np.linalg.norm(sides, axis=1) / WIDTH).astype(np.int64)
        self._starts = np.concatenate(([0], np.cumsum(strips)))
        self._first = 6 + 3 * self._n
        count = int(self._starts[-1])
        self._slopes, self._plane = np.full(count, USUAL_SLOPE), np.zeros(3)
        self._own, self._base = np.zeros((self._n, 3)), np.zeros(self._n)
        #: which strips have an edge to show
        self.active = np.ones(count, bool)
        self._constrained: np.ndarray | None = None
        self._seen, self._costs = np.zeros((count, 3)), np.zeros(count)
        self._edge_of = np.repeat(np.arange(self._n), strips)
        self._known = prior.information
        self._sigma = max(field.noise, 0.05e-3)
        self._window = np.array([WITHIN, OUTSIDE, CORNER, 0.5 * field.pitch])
        self._gather()

    def solve(self) -> bool:
        """Fit; False where no edge shows. `pose`, `active`, `information` and `kinks` are the answer."""
        self._bend()
        self._step(3.0)
        self._choose()
        if not self._enough():
            return False
        self._bend()
        for widened in (2.0, 2.0, 1.4, 1.4):
            self._move(self._step(widened))
        self._assign()
        self._step(1.0)
        self._choose()
        if not self._enough():
            return False
        self._bend()
        for _ in range(2):
            self._move(self._step(1.0))
        for _ in range(2):
            self.active &= self._slopes > LEAST_SLOPE
            if not self._enough():
                return False
            self._move(self._step(1.0))
        self._step(1.0)
        if self._drop_false_edges():
            if not self._enough():
                return False
            for _ in range(2):
                self._move(self._step(1.0))
            self._step(1.0)
        return True

    @property
    def information(self) -> Array:
        """Information (3, 3) of the picture alone on Δ, everything else integrated out."""
        H = self._left
        own = H[:3, :3] - self._known
        information = own - H[:3, 3:] @ kernels.solve_positive(H[3:, 3:].copy(), H[3:, :3].copy())
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        information = (vectors * np.maximum(values, 0.0)) @ vectors.T
        loose = np.diag([SYSTEMATIC.shift**-2, SYSTEMATIC.shift**-2, SYSTEMATIC.turn**-2])
        return information - information @ np.linalg.solve(information + loose, information)

    @property
    def kinks(self) -> Array:
        """Where strips show a kink (m, 2) [m], in ee."""
        strips = np.flatnonzero(self.active)
        edge = np.searchsorted(self._starts, strips, side="right") - 1
        lines = self._lines[edge]
        along = np.minimum((strips - self._starts[edge] + 0.5) * WIDTH, lines[:, 4])
        outward = np.column_stack((lines[:, 3], -lines[:, 2]))
        off = self._own[edge, 0] + self._own[edge, 1] * (along - 0.5 * lines[:, 4])
        return lines[:, :2] + along[:, None] * lines[:, 2:4] + off[:, None] * outward

    # -- pixels ------------------------------------------------------------------------------------------------------

    def _gather(self) -> None:
        """The pixels about the face, in ee."""
        field = self._field
        size = 2 * round(8e-3 / field.pitch) + 1
        near = cv2.dilate(field.flat.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool) & field.valid
        count, finger, bare = int(np.count_nonzero(near)), self._finger, field.untouched
        origin = finger.in_ee(np.zeros(2))
        to_ee = np.column_stack(((finger.in_ee(np.eye(2)) - origin).T, origin))
        self._all, self._all_rays, self._all_values = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
        kernels.pixels_about(
            near, field.beyond, np.linalg.inv(field.to_pixels), to_ee, bare.across, bare.down, bare.turn,
            self._all, self._all_rays, self._all_values
        )  # fmt: skip
        self._assign()

    def _assign(self) -> None:
        edges = np.empty(len(self._all), np.int64)
        slack = 1e-3
        kernels.nearest_edges(self._all, self._lines, WITHIN + slack, OUTSIDE + slack, 0.5 * CORNER, edges)
        self._pixels = self._all, self._all_rays, self._all_values, edges

    def _lines_at(self, pose: Array) -> Array:
        """The outline's edges (n, 5) at a pose, as `estimation.strip_kernels` has them."""
        x, y, theta = pose.tolist()
        c, s = cos(theta), sin(theta)
        u, v = self._vertices[:, 0], self._vertices[:, 1]
        out = np.empty((self._n, 5))
        out[:, 0], out[:, 1] = x + (c * u - s * v), y + (s * u + c * v)
        side = out[self._next, :2] - out[:, :2]
        out[:, 4] = np.sqrt(side[:, 0] ** 2 + side[:, 1] ** 2)
        out[:, 2:4] = side / out[:, 4:]
        return out

    def _choose(self) -> None:
        """Strips that are seen on both sides and flat within."""
        total, count, beyond = self._seen.T
        pixels = WIDTH / self._field.pitch**2
        mean = np.abs(total) / np.maximum(count, 1)
        scatter = self._sigma * np.sqrt(self._field.alike / np.maximum(count, 1))
        self.active = (count > 0.5 * pixels * WITHIN) & (beyond > 0.5 * pixels * OUTSIDE) & (mean < 1e-4 + 3 * scatter)

    def _enough(self) -> bool:
        self._constrain()
        return self.active.sum() >= 3

    def _bend(self) -> None:
        """How the untouched membrane is curved about each edge."""
        lines = self._lines
        for k in range(self._n):
            here = np.flatnonzero(self.active[self._starts[k] : self._starts[k + 1]])
            if len(here) and not self._base[k]:
                middle = lines[k, :2] + lines[k, 2:4] * WIDTH * (here.mean() + 0.5)
                self._base[k] = self._field.curvature(self._finger.in_finger(middle))
                self._own[k] = 0.0, 0.0, self._base[k] + PRESSURE
        self._constrain()

    # -- equations ---------------------------------------------------------------------------------------------------

    def _constrain(self) -> None:
        """Which unknowns there are, and what is known of them beforehand: their information (m, m)."""
        first, active, edge_of = self._first, self.active, self._edge_of
        if self._constrained is not None and np.array_equal(active, self._constrained):
            return
        self._constrained = active.copy()
        shown = np.bincount(edge_of[active], minlength=self._n) > 0
        used = np.flatnonzero(np.concatenate((np.ones(6, bool), np.repeat(shown, 3), active)))
        place = np.full(first + len(active), -1)
        place[used] = np.arange(len(used))
        R = np.zeros((len(used), len(used)))
        R[(3, 4, 5), (3, 4, 5)] = PLANE_SPREAD**-2
        own = place[6 + 3 * np.flatnonzero(shown)]
        R[own, own] = SYSTEMATIC.offset**-2
        R[own + 1, own + 1] = SYSTEMATIC.tilt**-2
        R[own[:, None] + 2, own + 2] = _curvatures(len(own))
        middle = 1 + np.flatnonzero(active[:-2] & active[1:-1] & active[2:] & (edge_of[:-2] == edge_of[2:]))
        at = place[first + middle]  # its neighbours are there, too, and stand beside it
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                R[at + i, at + j] += BEND[i + 1, j + 1] * SLOPE_BEND**-2
        strips = np.arange(6 + 3 * len(own), len(used))
        R[strips, strips] += 1.0
        self._R, self._used, self._place = R, used, place

    def _step(self, widened: float) -> Array:
        """One Gauss–Newton step of all unknowns, residuals counting up to four ``widened`` standard deviations."""
        points, rays, values, edges = self._pixels
        trust = 1.0 / (self._sigma**2 * self._field.alike)
        used, R = self._used, self._R
        H, g = np.empty_like(R), np.empty(len(used))
        kernels.kink_equations(
            points, rays, values, edges, self._lines, self._starts, WIDTH, self._slopes, self._own, self._plane,
            self.active, self._window, trust, 4.0 * widened * self._sigma, self._place, H, g, self._seen, self._costs
        )  # fmt: skip
        away = np.concatenate((np.zeros(3), self._plane, self._own.ravel(), self._slopes - USUAL_SLOPE))
        away[8 : self._first : 3] -= self._base + PRESSURE
        H += R
        g -= R @ away[used]
        H[:3, :3] += self._known
        g[:3] -= self._known @ left_difference(self.pose, self._prior.pose)
        self._left = H
        step = np.zeros(len(away))
        step[used] = kernels.solve_positive(H.copy(), g[:, None])[:, 0]
        return step

    def _move(self, step: Array) -> None:
        self.pose = left_moved(self.pose, step[:3])
        self._lines = self._lines_at(self.pose)
        self._plane = self._plane + step[3:6]
        self._own = self._own + step[6 : self._first].reshape(-1, 3)
        self._own[:, 2] = np.clip(self._own[:, 2], 0.0, 400.0)
        self._slopes = np.clip(self._slopes + step[self._first :], 0.0, 1.5)

    def _drop_false_edges(self) -> bool:
        """Drop the edges whose kink explains little; whether there were any."""
        points, rays, values, edges = self._pixels
        smooth = np.zeros((len(self._slopes), len(DEPARTURES)))
        kernels.departure_costs(
            points, rays, values, edges, self._lines, self._starts, WIDTH, self._own, self._plane, self.active,
            self._window, 1.0 / (self._sigma**2 * self._field.alike), 4.0 * self._sigma, DEPARTURES, smooth
        )  # fmt: skip
        gain = np.where(self.active, smooth.min(axis=1) - self._costs, 0.0)
        false = np.repeat(np.add.reduceat(gain, self._starts[:-1]) < LEAST_GAIN, np.diff(self._starts))
        dropped = bool((self.active & false).any())
        self.active &= ~false
        return dropped


@cache
def _curvatures(edges: int) -> Array:
    """What is known of the curvatures of so many edges, which have the gas in common: their information."""
    covariance = PRESSURE_SPREAD**2 * np.ones((edges, edges)) + CURVATURE_SPREAD**2 * np.eye(edges)
    return np.asarray(np.linalg.inv(covariance), np.float64)
