"""The loss of a contact trajectory problem and its derivatives by torch, through any backend that it differentiates.

Per step: variables → poses by closure (`planning.closure`) → contact program (`planning.program`) → forces → sensor's
wrench and end-effector → residuals (`planning.losses`). The loss is the sum of all squared residuals. `TorchObjective`
differentiates the whole by autograd, through the program's solution by the backend's own implicit gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mechanics.readings import Array
from planning import evaluation, trajectory
from planning.errors import InfeasiblePlan
from planning.evaluation import Evaluation, backend_of, check_finite, check_shape
from planning.optimisers.base import Quadratic
from planning.problem import MILLIMETRE, VARIABLES, Problem
from planning.program import Backend
from planning.trajectory import Posed


class TorchObjective:
    """The loss of a problem by torch, with the programs solved by a backend: an `Objective` of 5 variables per step.

    ``backend`` is "torch", "cvxpylayers" or a function that solves a `ContactProgram`, through which autograd reaches
    its data where derivatives are asked for; `values` and `evaluate` need none. Where the loss is infinite, outside a
    barrier or where a program has no solution, `gradient` and `quadratic` answer with +inf and zeros, as optimisers
    expect it, and `refusal` says why. Raises ValueError for a z of another shape.
    """

    def __init__(self, problem: Problem, backend: str | Backend = "torch"):
        self.problem, self._solve = problem, backend_of(backend)
        self.start: Array = problem.start
        self.free: NDArray[np.bool_] = problem.free

    def values(self, z: Array) -> Array:
        """Return the loss (B,) of ``z`` (B, K, 5): +inf outside a barrier or where a program has no solution."""
        z = np.asarray(z, dtype=np.float64)
        check_shape(self.problem, z, batched=True)
        if len(z) == 0:
            return np.empty(0)
        finite = np.all(np.isfinite(np.where(self.free, z, 0.0)), axis=(1, 2))
        z = np.where(self.free & finite[:, None, None], z, self.start)
        with torch.no_grad():
            posed = trajectory.pose(self.problem, torch.from_numpy(z))
            solution = self._solve(trajectory.posed_program(self.problem, posed))
            forces = _tensor(solution.forces).reshape(posed.placed.points.shape)
            parts = trajectory.residuals(self.problem, posed, forces)
            value = sum((r.square().sum((-2, -1)) for r in parts.values()), torch.zeros(len(z), dtype=torch.float64))
        usable = solution.usable.reshape(len(z), -1).all(axis=1)
        return np.where(finite & usable & ~np.isnan(value.numpy()), value.numpy(), np.inf)

    def gradient(self, z: Array) -> tuple[float, Array]:
        """Return the loss and its gradient (K, 5) at ``z`` (K, 5)."""
        solved = self._solved(z)
        if solved is None:
            return np.inf, np.zeros(self.free.shape)
        total = sum((r.square().sum() for r in solved.parts.values()), 0 * solved.at.sum())
        (gradient,) = torch.autograd.grad(total, solved.at)
        return float(total.detach()), np.where(self.free, gradient.numpy(), 0.0)

    def quadratic(self, z: Array) -> Quadratic:
        """Return the Gauss–Newton model at ``z`` (K, 5).

        Each step's residuals depend on its own variables alone, so one backward pass gives a residual's derivatives at
        all steps; smoothness couples neighbours through the go's poses.
        """
        K, solved = self.problem.steps, self._solved(z)
        gradient, diagonal = np.zeros((K, VARIABLES)), np.zeros((K, VARIABLES, VARIABLES))
        below = np.zeros((K - 1, VARIABLES, VARIABLES))
        if solved is None:
            return Quadratic(np.inf, gradient, diagonal, below)
        value = 0.0
        for name, residual in solved.parts.items():
            r = residual.detach().numpy()
            value += float((r**2).sum())
            if name == "smooth":
                size = np.array([1.0, 1.0, self.problem.go_body.rho]) / MILLIMETRE
                G = size[:, None] * self._jacobian(solved.posed.placed.go, solved.at)
                G *= (self.problem.weights.smooth / (K - 1)) ** 0.5
                gradient[1:] += 2 * np.einsum("kr,krd->kd", r, G[1:])
                gradient[:-1] -= 2 * np.einsum("kr,krd->kd", r, G[:-1])
                square = 2 * np.einsum("kri,krj->kij", G, G)
                diagonal[1:] += square[1:]
                diagonal[:-1] += square[:-1]
                below -= 2 * np.einsum("kri,krj->kij", G[1:], G[:-1])
            else:
                J = self._jacobian(residual, solved.at)
                gradient += 2 * np.einsum("kr,krd->kd", r, J)
                diagonal += 2 * np.einsum("kri,krj->kij", J, J)
        return Quadratic(value, gradient, diagonal, below)

    def evaluate(self, z: Array) -> Evaluation:
        """Return everything at ``z`` (K, 5)."""
        return evaluation.evaluate(self.problem, z, self._solve)

    def refusal(self, z: Array) -> InfeasiblePlan | None:
        """Return what makes the loss infinite at ``z`` (K, 5), naming step and constraint; None where it is finite."""
        return evaluation.refusal(self.problem, z, self._solve)

    def _solved(self, z: Array) -> _Solved | None:
        """The residuals at ``z``, None where one is infinite."""
        z = np.asarray(z, dtype=np.float64)
        check_shape(self.problem, z)
        check_finite(self.problem, z)
        z = np.where(self.free, z, self.start)
        at = torch.from_numpy(z).requires_grad_()
        posed = trajectory.pose(self.problem, at)
        solution = self._solve(trajectory.posed_program(self.problem, posed))
        if not solution.usable.all():
            return None
        if not isinstance(solution.forces, torch.Tensor):
            raise ValueError("objective: backend: expected one that torch differentiates, received forces in numpy")
        parts = trajectory.residuals(self.problem, posed, solution.forces)
        if not all(bool(torch.isfinite(residual).all()) for residual in parts.values()):
            return None
        return _Solved(at, posed, parts)

    def _jacobian(self, of: torch.Tensor, at: torch.Tensor) -> Array:
        """d of / d at (K, r, 5), where step k of ``of`` (K, r) depends on step k of ``at`` alone."""
        J = np.zeros((*of.shape, VARIABLES))
        for i in range(of.shape[1]):
            if of.requires_grad:
                row = torch.autograd.grad(of[:, i].sum(), at, retain_graph=True, allow_unused=True)[0]
                J[:, i] = 0.0 if row is None else row.numpy()
        return np.where(self.free[:, None, :], J, 0.0)


@dataclass(frozen=True, eq=False)
class _Solved:
    """The variables (K, 5), which gather gradients, and the residuals of them, all finite."""

    at: torch.Tensor
    posed: Posed
    parts: dict[str, torch.Tensor]


def _tensor(value: Any) -> torch.Tensor:
    return value if isinstance(value, torch.Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
