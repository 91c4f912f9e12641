"""The loss of a problem by the compiled kernels: the `Objective` that plans are made with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Array
from planning import evaluation
from planning.errors import InfeasiblePlan
from planning.evaluation import Evaluation, check_finite, check_shape
from planning.fused.pack import pack
from planning.fused.trajectory import ADAM, run
from planning.optimisers.base import Quadratic
from planning.problem import VARIABLES, Problem


class FusedObjective:
    """The same loss as `planning.objective.TorchObjective` with exact derivatives, in one compiled loop over steps.

    The active set of each step is kept from call to call, as a first guess: answers do not depend on it but for
    rounding. Where the loss is infinite, outside a barrier or where a program has no solution, `gradient` and
    `quadratic` answer with +inf and zeros. Raises ValueError for a z of another shape, or that is not finite where a
    derivative is asked for. Not to be shared between threads.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.free = problem.free
        self._data = pack(problem)
        self._warm = np.zeros(problem.steps, np.int64)
        self._none, self._adam = np.empty((1, VARIABLES, VARIABLES)), (np.empty((1, VARIABLES)), 0.0, 0.0, 0.0, 0.0)

    @property
    def start(self) -> Array:
        """z (K, 5) at the nominal values; found when it is first asked for, which takes longer than all else here."""
        return self.problem.start

    def values(self, z: Array) -> Array:
        """Return the loss (B,) of ``z`` (B, K, 5): +inf outside a barrier or where a program has no solution."""
        z = self._checked(z, batched=True)
        values = np.empty(len(z))
        self._run(z, values, self._none[0], self._none, self._none, 0)
        return values

    def gradient(self, z: Array) -> tuple[float, Array]:
        """Return the loss and its gradient (K, 5) at ``z`` (K, 5)."""
        z = self._checked(z)
        value, gradient = np.empty(1), np.empty(z.shape)
        self._run(z[None], value, gradient, self._none, self._none, 1)
        value = float(value[0])
        return value, gradient if value < np.inf else np.zeros(z.shape)

    def quadratic(self, z: Array) -> Quadratic:
        """Return the Gauss–Newton model at ``z`` (K, 5)."""
        z = self._checked(z)
        K = len(z)
        gradient, diagonal = np.empty(z.shape), np.empty((K, VARIABLES, VARIABLES))
        below = np.zeros((K - 1, VARIABLES, VARIABLES))
        value = np.empty(1)
        self._run(z[None], value, gradient, diagonal, below, 2)
        value = float(value[0])
        if not value < np.inf:
            gradient, diagonal, below = np.zeros_like(gradient), np.zeros_like(diagonal), np.zeros_like(below)
        return Quadratic(value, gradient, diagonal, below)

    def adam(
        self, z: Array, iterations: int, rate: float, betas: tuple[float, float], eps: float
    ) -> tuple[Array, Array]:
        """Return the best z (K, 5) and the curve (iterations,) of `planning.optimisers.gradient.adam`, compiled."""
        z, curve = self._checked(z), np.empty(iterations)
        best, settings = np.empty(z.shape), (float(rate), float(betas[0]), float(betas[1]), float(eps))
        self._run(z[None], curve, np.empty(z.shape), self._none, self._none, ADAM, (best, *settings))
        return best, curve

    def evaluate(self, z: Array) -> Evaluation:
        """Return everything at ``z`` (K, 5), with the programs solved by the same kernel."""
        return evaluation.evaluate(self.problem, z, "fused")

    def refusal(self, z: Array) -> InfeasiblePlan | None:
        """Return what makes the loss infinite at ``z`` (K, 5), naming step and constraint; None where it is finite."""
        return evaluation.refusal(self.problem, z, "fused")

    def _run(self, z: Array, values: Array, gradient: Array, diagonal: Array, below: Array, level: int, adam=None):
        run(z, *self._data, self._warm, values, gradient, diagonal, below, level, *(adam or self._adam))

    def _checked(self, z: Array, batched: bool = False) -> NDArray[np.float64]:
        z = np.require(z, np.float64, ["C", "W"])  # another layout would be compiled anew
        check_shape(self.problem, z, batched)
        if not batched and not np.isfinite(z).all():
            check_finite(self.problem, z)
        return z
