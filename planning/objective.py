"""The loss of a contact trajectory problem, through any backend: build the programs, solve, weigh.

Per step: variables → poses by closure (`planning.closure`) → contact program (`planning.program`) → forces → sensor's
wrench and end-effector → residuals (`planning.losses`). The loss is the sum of all squared residuals. `TorchObjective`
differentiates the whole by autograd, through the program's solution by the backend's own implicit gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mechanics.friction import Mode
from mechanics.readings import Array
from planning import losses, trajectory
from planning.errors import InfeasiblePlan
from planning.optimisers.base import Quadratic
from planning.problem import MILLIMETRE, VARIABLES, Problem
from planning.program import BACKENDS, Backend, ContactProgram, Solution
from planning.trajectory import Posed, program

__all__ = ["Evaluation", "OutsideBarrier", "TorchObjective", "backend_of", "evaluate", "program"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A solved trajectory of K steps and C contacts, in numpy: the object contacts first, then those with the ground.

    Poses (K, 3) X_W_go, X_W_ee, X_W_eo; ``wrench`` (K, 3) of the sensor on the go about the grasp centre, axes of W;
    ``points`` and ``normals`` (K, C, 2) in W, ``forces`` (K, C, 2), ``modes`` K × C and ``mu`` (C,), signs as in
    `mechanics.friction`. ``terms`` is each loss by name, ``value`` their sum, +inf outside a barrier or where a program
    has no solution: ``solution.status`` says which.
    """

    go: Array
    ee: Array
    eo: Array
    wrench: Array
    names: tuple[str, ...]
    points: Array
    normals: Array
    forces: Array
    modes: tuple[tuple[Mode, ...], ...]
    mu: Array
    terms: dict[str, float]
    value: float
    solution: Solution


class OutsideBarrier(InfeasiblePlan):
    """A step lies beyond what a barrier keeps it from, so the loss is infinite and has no gradient.

    ``contact`` is the loss: ``penetration``, ``workspace``, ``joints`` or ``sensor``.
    """

    def __str__(self) -> str:
        return f"{self.contact}, step {self.step}: {self.reason}"


def backend_of(backend: str | Backend) -> Backend:
    """Return a backend by name. Raises ValueError for an unknown one."""
    if callable(backend):
        return backend
    if backend not in BACKENDS:
        raise ValueError(f"objective: backend: expected one of {', '.join(sorted(BACKENDS))}, received {backend!r}")
    return BACKENDS[backend]()


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
        _check(self.problem, z, batched=True)
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
        if not isinstance(solved, _Solved):
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
        if not isinstance(solved, _Solved):
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
        return evaluate(self.problem, z, self._solve)

    def refusal(self, z: Array) -> InfeasiblePlan | None:
        """Return what makes the loss infinite at ``z`` (K, 5), naming step and constraint; None where it is finite."""
        solved = self._solved(z)
        return None if isinstance(solved, _Solved) else solved()

    def _solved(self, z: Array) -> _Solved | Callable[[], InfeasiblePlan]:
        """The residuals at ``z``, or where one is infinite a function that says why: that takes linear programs."""
        z = np.asarray(z, dtype=np.float64)
        _check(self.problem, z)
        z = np.where(self.free, z, self.start)
        if not np.isfinite(z).all():
            k = int(np.argwhere(~np.isfinite(z))[0, 0])
            raise ValueError(f"objective: z: step {k}: expected finite numbers, received {z[k].tolist()}")
        at = torch.from_numpy(z).requires_grad_()
        posed = trajectory.pose(self.problem, at)
        asked = trajectory.posed_program(self.problem, posed)
        solution = self._solve(asked)
        if not solution.usable.all():
            return partial(_without_solution, asked, solution)
        if not isinstance(solution.forces, torch.Tensor):
            raise ValueError("objective: backend: expected one that torch differentiates, received forces in numpy")
        parts = trajectory.residuals(self.problem, posed, solution.forces)
        for name, residual in parts.items():
            infinite = np.argwhere(~np.isfinite(residual.detach().numpy()))
            if len(infinite):
                k, i = (int(n) for n in infinite[0])
                return partial(_outside, self.problem, posed, solution.forces, name, k, i)
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


