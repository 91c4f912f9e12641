"""The dots printed on a gel: found to a fraction of a pixel, followed from the untouched picture, and what they say.

Where a flat face presses, the gel's surface sticks to it and is carried along as one rigid body, so the dots under it
show the shear: how far the grasp has moved in the finger since they met (notes on tactile images; SEED's X of gocf in
ee). That surface also lies nearer to the camera by the depth of the indentation, which draws the dots apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from estimation.tactile_pose import FingerModel, Picture
from mechanics import se2
from mechanics.readings import Array

#: pitch of a gel's dots as a share of the picture's width, where nobody says (GelSlim 3.0: 20 dots across)
USUAL_PITCH = 1 / 20
#: least share of the light that the middle of a dot takes away
DARKNESS = 0.18
#: fewer dots are none: dust
FEWEST = 12
#: scatter of a dot's centre [m], of a picture against the untouched one: with grain of 3 grey levels, 0.1 px
DOT_SIGMA = 0.02e-3
#: what all dots have in common, from lens and tilt [m], and as an angle [rad]
SHEAR_FLOOR = (0.001e-3, np.radians(0.002))
#: a dot within this of where a motion puts it is explained by it [m]
EXPLAINED_WITHIN = 0.25e-3
#: lengths over which shear may die away beside a face [m]: one to three times the thickness of gels
FADING = (2e-3, 4e-3, 8e-3)
#: share of the described indentation that the real one may differ by, one standard deviation
DEPTH_SPREAD = 0.2

_CELL = 0.2e-3  # of the table of nearest dots [m]


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots of a picture: ``centres`` (n, 2) [px], their ``area`` (median) [px²] and ``mask`` (h, w), 255 on their ink.

    A picture without marks has none.
    """

    centres: Array
    area: float
    mask: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.centres)


def find_dots(picture: Picture, pitch: float | None = None, area: float | None = None) -> Dots:
    """The dark dots of ``picture`` (h, w, 3), about ``pitch`` [px] apart and of ``area`` [px²] where that is known.

    A dot is a compact spot that is darker than its surroundings; what is longer, larger or smaller than the others (a
    contact's shadow, dust) is none.
    """
    height, width = picture.shape[:2]
    apart = float(USUAL_PITCH * width if pitch is None else pitch)
    grey = cv2.transform(picture, np.full((1, 3), 1 / 3, np.float32))
    size = 2 * round(0.4 * apart) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    around = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, kernel).astype(np.float32)
    ink = 1 - (grey.astype(np.float32) + 3) / (around + 3)  # + 3: dark corners are noise
    ink = cv2.GaussianBlur(ink, (0, 0), 0.04 * apart)
    count, found, stats, _ = cv2.connectedComponentsWithStats((ink > DARKNESS).astype(np.uint8), connectivity=4)
    labels = np.asarray(found, np.int32)
    areas = stats[:, cv2.CC_STAT_AREA].astype(float)
    boxes = stats[:, (cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT)].astype(float)
    plausible = (areas > 0.008 * apart**2) & (boxes.max(axis=1) < 0.8 * apart)
    plausible[0] = False
    usual = area or (float(np.median(areas[plausible])) if plausible.any() else 0.0)
    good = plausible & (areas > 0.35 * usual) & (areas < 2.2 * usual) & (areas > 0.45 * boxes.prod(axis=1))
    if good.sum() < FEWEST:
        return Dots(np.empty((0, 2)), 0.0, np.zeros((height, width), np.uint8))
    on = labels > 0
    label = labels[on]
    rows, columns = np.nonzero(on)
    weight = ink[on] - 0.5 * DARKNESS
    total = np.bincount(label, weight, count)[good]
    centres = np.stack([np.bincount(label, weight * at, count)[good] / total for at in (columns, rows)], axis=-1)
    low = stats[:, (cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP)]
    cut = (areas < 2.2 * usual) & ((low <= 1) | (low + boxes >= (width - 1, height - 1))).any(axis=1)
    cut[0] = False
    mask = np.where(good | cut, 255, 0).astype(np.uint8)[labels]
    # a dot that the border cuts has its centre elsewhere; its ink still counts
    inner = ((centres > 0.3 * apart) & (centres < np.array([width, height]) - 1 - 0.3 * apart)).all(axis=1)
    reach = 2 * round(0.09 * apart) + 1  # the lens spreads ink
    mask = np.asarray(cv2.dilate(mask, np.ones((reach, reach), np.uint8)), np.uint8)
    return Dots(centres[inner], usual, mask)


