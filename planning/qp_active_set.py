"""The batched active set: contact programs solved by deciding which inequalities hold with equality.

Each contact is in one of four states: inside its cone, on one of its edges, or at the apex. With the states given, the
forces are f = T a, T orthonormal, and a solves a least-squares problem under the three rows of balance. Those rows are
orthonormalised one by one, the largest first, and one that adds nothing is left out: coincident contacts, redundant
rows and more equalities than unknowns are cases like any other. The penalty of the paper form is three rows with a
compliance, a system of 3×3, so that U stays exact beside weights a million times larger.

States are found by the primal–dual active-set iteration: a row becomes active where its force or its multiplier has the
wrong sign. Steps that this does not settle get every combination of states. A step is accepted on its optimality
conditions alone.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from planning.program import FREE, STICK

INSIDE, PLUS, MINUS, APEX = 0, 1, -1, 2
"""States of a contact: both components are free, f_t = ±µ f_n, or none. A mode's code is its loosest state."""

ITERATIONS = 12
ACCEPT = 1e-10
"""Violation, relative to the step's forces, up to which a set of states is taken for the solution's."""
RANK = 1e-9
"""A row of balance whose remainder is below this fraction of itself adds nothing."""


@dataclass(frozen=True, eq=False)
class Steps:
    """B steps, components flattened to n = 2C: balance A f + b = 0 in newtons, and the penalty ½ eᵀ W e with
    e = J f + c, where J has orthonormal rows or rows of 0, see `penalty`. ``scale`` (B) [N] is what violations are
    compared with; ``worth`` (B, C, 3) the newtons that a multiplier of 1 causes."""

    modes: Tensor
    hard: Tensor
    mu: Tensor
    U: Tensor
    desired: Tensor
    A: Tensor
    b: Tensor
    J: Tensor
    c: Tensor
    W: Tensor
    scale: Tensor
    worth: Tensor

    def take(self, index: Tensor) -> Steps:
        """Return some of the steps."""
        return Steps(*(getattr(self, field.name)[index] for field in fields(self)))

    @property
    def one_way(self) -> Tensor:
        """(B, C) sticking without friction: f_t = 0, the edge of µ = 0."""
        return (self.modes == STICK) & (self.mu == 0) & self.hard

    @property
    def loosest(self) -> Tensor:
        """(B, C) the states with no inequality active."""
        return torch.where(self.one_way, PLUS, self.modes)


