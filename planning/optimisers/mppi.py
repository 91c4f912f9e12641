"""Model-predictive path integrals: a mean trajectory moved by the weighted average of noisy ones."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mechanics.readings import Array
from planning.optimisers.base import Objective, Optimiser, Optimum, register
from planning.optimisers.checks import checked_start, require_finite
from planning.optimisers.noise import coloured


def weights(losses: Array, temperature: float | None, effective: float) -> Array:
    """Return exp(−loss/λ) (B), normalised (Williams et al. 2017, algorithm 2). Infinite losses weigh nothing.

    λ is ``temperature`` in the loss's own unit, or None: then λ is such that the effective number of samples 1/Σω² is
    ``effective`` times the number of finite ones. That is the same for any scale and offset of the loss.
    """
    finite = np.isfinite(losses)
    above = np.where(finite, losses - losses[finite].min(), np.inf)
    if temperature is None:
        temperature = _temperature(above[finite], effective)
    omega = np.exp(-above / temperature)
    return omega / omega.sum()


def _temperature(above: Array, effective: float) -> float:
    """λ for an effective share of the samples, by bisection of log λ; ``above`` are finite losses less the least."""
    spread = float(above.max())
    if spread == 0.0:
        return 1.0  # all the same: any λ weighs them the same
    low, high = np.log(spread) - 30.0, np.log(spread) + 10.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        omega = np.exp(-above / np.exp(middle))
        if omega.sum() ** 2 > effective * len(above) * np.sum(omega**2):
            high = middle
        else:
            low = middle
    return float(np.exp(high))


@register
@dataclass
class MPPI(Optimiser):
    """MPPI with ``iterations`` × ``samples`` queries in all: 1 × 100 and 10 × 100 are the paper's.

    Each iteration asks in one batch for the mean and for noisy copies of it, and moves the mean to their average under
    `weights`, in which the best trajectory so far takes part where ``elite``. The last iteration leaves one query for
    the mean that it ends with. The best of all is returned; the curve is the least loss after each iteration.

    ``sigma`` is the noise's standard deviation in units of z (about 1 mm, 1 N), one for all variables or one for each;
    it shrinks by ``shrink`` per iteration. Where its scale is not known, each sample can have its own, drawn between
    ``sigma``/``spread`` and ``sigma``, even in the logarithm. ``beta`` colours the noise along the steps, 0 is white.
    ``temperature`` None adapts to an ``effective`` share of the samples.

    There is no cost on the noise. With a quadratic action cost MPPI's importance weights contain λ uᵀΣ⁻¹ε, linear in
    the noise; where the losses tie it draws the mean toward zero or, with the noise's magnitude, keeps it from moving.
    Zero means nothing among our variables and smoothness is a loss of its own, so the term is left out (γ = 0).
    """

    name: ClassVar[str] = "mppi"
    iterations: int = 10
    samples: int = 100
    sigma: float | tuple[float, ...] = 0.1
    beta: float = 3.0
    temperature: float | None = None
    effective: float = 0.1
    shrink: float = 0.8
    spread: float = 1.0
    elite: bool = True

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"mppi: iterations: expected at least 1, received {self.iterations}")
        if self.samples < 3:
            raise ValueError(f"mppi: samples: expected at least 3, received {self.samples}")
        if not np.all(np.asarray(self.sigma) >= 0):
            raise ValueError(f"mppi: sigma: expected standard deviations, received {self.sigma}")
        if self.temperature is not None and not self.temperature > 0:
            raise ValueError(f"mppi: temperature: expected a positive number or None, received {self.temperature}")
        if not 0 < self.effective < 1:
            raise ValueError(f"mppi: effective: expected a share between 0 and 1, received {self.effective}")

    def optimise(self, objective: Objective, z: Array, rng: np.random.Generator) -> Optimum:
        """Improve ``z`` (K, D). Raises ValueError where the loss is not finite at ``z``."""
        mean = checked_start(self.name, objective, z)
        began = time.perf_counter()
        sigma = np.where(objective.free, self.sigma, 0.0)
        best, least, queries, curve, asked = mean, np.inf, 0, [], []
        for i in range(self.iterations):
            last = i == self.iterations - 1
            count = self.samples - last
            noise = coloured(rng, (count, *mean.shape), self.beta)
            noise *= self.spread ** -rng.random((count, 1, 1))
            noise[0] = 0.0
            trials = mean + noise * sigma * self.shrink**i
            losses = objective.values(trials)
            queries += count
            if i == 0:
                require_finite(self.name, losses[0])
            if losses.min() < least:
                best, least = trials[np.argmin(losses)], float(losses.min())
            trials, losses = trials[1:], losses[1:]
            if self.elite:
                trials, losses = np.concatenate([trials, best[None]]), np.append(losses, least)
            if np.isfinite(losses).any():
                mean = np.tensordot(weights(losses, self.temperature, self.effective), trials, axes=1)
            if last:
                value = float(objective.values(mean[None])[0])
                queries += 1
                if value < least:
                    best, least = mean, value
            curve.append(least)
            asked.append(queries)
        return Optimum(best, least, np.array(curve), queries, time.perf_counter() - began, asked=tuple(asked))
