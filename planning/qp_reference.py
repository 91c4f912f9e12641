"""P2 through cvxpylayers: the reference that every faster way is checked against.

One compiled layer per pattern of modes. The solver is SCS with the dense derivative: the iterative default was wrong by
more than 1 % on one gradient in five. SCS stops on absolute residuals, so each step is scaled to unit force and its
weights go into the cones.
"""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from array_api_compat import is_torch_array

from mechanics.friction import Mode
from planning.p2 import P2, Solution

SOLVER_ARGS = {
    "solve_method": "SCS",
    "eps": 1e-9,
    "max_iters": 100_000,
    "n_jobs_forward": 1,
}
GRADIENT_ARGS = {"mode": "dense", "n_jobs_backward": 1}
"""What only the derivative understands: without one, the layer hands every option to SCS, which refuses these."""

RESIDUAL = 1e-6
"""Largest optimality violation, relative to the desired force, that still counts as solved."""


def solve(problem: P2) -> Solution:
    """Solve P2; forces are torch where ``desired``, ``mu`` or ``weights`` is, and differentiable in all three.

    A step that the solver gives up on has status ``failed`` and zero force; none is NaN.
    """
    given = (problem.desired, problem.mu, problem.weights)
    desired, mu, weights = (torch.as_tensor(np.array(v) if not is_torch_array(v) else v).double() for v in given)
    groups: dict[tuple[Mode, ...], list[int]] = defaultdict(list)
    for k, row in enumerate(problem.modes):
        groups[row].append(k)

    forces = 0 * (desired + mu[..., None] + weights)  # where all is free, torch still finds its inputs
    status, residual = ["solved"] * problem.steps, np.zeros(problem.steps)
    for pattern, steps in groups.items():
        touching = [c for c, mode in enumerate(pattern) if mode is not Mode.FREE]
        if not touching:
            continue
        at = (torch.tensor(steps)[:, None], torch.tensor(touching)[None, :])
        part, part_status, part_residual = _solve_pattern(
            tuple(pattern[c] for c in touching), desired[at], mu[at], weights[at]
        )
        forces = forces.index_put(at, part)
        for k, said, value in zip(steps, part_status, part_residual, strict=True):
            status[k], residual[k] = said, value
    as_torch = any(is_torch_array(value) for value in given)
    return Solution(forces if as_torch else forces.detach().numpy(), tuple(status), residual)


def _solve_pattern(
    pattern: tuple[Mode, ...], desired: torch.Tensor, mu: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, list[str], list[float]]:
    # With f' = √U f the objective is a plain distance and the cone one of slope µ' = µ √(U_t / U_n). The solution is
    # homogeneous in the force and does not change with the scale of the weights, so those scales may be constants.
    root = (weights / weights.detach().amax(dim=(1, 2), keepdim=True)).sqrt()
    target = root * desired
    size = target.detach().abs().amax(dim=(1, 2), keepdim=True)
    size = torch.where(size > 0, size, torch.ones_like(size))
    slope = mu * root[..., 1] / root[..., 0]
    length = (1 + slope**2).sqrt()
    parameters = ((target / size).flatten(1), slope / length, 1 / length)
    (solved, *multipliers), status = _run(_layer(pattern), parameters)
    f = solved.unflatten(1, desired.shape[1:])
    residual = _kkt_residual(pattern, f, multipliers, *parameters)
    final, worst = [], []
    for word, value in zip(status, residual, strict=True):
        failed = word == "failed"
        final.append(word if failed or value <= RESIDUAL else "inaccurate")
        worst.append(math.inf if failed else value)
    return f * size / root, final, worst


def _run(layer: Any, parameters: tuple[torch.Tensor, ...]) -> tuple[tuple[torch.Tensor, ...], list[str]]:
    """Solve a batch; where the solver refuses, solve its steps one by one to find out which."""
    from diffcp import SolverError

    count = len(parameters[0])
    try:
        out = layer(*parameters)
        bad = ~torch.stack([value.detach().isfinite().reshape(count, -1).all(1) for value in out]).all(0)
        if not bad.any():
            return out, ["solved"] * count
    except (SolverError, RuntimeError):
        pass
    if count == 1:
        zeros = tuple(parameters[0].new_zeros((1, variable)) for variable in layer.sizes)
        return zeros, ["failed"]
    parts = [_run(layer, tuple(value[k : k + 1] for value in parameters)) for k in range(count)]
    return tuple(torch.cat(values) for values in zip(*(out for out, _ in parts), strict=True)), [
        word for _, words in parts for word in words
    ]


