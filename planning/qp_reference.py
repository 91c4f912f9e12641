"""Contact programs through cvxpylayers: the reference that every faster way is checked against.

One compiled layer per pattern of modes. Two settings: *accurate*, SCS at 1e-9, and *fast*, Clarabel, which is as
exact as its conic form lets it be: about 1e-4 of the force. Both differentiate by the dense method; the iterative
default was wrong by more than 1 % on one gradient in five. Solvers stop on absolute residuals, so each step is scaled
to unit force, its weights go into the rows, and the rows of balance to unit length.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from array_api_compat import is_torch_array
from torch import Tensor

from planning.feasibility import BALANCED, imbalance
from planning.program import FREE, STICK, ContactProgram, Solution, force_scale, kkt_residual, take


@dataclass(frozen=True)
class Settings:
    """Options of a solver, those that only the derivative understands, and the ``residual`` up to which a step counts
    as solved. Without a derivative the layer hands every option to the solver, which refuses a derivative's."""

    name: str
    solver: dict[str, Any] = field(hash=False)
    derivative: dict[str, Any] = field(hash=False)
    residual: float = 1e-6


DENSE = {"mode": "dense", "n_jobs_backward": 1}
ACCURATE = Settings("accurate", {"solve_method": "SCS", "eps": 1e-9, "max_iters": 100_000, "n_jobs_forward": 1}, DENSE)
FAST = Settings("fast", {"solve_method": "Clarabel", "n_jobs_forward": 1}, DENSE, residual=1e-3)

INACCURATE = 1e-2
"""Residual beyond which an answer is none: the step ``failed``."""

_DIFFERENTIABLE = ("desired", "mu", "weights", "eo_jacobian", "eo_load", "go_jacobian", "go_load")


def solve_accurate(program: ContactProgram) -> Solution:
    """Solve every step by SCS; see `solve`."""
    return solve(program, ACCURATE)


def solve_fast(program: ContactProgram) -> Solution:
    """Solve every step by Clarabel; see `solve`."""
    return solve(program, FAST)


def solve(program: ContactProgram, settings: Settings = ACCURATE) -> Solution:
    """Solve every step; forces are torch, and differentiable, where a field of ``program`` is torch.

    A batch that the solver refuses is solved one by one. A step that it calls infeasible, or gives up on where a linear
    program says so too, is ``infeasible``, else ``failed``. Multipliers carry no gradient.
    """
    given = [getattr(program, name) for name in _DIFFERENTIABLE]
    as_torch = any(is_torch_array(value) for value in given)
    tensors: dict[str, Any] = {n: _double(v) for n, v in zip(_DIFFERENTIABLE, given, strict=True)}
    data = _Data(**tensors)
    K, C = program.modes.shape
    forces = 0 * (
        data.desired.nan_to_num() + data.mu.nan_to_num()[..., None]
    )  # torch finds its inputs where all is free
    balance = None if program.eo_jacobian is None else np.zeros((K, 3))
    cone, status = np.zeros((K, C, 3)), np.array(["solved"] * K, dtype=object)
    scale = torch.from_numpy(force_scale(program))
    flat = (data.mu.detach() == 0).numpy() & (program.modes == STICK)
    groups: dict[tuple[tuple[int, bool], ...], list[int]] = defaultdict(list)
    for k in range(K):
        if data.finite(k):
            groups[tuple(zip(program.modes[k].tolist(), flat[k].tolist(), strict=True))].append(k)
        else:
            status[k] = "failed"
    for pattern, steps in groups.items():
        at = torch.tensor(steps)
        part = _solve_pattern(program, settings, pattern, data.take(at), scale[at])
        touching = torch.tensor([c for c, (mode, _) in enumerate(pattern) if mode != FREE], dtype=torch.long)
        forces = forces.index_put((at[:, None], touching[None, :]), part.forces)
        cone[np.ix_(steps, touching.tolist())] = part.cone
        status[steps] = part.status
        if balance is not None:
            balance[steps] = part.balance
    residual = kkt_residual(program, forces.detach().numpy(), balance, cone)
    none = np.isin(status, ("failed", "infeasible"))
    status[~none & (residual > settings.residual)] = "inaccurate"
    status[~none & ~(residual <= INACCURATE)] = "failed"
    doubtful = [k for k in np.flatnonzero(status == "failed").tolist() if data.finite(k)]
    if doubtful:  # the layer does not always pass on what the solver said
        status[np.array(doubtful)[imbalance(take(program, doubtful), hard=False) > BALANCED]] = "infeasible"
    none = np.isin(status, ("failed", "infeasible"))
    residual[none] = np.inf
    cone[none] = 0.0
    if balance is not None:
        balance[none] = 0.0
    forces = torch.where(torch.from_numpy(none)[:, None, None], 0.0, forces)
    return Solution(forces if as_torch else forces.detach().numpy(), balance, cone, residual, tuple(status.tolist()))


