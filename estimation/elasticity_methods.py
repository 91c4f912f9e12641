"""The linear ways from displacements and wrenches to a stiffness, w = K x + b, side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.finger_law import symmetric
from estimation.finger_memory import Path
from mechanics.readings import Array

#: gradient steps of the paper's method, and their size at the start
_STEPS, _RATE = 300, 0.01


@dataclass(frozen=True, eq=False)
class Samples:
    """Checked readings in one frame: ``x``, ``w`` (n, 3), their noise (3, 3), and, where given, how they were reached.

    ``hold`` (n,) numbers the holds from 0; the readings of a hold have one x, of which ``x_covariance`` is the noise.
    ``vertices`` (n,) are the path's at the readings, ``drift`` (n, k) the polynomials by which the wrench may wander.
    """

    x: Array
    w: Array
    x_covariance: Array
    w_covariance: Array
    hold: NDArray[np.intp]
    path: Path | None
    vertices: NDArray[np.intp] | None
    drift: Array

    @cached_property
    def count(self) -> Array:
        """How many readings each hold has, (holds,)."""
        return np.bincount(self.hold).astype(float)

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """A reading of each hold, (holds,)."""
        return np.unique(self.hold, return_index=True)[1]

    def split(self, values: Array) -> tuple[Array, Array]:
        """The mean of ``values`` (n, k) in each hold (holds, k), and what each reading is away from it (n, k)."""
        total = np.zeros((len(self.count), values.shape[1]))
        np.add.at(total, self.hold, values)
        mean = total / self.count[:, None]
        return mean, values - mean[self.hold]

    def by_hold(self, values: Array) -> Array:
        """Sums (holds, k) of ``values`` (holds · 3 + n · 3, k) of a hold: three of its mean, three a reading."""
        holds, k = len(self.count), values.shape[1]
        total = values[: 3 * holds].reshape(holds, 3, k).sum(axis=1)
        np.add.at(total, self.hold, values[3 * holds :].reshape(-1, 3, k).sum(axis=1))
        return total

    def replaced(self, **changes: Any) -> Samples:
        """The same with other values."""
        return replace(self, **changes)

    @staticmethod
    def design(x: Array) -> Array:
        """Rows (n, 3, 6) with which K's six entries make the wrenches of ``x`` (n, 3)."""
        rows = np.zeros((len(x), 3, 6))
        rows[:, 0, :3] = x
        rows[:, 1, (1, 3, 4)] = x
        rows[:, 2, (2, 4, 5)] = x
        return rows


def least_squares(samples: Samples) -> tuple[Array, Array]:
    """K (3, 3) symmetric and b (3,) that leave the least in the wrenches, each component over its spread."""
    return _regress(samples.x, samples.w, 1 / samples.w.std(axis=0))


def inverse_regression(samples: Samples) -> tuple[Array, Array]:
    """K and b from x = C w + d, C symmetric, which leaves the least in the displacements, each over its noise."""
    C, d = _regress(samples.w, samples.x, 1 / np.sqrt(np.diag(samples.x_covariance)))
    K = np.linalg.inv(C)
    K = 0.5 * (K + K.T)
    return K, -K @ d


def _regress(given: Array, wanted: Array, weights: Array) -> tuple[Array, Array]:
    centre, mean = given.mean(axis=0), wanted.mean(axis=0)
    # in units of its own spread each column counts alike, whatever it is measured in
    unit = given.std(axis=0)
    rows = Samples.design(given - centre) * weights[:, None]
    lengths = np.array([max(unit[0], 1e-300), *(np.sqrt(unit[i] * unit[j]) or 1.0 for i, j in _PAIRS[1:])])
    target = ((wanted - mean) * weights).ravel()
    entries = np.linalg.lstsq((rows / lengths).reshape(-1, 6), target, rcond=None)[0] / lengths
    M = symmetric(entries)
    return M, mean - M @ centre


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def torch_descent(samples: Samples) -> tuple[Array, Array]:
    """The paper's: K = LᵀL and b by Adam on the mean squared wrench, in units in which K is about the identity."""
    import torch

    start, b = least_squares(samples)
    force = samples.w.std(axis=0)
    unit = np.sqrt(np.abs(np.diag(start)))
    values, vectors = np.linalg.eigh(start / np.outer(unit, unit))
    root = np.sqrt(np.maximum(values, 1e-3))[:, None] * vectors.T
    x, w, weights = (torch.as_tensor(v) for v in (samples.x * unit, samples.w / force, unit / force))
    L = torch.as_tensor(root).clone().requires_grad_(True)
    offset = torch.as_tensor(b / force).clone().requires_grad_(True)
    optimiser = torch.optim.Adam([L, offset], lr=_RATE)
    for step in range(_STEPS):
        # a rate that falls to nothing: Adam circles the minimum by its rate otherwise
        optimiser.param_groups[0]["lr"] = _RATE * (1 - step / _STEPS) ** 2
        optimiser.zero_grad()
        loss = torch.mean((x @ (L.T @ L) * weights + offset - w) ** 2)
        loss.backward()
        optimiser.step()
    found = L.detach().numpy() * unit
    return found.T @ found, offset.detach().numpy() * force
