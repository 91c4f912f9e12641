"""The compliant fingers between the end-effector and the grasped object: the plant's own elasticity.

Written in scalars, because it runs once per plant step.
"""

from __future__ import annotations

from math import cos, hypot, inf, pi, remainder, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import sqrtm

from drivers.sim.limit_surface import LimitSurface
from drivers.sim.membrane import Membrane, MembraneSpring
from mechanics.readings import Array

#: the plant's step resolves a membrane that is displaced as far as this [m]
FAR = 0.01
#: a slipping finger is put back onto its limit surface to this share, within so many corrections
_ON_SURFACE, _CORRECTIONS = 1e-9, 20

Three = tuple[float, float, float]


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

    With a `Membrane`, K x becomes the membrane's law. With a limit, the object slips between the fingers where that
    wrench (without the damping, which is the integrator's) would leave the limit surface: `grasp` then moves on it.
    """

    def __init__(
        self,
        stiffness: ArrayLike,
        grasp: ArrayLike,
        mass: float,
        inertia: float,
        membrane: Membrane | None = None,
        limit: tuple[float, float] = (inf, inf),
    ):
        """``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf, ``grasp`` = X_go_gocf, ``inertia`` about the go's origin.

        ``limit`` is the force [N] and the torque [N·m] beyond which the fingers slip.
        Raises ValueError for a stiffness that is not symmetric positive definite, or a limit that is not positive.
        """
        self.stiffness = np.array(stiffness, float)
        if self.stiffness.shape != (3, 3) or not np.isfinite(self.stiffness).all():
            raise ValueError(f"scene.stiffness: expected a finite (3, 3) matrix, got {self.stiffness.tolist()}")
        if not np.allclose(self.stiffness, self.stiffness.T, rtol=1e-6, atol=1e-9):
            raise ValueError(f"scene.stiffness: not symmetric: {self.stiffness.tolist()}")
        smallest = np.linalg.eigvalsh(self.stiffness)[0]
        if smallest <= 0:
            raise ValueError(f"scene.stiffness: not positive definite, its smallest eigenvalue is {smallest:g}")
        self._grasp: Three = tuple(np.array(grasp, float).tolist())
        self.mass, self.inertia = mass, inertia
        inertia_at_grasp = self._inertia_matrix()
        root = np.real(sqrtm(inertia_at_grasp))
        whitened = np.linalg.solve(root, np.linalg.solve(root, self.stiffness).T)
        self.damping = 2.0 * root @ np.real(sqrtm(whitened)) @ root
        #: fastest natural frequency [rad/s] of the go on its fingers: the plant's step must resolve it
        self.fastest = float(np.sqrt(np.linalg.eigvalsh(0.5 * (whitened + whitened.T))[-1]))
        surface = LimitSurface(*limit, self.stiffness)
        membrane = membrane or Membrane()
        self.fastest *= float(np.sqrt(membrane.steepest(FAR)))
        self._surface = None if surface.is_infinite else surface
        #: None for the plain w = K x, which costs least
        self._spring = None if membrane.is_linear else MembraneSpring(self.stiffness, membrane)
        #: how far the object has slipped between the fingers: length of the path [m], sum of the turns [rad]
        self.slipped = self.turned = 0.0
        self._k = tuple(self.stiffness.ravel().tolist())
        self._d = tuple(self.damping.ravel().tolist())

    @property
    def grasp(self) -> Array:
        """X_go_gocf (3,); it moves when the object slips between the fingers."""
        return np.array(self._grasp)

    def _inertia_matrix(self) -> Array:
        """Inertia (3, 3) of the go for twists of gocf, in gocf."""
        x, y, angle = self._grasp
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

    def grip(self, go: tuple, go_twist: tuple, ee: tuple, ee_twist: tuple, dt: float = 0.0) -> Grip:
        """The wrench on the go; poses (x, y, θ) and twists (ẋ, ẏ, θ̇) are floats in W, of each body's origin.

        ``dt`` [s] is how long it took to come here: a membrane relaxes and slips in that time.
        """
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
        k, d, spring = self._k, self._d, self._spring
        if spring is None:
            f = k[0] * x + k[1] * y + k[2] * theta
            g = k[3] * x + k[4] * y + k[5] * theta
            tau = k[6] * x + k[7] * y + k[8] * theta
        else:
            f, g, tau = spring.wrench(x, y, theta)
        if self._surface is not None and self._surface.load(f, g, tau) > 1 + _ON_SURFACE:
            (sx, sy, st), (f, g, tau) = self._slip((x, y, theta), (f, g, tau))
            if dt > 0:
                # gocf has run after the ee on the go, and that motion is not the membrane's
                xd, yd, thetad = xd - sx / dt, yd - sy / dt, thetad - st / dt
            px, py, turn = self._grasp
            c, s = cos(go[2]), sin(go[2])
            gx, gy = qx + c * px - s * py, qy + s * px + c * py
            c, s = cos(go[2] + turn), sin(go[2] + turn)
        if spring is not None:
            spring.advance(dt)
        f = f + d[0] * xd + d[1] * yd + d[2] * thetad
        g = g + d[3] * xd + d[4] * yd + d[5] * thetad
        tau = tau + d[6] * xd + d[7] * yd + d[8] * thetad
        return Grip(c * f - s * g, s * f + c * g, tau, gx, gy)

    def _slip(self, x: Three, w: Three) -> tuple[Three, Three]:
        """Move gocf on the go until the wrench ``w`` at the displacement ``x`` is back on the limit surface.

        Returns the motion in gocf, and the wrench that is left.
        """
        surface, spring = self._surface, self._spring
        assert surface is not None
        k, total = self._k, (0.0, 0.0, 0.0)
        for _ in range(_CORRECTIONS):
            steepness = 1.0 if spring is None else spring.membrane.steepest(spring.size(*x))
            sx, sy, turn = surface.slip(*w, steepness)
            # grasp ∘ slip, and the displacement as the moved frame sees it
            px, py, at = self._grasp
            c, s = cos(at), sin(at)
            self._grasp = (px + c * sx - s * sy, py + s * sx + c * sy, at + turn)
            c, s = cos(turn), sin(turn)
            dx, dy = x[0] - sx, x[1] - sy
            x = (c * dx + s * dy, c * dy - s * dx, x[2] - turn)
            total = (total[0] + sx, total[1] + sy, total[2] + turn)
            self.slipped += hypot(sx, sy)
            self.turned += abs(turn)
            if spring is None:
                w = (
                    k[0] * x[0] + k[1] * x[1] + k[2] * x[2],
                    k[3] * x[0] + k[4] * x[1] + k[5] * x[2],
                    k[6] * x[0] + k[7] * x[1] + k[8] * x[2],
                )
            else:
                w = spring.wrench(*x)
            if surface.load(*w) <= 1 + _ON_SURFACE:
                break
        return total, w

    def strain(self, share: Array) -> None:
        """As `MembraneSpring.strain`; a linear coupling keeps no strain."""
        if self._spring is not None:
            self._spring.strain(share)

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
            if self._spring is not None:
                x = self._spring.at_rest(x)
            before, angle = angle, turned - float(x[2])
            if abs(angle - before) < 1e-15:
                break
        else:
            raise ValueError("scene.stiffness: the fingers are too soft to hold the grasped body in free air")
        if self._surface is not None and self._surface.load(s * weight, c * weight, weight * arm_x) > 1:
            raise ValueError(
                f"scene.finger_limit: the weight of {weight:.2f} N slips out of fingers that hold "
                f"{self._surface.force:g} N and {self._surface.torque:g} N·m"
            )
        c, s = cos(angle), sin(angle)
        gx, gy = ex - (c * x[0] - s * x[1]), ey - (s * x[0] + c * x[1])
        go_angle = angle - turn
        c, s = cos(go_angle), sin(go_angle)
        return np.array([gx - (c * px - s * py), gy - (s * px + c * py), go_angle])