def on_plane(finger: FingerModel, pixels: ArrayLike, height: float) -> Array:
    """Points (..., 2) [m] of F's x-y plane, ``height`` [m] above the gel at rest, seen at ``pixels`` (..., 2)."""
    camera = finger.camera
    pixels = np.asarray(pixels, float)
    ideal = camera.undistort(pixels.reshape(-1, 2))
    rays = np.column_stack((ideal, np.ones(len(ideal)))) @ np.linalg.inv(camera.K).T @ camera.X_WC[:3, :3].T
    p = camera.X_WC[:2, 3] + rays[:, :2] * ((height - camera.X_WC[2, 3]) / rays[:, 2:])
    return p.reshape(pixels.shape)


@dataclass(frozen=True, eq=False)
class MarkerField:
    """Displacements of dots: ``material`` (n, 2) [m] in F at rest, ``moved`` (n, 2) [m] in F by the plane at rest.

    ``moved`` is where the ray through the dot meets the gel at rest: a dot on a raised surface looks further out.
    """

    material: Array
    moved: Array

    @property
    def displacements(self) -> Array:
        """(n, 2) [m]."""
        return self.moved - self.material


@dataclass(frozen=True, eq=False)
class GelShear:
    """The shear ``pose`` (3,): X of gocf in ee, (0, 0, 0) when the object was grasped; ``covariance`` (3, 3) of Δ.

    Δ is a left perturbation as in `estimation.tactile_pose`. ``depth`` [m] is how far the gel is pressed in, by the
    dots' spread, with standard deviation ``depth_sigma``; ``dots`` says how many agree, of ``under`` that should. A
    shear that cannot be told has no dots, and a covariance that says so.
    """

    pose: Array
    covariance: Array
    depth: float
    depth_sigma: float
    dots: int
    under: int
    field: MarkerField
    reason: str = ""

    @property
    def known(self) -> bool:
        """Whether the dots tell the shear."""
        return self.dots > 0


#: what is known of a shear before anything is seen: standard deviations (m, m, rad)
UNKNOWN_SHEAR = (5e-3, 5e-3, np.radians(5.0))