def _double(value: Any) -> Tensor | None:
    if value is None:
        return None
    return value.double() if is_torch_array(value) else torch.from_numpy(np.array(value, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class _Data:
    """The arrays of a program as tensors."""

    desired: Tensor
    mu: Tensor
    weights: Tensor
    eo_jacobian: Tensor | None
    eo_load: Tensor | None
    go_jacobian: Tensor | None
    go_load: Tensor | None

    def take(self, at: Tensor) -> _Data:
        return replace(self, **{name: value[at] for name, value in vars(self).items() if value is not None})

    def finite(self, k: int) -> bool:
        return all(bool(value[k].isfinite().all()) for value in vars(self).values() if value is not None)


@dataclass(frozen=True, eq=False)
class _Part:
    """What steps of one pattern got: forces (B, C', 2) and cone (B, C', 3) of the contacts that touch."""

    forces: Tensor
    balance: np.ndarray
    cone: np.ndarray
    status: list[str]


def _solve_pattern(
    program: ContactProgram, settings: Settings, pattern: tuple[tuple[int, bool], ...], data: _Data, scale: Tensor
) -> _Part:
    # With f' = √U f / scale the objective is a plain distance and the cone one of slope µ' = µ √(U_t / U_n). The
    # solution is homogeneous in f_des and loads and does not change with a common scale of the weights, so both scales
    # may be constants.
    on = [c for c, (mode, _) in enumerate(pattern) if mode != FREE]
    B, C = len(scale), len(on)
    rows = tuple((mode, flat, not program.relaxed[c]) for c, (mode, flat) in enumerate(pattern) if mode != FREE)
    layer = _layer(rows, data.eo_load is not None, data.go_load is not None, settings)
    weights, size = data.weights[:, on], scale[:, None, None]
    common = weights.detach().amax(dim=(1, 2), keepdim=True) if C else torch.ones_like(size)
    root = (weights / common).sqrt()
    slope = data.mu[:, on] * root[..., 1] / root[..., 0]
    length = (1 + slope**2).sqrt()
    parameters = [(root * data.desired[:, on] / size).flatten(1)] if C else []
    parameters += [slope / length, 1 / length] if any(mode != STICK or hard for mode, _, hard in rows) else []
    divisor = torch.tensor([1.0, 1.0, program.length], dtype=torch.float64)
    row_size = torch.ones((B, 3), dtype=torch.float64)
    if data.eo_jacobian is not None and data.eo_load is not None:
        A = (data.eo_jacobian[:, on] / root[..., None]).flatten(1, 2).mT / divisor[:, None]
        row_size = A.detach().norm(dim=2) if C else row_size
        row_size = torch.where(row_size > 1e-6, row_size, 1.0)
        parameters += [A / row_size[..., None]] if C else []
        parameters += [data.eo_load / divisor / scale[:, None] / row_size]
    if data.go_jacobian is not None and data.go_load is not None and C:
        heavy = (torch.as_tensor(program.slack_weights).double() / common[:, 0]).sqrt()
        J = (data.go_jacobian[:, on] / root[..., None]).flatten(1, 2).mT * heavy[..., None]
        parameters += [J, heavy * data.go_load / scale[:, None]]
    if C == 0:
        lacks = parameters[0].abs().amax(1) if parameters else torch.zeros(B)
        status = ["solved" if value <= settings.residual else "infeasible" for value in lacks.tolist()]
        return _Part(data.desired[:, on], np.zeros((B, 3)), np.zeros((B, 0, 3)), status)
    (solved, *multipliers), status = _run(layer, tuple(parameters))

    found = iter([value.detach().numpy() for value in multipliers])
    balance = np.zeros((B, 3))
    force = (common * size)[:, 0, :].numpy()  # what a multiplier of the scaled program is worth
    if data.eo_load is not None:
        balance = -next(found) * force / (divisor * row_size).numpy()
    cone = np.zeros((B, C, 3))
    edge = (root[..., 1] / length).detach().numpy()
    for c, (mode, flat, hard) in enumerate(rows):
        if mode == STICK and hard:
            cone[:, c, 0], cone[:, c, 1] = (next(found)[:, 0] * force[:, 0] * edge[:, c] for _ in range(2))
        elif mode != STICK:
            cone[:, c, 1] = -next(found)[:, 0] * force[:, 0] * edge[:, c]
        if hard and (flat or mode != STICK):
            cone[:, c, 2] = next(found)[:, 0] * force[:, 0] * root[:, c, 0].detach().numpy()
    return _Part(solved.unflatten(1, (C, 2)) * size / root, balance, cone, status)


def _run(layer: Any, parameters: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], list[str]]:
    """Solve a batch; where the solver refuses, solve its steps one by one to find out which."""
    from diffcp import SolverError

    count, word = len(parameters[0]), "failed"
    try:
        out = layer(*parameters)
        bad = ~torch.stack([value.detach().isfinite().reshape(count, -1).all(1) for value in out]).all(0)
        if not bad.any():
            return out, ["solved"] * count
    except (SolverError, RuntimeError) as refusal:
        word = "infeasible" if "infeasible" in str(refusal).lower() else "failed"
    if count == 1:
        return tuple(parameters[0].new_zeros((1, variable)) for variable in layer.sizes), [word]
    parts = [_run(layer, tuple(value[k : k + 1] for value in parameters)) for k in range(count)]
    return tuple(torch.cat(values) for values in zip(*(out for out, _ in parts), strict=True)), [
        word for _, words in parts for word in words
    ]


class _Layer:
    """A compiled program. Calls return the forces (B, 2C), then each constraint's multipliers (B, rows)."""

    def __init__(self, problem: Any, parameters: list[Any], variables: list[Any], settings: Settings):
        from cvxpylayers.torch.cvxpylayer import CvxpyLayer

        self.sizes, self._settings = [int(variable.size) for variable in variables], settings
        self._layer = CvxpyLayer(problem, parameters, variables, solver_args=settings.solver)

    def __call__(self, *parameters: Tensor) -> tuple[Tensor, ...]:
        needs = tuple(torch.is_grad_enabled() and value.requires_grad for value in parameters)
        solved: Any = _Solve.apply(self._layer, self._settings.derivative if any(needs) else {}, needs, *parameters)
        return tuple(value.reshape(len(value), -1) for value in solved)


class _Solve(torch.autograd.Function):
    """A layer with its own graph inside, so that what it warns of stays inside in both directions."""

    @staticmethod
    def forward(ctx: Any, layer: Any, options: dict[str, Any], needs: tuple[bool, ...], *values: Tensor):
        with torch.enable_grad(), _quiet():
            ctx.inputs = [value.detach().requires_grad_(need) for value, need in zip(values, needs, strict=True)]
            ctx.outputs = tuple(layer(*ctx.inputs, solver_args=options))
        return tuple(value.detach() for value in ctx.outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        wanted = [value for value in ctx.inputs if value.requires_grad]
        with _quiet():
            found = iter(torch.autograd.grad(ctx.outputs, wanted, gradients, retain_graph=True))
        return (None, None, None, *(next(found) if value.requires_grad else None for value in ctx.inputs))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep two warnings of the libraries from the user: an inaccurate solve, which the residual tells per step, and
    the layer's way of reading tensors into numpy."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solved/Inaccurate")
        warnings.filterwarnings("ignore", message="__array__ implementation", category=DeprecationWarning)
        yield


@lru_cache(maxsize=512)
def _layer(rows: tuple[tuple[int, bool, bool], ...], balanced: bool, slack: bool, settings: Settings) -> _Layer | None:
    """Compile the program of contacts with (mode, without friction, hard)."""
    import cvxpy as cp

    C = len(rows)
    if C == 0:
        return None
    f = cp.Variable(2 * C)
    target, sine, cosine = cp.Parameter(2 * C), cp.Parameter(C, nonneg=True), cp.Parameter(C, nonneg=True)
    parameters, constraints = [target], []
    parameters += [sine, cosine] if any(mode != STICK or hard for mode, _, hard in rows) else []
    cost = cp.sum_squares(f - target)
    if balanced:
        A, b = cp.Parameter((3, 2 * C)), cp.Parameter(3)
        parameters += [A, b]
        constraints.append(A @ f + b == 0)
    if slack:
        J, s = cp.Parameter((3, 2 * C)), cp.Parameter(3)
        parameters += [J, s]
        cost += cp.sum_squares(J @ f + s)
    for c, (mode, flat, hard) in enumerate(rows):
        normal, across = sine[c] * f[2 * c], cosine[c] * f[2 * c + 1]
        if mode == STICK and hard:
            constraints += [normal - across >= 0, normal + across >= 0]
        elif mode != STICK:
            constraints.append(across - mode * normal == 0)
        if hard and (flat or mode != STICK):
            constraints.append(f[2 * c] >= 0)
    program = cp.Problem(cp.Minimize(0.5 * cost), constraints)
    return _Layer(program, parameters, [f, *(row.dual_variables[0] for row in constraints)], settings)