@dataclass(frozen=True, eq=False)
class Basis:
    """The reduced problem of given states, in x = √D a with f = T a and D = TᵀUT, which is diagonal.

    ``along`` (B, 1, C, 2) is the first column of each contact's T and ``both`` (B, 1, C) whether the tangent is the
    second. ``Q`` = L Â are the rows of balance made orthonormal, or 0. ``B`` are those of the penalty and ``W`` its
    stiffness, B P = Rᵀ V with P = I − QᵀQ and V orthonormal or 0; ``S`` and ``G`` the Cholesky factors of I + R W Rᵀ
    and R Rᵀ.
    """

    along: Tensor
    both: Tensor
    root: Tensor
    Q: Tensor
    L: Tensor
    B: Tensor
    W: Tensor
    V: Tensor
    R: Tensor
    S: Tensor
    G: Tensor

    def reduce(self, v: Tensor) -> Tensor:
        """D^(-½) Tᵀ v of rows ``v`` (B, m, n)."""
        pairs = v.unflatten(2, (-1, 2))
        first, second = (pairs * self.along).sum(3), pairs[..., 1] * self.both
        return torch.stack([first, second], 3).flatten(2) / self.root

    def expand(self, x: Tensor) -> Tensor:
        """T D^(-½) x of rows ``x`` (B, m, n)."""
        a = (x / self.root).unflatten(2, (-1, 2))
        second = torch.stack([torch.zeros_like(a[..., 1]), a[..., 1] * self.both], 3)
        return (a[..., :1] * self.along + second).flatten(2)

    def project(self, x: Tensor) -> Tensor:
        """P x of rows ``x`` (B, m, n), twice for the rounding."""
        x = x - (x @ self.Q.mT) @ self.Q
        return x - (x @ self.Q.mT) @ self.Q

    def least(self, target: Tensor, offset: Tensor, fixed: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (B, 1, n) = ``fixed`` + P v of least ½|x − target|² + ½ eᵀ W e, e = B x + offset, and y = W e."""
        near = fixed + self.project(target)
        if self.B.shape[1] == 0:
            return near, offset
        e = near @ self.B.mT + offset
        z = -torch.cholesky_solve(self.R @ (e @ self.W).mT, self.S)
        x = near + z.mT @ self.V
        # y such that P Bᵀ y = near − x to the last digit, which W e is not where it is a small rest of large numbers
        y = (x @ self.B.mT + offset) @ self.W
        rest = torch.cholesky_solve(-z - self.R @ y.mT, self.G)
        return x, y + rest.mT @ self.R


def reduced(data: Steps, states: Tensor) -> Basis:
    """Return the reduced problem of steps whose contacts are in ``states`` (B, C)."""
    sign = torch.where(states == PLUS, 1.0, -1.0).double()
    slope = sign * data.mu / (1 + data.mu**2).sqrt()
    inside, apex = states == INSIDE, states == APEX
    one = torch.where(inside, 1.0, 1 / (1 + data.mu**2).sqrt())
    along = torch.stack([one, torch.where(inside, 0.0, slope)], 2).masked_fill(apex[..., None], 0.0)
    weights = data.U.unflatten(1, (-1, 2))
    D = torch.stack([(weights * along**2).sum(2), torch.where(inside, weights[..., 1], 1.0)], 2)
    D[..., 0].masked_fill_(apex, 1.0)
    none = data.A.new_zeros(0)
    shape = along[:, None], inside[:, None], D.flatten(1).sqrt()[:, None]
    basis = Basis(*shape, Q=none, L=none, B=none, W=data.W, V=none, R=none, S=none, G=none)
    norm = (data.A / data.U.sqrt()[:, None]).norm(dim=2)
    Q, L = orthonormal(basis.reduce(data.A), torch.where(norm > 0, norm, 1.0))
    basis = replace(basis, Q=Q, L=L, B=basis.reduce(data.J))
    if data.J.shape[1] == 0:
        return basis
    free = basis.project(basis.B)
    size = basis.B.norm(dim=2)
    V = orthonormal(free, torch.where(size > 0, size, 1.0))[0]
    R = V @ free.mT
    S = torch.eye(3, dtype=V.dtype) + R @ data.W @ R.mT
    G = R @ R.mT + torch.diag_embed((V == 0).all(2).double())
    return replace(basis, V=V, R=R, S=torch.linalg.cholesky_ex(S).L, G=torch.linalg.cholesky_ex(G).L)


def orthonormal(A: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return Q (B, 3, n), orthonormal rows or rows of 0, and L with Q = L A, for rows of the given ``size`` (B, 3)."""
    if A.shape[1] == 0:
        return A, A.new_zeros((len(A), 0, 0))
    rest, made = A / size[..., None], torch.diag_embed(1 / size)
    rest, made = torch.cat([rest, made], 2), A.shape[2]
    picked: list[Tensor] = []
    for _ in range(3):
        largest = rest[..., :made].norm(dim=2).argmax(1)
        row = rest.gather(1, largest[:, None, None].expand(-1, 1, rest.shape[2]))
        for other in picked:
            row = row - (row[..., :made] * other[..., :made]).sum(2, keepdim=True) * other
        norm = row[..., :made].norm(dim=2, keepdim=True)
        row = torch.where(norm > RANK, row / norm, 0.0)
        picked.append(row)
        rest = rest - rest[..., :made] @ row[..., :made].mT * row
    whole = torch.cat(picked, 1)
    return whole[..., :made], whole[..., made:]


@dataclass(frozen=True, eq=False)
class Point:
    """Forces (B, n) and multipliers of given ``states``; ``worst`` (B) relative violation; ``better`` states to try."""

    states: Tensor
    f: Tensor
    nu: Tensor
    cone: Tensor
    worst: Tensor
    better: Tensor


def solve_at(data: Steps, states: Tensor) -> Point:
    """Solve with the states given."""
    basis = reduced(data, states)
    target = basis.reduce((data.U * data.desired)[:, None])
    fixed = -(data.b[:, None] @ basis.L.mT) @ basis.Q
    x, y = basis.least(target, data.c[:, None], fixed)
    nu = ((x - target + y @ basis.B) @ basis.Q.mT) @ basis.L
    f, nu, y = basis.expand(x)[:, 0], nu[:, 0], y[:, 0]
    pull = data.U * (f - data.desired) + (y[:, None] @ data.J - nu[:, None] @ data.A)[:, 0]
    cone = multipliers(data, states, pull.unflatten(1, (-1, 2)))

    fn, ft = f.unflatten(1, (-1, 2)).unbind(2)
    stick = (data.modes == STICK) & ~data.one_way
    slant = (1 + data.mu**2).sqrt()
    gaps = torch.stack([(data.mu * fn - ft) / slant, (data.mu * fn + ft) / slant, fn], 2)
    counts = torch.stack([stick, stick, ~stick & (data.modes != FREE)], 2) & data.hard[..., None]
    pushes = cone * data.worth
    wrong = torch.where(counts, torch.minimum(gaps, pushes).neg(), 0.0).flatten(1).amax(1)
    lacks = _lacks(data, f)
    worst = torch.maximum(wrong, lacks) / torch.maximum(data.scale, f.abs().amax(1))

    active = counts & (torch.where(cone != 0, pushes, -gaps) > 0)
    plus, minus, end = active.unbind(2)
    edges = torch.where(plus & minus, APEX, torch.where(plus, PLUS, torch.where(minus, MINUS, INSIDE)))
    better = torch.where(stick, edges.to(states.dtype), torch.where(end, APEX, data.loosest))
    return Point(states, f, nu, cone, worst.nan_to_num(torch.inf), better.to(states.dtype))


def _lacks(data: Steps, f: Tensor) -> Tensor:
    """Return (B) [N] the largest component of what balance lacks at forces ``f`` (B, n)."""
    lacks = data.b + (data.A @ f[..., None])[..., 0]
    return torch.cat([lacks.abs(), torch.zeros_like(f[:, :1])], 1).amax(1)


def multipliers(data: Steps, states: Tensor, pull: Tensor) -> Tensor:
    """Return λ (B, C, 3) with Gᵀ λ = ``pull`` (B, C, 2) over the rows that the states make active, else 0."""
    pn, pt = pull.unbind(2)
    stick, mu = (data.modes == STICK) & ~data.one_way, data.mu
    apex, edge = states == APEX, 1 + mu**2
    safe = torch.where(mu > 0, mu, 1.0)
    left = torch.where(apex, pn / safe - pt, 0.0) / 2 + torch.where(states == PLUS, (mu * pn - pt) / edge, 0.0)
    right = torch.where(apex, pn / safe + pt, 0.0) / 2 + torch.where(states == MINUS, (mu * pn + pt) / edge, 0.0)
    slips, flat = data.modes.abs() == 1, data.one_way
    left = torch.where(stick, left, torch.where(flat, (-pt).clamp(min=0), 0.0))
    right = torch.where(stick, right, torch.where(slips, pt, torch.where(flat, pt.clamp(min=0), 0.0)))
    end = torch.where((slips | flat) & apex, pn + data.modes * mu * pt, 0.0)
    return torch.stack([left, right, end], 2)


def search(data: Steps, states: Tensor) -> Point:
    """Return the best point found: by iteration from ``states``, else among all combinations."""
    best = solve_at(data, states)
    index, point = torch.arange(len(states)), best
    for _ in range(ITERATIONS):
        left = torch.nonzero(point.worst > ACCEPT)[:, 0]
        if len(left) == 0:
            return best
        index = index[left]
        point = solve_at(data.take(index) if len(index) < len(states) else data, point.better[left])
        best = _improved(best, index, point)
    left = torch.nonzero(best.worst > ACCEPT)[:, 0]
    if len(left):
        best = _improved(best, left, _enumerate(data.take(left)))
    return best


def _improved(best: Point, index: Tensor, point: Point) -> Point:
    """Put ``point`` in at ``index`` where it is better."""
    wins = point.worst < best.worst[index]
    at = index[wins]
    values = {f.name: getattr(best, f.name).clone() for f in fields(best)}
    for name, value in values.items():
        value[at] = getattr(point, name)[wins]
    return Point(**values)


def _enumerate(data: Steps, chunk: int = 16384) -> Point:
    """Return the best of every combination of states that the modes allow."""
    kind = torch.stack([data.modes, data.hard.to(data.modes.dtype), data.one_way.to(data.modes.dtype)], 2)
    signatures, which = torch.unique(kind.flatten(1), dim=0, return_inverse=True)
    best = solve_at(data, data.loosest)
    for number, signature in enumerate(signatures.tolist()):
        allowed = []
        for mode, hard, one_way in (signature[i : i + 3] for i in range(0, len(signature), 3)):
            more = (PLUS, MINUS, APEX) if mode == STICK and not one_way else (APEX,)
            allowed.append((PLUS if one_way else mode, *(more if hard and mode != FREE else ())))
        combinations = torch.tensor(list(itertools.product(*allowed)), dtype=data.modes.dtype)
        for members in torch.nonzero(which == number)[:, 0].split(max(1, chunk // len(combinations))):
            every = data.take(members.repeat_interleave(len(combinations)))
            point = solve_at(every, combinations.repeat(len(members), 1))
            winner = point.worst.unflatten(0, (len(members), -1)).argmin(1)
            winner += torch.arange(len(members)) * len(combinations)
            best = _improved(best, members, Point(*(getattr(point, f.name)[winner] for f in fields(point))))
    return best


def penalty(J: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return V, d, W with ½|J f + c|² = ½ (V f + d)ᵀ W (V f + d) + constant and orthonormal rows V, or rows of 0.

    What of c the forces cannot reach is the constant: left in, and weighted a million times more than U, its rounding
    would outweigh what is asked for. ``J`` (K, 3, n) and ``c`` (K, 3).
    """
    size = J.norm(dim=2)
    V = orthonormal(J, torch.where(size > 0, size, 1.0))[0]
    R = V @ J.mT
    W = R @ R.mT
    padded = W + torch.diag_embed((V == 0).all(2).double())
    return V, torch.linalg.solve_ex(padded, R @ c[..., None]).result[..., 0], W


def worth_of(mu: Tensor, weights: Tensor, J: Tensor) -> Tensor:
    """Return (K, C, 3) the largest component of H⁻¹ g, H = U + JᵀJ: the force that a row's unit multiplier causes."""
    K, C = mu.shape
    one, zero = torch.ones_like(mu), torch.zeros_like(mu)
    G = torch.stack([mu, -one, mu, one, one, zero], 2).unflatten(2, (3, 2))
    if J.shape[1] == 0:
        return (G / weights[:, :, None]).abs().amax(3)
    spread = torch.diag_embed(G.permute(2, 3, 0, 1)).permute(2, 3, 0, 4, 1).reshape(K, 3 * C, 2 * C)
    factor = torch.linalg.qr(torch.cat([torch.diag_embed(weights.flatten(1).sqrt()), J], 1), mode="r").R
    half = torch.linalg.solve_triangular(factor.mT, spread.mT, upper=False)
    return torch.linalg.solve_triangular(factor, half, upper=True).abs().amax(1).unflatten(1, (C, 3))


def distance_from_balance(data: Steps) -> Tensor:
    """Return (B) how far from balance [N] the forces stay that come nearest to it, relative to the step's scale."""
    nothing, heavy = (data.A[:, :0], data.b[:, :0]), 1e5  # against U = 1: what is asked for has no say
    J, c, W = penalty(data.A * heavy, data.b * heavy)
    worth = worth_of(data.mu, torch.ones_like(data.U).unflatten(1, (-1, 2)), data.A * heavy)
    soft = replace(data, U=torch.ones_like(data.U), A=nothing[0], b=nothing[1], J=J, c=c, W=W, worth=worth)
    return _lacks(data, search(soft, soft.loosest).f) / data.scale
