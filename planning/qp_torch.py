"""Contact programs in torch: a batched active set, all steps of all modes at once, with the implicit gradient.

The forces come from `planning.qp_active_set`. The gradient is the one of the equations that hold with the active set
fixed, and uses the same factors; at a tie it is that of the chosen side. A step without a solution is told apart by how
near its cones come to balance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from array_api_compat import is_torch_array
from torch import Tensor

from planning.program import FREE, STICK, ContactProgram, Solution, kkt_residual
from planning.qp_active_set import (
    APEX,
    INSIDE,
    MINUS,
    PLUS,
    Steps,
    distance_from_balance,
    multipliers,
    penalty,
    reduced,
    search,
    worth_of,
)

SOLVED, USABLE = 1e-9, 1e-6
"""Largest `kkt_residual` of a step that is ``solved``, and of one that is at least ``inaccurate``."""
LACKS = 1e-7
"""Relative distance from balance beyond which a step is ``infeasible``."""

_DIFFERENTIABLE = ("desired", "mu", "weights", "eo_jacobian", "eo_load", "go_jacobian", "go_load")


def solve(program: ContactProgram, warm: Solution | None = None) -> Solution:
    """Solve every step; forces are torch, and differentiable, where a field of ``program`` is torch.

    ``warm`` is a solution of a program near by, whose active set is tried first. Multipliers carry no gradient. An
    accepted step is exact up to rounding: ``solved`` at a residual ≤ 1e-9, ``inaccurate`` up to 1e-6.
    """
    given = [getattr(program, name) for name in _DIFFERENTIABLE]
    as_torch = any(is_torch_array(value) for value in given)
    tensors = [None if value is None else _double(value) for value in given]
    found: list[tuple[Tensor | None, Tensor, np.ndarray, tuple[str, ...]]] = []
    forces = _Solve.apply(program, warm, found, *tensors)
    balance, cone, residual, status = found[0]
    if as_torch:
        return Solution(forces, balance, cone, residual, status)
    return Solution(forces.numpy(), None if balance is None else balance.numpy(), cone.numpy(), residual, status)


def _double(value: Any) -> Tensor:
    return value.double() if is_torch_array(value) else torch.from_numpy(np.array(value, dtype=np.float64))


def _data(program: ContactProgram, tensors: list[Tensor | None]) -> tuple[Steps, Tensor]:
    """Return the steps in newtons, and which of them (K) are made of finite numbers; the others are made harmless."""
    desired, mu, weights, eo_jacobian, eo_load, go_jacobian, go_load = tensors
    assert desired is not None and mu is not None and weights is not None
    K, C = program.modes.shape
    finite = torch.ones(K, dtype=torch.bool)
    for value in tensors:
        finite &= True if value is None else value.isfinite().flatten(1).all(1)
    if not finite.all():
        bad = ~finite
        desired, mu, weights, eo_jacobian, eo_load, go_jacobian, go_load = (
            None if value is None else value.masked_fill(bad.reshape(-1, *[1] * (value.ndim - 1)), fill)
            for value, fill in zip(tensors, (0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0), strict=True)
        )
    assert desired is not None and mu is not None and weights is not None
    rows_of = desired.new_zeros((K, 0, 2 * C)), desired.new_zeros((K, 0))
    divisor = torch.tensor([1.0, 1.0, program.length], dtype=torch.float64)
    A, b = rows_of
    if eo_jacobian is not None and eo_load is not None:
        A, b = eo_jacobian.flatten(1, 2).mT / divisor[:, None], eo_load / divisor
    (J, c), W, worth = rows_of, desired.new_zeros((K, 0, 0)), None
    if go_jacobian is not None and go_load is not None:
        root = torch.as_tensor(program.slack_weights).double().sqrt()
        heavy = go_jacobian.flatten(1, 2).mT * root[:, None]
        (J, c, W), worth = penalty(heavy, go_load * root), worth_of(mu, weights, heavy)
    scale = torch.cat([desired.flatten(1), b, torch.zeros_like(desired[:, 0, :1])], 1).abs().amax(1)
    if go_load is not None:
        scale = torch.maximum(scale, (go_load / divisor).abs().amax(1))
    hard = torch.tensor(program.relaxed).logical_not().expand(K, C)
    data = Steps(
        modes=torch.from_numpy(program.modes.astype(np.int64)),
        hard=hard,
        mu=mu,
        U=weights.flatten(1),
        desired=desired.flatten(1),
        A=A,
        b=b,
        J=J,
        c=c,
        W=W,
        scale=torch.where(scale > 0, scale, 1.0),
        worth=worth_of(mu, weights, J) if worth is None else worth,
    )
    return data, finite


def _warm(data: Steps, warm: Solution | None) -> Tensor:
    """Return the states (K, C) of a solution near by, where its shape and modes allow that."""
    if warm is None or tuple(warm.cone.shape) != (*data.modes.shape, 3):
        return data.loosest
    active = torch.as_tensor(warm.cone).detach() > 0
    plus, minus, end = active.unbind(2)
    stick = (data.modes == STICK) & ~data.one_way
    edges = torch.where(plus & minus, APEX, torch.where(plus, PLUS, torch.where(minus, MINUS, INSIDE)))
    states = torch.where(stick, edges, torch.where(end & (data.modes != FREE), APEX, data.loosest))
    return torch.where(data.hard, states, data.loosest)


class _Solve(torch.autograd.Function):
    """Forces (K, C, 2) of a program; multipliers and how it went are appended to ``found``."""

    @staticmethod
    def forward(ctx: Any, program: ContactProgram, warm: Solution | None, found: list, *tensors: Tensor | None):
        data, finite = _data(program, [None if value is None else value.detach() for value in tensors])
        point = search(data, _warm(data, warm))
        C = program.contacts
        divisor = torch.tensor([1.0, 1.0, program.length], dtype=torch.float64)
        forces, cone = point.f.unflatten(1, (C, 2)), point.cone
        balance = point.nu / divisor if data.A.shape[1] else None
        residual = kkt_residual(program, forces.numpy(), None if balance is None else balance.numpy(), cone.numpy())
        residual[~finite.numpy()] = np.inf
        status = np.where(residual <= SOLVED, "solved", np.where(residual <= USABLE, "inaccurate", "failed"))
        bad = torch.from_numpy(~(residual <= USABLE))
        doubtful = torch.nonzero(bad & finite)[:, 0]
        if len(doubtful) and data.A.shape[1]:
            far = distance_from_balance(data.take(doubtful)) > LACKS
            status[doubtful[far].numpy()] = "infeasible"
        forces, cone = (value.masked_fill(bad[:, None, None], 0.0) for value in (forces, cone))
        balance = None if balance is None else balance.masked_fill(bad[:, None], 0.0)
        found.append((balance, cone, residual, tuple(status.tolist())))
        ctx.data, ctx.states, ctx.good = data, point.states, ~bad
        ctx.forces, ctx.nu, ctx.cone, ctx.divisor = forces, point.nu, cone, divisor
        ctx.basis = ctx.slack = None
        if data.J.shape[1]:
            jacobian, load = tensors[-2:]
            assert jacobian is not None and load is not None
            weights = torch.as_tensor(program.slack_weights).double()
            ctx.slack = weights, jacobian.detach().flatten(1, 2), load.detach()
        return forces

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """The adjoint of H df − Aᵀ dν − Gᵀ dλ = …, A df = …, G df = … with the active rows G as they are."""
        data, f, cone = ctx.data, ctx.forces, ctx.cone
        g = torch.where(ctx.good[:, None, None], gradients[0], 0.0).flatten(1)
        ctx.basis = basis = ctx.basis or reduced(data, ctx.states)  # quadratic models come back once per residual
        wanted = basis.reduce(g[:, None])
        free = basis.project(wanted)
        x, z = basis.least(free, free.new_zeros((len(g), 1, data.J.shape[1])), torch.zeros_like(free))
        eta = -((x - wanted + z @ basis.B) @ basis.Q.mT) @ basis.L
        d = basis.expand(x)[:, 0]
        pull = g - data.U * d - (z @ data.J)[:, 0] - (eta @ data.A)[:, 0]
        kappa = multipliers(data, ctx.states, pull.unflatten(1, (-1, 2)))

        pairs = d.unflatten(1, (-1, 2))
        through = pairs[..., :1] * cone - kappa * f[..., :1]  # what the rows' slope µ does
        stick = (data.modes == STICK) & ~data.one_way
        flat = torch.sign(cone[..., 1] - cone[..., 0]) * _tangential(data, ctx.states, pull)
        flat = pairs[..., 0] * (cone[..., 0] + cone[..., 1]) - flat * f[..., 0]
        mu = torch.where(stick, through[..., 0] + through[..., 1], -data.modes * through[..., 1])
        mu = torch.where(data.one_way, flat, torch.where(data.modes == FREE, 0.0, mu))
        weights = -pairs * (f - data.desired.unflatten(1, (-1, 2)))
        desired = (data.U * d).unflatten(1, (-1, 2))
        eo_jacobian = eo_load = go_jacobian = go_load = None
        if data.A.shape[1]:
            nu, eta = ctx.nu / ctx.divisor, eta[:, 0] / ctx.divisor
            eo_jacobian = pairs[..., None] * nu[:, None, None] - f[..., None] * eta[:, None, None]
            eo_load = -eta
        if data.J.shape[1]:
            W, J, load = ctx.slack
            y = W * (load + (f.flatten(1)[:, None] @ J)[:, 0])
            z = W * (d[:, None] @ J)[:, 0]
            go_jacobian = -(pairs[..., None] * y[:, None, None] + f[..., None] * z[:, None, None])
            go_load = -z
        good = ctx.good
        made = (desired, mu, weights, eo_jacobian, eo_load, go_jacobian, go_load)
        return (
            None,
            None,
            None,
            *(None if v is None else torch.where(good.reshape(-1, *[1] * (v.ndim - 1)), v, 0.0) for v in made),
        )


def _tangential(data: Steps, states: Tensor, pull: Tensor) -> Tensor:
    """Return the multiplier (B, C) of f_t = 0 where a contact without friction sticks."""
    return torch.where(states == PLUS, pull.unflatten(1, (-1, 2))[..., 1], 0.0)
