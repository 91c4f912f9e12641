"""What makes a finger's membrane more than a linear spring: stiffening, hysteresis and creep.

Displacements x = (x, y, θ) of the end-effector are in gocf and measured by s = √(xᵀ K x / k), with k the mean of K's
two translational stiffnesses: the length [m] of the plain translation that stores the same energy. Written in scalars,
because it runs once per plant step.
"""

from __future__ import annotations

from math import expm1, sqrt
from typing import Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from drivers.scene import Strict
from mechanics.readings import Array

Three = tuple[float, float, float]
_ZERO: Three = (0.0, 0.0, 0.0)


class Membrane(Strict):
    """How a membrane departs from w = K x. All zero: it does not.

    w = K [(1 + ``stiffening`` s) x + ``hysteresis`` z + ``creep`` (x − u)].

    * K is the stiffness of the membrane *at rest*: relaxed (u = x) and shaken out of its hysteresis (z = 0), in the
      limit of small displacements. It is the slope of the middle line between slow loading and unloading.
    * Stiffening: at a displacement s the secant stiffness of the membrane at rest is (1 + ``stiffening`` s) K, and it
      still derives from a potential.
    * Hysteresis: an elastic, ideally plastic (Jenkins) element in parallel. z follows x until it is as long as
      ``yield_length`` and is then dragged along, so that a loop of amplitude A in a direction of stiffness k
      encloses 4 ``hysteresis`` k ``yield_length`` (A − ``yield_length``).
    * Creep: a Maxwell arm in parallel, u̇ = (x − u) / ``creep_time`` (the standard linear solid). A displacement that
      is held relaxes from (1 + ``creep``) K x to K x with the time ``creep_time``; under a load that is held the
      displacement grows by the share ``creep``, with the time (1 + ``creep``) ``creep_time``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stiffening: float = Field(default=0.0, ge=0, description="growth of the stiffness with displacement [1/m]")
    hysteresis: float = Field(default=0.0, ge=0, description="stiffness of the hysteretic element over K")
    yield_length: float = Field(default=0.0, ge=0, description="displacement at which it yields [m]")
    creep: float = Field(default=0.0, ge=0, description="growth of a loaded membrane's displacement, as a share")
    creep_time: float = Field(default=0.0, ge=0, description="relaxation time [s]")

    @model_validator(mode="after")
    def _each_with_its_scale(self) -> Self:
        if self.hysteresis > 0 and self.yield_length == 0:
            raise ValueError("a membrane with hysteresis needs a yield_length above 0 [m]")
        if self.creep > 0 and self.creep_time == 0:
            raise ValueError("a membrane with creep needs a creep_time above 0 [s]")
        return self

    @property
    def is_linear(self) -> bool:
        """Whether it is the plain w = K x."""
        return not (self.stiffening or self.hysteresis or self.creep)

    def steepest(self, displacement: float) -> float:
        """The largest tangent stiffness over K within ``displacement`` [m], at any rate and in any direction."""
        return 1.0 + 2.0 * self.stiffening * displacement + self.hysteresis + self.creep


class MembraneSpring:
    """One membrane with its memory. It comes to rest in the first displacement it sees, and remembers from there on.

    `wrench` may be asked as often as needed; `advance` makes the displacement of the last question the membrane's own.
    """

    def __init__(self, stiffness: Array, membrane: Membrane):
        """``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf, symmetric positive definite."""
        self.membrane = membrane
        self._k = tuple(np.asarray(stiffness, float).ravel().tolist())
        self._per_k = 2.0 / (self._k[0] + self._k[4])
        self._stiffening, self._hysteresis, self._yield = (
            membrane.stiffening,
            membrane.hysteresis,
            membrane.yield_length,
        )
        self._creep = membrane.creep
        self._rested = False
        self._x = self._z = self._u = self._asked = self._asked_z = _ZERO

    def size(self, x: float, y: float, theta: float) -> float:
        """The length s [m] of a displacement."""
        k = self._k
        twice_energy = (
            x * (k[0] * x + k[1] * y + k[2] * theta)
            + y * (k[3] * x + k[4] * y + k[5] * theta)
            + theta * (k[6] * x + k[7] * y + k[8] * theta)
        )
        return sqrt(max(twice_energy, 0.0) * self._per_k)

    def wrench(self, x: float, y: float, theta: float) -> Three:
        """The wrench of the membrane on the go in gocf when the end-effector now moves to this displacement."""
        if not self._rested:
            self._rested = True
            self._x = self._u = (x, y, theta)
        share = 1.0 + self._creep
        if self._stiffening:
            share += self._stiffening * self.size(x, y, theta)
        ux, uy, ut = self._u
        c = self._creep
        qx, qy, qt = share * x - c * ux, share * y - c * uy, share * theta - c * ut
        if self._hysteresis:
            (x0, y0, t0), (zx, zy, zt) = self._x, self._z
            zx, zy, zt = zx + x - x0, zy + y - y0, zt + theta - t0
            length = self.size(zx, zy, zt)
            if length > self._yield:
                # the nearest point of the yield ellipsoid in K's metric: plastic flow along the element's own force
                back = self._yield / length
                zx, zy, zt = back * zx, back * zy, back * zt
            self._asked_z = (zx, zy, zt)
            h = self._hysteresis
            qx, qy, qt = qx + h * zx, qy + h * zy, qt + h * zt
        self._asked = (x, y, theta)
        k = self._k
        return (
            k[0] * qx + k[1] * qy + k[2] * qt,
            k[3] * qx + k[4] * qy + k[5] * qt,
            k[6] * qx + k[7] * qy + k[8] * qt,
        )

    def advance(self, dt: float) -> None:
        """Let ``dt`` [s] pass at the displacement that `wrench` was last asked for."""
        self._x, self._z = self._asked, self._asked_z
        if self._creep and dt > 0:
            share = -expm1(-dt / self.membrane.creep_time)
            (ux, uy, ut), (x, y, theta) = self._u, self._x
            self._u = (ux + share * (x - ux), uy + share * (y - uy), ut + share * (theta - ut))

    def strain(self, share: Array) -> None:
        """Leave the hysteretic element displaced, as handling does: by ``share`` (3,) of its yield ellipsoid.

        ``share`` lies in the unit ball, along the ellipsoid's principal axes.
        """
        values, axes = np.linalg.eigh(np.reshape(self._k, (3, 3)))
        x, y, theta = (self._yield / sqrt(self._per_k) * axes @ (share / np.sqrt(values))).tolist()
        self._z = (x, y, theta)

    def at_rest(self, linear: Array) -> Array:
        """The displacement (3,) under the wrench K · ``linear`` of a membrane at rest: its law turned around."""
        linear = linear - self._hysteresis * np.array(self._z)
        a = self._stiffening
        if not a:
            return linear
        x, y, theta = linear.tolist()
        # s (1 + a s) is the size of `linear`, whose direction is that of the displacement
        return linear / (0.5 + sqrt(0.25 + a * self.size(x, y, theta)))
