"""The task plane in space: how planar poses, points and wrenches read in the 3-D frames of arms and cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mechanics._shapes import Array, load
from mechanics.se2 import wrap

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class TaskPlane:
    """A plane in a 3-D frame W: ``origin`` [m] and the unit axes ``x`` and ``y`` of the plane, in W.

    The normal is n = x × y; a counter-clockwise angle in the plane is a right-handed rotation about n. By default the
    plane's x is W's X and its y is W's Z, so n is −Y: one who stands at −Y and looks toward +Y sees x right and y up.

    A planar frame B stands for the 3-D frame that is parallel to W at angle 0 and turns about n. In B's own axes the
    plane therefore lies as it lies in W, and `wrench_to_planar` and `wrench_to_spatial` hold unchanged for wrenches
    given in B: a sensor's frame embeds like W itself. Raises ValueError when the axes are not orthonormal.
    """

    origin: Vector3 = (0.0, 0.0, 0.0)
    x: Vector3 = (1.0, 0.0, 0.0)
    y: Vector3 = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("origin", "x", "y"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"TaskPlane: {name}: expected three finite numbers, received {getattr(self, name)!r}")
            object.__setattr__(self, name, tuple(value.tolist()))
        x, y = np.array(self.x), np.array(self.y)
        errors = {"|x| = 1": abs(x @ x - 1), "|y| = 1": abs(y @ y - 1), "x · y = 0": abs(x @ y)}
        for rule, error in errors.items():
            if error > 1e-9:
                raise ValueError(
                    f"TaskPlane: axes: expected {rule}, received x {self.x}, y {self.y}: off by {error:.2g}"
                )

    @property
    def normal(self) -> Vector3:
        """The plane's unit normal n = x × y in W."""
        nx, ny, nz = np.cross(self.x, self.y).tolist()
        return nx, ny, nz

    def pose_to_se3(self, pose: Array) -> Array:
        """Return the homogeneous matrices (..., 4, 4) of planar poses (..., 3)."""
        xp, pose, n = load("pose_to_se3", pose=(pose, (3,)), n=(self.normal, (3,)))
        theta = pose[..., 2, None, None]
        cross = _cross_matrix(xp, n)
        turn = _identity(xp, cross) + xp.sin(theta) * cross + (1 - xp.cos(theta)) * (cross @ cross)
        top = xp.concat([turn, self.point_to_3d(pose[..., :2])[..., None]], axis=-1)
        last = xp.broadcast_to(_identity(xp, top, 4)[3:], (*top.shape[:-2], 1, 4))
        return xp.concat([top, last], axis=-2)

    def pose_from_se3(self, matrices: Array) -> tuple[Array, Array, Array]:
        """Return the planar pose (..., 3), the signed distance (...) [m] along n and the tilt (...) [rad] out of plane.

        The planar angle is the rotation about n that comes closest (swing–twist), in (−π, π]; the tilt is the angle
        of the rotation that is left, in [0, π].
        """
        xp, matrices, n = load("pose_from_se3", matrices=(matrices, (4, 4)), n=(self.normal, (3,)))
        R = matrices[..., :3, :3]
        normal_turned = (R @ n[..., None])[..., 0]
        cosine = xp.sum(n * normal_turned, axis=-1)
        axial = xp.stack(
            [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
        )
        trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
        theta = xp.atan2(xp.sum(n * axial, axis=-1), trace - cosine)
        sine = xp.linalg.vector_norm((_cross_matrix(xp, n) @ normal_turned[..., None])[..., 0], axis=-1)
        point, distance = self.point_from_3d(matrices[..., :3, 3])
        return xp.concat([point, theta[..., None]], axis=-1), distance, xp.atan2(sine, cosine)

    def pose_to_ros(self, pose: Array) -> tuple[Array, Array]:
        """Return position (..., 3) [m] and quaternion (..., 4), (x, y, z, w) with w ≥ 0, of planar poses (..., 3)."""
        xp, pose, n = load("pose_to_ros", pose=(pose, (3,)), n=(self.normal, (3,)))
        half = wrap(pose[..., 2:]) / 2
        return self.point_to_3d(pose[..., :2]), xp.concat([n * xp.sin(half), xp.cos(half)], axis=-1)

    def pose_from_ros(self, position: Array, quaternion: Array) -> tuple[Array, Array, Array]:
        """Return what `pose_from_se3` returns, from position (..., 3) [m] and quaternion (..., 4) (x, y, z, w).

        The quaternion need not be of unit length. Raises ValueError when it is all zeros.
        """
        xp, position, quaternion, n = load(
            "pose_from_ros", position=(position, (3,)), quaternion=(quaternion, (4,)), n=(self.normal, (3,))
        )
        if not bool(xp.all(xp.any(quaternion != 0, axis=-1))):
            raise ValueError("pose_from_ros: quaternion: expected a rotation, received all zeros")
        vector, scalar = quaternion[..., :3], quaternion[..., 3]
        twist = xp.sum(vector * n, axis=-1)
        swing = xp.linalg.vector_norm(vector - twist[..., None] * n, axis=-1)
        theta = wrap(2 * xp.atan2(twist, scalar))
        point, distance = self.point_from_3d(position)
        tilt = 2 * xp.atan2(swing, xp.hypot(twist, scalar))
        return xp.concat([point, theta[..., None]], axis=-1), distance, tilt

    def point_to_3d(self, point: Array) -> Array:
        """Return points (..., 3) in W of points (..., 2) of the plane [m]."""
        _, point, origin, x, y = load(
            "point_to_3d", point=(point, (2,)), origin=(self.origin, (3,)), x=(self.x, (3,)), y=(self.y, (3,))
        )
        return origin + point[..., :1] * x + point[..., 1:] * y

    def point_from_3d(self, point: Array) -> tuple[Array, Array]:
        """Return the feet (..., 2) [m] in the plane of points (..., 3) in W, and their distances (...) along n."""
        xp, point, origin = load("point_from_3d", point=(point, (3,)), origin=(self.origin, (3,)))
        along = [
            xp.sum((point - origin) * self._axis(xp, axis, point), axis=-1) for axis in (self.x, self.y, self.normal)
        ]
        return xp.stack(along[:2], axis=-1), along[2]

    def wrench_to_planar(self, wrench: Array) -> Array:
        """Return (fx, fy, τ) (..., 3): what of a spatial wrench (fx, fy, fz, tx, ty, tz) (..., 6) acts in the plane.

        Forces along the plane's axes, torque about n (counter-clockwise positive), about the same point. The wrench
        is given in W or in any frame that embeds like it (see the class).
        """
        xp, wrench = load("wrench_to_planar", wrench=(wrench, (6,)))
        force, torque = wrench[..., :3], wrench[..., 3:]
        parts = ((force, self.x), (force, self.y), (torque, self.normal))
        return xp.stack([xp.sum(v * self._axis(xp, axis, v), axis=-1) for v, axis in parts], axis=-1)

    def wrench_to_spatial(self, wrench: Array) -> Array:
        """Return the spatial wrench (..., 6) of a planar one (..., 3), with nothing out of the plane."""
        xp, wrench = load("wrench_to_spatial", wrench=(wrench, (3,)))
        x, y, n = (self._axis(xp, axis, wrench) for axis in (self.x, self.y, self.normal))
        return xp.concat([wrench[..., :1] * x + wrench[..., 1:2] * y, wrench[..., 2:] * n], axis=-1)

    @staticmethod
    def _axis(xp: Any, axis: Vector3, like: Array) -> Array:
        return xp.asarray(axis, dtype=like.dtype, device=like.device)


def _identity(xp: Any, like: Array, size: int = 3) -> Array:
    return xp.eye(size, dtype=like.dtype, device=like.device)


def _cross_matrix(xp: Any, v: Array) -> Array:
    """Return [v]×, (..., 3, 3)."""
    a, b, c = v[..., 0], v[..., 1], v[..., 2]
    o = xp.zeros_like(a)
    return xp.stack([xp.stack(row, axis=-1) for row in ([o, -c, b], [c, o, -a], [-b, a, o])], axis=-2)


DEFAULT_PLANE = TaskPlane()
"""x right, z up."""
