"""What a rubber finger remembers: where it has been, and for how long.

Two elements of textbook rheology beside the spring: an elastic, ideally plastic one (Jenkins), which makes the loop
between loading and unloading, and a Maxwell arm, which makes a held finger relax. Both are driven by the path of the
displacement alone, so that a recorded path explains what a single pair of pose and wrench cannot.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, exp, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimation.errors import FitError, finite_rows
from mechanics import se2
from mechanics.readings import Array

#: a move is followed in steps of this share of the yield length, at most so many
_SHARE, _MOST_STEPS = 0.25, 64


@dataclass(frozen=True, eq=False)
class Path:
    """How the end-effector went: at ``times`` (m,) [s] it was at ``x`` (m, 3) in gocf, straight in between.

    Set-points or measured poses, in the same coordinates as the samples; a hold is one x at two times. It begins where
    the fingers closed, which is where they are at rest. Raises FitError for NaN, or times that do not increase.
    """

    times: Array
    x: Array

    def __post_init__(self) -> None:
        times = finite_rows("times of the path", np.asarray(self.times, float)[:, None], (1,))[:, 0]
        x = finite_rows("path", self.x, (3,), ("x", "y", "θ"))
        if len(times) != len(x) or len(x) == 0 or (np.diff(times) <= 0).any():
            raise FitError(
                "path",
                "as many increasing times as displacements",
                f"{len(times)} times and {len(x)} displacements",
                "Take both from the same set-points or readings.",
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "x", x)

    def through(self, instants: Array) -> tuple[Path, NDArray[np.intp]]:
        """The same path with a vertex at each of ``instants`` (n,) [s], and the indices (n,) of these vertices."""
        if instants.min() < self.times[0] or instants.max() > self.times[-1]:
            raise FitError(
                "times of the samples",
                f"within the path, {self.times[0]:g} to {self.times[-1]:g} s",
                f"{instants.min():g} to {instants.max():g} s",
                "Record the path from the grasp to the last sample.",
            )
        times = np.union1d(self.times, instants)
        x = np.stack([np.interp(times, self.times, self.x[:, k]) for k in range(3)], axis=-1)
        return Path(times, x), np.searchsorted(times, instants)

    def seen_from(self, X: Array) -> Path:
        """The same path in a frame at ``X`` (3,)."""
        return Path(self.times, se2.between(np.broadcast_to(X, self.x.shape), self.x))

    def states(self, K: Array, yield_length: float, creep_time: float) -> tuple[Array, Array]:
        """Where the two elements are at each vertex: ζ (m, 3), the plastic one over its yield length, and u (m, 3).

        ζ lies within the unit ball of K's metric (`size`), u follows x with ``creep_time`` [s].
        """
        values = np.ascontiguousarray(K, np.float64)
        return _follow(self.times, self.x, values, 2 / (values[0, 0] + values[1, 1]), yield_length, creep_time)


def size(K: ArrayLike, x: ArrayLike) -> Array:
    """The length (...) [m] of displacements ``x`` (..., 3): of the translation that stores the same energy.

    s² = xᵀ K x / k with k the mean of the two translational stiffnesses of ``K`` (3, 3).
    """
    K, x = np.asarray(K, float), np.asarray(x, float)
    return np.sqrt(np.maximum(np.einsum("...i,ij,...j", x, K, x), 0.0) * 2 / (K[0, 0] + K[1, 1]))


@njit(cache=True)
def _follow(times, x, K, per_k, yield_length, creep_time):
    m = len(times)
    zeta, u = np.zeros((m, 3)), np.zeros((m, 3))
    z, d, lag = np.zeros(3), np.zeros(3), x[0].copy()
    u[0] = lag
    for i in range(1, m):
        dt = times[i] - times[i - 1]
        for j in range(3):
            d[j] = x[i, j] - x[i - 1, j]
        length = sqrt(max(_energy(K, d) * per_k, 0.0))
        if length > 0.0:
            steps = min(_MOST_STEPS, ceil(length / (_SHARE * yield_length)))
            for _ in range(steps):
                for j in range(3):
                    z[j] += d[j] / steps
                long = sqrt(max(_energy(K, z) * per_k, 0.0))
                if long > yield_length:
                    for j in range(3):
                        z[j] *= yield_length / long
        # u̇ = (x − u) / T along a straight path, in closed form
        decay = exp(-dt / creep_time)
        for j in range(3):
            behind = d[j] / dt * creep_time
            lag[j] = x[i, j] - behind + (lag[j] - x[i - 1, j] + behind) * decay
            zeta[i, j] = z[j] / yield_length
            u[i, j] = lag[j]
    return zeta, u


@njit(cache=True)
def _energy(K, v):
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += v[i] * K[i, j] * v[j]
    return total
