"""The planar pose of a body from the corners of the tags on it.

A body in the task plane has three unknowns, and a tag gives eight pixel coordinates; so the pose is constrained to the
plane (a free six-axis pose of a small tag trades depth against tilt) and solved by least squares on the reprojection
error, with the camera's distortion inside.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mechanics.camera import CameraModel, TagGeometry, point_in_world
from mechanics.readings import Array, TagDetection
from mechanics.se2 import compose, wrap

PIXEL_SIGMA = 0.01  # px; scatter of refined corners at a camera noise of four grey levels
_TURNED = np.array([[0.0, 1.0], [-1.0, 0.0]])  # p @ _TURNED is p turned by +90°


@dataclass(frozen=True, slots=True)
class TagPose:
    """A body's planar ``pose`` X_W_B (3,) [m, m, rad] and its ``covariance`` (3, 3), from ``n_tags`` sightings.

    ``residual_px`` is the root mean square of the reprojection error; ``rejected`` are the ids of sightings that
    disagree with the pose.
    """

    pose: Array
    covariance: Array
    residual_px: float
    n_tags: int
    rejected: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class _Sighting:
    id: int
    pixels: Array  # (4, 2)
    corners: Array  # (4, 2) in the body frame
    height: float


def estimate_planar_pose(
    camera: CameraModel,
    detections: Iterable[TagDetection],
    geometries: Sequence[TagGeometry],
    *,
    sigma: float = PIXEL_SIGMA,
    gate: float = 1.0,
) -> TagPose | None:
    """X_W_B of the body that carries ``geometries``; None where none of its tags is among ``detections``.

    ``sigma`` [px] is the standard deviation of a corner coordinate and scales the covariance. A sighting whose
    corners lie more than ``gate`` [px, rms] from where the pose puts them is left out. The pose that most sightings
    agree on wins; among equals, the one with the smallest residual. Where not one lies within the gate (a tag that
    looks like no square of its size), the answer is None as well.
    """
    known = {geometry.id: geometry for geometry in geometries}
    sightings = [
        _Sighting(d.id, np.asarray(d.corners, float), known[d.id].corners, known[d.id].height)
        for d in detections
        if d.id in known
    ]
    best: tuple[int, float] | None = None
    chosen: list[_Sighting] = []
    pose = np.zeros(3)
    for seed in sightings:
        candidate = _solve(camera, [seed], _from_homography(camera, seed))
        # One tag's angle, carried over to the others, misses them by more than they miss each other: widen, then close.
        inliers = _within(camera, sightings, candidate, 5 * gate)
        for _ in range(3):
            if not inliers:
                break
            candidate = _solve(camera, inliers, candidate)
            inliers = _within(camera, inliers, candidate, gate)
        if not inliers:
            continue
        candidate = _solve(camera, inliers, candidate)
        score = (-len(inliers), _rms(camera, inliers, candidate))
        if best is None or score < best:
            best, chosen, pose = score, inliers, candidate
        if len(inliers) == len(sightings):
            break
    if best is None:
        return None
    _, jacobian = _reprojection(camera, chosen, pose)
    covariance = np.asarray(sigma**2 * np.linalg.inv(jacobian.T @ jacobian), np.float64)
    rejected = tuple(s.id for s in sightings if not any(s is c for c in chosen))
    return TagPose(pose, covariance, best[1], len(chosen), rejected)


def _reprojection(camera: CameraModel, sightings: Sequence[_Sighting], pose: Array) -> tuple[Array, Array]:
    """Projected minus seen pixels (8n,), and their derivative (8n, 3) by (x, y, θ)."""
    corners = np.concatenate([s.corners for s in sightings])
    heights = np.repeat([s.height for s in sightings], 4)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    arm_W = corners @ np.array([[c, s], [-s, c]])
    pixels, by_point = camera.project_with_jacobian(point_in_world(arm_W + pose[:2], heights))
    motion = np.zeros((len(corners), 3, 3))  # of the world point by (x, y, θ)
    motion[:, :, :2] = point_in_world(np.eye(2)).T
    motion[:, :, 2] = point_in_world(arm_W @ _TURNED)
    residual = pixels - np.concatenate([s.pixels for s in sightings])
    return residual.ravel(), (by_point @ motion).reshape(-1, 3)


def _solve(camera: CameraModel, sightings: Sequence[_Sighting], pose: Array) -> Array:
    """Gauss–Newton from ``pose``; the problem is nearly linear, and a few steps reach rounding."""
    pose = pose.copy()
    for _ in range(10):
        residual, jacobian = _reprojection(camera, sightings, pose)
        step = np.linalg.solve(jacobian.T @ jacobian, -jacobian.T @ residual)
        if not np.isfinite(step).all():
            break
        pose += step
        if np.abs(step).max() < 1e-11:
            break
    pose[2] = wrap(pose[2])
    return pose


def _from_homography(camera: CameraModel, sighting: _Sighting) -> Array:
    """The rigid motion that best carries a tag's corners to where their rays meet its plane (Procrustes)."""
    ideal = camera.undistort(sighting.pixels)
    rays = np.column_stack((ideal, np.ones(4))) @ np.linalg.inv(camera.plane_homography(sighting.height)).T
    seen = rays[:, :2] / rays[:, 2:]
    a, b = sighting.corners - sighting.corners.mean(axis=0), seen - seen.mean(axis=0)
    theta = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turned = compose(np.array([0.0, 0.0, theta]), np.array([*sighting.corners.mean(axis=0), 0.0]))
    return np.array([*(seen.mean(axis=0) - turned[:2]), theta])


def _rms(camera: CameraModel, sightings: Sequence[_Sighting], pose: Array) -> float:
    residual = _reprojection(camera, sightings, pose)[0]
    return float(np.sqrt(np.mean(residual**2) * 2))


def _within(camera: CameraModel, sightings: Sequence[_Sighting], pose: Array, gate: float) -> list[_Sighting]:
    return [s for s in sightings if _rms(camera, [s], pose) <= gate]
