"""The compliant fingers between the end-effector and the grasped object: the plant's own elasticity.

Written in scalars, because it runs once per plant step.
"""

from __future__ import annotations

from math import cos, pi, remainder, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import sqrtm

from mechanics.readings import Array


class Grip(NamedTuple):
    """The wrench of the fingers on the go, axes of W: force, torque about the grasp centre (``px``, ``py``) in W."""

    fx: float
    fy: float
    tau: float
    px: float
    py: float

    def torque_about(self, x: float, y: float) -> float:
        """Torque [N·m] of the same wrench about another point (x, y) in W."""
        return self.tau + (self.px - x) * self.fy - (self.py - y) * self.fx


class Coupling:
    """w = K x + D ẋ on the go about the grasp centre, in gocf.

    x = (x, y, θ) is the pose of the end-effector in gocf, in which it is zero at zero wrench; θ and the translation
    are used as they are, not through an exponential. ẋ is its rate, so a common rigid motion of both is not damped.
    D is critical for the go in free air.
    """

    def __init__(self, stiffness: ArrayLike, grasp: ArrayLike, mass: float, inertia: float):
        """``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf, ``grasp`` = X_go_gocf, ``inertia`` about the go's origin.

        Raises ValueError for a stiffness that is not symmetric positive definite.
        """
        self.stiffness = np.array(stiffness, float)
        if self.stiffness.shape != (3, 3) or not np.isfinite(self.stiffness).all():
            raise ValueError(f"scene.stiffness: expected a finite (3, 3) matrix, got {self.stiffness.tolist()}")
        if not np.allclose(self.stiffness, self.stiffness.T, rtol=1e-6, atol=1e-9):
            raise ValueError(f"scene.stiffness: not symmetric: {self.stiffness.tolist()}")
        smallest = np.linalg.eigvalsh(self.stiffness)[0]
        if smallest <= 0:
            raise ValueError(f"scene.stiffness: not positive definite, its smallest eigenvalue is {smallest:g}")
        self.grasp = np.array(grasp, float)
        self.mass, self.inertia = mass, inertia
        inertia_at_grasp = self._inertia_matrix()
        root = np.real(sqrtm(inertia_at_grasp))
        whitened = np.linalg.solve(root, np.linalg.solve(root, self.stiffness).T)
        self.damping = 2.0 * root @ np.real(sqrtm(whitened)) @ root
        #: fastest natural frequency [rad/s] of the go on its fingers: the plant's step must resolve it
        self.fastest = float(np.sqrt(np.linalg.eigvalsh(0.5 * (whitened + whitened.T))[-1]))
        self._k = tuple(self.stiffness.ravel().tolist())
        self._d = tuple(self.damping.ravel().tolist())
        self._grasp = tuple(self.grasp.tolist())

    def _inertia_matrix(self) -> Array:
        """Inertia (3, 3) of the go for twists of gocf, in gocf."""
        x, y, angle = self.grasp
        # the centre of mass, the go's origin, seen from gocf
        cx = -(cos(angle) * x + sin(angle) * y)
        cy = -(-sin(angle) * x + cos(angle) * y)
        m = self.mass
        return np.array([[m, 0, -m * cy], [0, m, m * cx], [-m * cy, m * cx, self.inertia + m * (cx * cx + cy * cy)]])

    def grasp_pose(self, go: ArrayLike) -> tuple[float, float, float]:
        """X_W_gocf with the go at ``go`` (3,) in W."""
        x, y, angle = np.asarray(go, float).tolist()
        px, py, turn = self._grasp
        c, s = cos(angle), sin(angle)
        return x + c * px - s * py, y + s * px + c * py, angle + turn

    def grip(self, go: tuple, go_twist: tuple, ee: tuple, ee_twist: tuple) -> Grip:
        """The wrench on the go; poses (x, y, θ) and twists (ẋ, ẏ, θ̇) are floats in W, of each body's origin."""
        qx, qy, angle = go
        vx, vy, spin = go_twist
        px, py, turn = self._grasp
        c, s = cos(angle), sin(angle)
        rx, ry = c * px - s * py, s * px + c * py
        gx, gy = qx + rx, qy + ry
        angle += turn
        if turn:
            c, s = cos(angle), sin(angle)
        dx, dy = ee[0] - gx, ee[1] - gy
        # the velocity of ee as gocf, which moves and turns with the go, sees it
        ux = ee_twist[0] - vx + spin * (ry + dy)
        uy = ee_twist[1] - vy - spin * (rx + dx)
        x, y, theta = c * dx + s * dy, c * dy - s * dx, remainder(ee[2] - angle, 2 * pi)
        xd, yd, thetad = c * ux + s * uy, c * uy - s * ux, ee_twist[2] - spin
        k, d = self._k, self._d
        f = k[0] * x + k[1] * y + k[2] * theta + d[0] * xd + d[1] * yd + d[2] * thetad
        g = k[3] * x + k[4] * y + k[5] * theta + d[3] * xd + d[4] * yd + d[5] * thetad
        tau = k[6] * x + k[7] * y + k[8] * theta + d[6] * xd + d[7] * yd + d[8] * thetad
        return Grip(c * f - s * g, s * f + c * g, tau, gx, gy)

    def sagged(self, ee: ArrayLike, gravity: float) -> Array:
        """The pose (3,) in W in which the go hangs at rest in free air from an end-effector at ``ee`` (3,) in W.

        Raises ValueError where the fingers are too soft to hold the go.
        """
        ex, ey, turned = np.asarray(ee, float).tolist()
        px, py, turn = self._grasp
        weight = self.mass * gravity
        compliance = np.linalg.inv(self.stiffness)
        angle = turned
        x = np.zeros(3)
        for _ in range(100):
            # the fingers carry the weight, which acts at the go's origin
            c, s = cos(angle), sin(angle)
            go_angle = angle - turn
            arm_x = -(cos(go_angle) * px - sin(go_angle) * py)
            x = compliance @ [s * weight, c * weight, weight * arm_x]
            before, angle = angle, turned - float(x[2])
            if abs(angle - before) < 1e-15:
                break
        else:
            raise ValueError("scene.stiffness: the fingers are too soft to hold the grasped body in free air")
        c, s = cos(angle), sin(angle)
        gx, gy = ex - (c * x[0] - s * x[1]), ey - (s * x[0] + c * x[1])
        go_angle = angle - turn
        c, s = cos(go_angle), sin(go_angle)
        return np.array([gx - (c * px - s * py), gy - (s * px + c * py), go_angle])
