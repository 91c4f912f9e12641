"""First order: Adam for a fixed number of queries; the paper's Grad 100."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from mechanics.readings import Array
from planning.optimisers.base import Objective, Optimiser, Optimum, register
from planning.optimisers.checks import checked_start, require_finite


@runtime_checkable
class HasAdam(Protocol):
    """An objective with Adam inside, which spares the way out of the compiled loop and back at each query."""

    def adam(
        self, z: Array, iterations: int, rate: float, betas: tuple[float, float], eps: float
    ) -> tuple[Array, Array]:
        """Return what `adam` returns: the best z (K, D) and the curve (iterations)."""
        ...


def adam(
    objective: Objective, z: Array, iterations: int, rate: float, betas: tuple[float, float], eps: float
) -> tuple[Array, Array]:
    """Adam (Kingma and Ba 2015, algorithm 1) from ``z`` (K, D): the best z that was seen, and the loss at each query.

    Query i is at the point that i steps lead to, so the last query has no step after it. Where the loss or its
    gradient is not finite (behind a barrier), the last step is halved until it is; each halving is a query, the moments
    stay as they are, and the curve repeats the loss of the point that the step set out from. Variables that are not
    free do not move. The curve is all infinite where the start is not finite.
    """
    free = objective.free
    here = np.array(z, dtype=float)  # the last point with a finite loss, and the step that leads away from it
    step = np.zeros_like(here)
    best, least, stands = here, np.inf, np.inf
    first, second = np.zeros_like(here), np.zeros_like(here)
    curve = np.empty(iterations)
    t = 0
    for i in range(iterations):
        there = here + step
        value, gradient = objective.gradient(there)
        gradient = np.where(free, gradient, 0.0)
        if np.isfinite(value) and np.isfinite(gradient).all():
            here, stands = there, value
            if value < least:
                best, least = here, value
            t += 1
            first = betas[0] * first + (1 - betas[0]) * gradient
            second = betas[1] * second + (1 - betas[1]) * gradient**2
            mean, square = first / (1 - betas[0] ** t), second / (1 - betas[1] ** t)
            step = -rate * mean / (np.sqrt(square) + eps)
        else:
            step = 0.5 * step
        curve[i] = stands
    return best, curve


@register
@dataclass
class Gradient(Optimiser):
    """Adam: ``iterations`` queries of loss and gradient, at a ``rate`` in units of z (about 1 mm, 1 N).

    The objective's own Adam is used where it has one; it is the same formula, see `adam`.
    """

    name: ClassVar[str] = "gradient"
    iterations: int = 100
    rate: float = 0.2
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"gradient: iterations: expected at least 1, received {self.iterations}")
        if not self.rate > 0:
            raise ValueError(f"gradient: rate: expected a positive number, received {self.rate}")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"gradient: betas: expected two numbers in [0, 1), received {self.betas}")

    def optimise(self, objective: Objective, z: Array, rng: np.random.Generator) -> Optimum:
        """Improve ``z`` (K, D); ``rng`` is not used. Raises ValueError where the loss is not finite at ``z``."""
        z = checked_start(self.name, objective, z)
        began = time.perf_counter()
        own = objective.adam if isinstance(objective, HasAdam) else None
        settings = (self.iterations, self.rate, self.betas, self.eps)
        best, curve = own(z, *settings) if own else adam(objective, z, *settings)
        elapsed = time.perf_counter() - began
        require_finite(self.name, float(curve[0]))
        return Optimum(
            best, float(np.min(curve)), curve, self.iterations, elapsed, asked=tuple(range(1, self.iterations + 1))
        )
