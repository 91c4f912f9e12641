"""A calibrated camera that looks at the task plane, and the tags it may see.

The 3-D world has X right, Y away from the viewer and Z up. The task plane is Y = 0: plane x is X, plane y is Z, and
counter-clockwise in the plane is a rotation about −Y. The viewer stands at negative Y. What stands ``height`` in front
of the task plane, toward the viewer, lies at Y = −height.

Camera axes are OpenCV's: x right, y down, z forward; pixel centres lie at integer coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from mechanics.readings import Array

_TOWARD_VIEWER = np.array([0.0, -1.0, 0.0])
_PLANE_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # rows: plane x and plane y in the world


def point_in_world(p_W: ArrayLike, height: ArrayLike = 0.0) -> Array:
    """Points (..., 2) [m] of the task plane as world points (..., 3) that stand ``height`` (...) [m] in front of it."""
    return np.asarray(p_W, float) @ _PLANE_AXES + np.asarray(height, float)[..., None] * _TOWARD_VIEWER


def rigid(name: str, X_AB: ArrayLike) -> Array:
    """The pose ``X_AB`` (4, 4) as float64. Raises ValueError, with its ``name``, for what is no rigid motion."""
    X_AB = np.array(X_AB, float)
    if X_AB.shape != (4, 4) or not np.isfinite(X_AB).all():
        raise ValueError(f"{name}: expected 4 x 4 finite numbers, got {X_AB.tolist()}")
    R = X_AB[:3, :3]
    with np.errstate(all="ignore"):  # of figures that no rotation has
        rotation = np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0
    if not rotation:
        raise ValueError(f"{name}: expected a rotation in the upper left 3 x 3 block")
    if not np.array_equal(X_AB[3], (0, 0, 0, 1)):
        raise ValueError(f"{name}: expected last row (0, 0, 0, 1), got {X_AB[3].tolist()}")
    return X_AB


def tag_corners(size: float) -> Array:
    """Corners (4, 2) [m] of a tag of edge ``size`` in its own frame: (−,−), (+,−), (+,+), (−,+)."""
    return 0.5 * size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, slots=True)
class TagGeometry:
    """Where a tag sits on a body: edge ``size`` [m] of its black square and its planar ``pose`` (3,) in the body frame.

    ``height`` [m] is how far the tag's plane stands in front of the task plane, toward the viewer.
    """

    id: int
    size: float
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height: float = 0.0

    @property
    def corners(self) -> Array:
        """Corners (4, 2) [m] in the body frame, in the order of `mechanics.readings.TagDetection`."""
        x, y, theta = self.pose
        c, s = np.cos(theta), np.sin(theta)
        return tag_corners(self.size) @ np.array([[c, s], [-s, c]]) + (x, y)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pinhole camera with OpenCV's five distortion coefficients.

    ``K`` (3, 3) [px]; ``distortion`` (5,) = (k1, k2, p1, p2, k3); ``X_WC`` (4, 4) is the camera's pose in the world.
    Raises ValueError on shapes, on values that are not finite and on a pose that is not rigid.
    """

    width: int
    height: int
    K: Array
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    X_WC: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("distortion", (5,)), ("X_WC", (4, 4))):
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise ValueError(f"camera {name}: expected shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"camera {name}: every entry must be finite, got {value.tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera image: expected a positive size, got {self.width} x {self.height}")
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0 and np.array_equal(self.K[2], (0, 0, 1))):
            raise ValueError(f"camera K: expected positive focal lengths and last row (0, 0, 1), got {self.K.tolist()}")
        rigid("camera X_WC", self.X_WC)

    @classmethod
    def looking_at(
        cls,
        position: Sequence[float],
        target: Sequence[float],
        focal: float,
        width: int,
        height: int,
        distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> CameraModel:
        """A camera at ``position`` (3,) that looks at ``target`` (3,) [m, world], upright, ``focal`` [px].

        The principal point is the middle of the image. Raises ValueError where the view is empty or vertical.
        """
        forward = np.asarray(target, float) - np.asarray(position, float)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) <= 1e-9 * max(1.0, float(np.linalg.norm(forward))):
            raise ValueError(f"camera view from {tuple(position)} to {tuple(target)}: it must not be empty or vertical")
        forward /= np.linalg.norm(forward)
        right /= np.linalg.norm(right)
        X_WC = np.eye(4)
        X_WC[:3, :3] = np.column_stack((right, np.cross(forward, right), forward))
        X_WC[:3, 3] = position
        K = np.array([[focal, 0, 0.5 * (width - 1)], [0, focal, 0.5 * (height - 1)], [0, 0, 1.0]])
        return cls(width, height, K, np.array(distortion, float), X_WC)

    @property
    def X_CW(self) -> Array:
        """Pose (4, 4) of the world in the camera."""
        R = self.X_WC[:3, :3]
        out = np.eye(4)
        out[:3, :3] = R.T
        out[:3, 3] = -R.T @ self.X_WC[:3, 3]
        return out

    def project(self, p_W: ArrayLike) -> Array:
        """Pixels (..., 2) of world points (..., 3) [m]; NaN where a point is not in front of the camera."""
        ray = self._rays(p_W)[0]
        return self._distort(ray) @ self.K[:2, :2].T + self.K[:2, 2]

    def project_with_jacobian(self, p_W: ArrayLike) -> tuple[Array, Array]:
        """Pixels (..., 2) of world points (..., 3) [m] and their derivative (..., 2, 3) [px/m] by the point."""
        ray, depth = self._rays(p_W)
        d_ray = np.zeros((*ray.shape, 3))
        d_ray[..., 0, 0] = d_ray[..., 1, 1] = 1 / depth
        d_ray[..., 2] = -ray / depth[..., None]
        A = self.K[:2, :2]
        by_point = A @ self._distort_slope(ray) @ d_ray @ self.X_CW[:3, :3]
        return self._distort(ray) @ A.T + self.K[:2, 2], by_point

    def _rays(self, p_W: ArrayLike) -> tuple[Array, Array]:
        """Normalised coordinates (..., 2) of world points (..., 3), and their depths; NaN where not in front."""
        p_W = np.asarray(p_W, float)
        if p_W.shape[-1:] != (3,):
            raise ValueError(f"points to project: expected shape (..., 3), got {p_W.shape}")
        X_CW = self.X_CW
        p_C = p_W @ X_CW[:3, :3].T + X_CW[:3, 3]
        depth = np.where(p_C[..., 2] > 0, p_C[..., 2], np.nan)
        return p_C[..., :2] / depth[..., None], depth

    def undistort(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) of an ideal camera with the same K and no distortion, from real ``pixels`` (..., 2)."""
        pixels = np.asarray(pixels, float)
        if not self.distortion.any():
            return pixels.copy()
        A, centre = self.K[:2, :2], self.K[:2, 2]
        bent = (pixels - centre) @ np.linalg.inv(A).T
        ray = bent.copy()
        for _ in range(20):  # Newton; three or four steps for any usable lens
            (a, b), (c, d) = np.moveaxis(self._distort_slope(ray), (-2, -1), (0, 1))
            u, v = np.moveaxis(self._distort(ray) - bent, -1, 0)
            # by Cramer's rule: solvers of matrices this small take ten times as long
            step = np.stack((d * u - b * v, a * v - c * u), axis=-1) / (a * d - b * c)[..., None]
            ray = ray - step
            if not np.any(np.abs(step) > 1e-8):  # the error left is its square, and that is rounding
                break
        return ray @ A.T + centre

    def distort(self, pixels: ArrayLike) -> Array:
        """Inverse of `undistort`."""
        A, centre = self.K[:2, :2], self.K[:2, 2]
        ray = (np.asarray(pixels, float) - centre) @ np.linalg.inv(A).T
        return self._distort(ray) @ A.T + centre

    def plane_homography(self, height: float = 0.0) -> Array:
        """Homography (3, 3) from plane (x, y, 1) [m], ``height`` in front of the task plane, to undistorted pixels."""
        X_CW = self.X_CW
        origin = X_CW[:3, :3] @ (height * _TOWARD_VIEWER) + X_CW[:3, 3]
        return self.K @ np.column_stack((X_CW[:3, :3] @ _PLANE_AXES.T, origin))

    def _distort(self, ray: Array) -> Array:
        """Brown–Conrady: distorted normalised coordinates (..., 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ray[..., 0], ray[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out = np.empty(ray.shape)
        out[..., 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        out[..., 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return out

    def _distort_slope(self, ray: Array) -> Array:
        """The derivative (..., 2, 2) of `_distort`."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ray[..., 0], ray[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # of `radial` by x is slope x, by y is slope y
        jacobian = np.empty((*ray.shape, 2))
        jacobian[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        jacobian[..., 0, 1] = jacobian[..., 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
        jacobian[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return jacobian

    def as_dict(self) -> dict:
        """The model as JSON-serialisable values."""
        return {
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
            "X_WC": self.X_WC.tolist(),
        }

    @classmethod
    def from_dict(cls, values: Mapping) -> CameraModel:
        """Inverse of `as_dict`. Raises ValueError naming what is missing, unknown or misshapen."""
        expected = {"width", "height", "K", "distortion", "X_WC"}
        if set(values) != expected:
            missing, unknown = sorted(expected - set(values)), sorted(set(values) - expected)
            raise ValueError(f"camera model: missing {missing}, unknown {unknown}")
        width, height = values["width"], values["height"]
        if not all(isinstance(size, int) and size < 2**31 for size in (width, height)):
            raise ValueError(f"camera image: expected a whole number of pixels, got {width!r:.60} x {height!r:.60}")
        try:
            arrays = [np.array(values[name], float) for name in ("K", "distortion", "X_WC")]
        except (TypeError, OverflowError) as error:
            raise ValueError(f"camera model: expected numbers: {error}") from None
        return cls(width, height, *arrays)
