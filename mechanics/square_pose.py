"""The pose in space of a square that a camera sees, with both of the poses that explain it (IPPE).

T. Collins, A. Bartoli, *Infinitesimal Plane-Based Pose Estimation*, IJCV 2014: a plane that is seen from afar looks
much the same tilted one way or the other, so there are two poses, and the corners prefer one by little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics.camera import CameraModel, tag_corners
from mechanics.readings import Array


@dataclass(frozen=True, eq=False)
class SquarePose:
    """``X_CT`` (4, 4), the pose of a tag T in the camera, and ``other``, the second pose that explains its corners.

    T's x points right and y up as the tag is read, z out of it toward the reader. ``residual_px`` and
    ``other_residual_px`` are the root mean squares of their reprojection errors [px], the smaller first.
    """

    X_CT: Array
    other: Array
    residual_px: float
    other_residual_px: float

    @property
    def ambiguity(self) -> float:
        """The ratio of both residuals: 0 where the pose is beyond doubt, 1 where both explain the corners alike.

        They do, for one, where the tag is seen head-on; there both poses are nearly the same (`flip`).
        """
        return self.residual_px / self.other_residual_px if self.other_residual_px > 0 else 1.0

    @property
    def flip(self) -> float:
        """The angle [rad] between the tag's normals in both poses: how far off the wrong one would be."""
        cosine = float(self.X_CT[:3, 2] @ self.other[:3, 2])
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def square_homography(pixels: Array) -> Array:
    """(3, 3) from a tag's square, ±1 in x and y, to its corners ``pixels`` (4, 2); zeros where they span none."""
    rows = []
    for (x, y), (u, v) in zip(tag_corners(2.0), pixels, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    try:
        return np.append(np.linalg.solve(np.array(rows), np.asarray(pixels, float).reshape(-1)), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError:
        return np.zeros((3, 3))


def square_pose(camera: CameraModel, corners: Array, size: float) -> SquarePose | None:
    """Both poses of a tag of edge ``size`` [m] whose ``corners`` (4, 2) [px] are as in `mechanics.readings`.

    None for corners that no square before the camera can have. The residuals do not depend on ``size``. OpenCV's own
    (SOLVEPNP_IPPE_SQUARE) gives a tag that is seen exactly head-on from behind, or not at all.
    """
    pixels = np.asarray(corners, float)
    if pixels.shape != (4, 2) or not np.isfinite(pixels).all() or not size > 0:
        return None
    try:
        with np.errstate(all="ignore"):  # what is not finite in the end is no pose
            found = _poses(camera, pixels, size)
    except np.linalg.LinAlgError:
        return None
    if not found:
        return None
    found.sort(key=lambda pose: pose[0])
    (residual, best), (other_residual, other) = found[0], found[-1]
    return SquarePose(best, other, residual, other_residual)


def _poses(camera: CameraModel, pixels: Array, size: float) -> list[tuple[float, Array]]:
    """Residuals [px] and poses X_CT (4, 4) that are before the camera."""
    ideal = camera.undistort(pixels)
    rays = np.column_stack((ideal, np.ones(4))) @ np.linalg.inv(camera.K).T
    corners_T = np.column_stack((tag_corners(2.0), np.zeros(4)))
    found = []
    for R in _rotations(square_homography(rays[:, :2])):
        X_CT = np.eye(4)
        X_CT[:3, :3], X_CT[:3, 3] = R, _translation(R, corners_T, rays)
        seen = (corners_T @ R.T + X_CT[:3, 3]) @ camera.K.T
        X_CT[:3, 3] *= size / 2
        if np.isfinite(seen).all() and np.isfinite(X_CT).all() and (seen[:, 2] > 0).all():
            error = seen[:, :2] / seen[:, 2:] - ideal
            found.append((float(np.sqrt(np.mean((error**2).sum(axis=1)))), X_CT))
    return found


def _rotations(H: Array) -> list[Array]:
    """Both rotations (3, 3) by the homography ``H`` from a plane to normalised pixels, from its slope at the origin."""
    if not H[2, 2] or not np.isfinite(H).all():
        return []
    v = H[:2, 2]  # where the plane's origin is seen
    J = H[:2, :2] - np.outer(v, H[2, :2])
    # Rv turns the optical axis to the ray of v
    turn, cosine = np.array([v[1], -v[0]]), 1 / np.sqrt(1 + v @ v)
    skew = np.array([[0.0, 0.0, -turn[1]], [0.0, 0.0, turn[0]], [turn[1], -turn[0], 0.0]]) * cosine
    Rv = np.eye(3) + skew + skew @ skew / (1 + cosine)
    B = np.column_stack((np.eye(2), -v)) @ Rv[:, :2]
    A = np.linalg.inv(B) @ J
    scale = float(np.linalg.norm(A, 2))
    if not scale > 0:
        return []
    A = A / scale
    # the third row b of both columns makes them orthonormal; its sign is what the slope does not tell
    b = np.sqrt(np.maximum(1 - (A**2).sum(axis=0), 0.0))
    if A[:, 0] @ A[:, 1] > 0:
        b[1] = -b[1]
    found = []
    for sign in (1.0, -1.0):
        x, y = np.vstack((A, sign * b)).T
        U, _, Vt = np.linalg.svd(Rv @ np.column_stack((x, y, np.cross(x, y))))
        found.append(U @ Vt)
    return found


def _translation(R: Array, corners_T: Array, rays: Array) -> Array:
    """Where the square turned by ``R`` is, from the rays (4, 3) of its corners, by least squares."""
    turned = corners_T @ R.T
    rows, values = [], []
    for (X, Y, Z), (u, v, _) in zip(turned, rays, strict=True):
        rows += [[1.0, 0.0, -u], [0.0, 1.0, -v]]
        values += [u * Z - X, v * Z - Y]
    return np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