class MarkerTracker:
    """Follows the dots of one finger from its untouched picture; keeps nothing between pictures.

    ``pitch`` [m] is that of the dots (``marker_pitch_mm`` of the device's description).
    """

    def __init__(self, finger: FingerModel, dots: Dots):
        self.finger = finger
        self.indentation = 1e-3 * float(finger.described.get("indentation_mm", 0.8))
        self.material = on_plane(finger, dots.centres, 0.0)
        self.foot, self.distance = finger.camera.X_WC[:2, 3], float(finger.camera.X_WC[2, 3])
        if len(self.material) > 1:
            gaps = np.linalg.norm(self.material[:, None] - self.material, axis=2)
            np.fill_diagonal(gaps, np.inf)
            self.pitch = float(np.median(gaps.min(axis=1)))
        else:
            self.material, self.pitch = np.zeros((1, 2)), np.inf
        self._low = self.material.min(axis=0) - 5e-3
        size = ((np.ptp(self.material, axis=0) + 10e-3) / _CELL).astype(int) + 1
        at = self._low + _CELL * (np.stack(np.meshgrid(*(np.arange(k) for k in size)), axis=-1) + 0.5)
        self._cells = np.asarray(KDTree(self.material).query(at)[1], np.int64)

    def shear(self, dots: Dots, distance: Array | None, guess: ArrayLike = (0.0, 0.0, 0.0)) -> GelShear:
        """The rigid motion of the gel under the face, from the ``dots`` of a picture.

        ``distance`` (n,) [m] is how far outside the face each of ``dots`` is seen (inside < 0), by the plane that is
        pressed in; None: the face covers all. Dots alike in rows look the same one pitch further: what lies beside the
        face tells it, as far as any does, else the motion nearest to ``guess`` (3,), X of gocf in ee, is taken.
        """
        seen = on_plane(self.finger, dots.centres, 0.0)
        raised = self._raised(seen, self.indentation)
        d = np.full(len(seen), -np.inf) if distance is None else np.asarray(distance, float)
        under = d < -0.5 * self.pitch / 2
        start = self._in_finger(np.asarray(guess, float))
        if under.sum() < 6 or len(self.material) < FEWEST:
            return self.none(f"{int(under.sum())} dots under the face; expected at least 6", int(under.sum()))
        motion = self._search(raised, d, under, start)
        return self._fitted(seen, under, motion)

    # -- a first motion ------------------------------------------------------------------------------------------------

    def _nearest(self, points: Array) -> NDArray[np.int64]:
        """Index of the dot at rest that each of ``points`` (m, 2) is nearest to, for points within half a pitch."""
        column, row = np.clip(((points - self._low) / _CELL).astype(int), 0, self._cells.shape[1::-1] - np.array(1)).T
        return self._cells[row, column]

    def _search(self, raised: Array, d: Array, under: NDArray[np.bool_], start: Array) -> Array:
        """X_F_grasp (3,) that brings most dots back to where they were, those beside the face by a fading share."""
        beside = (d > 1e-3) & (d < 12e-3)
        angles = start[2] + np.radians(np.arange(-6, 6.01, 1.0))
        fading = np.exp(-d[beside, None] / np.array(FADING))
        return _best_motion(
            raised[under], raised[beside], fading, self.material, self._cells, self._low, self.pitch, start, angles
        )

    # -- the motion to a hundredth of a millimetre ---------------------------------------------------------------------

    def _fitted(self, seen: Array, under: NDArray[np.bool_], motion: Array) -> GelShear:
        """Least squares for (x, y, θ, depth) on where the dots are seen, robustly."""
        depth, count = self.indentation, int(under.sum())
        p = seen[under]
        m = self.material[self._nearest(se2.transform(se2.inverse(motion), self._raised(p, depth)))]
        outward = (p - self.foot) / self.distance  # of what is seen, per height
        sigma, weights = DOT_SIGMA, np.ones(len(p))
        H = np.eye(4)
        for _ in range(8):
            at = se2.transform(motion, m)
            r = p - outward * depth - at
            gap = np.linalg.norm(r, axis=1)
            weights = np.where(gap < EXPLAINED_WITHIN * 2, 1 / (1 + (gap / (3 * sigma)) ** 2) ** 2, 0.0)
            lever = (at - motion[:2]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
            J = np.zeros((len(p), 2, 4))
            J[:, 0, 0] = J[:, 1, 1] = 1.0
            J[:, :, 2] = lever
            J[:, :, 3] = outward
            W = weights / sigma**2
            H = np.einsum("n,nij,nik->jk", W, J, J)
            H[3, 3] += (DEPTH_SPREAD * self.indentation) ** -2
            g = np.einsum("n,nij,ni->j", W, J, r)
            g[3] -= (depth - self.indentation) * (DEPTH_SPREAD * self.indentation) ** -2
            step = np.linalg.solve(H, g)
            motion, depth = motion + step[:3], depth + step[3]
            good = weights > 0.25
            if good.sum() > 3:
                sigma = float(np.clip(np.sqrt(0.5 * np.mean(gap[good] ** 2)), 0.25 * DOT_SIGMA, EXPLAINED_WITHIN))
            if np.abs(step).max() < 1e-8:
                break
        good = weights > 0.25
        agreed = int(good.sum())
        if agreed < max(6, 0.5 * count):
            return self.none(f"{agreed} of {count} dots move as one body; expected half of them", count)
        C = np.asarray(np.linalg.inv(H), np.float64)
        moved = MarkerField(m[good], p[good])
        pose, covariance = self._in_ee(motion, C[:3, :3])
        return GelShear(pose, covariance, depth, float(np.sqrt(C[3, 3])), agreed, count, moved)

    def _raised(self, p: Array, height: float) -> Array:
        """Points (n, 2) at ``height`` [m] on the rays that meet the gel at rest in ``p`` (n, 2)."""
        return p + (self.foot - p) * (height / self.distance)

    def none(self, reason: str, under: int = 0) -> GelShear:
        """No shear, and why."""
        nothing = MarkerField(np.empty((0, 2)), np.empty((0, 2)))
        spread = DEPTH_SPREAD * self.indentation
        return GelShear(np.zeros(3), np.diag(UNKNOWN_SHEAR) ** 2, self.indentation, spread, 0, under, nothing, reason)

    # -- frames --------------------------------------------------------------------------------------------------------

    def _plane(self) -> tuple[Array, float]:
        """The map (2, 2) of F's x-y plane to ee's, and its determinant: −1 for a finger that looks from behind."""
        plane = self.finger.X_ee_F[np.ix_((0, 2), (0, 1))]
        return plane, float(np.sign(np.linalg.det(plane)))

    def _in_finger(self, pose: Array) -> Array:
        """X of gocf in ee as the same motion of points of F."""
        _, sign = self._plane()
        moved = self.finger.in_finger(se2.transform(pose, self.finger.in_ee(np.zeros(2))))
        return np.array([*moved, sign * pose[2]])

    def _in_ee(self, motion: Array, C: Array) -> tuple[Array, Array]:
        """The inverse, with the covariance of its left perturbation about the ee's origin."""
        plane, sign = self._plane()
        p_FoEo_F = self.finger.in_finger(np.zeros(2))
        origin = self.finger.in_ee(se2.transform(motion, p_FoEo_F))
        pose = np.array([*origin, sign * motion[2]])
        # (dx, dy, dθ) of `motion` to Δ: the displacement of the point that lies in ee's origin now
        lever = p_FoEo_F - motion[:2]
        J = np.zeros((3, 3))
        J[:2, :2] = plane
        J[:2, 2] = plane @ np.array([-lever[1], lever[0]])
        J[2, 2] = sign
        floor = np.diag([SHEAR_FLOOR[0], SHEAR_FLOOR[0], SHEAR_FLOOR[1]]) ** 2
        return pose, J @ C @ J.T + floor


@njit(cache=True)
def _best_motion(p, beside, fading, material, cells, low, pitch, start, angles):
    """The motion (3,) that most of ``p`` (n, 2), and of ``beside`` by a share ``fading`` (m, 3), come from."""
    best, chosen = -np.inf, start.copy()
    q, slip = np.empty_like(p), np.empty_like(p)
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        for i in range(len(p)):
            x, y = p[i, 0] - start[0], p[i, 1] - start[1]
            q[i, 0], q[i, 1] = c * x + s * y, c * y - s * x
            k = _cell(q[i, 0], q[i, 1], cells, low)
            slip[i, 0], slip[i, 1] = q[i, 0] - material[k, 0], q[i, 1] - material[k, 1]
        # the shift that most agree on: where the slips crowd in the cell between dots
        mx, my, crowd = 0.0, 0.0, 0
        for i in range(0, len(p), 2):
            x, y, count = 0.0, 0.0, 0
            for j in range(len(p)):
                if (slip[i, 0] - slip[j, 0]) ** 2 + (slip[i, 1] - slip[j, 1]) ** 2 < (0.2 * pitch) ** 2:
                    x, y, count = x + slip[j, 0], y + slip[j, 1], count + 1
            if count > crowd:
                mx, my, crowd = x / count, y / count, count
        for step in range(9):
            u, v = mx + pitch * (step % 3 - 1), my + pitch * (step // 3 - 1)
            tx, ty = start[0] + c * u - s * v, start[1] + s * u + c * v
            score = 0.0
            for i in range(len(p)):
                k = _cell(q[i, 0] - u, q[i, 1] - v, cells, low)
                gap = (q[i, 0] - u - material[k, 0]) ** 2 + (q[i, 1] - v - material[k, 1]) ** 2
                score += max(1 - gap / (0.35 * pitch) ** 2, 0.0)
            most = 0.0
            for f in range(fading.shape[1]):
                total = 0.0
                for i in range(len(beside)):
                    x, y = beside[i, 0] - tx, beside[i, 1] - ty
                    bx = beside[i, 0] - fading[i, f] * (beside[i, 0] - c * x - s * y)
                    by = beside[i, 1] - fading[i, f] * (beside[i, 1] - c * y + s * x)
                    k = _cell(bx, by, cells, low)
                    gap = (bx - material[k, 0]) ** 2 + (by - material[k, 1]) ** 2
                    total += max(1 - gap / (0.25 * pitch) ** 2, 0.0)
                most = max(most, total)
            # where all fits alike, the motion that is nearer
            far = np.hypot(tx - start[0], ty - start[1]) / pitch + 0.1 * abs(angle - start[2]) / np.radians(1.0)
            score += most - 0.02 * len(p) * far
            if score > best:
                best = score
                chosen[0], chosen[1], chosen[2] = tx, ty, angle
    return chosen


@njit(cache=True, inline="always")
def _cell(x, y, cells, low):
    column = min(max(int((x - low[0]) / _CELL), 0), cells.shape[1] - 1)
    row = min(max(int((y - low[1]) / _CELL), 0), cells.shape[0] - 1)
    return cells[row, column]
