"""What an elasticity identification finds: a stiffness, how it grows, what the finger remembers, and how sure it is.

At rest w = K (1 + a s) x with s = √(xᵀ K x / k), the length of the translation that stores the same energy
(`finger_memory.size`). The law derives from the potential ½ k s² (1 + ⅔ a s), is monotone for a ≥ 0, and has an inverse
in closed form. With a = 0 it is the paper's eq. (1). In motion, w = K [(1 + a s) x + h z + c (x − u)].
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from estimation.finger_memory import size
from mechanics.elasticity import Elasticity
from mechanics.readings import Array

#: the six entries of a symmetric K, in the order of every covariance here
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
ENTRY_NAMES = ("xx", "xy", "xθ", "yy", "yθ", "θθ")


def symmetric(entries: ArrayLike) -> Array:
    """The symmetric matrix (3, 3) of six ``entries``, in the order of `ENTRIES`."""
    K = np.zeros((3, 3))
    for value, (i, j) in zip(np.asarray(entries, float), ENTRIES, strict=True):
        K[i, j] = K[j, i] = value
    return K


def entries_of(K: Array) -> Array:
    """The six entries (6,) of a symmetric matrix, in the order of `ENTRIES`."""
    return np.array([K[i, j] for i, j in ENTRIES])


@dataclass(frozen=True)
class Memory:
    """What a finger remembers, as identified from a path; a term that the residuals did not ask for is zero.

    ``hysteresis`` of K in an element that yields at ``yield_length`` [m]; only their product is well known where all
    moves are longer. ``creep`` of K in an arm that relaxes with ``creep_time`` [s].
    """

    hysteresis: float = 0.0
    yield_length: float = 0.0
    creep: float = 0.0
    creep_time: float = 0.0


@dataclass(frozen=True, eq=False)
class ElasticityFit:
    """An identified finger.

    ``stiffness`` K (3, 3) [N/m, N, N·m/rad] in gocf at small displacements, ``stiffening`` a ≥ 0 [1/m];
    ``covariance`` (7, 7) of K's six `ENTRIES` and of a (zero where the residuals did not ask for it). ``offset`` (3,)
    is where gocf, in which zero wrench is x = 0, lies in the gocf of the samples: a regrasp, and what a constant bias
    of the wrench looks like. ``lever`` (2,) [m]: the torque of the samples is off by lever · force, as by gains that
    differ on the wrist's lever; it is not part of the law. ``residual_rms`` (3,) [N, N, N·m] and ``chi2`` per degree
    of freedom tell how well it fits: 1 where the given noise is all there is. ``reach`` [m] is the size s of the
    largest sample.
    """

    stiffness: Array
    stiffening: float
    covariance: Array
    offset: Array
    lever: Array
    residual_rms: Array
    chi2: float
    samples: int
    reach: float
    method: str
    memory: Memory = field(default_factory=Memory)

    @property
    def standard_errors(self) -> Array:
        """1 sigma of each entry of K, (3, 3)."""
        return symmetric(np.sqrt(np.diag(self.covariance)[:6]))

    def wrench(self, x: ArrayLike) -> Array:
        """The wrench (..., 3) at rest, of the sensor on the object in gocf, for displacements ``x`` (..., 3)."""
        x = np.asarray(x, float)
        return (1 + self.stiffening * size(self.stiffness, x))[..., None] * (x @ self.stiffness)

    def displacement(self, w: ArrayLike) -> Array:
        """The displacement (..., 3) at rest under ``w`` (..., 3): the inverse of `wrench`."""
        linear = np.linalg.solve(self.stiffness, np.asarray(w, float)[..., None])[..., 0]
        # s (1 + a s) is the size of K⁻¹ w, whose direction is that of x
        return linear / (0.5 + np.sqrt(0.25 + self.stiffening * size(self.stiffness, linear)))[..., None]

    def secant(self, amplitude: float) -> Array:
        """The secant stiffness (3, 3) at displacements of the size ``amplitude`` [m]: w = secant x there."""
        return (1 + self.stiffening * amplitude) * self.stiffness

    def secant_errors(self, amplitude: float) -> Array:
        """1 sigma (3, 3) of each entry of `secant`."""
        J = np.hstack([(1 + self.stiffening * amplitude) * np.eye(6), amplitude * entries_of(self.stiffness)[:, None]])
        return symmetric(np.sqrt(np.einsum("ij,jk,ik->i", J, self.covariance, J)))

    def elasticity(self, amplitude: float = 0.0) -> Elasticity:
        """The linear spring that planner and controllers take, with the secant stiffness at ``amplitude`` [m]."""
        return Elasticity(self.secant(amplitude))