def evaluate(problem: Problem, z: Array, backend: str | Backend = "torch") -> Evaluation:
    """Return everything at ``z`` (K, 5), in numpy. Nothing is raised where a program has no solution."""
    z = np.asarray(z, dtype=np.float64)
    _check(problem, z)
    z = np.where(problem.free, z, problem.start)
    posed = trajectory.pose(problem, z)
    solution = backend_of(backend)(trajectory.posed_program(problem, posed))
    if isinstance(solution.forces, torch.Tensor):
        found = {n: getattr(solution, n) for n in ("forces", "balance", "cone")}
        solution = replace(solution, **{n: v.detach().numpy() for n, v in found.items() if isinstance(v, torch.Tensor)})
    forces = np.asarray(solution.forces)
    with torch.no_grad():
        parts = trajectory.residuals(
            problem, trajectory.pose(problem, torch.from_numpy(z)), torch.from_numpy(np.array(forces))
        )
        terms = {name: float(r.square().sum()) for name, r in parts.items()}
    value = sum(terms.values()) if solution.usable.all() else np.inf
    wrench, ee = trajectory.sensor(problem, posed, forces)
    return Evaluation(
        go=posed.placed.go,
        ee=ee,
        eo=np.array(problem.eo),
        wrench=wrench,
        names=trajectory.contact_names(problem),
        points=posed.placed.points,
        normals=posed.placed.normals,
        forces=forces,
        modes=tuple(zip(*(contact.modes for contact in (*problem.contacts, *problem.ground)), strict=True)),
        mu=trajectory.contact_mu(problem),
        terms=terms,
        value=float(value) if not np.isnan(value) else np.inf,
        solution=solution,
    )


def _check(problem: Problem, z: Array, batched: bool = False) -> None:
    if z.ndim != 2 + batched or z.shape[-2:] != (problem.steps, VARIABLES):
        expected = f"({'B, ' * batched}{problem.steps}, {VARIABLES})"
        raise ValueError(f"objective: z: expected shape {expected}, received {z.shape}")


def _tensor(value: Any) -> torch.Tensor:
    return value if isinstance(value, torch.Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))


def _outside(problem: Problem, posed: Posed, forces: torch.Tensor, name: str, k: int, i: int) -> OutsideBarrier:
    """The residual ``i`` of the loss ``name`` that is infinite at step ``k``, in figures."""
    wrench, ee = (value.detach().numpy()[k] for value in trajectory.sensor(problem, posed, forces))
    limits = problem.limits
    reason = "the loss is infinite"
    if name == "penetration":
        angle, (lo, hi) = np.degrees(posed.variables.angle[k].item()), np.degrees(problem.angle_limits[k])
        reason = f"the relative angle is {angle:.4g}°, admissible are {lo:.4g}° to {hi:.4g}°"
    elif name == "workspace" and limits.workspace is not None:
        which, unit, factor = (("x", "mm", 1e3), ("y", "mm", 1e3), ("angle", "°", 180 / np.pi))[i]
        lo, hi = limits.workspace[i] * factor
        reason = f"the end-effector's {which} is {ee[i] * factor:.4g} {unit}, the workspace {lo:.4g} to {hi:.4g} {unit}"
    elif name == "joints" and limits.arm is not None:
        readings, reachable = losses.joint_readings(limits.arm, torch.from_numpy(ee))
        joint, (lo, hi) = ("shoulder", "elbow", "wrist")[i], np.degrees(limits.arm.limits[i])
        reason = f"the {joint} is at {np.degrees(float(readings[i])):.4g}°, its limits are {lo:.4g}° to {hi:.4g}°"
        if not reachable:
            reason = f"the arm does not reach ({ee[0] * 1e3:.4g}, {ee[1] * 1e3:.4g}) mm at {np.degrees(ee[2]):.4g}°"
    elif name == "sensor" and i == 0 and limits.force is not None:
        reason = f"the sensor takes {limits.force:.4g} N and is to carry {np.hypot(wrench[0], wrench[1]):.4g} N"
    elif name == "sensor" and limits.torque is not None:
        reason = f"the sensor takes {limits.torque * 1e3:.4g} N·mm and is to carry {abs(wrench[2]) * 1e3:.4g} N·mm"
    return OutsideBarrier(k, name, np.nan, np.nan, reason=reason)


def _without_solution(asked: ContactProgram, solution: Solution) -> InfeasiblePlan:
    """The first step whose program has no solution, and why."""
    from planning.feasibility import explain

    k = int(np.argmin(solution.usable))
    found = explain(asked, k, hard=False)
    if found is not None:
        return found.error()
    reason = f"forces exist, but the solver found none ({solution.status[k]})"
    return InfeasiblePlan(k, "', '".join(asked.names), np.nan, np.nan, reason=reason)