class _Layer:
    """A compiled program. Calls return the forces (K, 2C), then each constraint's multipliers (K, rows)."""

    def __init__(self, problem: Any, parameters: list[Any], variables: list[Any]):
        from cvxpylayers.torch.cvxpylayer import CvxpyLayer

        self.sizes = [int(variable.size) for variable in variables]
        self._layer = CvxpyLayer(problem, parameters, variables, solver_args=SOLVER_ARGS)

    def __call__(self, *parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        needs = tuple(torch.is_grad_enabled() and value.requires_grad for value in parameters)
        solved: Any = _Solve.apply(self._layer, needs, *parameters)
        return tuple(value.reshape(len(value), -1) for value in solved)


class _Solve(torch.autograd.Function):
    """A layer with its own graph inside, so that what it warns of stays inside in both directions."""

    @staticmethod
    def forward(ctx: Any, layer: Any, needs: tuple[bool, ...], *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        with torch.enable_grad(), _quiet():
            ctx.inputs = [value.detach().requires_grad_(need) for value, need in zip(values, needs, strict=True)]
            ctx.outputs = tuple(layer(*ctx.inputs, solver_args=GRADIENT_ARGS if any(needs) else {}))
        return tuple(value.detach() for value in ctx.outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        wanted = [value for value in ctx.inputs if value.requires_grad]
        with _quiet():
            found = iter(torch.autograd.grad(ctx.outputs, wanted, gradients, retain_graph=True))
        return (None, None, *(next(found) if value.requires_grad else None for value in ctx.inputs))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep two warnings of the libraries from the user: an inaccurate solve, which the residual tells per step, and
    the layer's way of reading tensors into numpy."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solved/Inaccurate")
        warnings.filterwarnings("ignore", message="__array__ implementation", category=DeprecationWarning)
        yield


@lru_cache(maxsize=64)
def _layer(pattern: tuple[Mode, ...]) -> _Layer:
    import cvxpy as cp

    C = len(pattern)
    target, sine, cosine = cp.Parameter(2 * C), cp.Parameter(C, nonneg=True), cp.Parameter(C, nonneg=True)
    f = cp.Variable(2 * C)
    constraints = []
    for c, mode in enumerate(pattern):
        normal, across = sine[c] * f[2 * c], cosine[c] * f[2 * c + 1]
        if mode is Mode.STICK:
            constraints += [normal - across >= 0, normal + across >= 0, f[2 * c] >= 0]
        else:
            constraints += [f[2 * c] >= 0, across - mode.slip_sign * normal == 0]
    program = cp.Problem(cp.Minimize(0.5 * cp.sum_squares(f - target)), constraints)
    return _Layer(program, [target, sine, cosine], [f, *(row.dual_variables[0] for row in constraints)])


def _kkt_residual(
    pattern: tuple[Mode, ...], f: torch.Tensor, multipliers: list[torch.Tensor], *parameters: torch.Tensor
):
    """Return the largest violation per step of stationarity, feasibility, sign and complementarity, scaled program."""
    with torch.no_grad():
        target, sine, cosine = parameters
        stationarity = f - target.reshape(f.shape)
        violations = []
        rows = iter(value[:, 0] for value in multipliers)
        zero, one = torch.zeros_like(sine[:, 0]), torch.ones_like(sine[:, 0])
        for c, mode in enumerate(pattern):
            a, b = sine[:, c], cosine[:, c]
            stick = mode is Mode.STICK
            inequalities = [(a, -b), (a, b), (one, zero)] if stick else [(one, zero)]
            for along, across in inequalities:
                value, multiplier = along * f[:, c, 0] + across * f[:, c, 1], next(rows)
                violations += [-value, -multiplier, (value * multiplier).abs()]
                stationarity[:, c] -= multiplier[:, None] * torch.stack([along, across], dim=-1)
            if not stick:
                along, across = -mode.slip_sign * a, b
                violations.append((along * f[:, c, 0] + across * f[:, c, 1]).abs())
                stationarity[:, c] += next(rows)[:, None] * torch.stack([along, across], dim=-1)
        violations.append(stationarity.abs().amax(dim=(1, 2)))
        return torch.stack(violations).amax(dim=0).tolist()
