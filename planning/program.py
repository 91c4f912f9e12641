"""One batch of contact programs: what the backends solve, step by step.

Extrinsic Contact Model, (P1) and (P2), with the modes given. Per step, over the forces f = (f_n, f_t) of all contacts,

    min  ½ Σ (f − f_des)ᵀ U (f − f_des) + ½ sᵀ W s
    s.t. eo_load + Σ J_eoᵀ f = 0                                   the extrinsic object's balance (P1)
         s = go_load + Σ J_goᵀ f                                   what the grasped object's balance lacks (paper form)
         stick:  µ f_n − f_t ≥ 0,  µ f_n + f_t ≥ 0   (µ = 0: also f_n ≥ 0)
         slip±:  f_t = ±µ f_n,  f_n ≥ 0
         free:   f = 0

with U diagonal and positive and W = diag(slack_weights). Moments are about the origin of the body's frame, axes of W;
a Jacobian carries its sign: in P1 the object contact acts on the eo with +f and on the go with −f. Signs of f_n, f_t
and of the modes as in `mechanics.friction`. A *relaxed* contact has no inequalities, as the paper does with the
contact of the two objects; where it slips, f_t = ±µ f_n stays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from array_api_compat import is_torch_array
from numpy.typing import NDArray

from mechanics._shapes import Array
from mechanics.friction import Mode

STICK, SLIP_PLUS, SLIP_MINUS, FREE = 0, 1, -1, 2
"""Modes as int8; where a contact slips, the code is the sign of f_t."""

_CODES = {Mode.STICK: STICK, Mode.SLIP_POSITIVE: SLIP_PLUS, Mode.SLIP_NEGATIVE: SLIP_MINUS, Mode.FREE: FREE}
_MODES = {code: mode for mode, code in _CODES.items()}

ABSENT, INEQUALITY, EQUALITY = 0, 1, 2
"""What a row of `rows` is."""

ROUNDING = 64 * float(np.finfo(np.float64).eps)
"""Of a sum of terms, the part that may be rounding."""


def codes(modes: Iterable) -> NDArray[np.int8]:
    """Return modes, nested in any way, as int8 codes. Raises ValueError for what is no mode."""
    given = np.array(modes, dtype=object)
    return np.array([_CODES[Mode(mode)] for mode in given.ravel()], dtype=np.int8).reshape(given.shape)


def mode_of(code: int) -> Mode:
    """Return the mode of a code. Raises ValueError for what is no code."""
    if int(code) not in _MODES:
        raise ValueError(f"mode_of: expected a code in {sorted(_MODES)}, received {code}")
    return _MODES[int(code)]


@dataclass(frozen=True, eq=False)
class ContactProgram:
    """K programs with C contacts each; arrays are numpy float64, or torch double where one wants gradients.

    ``names`` (C) and ``relaxed`` (C) hold for all steps, ``modes`` (K, C) are int8 codes. ``desired`` (K, C, 2) f_des
    [N]; ``mu`` (K, C); ``weights`` (K, C, 2) the diagonal of U, positive. P1 has ``eo_jacobian`` (K, C, 2, 3) and
    ``eo_load`` (K, 3) [N, N, N·m], the paper form ``go_jacobian``, ``go_load`` and ``slack_weights`` (3,), positive.
    ``length`` [m] divides moments before they are compared with forces. Raises ValueError naming the field.
    """

    names: tuple[str, ...]
    modes: NDArray[np.int8]
    desired: Array
    mu: Array
    weights: Array
    relaxed: tuple[bool, ...]
    eo_jacobian: Array | None = None
    eo_load: Array | None = None
    go_jacobian: Array | None = None
    go_load: Array | None = None
    slack_weights: Array | None = None
    length: float = 0.05

    def __post_init__(self) -> None:
        modes = np.asarray(self.modes, dtype=np.int8)
        object.__setattr__(self, "modes", modes)
        if modes.ndim != 2 or (modes < SLIP_MINUS).any() or (modes > FREE).any():
            raise ValueError(f"program: modes: expected codes (K, C), received {modes.tolist()}")
        K, C = modes.shape
        for name, value in (("names", self.names), ("relaxed", self.relaxed)):
            if len(value) != C:
                raise ValueError(f"program: {name}: expected {C}, one per contact, received {len(value)}")
        if (self.eo_jacobian is None) != (self.eo_load is None):
            raise ValueError("program: eo_load: expected together with eo_jacobian, or neither")
        if len({value is None for value in (self.go_jacobian, self.go_load, self.slack_weights)}) > 1:
            raise ValueError("program: go_load: expected together with go_jacobian and slack_weights, or none of them")
        shapes = {"desired": (K, C, 2), "mu": (K, C), "weights": (K, C, 2), "eo_jacobian": (K, C, 2, 3)}
        shapes |= {"eo_load": (K, 3), "go_jacobian": (K, C, 2, 3), "go_load": (K, 3), "slack_weights": (3,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not is_torch_array(value):
                value = np.asarray(value, dtype=np.float64)
                object.__setattr__(self, name, value)
            if tuple(value.shape) != shape:
                raise ValueError(f"program: {name}: expected shape {shape}, received {tuple(value.shape)}")
        for name in ("weights", "slack_weights"):
            if getattr(self, name) is not None and bool((getattr(self, name) <= 0).any()):
                raise ValueError(f"program: {name}: expected positive numbers")
        if bool((self.mu < 0).any()):
            raise ValueError("program: mu: expected numbers ≥ 0")
        if not self.length > 0:
            raise ValueError(f"program: length: expected a positive number, received {self.length}")

    @property
    def steps(self) -> int:
        """K."""
        return len(self.modes)

    @property
    def contacts(self) -> int:
        """C."""
        return self.modes.shape[1]


PER_STEP = ("modes", "desired", "mu", "weights", "eo_jacobian", "eo_load", "go_jacobian", "go_load")
"""Fields whose leading dimension is the step."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What solves a `ContactProgram`, and how well.

    ``forces`` (K, C, 2) [N]; ``balance`` (K, 3) ν of the eo's balance, None without one; ``cone`` (K, C, 3) λ of
    (µf_n − f_t ≥ 0; µf_n + f_t ≥ 0, or where it slips f_t ∓ µf_n = 0; f_n ≥ 0, used by slip and by µ = 0), so that

        U (f − f_des) + J_go W s − J_eo ν − Gᵀ λ = 0   at contacts that are not free.

    ``residual`` (K,) see `kkt_residual`. ``status`` per step: ``solved``; ``inaccurate`` (a force that misses the
    backend's promise); ``infeasible`` or ``failed``, where everything is 0. Nothing is NaN; a residual may be ∞.
    """

    forces: Array
    balance: Array | None
    cone: Array
    residual: NDArray[np.float64]
    status: tuple[str, ...]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(K,) whether a step has forces: ``solved`` or ``inaccurate``."""
        return np.array([word in ("solved", "inaccurate") for word in self.status], dtype=bool)


Backend: TypeAlias = Callable[[ContactProgram], Solution]
"""Something that solves a `ContactProgram`."""


def take(program: ContactProgram, steps: Iterable[int] | slice) -> ContactProgram:
    """Return the program of some ``steps`` only."""
    index = steps if isinstance(steps, slice) else np.array(list(steps), dtype=np.intp)
    given = {name: getattr(program, name) for name in PER_STEP}
    return replace(program, **{name: value[index] for name, value in given.items() if value is not None})


def as_numpy(program: ContactProgram) -> ContactProgram:
    """Return the program with every array in numpy, apart from any gradient."""
    given = {field.name: getattr(program, field.name) for field in fields(program)}
    return replace(program, **{n: v.detach().cpu().numpy() for n, v in given.items() if is_torch_array(v)})


def rows(program: ContactProgram) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Return the modes' rows G (K, C, 3, 2), in the order of `Solution.cone`, and what each is (K, C, 3)."""
    mu = np.asarray(as_numpy(program).mu)
    stick, slips = program.modes == STICK, np.abs(program.modes) == 1
    soft = np.array(program.relaxed, dtype=bool)[None, :]
    one, zero = np.ones_like(mu), np.zeros_like(mu)
    G = np.stack(
        [
            np.stack([mu, -one], axis=-1),
            np.stack([np.where(stick, mu, -program.modes * mu), one], axis=-1),
            np.stack([one, zero], axis=-1),
        ],
        axis=-2,
    )
    kind = np.zeros((*mu.shape, 3), dtype=np.int8)
    kind[..., 0] = kind[..., 1] = np.where(stick & ~soft, INEQUALITY, ABSENT)
    kind[..., 1][slips] = EQUALITY
    kind[..., 2] = np.where((slips | (stick & (mu == 0))) & ~soft, INEQUALITY, ABSENT)
    return G * (kind != ABSENT)[..., None], kind


def force_scale(program: ContactProgram, forces: Array | None = None) -> NDArray[np.float64]:
    """Return (K,) the largest force of each step among f_des, the loads (moments by ``length``) and ``forces``."""
    given = as_numpy(program)
    divisor = np.array([1.0, 1.0, program.length])
    sizes = [np.abs(given.desired).reshape(program.steps, -1)]
    sizes += [np.abs(load / divisor) for load in (given.eo_load, given.go_load) if load is not None]
    if forces is not None:
        sizes.append(np.abs(np.asarray(forces)).reshape(program.steps, -1))
    scale = np.concatenate([np.zeros((program.steps, 1)), *sizes], axis=1).max(axis=1)
    return np.where(scale > 0, scale, 1.0)


def kkt_residual(program: ContactProgram, forces: Array, balance: Array | None, cone: Array) -> NDArray[np.float64]:
    """Return (K,) by how much forces and multipliers miss the optimality conditions, relative to `force_scale`.

    Everything is brought to newtons, so that neither the weights' unit nor their spread matters: what the balance and
    the equalities lack; for an inequality min(gap, the force that its multiplier causes), which is 0 where one of them
    is 0 and none negative; and the force that would make up for what stationarity lacks, H⁻¹ r with
    H = U + J_go W J_goᵀ and r beyond what the rounding of its terms explains.
    """
    p, K, n = as_numpy(program), program.steps, 2 * program.contacts
    f, lam = (np.asarray(v, dtype=np.float64) for v in (forces, cone))
    G, kind = rows(p)
    norm = np.linalg.norm(G, axis=-1)
    norm = np.where(norm > 0, norm, 1.0)
    free = np.repeat(p.modes == FREE, 2, axis=1)

    weights = np.where(free, 1.0, np.asarray(p.weights).reshape(K, n))
    asked, cones = weights * (f - p.desired).reshape(K, n), (G * lam[..., None]).sum(axis=2).reshape(K, n)
    gradient, terms = asked - cones, np.abs(asked) + (np.abs(G) * np.abs(lam)[..., None]).sum(axis=2).reshape(K, n)
    root = np.sqrt(weights)[:, :, None] * np.eye(n)
    misses = [np.abs(np.where(free, f.reshape(K, n), 0.0))]
    if p.go_jacobian is not None and p.go_load is not None and p.slack_weights is not None:
        J = p.go_jacobian.reshape(K, n, 3)
        slack = p.go_load + np.einsum("kni,kn->ki", J, f.reshape(K, n))
        gradient += np.einsum("kni,ki->kn", J, p.slack_weights * slack)
        terms += np.einsum("kni,ki->kn", np.abs(J), p.slack_weights * np.abs(slack))
        soft = np.where(free[:, None, :], 0.0, np.sqrt(p.slack_weights)[:, None] * J.transpose(0, 2, 1))
        root = np.array(np.linalg.qr(np.concatenate([root, soft], axis=1), mode="r"))
    if p.eo_jacobian is not None and p.eo_load is not None and balance is not None:
        J = p.eo_jacobian.reshape(K, n, 3)
        lacks = p.eo_load + np.einsum("kni,kn->ki", J, f.reshape(K, n))
        misses.append(np.abs(lacks / [1.0, 1.0, p.length]))
        gradient -= np.einsum("kni,ki->kn", J, np.asarray(balance))
        terms += np.einsum("kni,ki->kn", np.abs(J), np.abs(np.asarray(balance)))

    def moved(pull: NDArray[np.float64]) -> NDArray[np.float64]:
        """H⁻¹ ``pull`` (K, n, m)."""
        return np.asarray(np.linalg.solve(root, np.linalg.solve(root.transpose(0, 2, 1), pull)), dtype=np.float64)

    spread = np.zeros((K, n, 3 * program.contacts))
    for c in range(program.contacts):
        spread[:, 2 * c : 2 * c + 2, 3 * c : 3 * c + 3] = G[:, c].transpose(0, 2, 1)
    beyond = np.maximum(np.abs(gradient) - ROUNDING * terms, 0.0) * np.sign(gradient)
    gradient = np.where(free, 0.0, beyond)
    shift = moved(np.concatenate([spread, gradient[:, :, None]], axis=2))
    gap = (G * f[:, :, None, :]).sum(axis=-1) / norm
    pushed = lam * np.abs(shift[:, :, :-1]).max(axis=1, initial=0.0).reshape(K, -1, 3)
    nearer = np.abs(np.minimum(gap, pushed))
    misses += [np.where(kind == INEQUALITY, nearer, np.where(kind == EQUALITY, np.abs(gap), 0.0)).reshape(K, -1)]
    misses += [np.abs(shift[:, :, -1])]
    worst = np.concatenate([np.zeros((K, 1)), *misses], axis=1).max(axis=1) / force_scale(p, f)
    return np.array(np.where(np.isfinite(worst), worst, np.inf), dtype=np.float64)
