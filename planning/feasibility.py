"""Can the forces be had at all, what is missing where not, and by how much do the cones hold: by linear programs.

With all cones hard a step of `ContactProgram` is feasible where forces in them balance the extrinsic object. What is
sought where they do not is the least friction coefficient of a *pair* of bodies that would do. Contacts belong to one
pair when the first words of their names agree: "ground left", "ground right". Forces are divided by the step's largest
and moments by the program's ``length``, so that one tolerance fits all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.friction import required_friction
from mechanics.readings import Array
from planning.errors import InfeasiblePlan
from planning.program import FREE, STICK, ContactProgram, as_numpy, force_scale, take

BALANCED = 1e-6
"""What balance may lack, relative to the step's force scale."""
MOST = 10.0
"""No pair of bodies has a greater friction coefficient."""


@dataclass(frozen=True)
class InfeasibleStep:
    """What step ``step`` lacks: at ``contact`` µ ≥ ``needs`` where it ``has`` less; ``needs`` is ∞ where no µ is enough
    and ``reason`` says why. With another pair short of friction too, ``reason`` names it."""

    step: int
    contact: str
    needs: float
    has: float
    reason: str | None = None

    def error(self) -> InfeasiblePlan:
        """The same as an exception."""
        return InfeasiblePlan(self.step, self.contact, self.needs, self.has, reason=self.reason)


@dataclass(frozen=True, eq=False)
class Robustness:
    """By how much cones hold under each of ``sizes`` (S,) [N] of a disturbance.

    ``forces`` (S, K, C, 2) [N]; ``margin`` (S, K, C) [N] the distance to the edge of the cone, negative outside, where
    a contact slips its f_n, ∞ where it is free; ``needs`` (S, K, C) the µ that would do, beside ``has`` (K, C).
    """

    names: tuple[str, ...]
    sizes: Array
    forces: Array
    margin: Array
    needs: Array
    has: Array

    @property
    def holds(self) -> bool:
        """Whether no cone is left."""
        return bool((self.margin >= -BALANCED).all())

    @property
    def worst(self) -> tuple[int, int, int]:
        """(s, k, c) of the least margin."""
        s, k, c = np.unravel_index(int(self.margin.argmin()), self.margin.shape)
        return int(s), int(k), int(c)


def check(program: ContactProgram, hard: bool = True, held: NDArray[np.bool_] | None = None) -> None:
    """Raise InfeasiblePlan at the first step that `explain` has something to say about.

    With ``hard`` False the relaxed contacts stay relaxed.
    """
    given = as_numpy(program)
    if given.eo_jacobian is None:
        lacking = [k for k in range(given.steps) if explain(given, k, hard, held) is not None]
    else:
        lacking = np.flatnonzero(_lacks(given, given.mu, hard, held)[0] > BALANCED).tolist()
    for k in lacking:
        found = explain(given, k, hard, held)
        if found is not None:
            raise found.error()


def explain(
    program: ContactProgram, k: int, hard: bool = True, held: NDArray[np.bool_] | None = None
) -> InfeasibleStep | None:
    """Return what step ``k`` lacks; None where it lacks nothing.

    ``held`` (C, 2) says which components of f_des are demanded. By default none is, in P1: whatever balances will do.
    P2 has no balance that could fail, so there the wish is what is judged.
    """
    step = take(as_numpy(program), [k])
    if step.eo_jacobian is None:
        return _wish(step, k)

    def lacks(mu: Array) -> float:
        return float(_lacks(step, mu[None], hard, held)[0][0])

    mu = step.mu[0]
    if lacks(mu) <= BALANCED:
        return None
    pairs = np.array([name.split()[0] for name in step.names])
    touching = step.modes[0] != FREE
    options: list[tuple[float, float, str]] = []
    for pair in dict.fromkeys(pairs[touching].tolist()):
        ours, has = (pairs == pair) & touching, float(mu[(pairs == pair) & touching].max())
        slips = bool((step.modes[0][ours] != STICK).any())
        needs = _least(lambda value, ours=ours: lacks(np.where(ours, value, mu)), has, slips)
        if needs is not None:
            options.append((needs / max(has, 1e-9), needs, pair))
    if options:
        _, needs, pair = min(options)
        ours = (pairs == pair) & touching
        c = _tightest(step, np.where(ours, needs, mu), ours, hard, held)
        return InfeasibleStep(k, step.names[c], needs, float(mu[c]))
    together = _least(
        lambda factor: lacks(np.minimum(mu * factor, MOST)), 1.0, bool((np.abs(step.modes[0]) == 1).any())
    )
    if together is not None:
        return _both(step, k, np.minimum(mu * together, MOST), pairs, touching, lacks)
    c, reason = _hopeless(step, hard, held)
    return InfeasibleStep(k, step.names[c], np.inf, float(mu[c]), reason)


def margins(
    program: ContactProgram, disturbance: Array, sizes: Sequence[float] = (-2.0, 2.0), forces: Array | None = None
) -> Robustness:
    """Return by how much the cones hold when the object's force changes by each of ``sizes`` times a disturbance.

    ``disturbance`` (K, 3) is its wrench on the eo per unit of size, about the eo's origin in axes of W; contacts of the
    object share its force evenly. ``forces`` (K, C, 2) are the nominal ones, by default the program's own with all
    cones hard. The ground answers; where that leaves a choice, with the forces whose least margin is largest, and where
    it cannot (a ground that slips), the object's force changes by what comes nearest. Raises ValueError for a program
    without an extrinsic object, and InfeasiblePlan where there are no nominal forces.
    """
    given = replace(as_numpy(program), relaxed=(False,) * program.contacts)
    if given.eo_jacobian is None:
        raise ValueError("margins: program: expected one with an extrinsic object's balance (P1)")
    if forces is None:
        from planning.qp_fused import solve

        solution = solve(given)
        if not solution.usable.all():
            check(given)
            k = int(np.argmin(solution.usable))
            raise InfeasiblePlan(k, given.names[0], np.nan, np.nan, reason=f"no nominal forces: {solution.status[k]}")
        forces = np.asarray(solution.forces)
    ours = np.array([not name.startswith("ground") for name in given.names]) & (given.modes != FREE)
    share = np.einsum("kcij,kj->kci", given.eo_jacobian[..., :2], np.asarray(disturbance)[:, :2])
    share *= (ours / np.maximum(ours.sum(axis=1, keepdims=True), 1))[..., None]
    answers = np.stack([_answer(given, forces + size * share, ours) for size in sizes])
    normal, side = answers[..., 0], np.abs(answers[..., 1])
    margin = np.where(given.modes == STICK, (given.mu * normal - side) / np.sqrt(1 + given.mu**2), normal)
    needs = np.where(given.modes == STICK, required_friction(answers), given.mu)
    free = given.modes == FREE
    return Robustness(
        names=given.names,
        sizes=np.asarray(sizes, dtype=np.float64),
        forces=answers,
        margin=np.where(free, np.inf, margin),
        needs=np.where(free, 0.0, needs),
        has=given.mu,
    )


def imbalance(program: ContactProgram, hard: bool = True) -> Array:
    """Return (K,) the least that the eo's balance lacks, as a sum over its rows relative to `force_scale`; P2: 0.

    With ``hard`` False the relaxed contacts stay relaxed.
    """
    given = as_numpy(program)
    return np.zeros(given.steps) if given.eo_jacobian is None else _lacks(given, given.mu, hard)[0]


def _lacks(
    program: ContactProgram,
    mu: Array,
    hard: bool = True,
    held: NDArray[np.bool_] | None = None,
    pull: float | None = None,
) -> tuple[Array, Array]:
    """Return (K,) the least that balance lacks, relative, and forces (K, C, 2) [N] that lack no more.

    With ``pull`` normal forces may be negative, at a price of ``pull`` each [per relative newton].
    """
    assert program.eo_jacobian is not None and program.eo_load is not None
    (K, C), scale = program.modes.shape, force_scale(program)
    equal, at_most, targets, bounds, cost = ([] for _ in range(5))
    divisor = np.array([1.0, 1.0, program.length])
    n = 2 * C
    for k in range(K):
        A = (program.eo_jacobian[k].reshape(n, 3) / divisor).T
        rows, values = [np.hstack([A, np.eye(3), -np.eye(3), np.zeros((3, C))])], [-program.eo_load[k] / divisor]
        less = []
        limits: list[tuple[float | None, float | None]] = []
        for c, mode in enumerate(program.modes[k]):
            normal, across = np.eye(n + 6 + C)[2 * c], np.eye(n + 6 + C)[2 * c + 1]
            bound = hard or not program.relaxed[c]
            if mode == FREE:
                limits += [(0.0, 0.0), (0.0, 0.0)]
                continue
            if mode == STICK and bound:
                less += [across - mu[k, c] * normal, -across - mu[k, c] * normal] if np.isfinite(mu[k, c]) else []
            elif mode != STICK:
                rows.append((across - mode * mu[k, c] * normal)[None])
                values.append(np.zeros(1))
            limits += [(0.0 if bound and pull is None else None, None), (None, None)]
            if bound and pull is not None:
                less.append(-normal - np.eye(n + 6 + C)[n + 6 + c])
            for i in range(2):
                if held is not None and held[c, i]:
                    rows.append(np.eye(n + 6 + C)[2 * c + i][None])
                    values.append(program.desired[k, c, i : i + 1])
        equal.append(np.vstack(rows))
        targets.append(np.concatenate(values) / scale[k])
        at_most.append(np.array(less).reshape(-1, n + 6 + C))
        bounds += limits + [(0.0, None)] * (6 + C)
        cost.append(np.concatenate([np.zeros(n), np.ones(6), np.full(C, pull or 0.0)]))
    x = _linear_program(cost, at_most, [np.zeros(len(rows)) for rows in at_most], equal, targets, bounds)
    if x is None:  # what is held contradicts a mode
        if K == 1:
            return np.array([np.inf]), np.zeros((1, C, 2))
        parts = [_lacks(take(program, [k]), mu[k : k + 1], hard, held, pull) for k in range(K)]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    x = x.reshape(K, -1)
    return x[:, n : n + 6].sum(axis=1), x[:, :n].reshape(K, C, 2) * scale[:, None, None]


def _linear_program(
    cost: list[Array],
    at_most: list[Array],
    limits: Sequence[Array],
    equal: list[Array],
    targets: list[Array],
    bounds: list[tuple[float | None, float | None]],
) -> NDArray[np.float64] | None:
    """Return the x of all steps at which Σ costᵀ x is least; None where nothing meets ``at_most`` x ≤ ``limits``,
    ``equal`` x = ``targets`` of each step, and the ``bounds``."""
    from scipy import sparse
    from scipy.optimize import linprog

    limited = any(map(len, at_most))
    return linprog(
        np.concatenate(cost),
        A_ub=sparse.block_diag(at_most, format="csr") if limited else None,
        b_ub=np.concatenate(limits) if limited else None,
        A_eq=sparse.block_diag(equal, format="csr"),
        b_eq=np.concatenate(targets),
        bounds=bounds,
        method="highs",
    ).x


def _least(lacks: Callable[[float], float], has: float, slips: bool) -> float | None:
    """Return the least value from ``has`` on at which nothing lacks; None where there is none.

    Where all stick more friction is never worse, so that bisection finds it. f_t = ±µ f_n can be too large as well:
    there a scan finds where to look.
    """
    low, high = max(has, 1e-6), None
    if not slips:
        high = next((value for value in (MOST, 1e6 * low) if value > low and lacks(value) <= BALANCED), None)
    else:
        grid = low * np.geomspace(1.0, 30.0 / min(low, 1.0), 60)
        amounts = [lacks(float(value)) for value in grid]
        good = [i for i, amount in enumerate(amounts) if amount <= BALANCED]
        if good:
            low, high = float(grid[max(good[0] - 1, 0)]), float(grid[good[0]])
        else:
            i = int(np.argmin(amounts))
            around = float(grid[max(i - 1, 0)]), float(grid[min(i + 1, len(grid) - 1)])
            from scipy.optimize import minimize_scalar

            nearest: Any = minimize_scalar(lacks, bounds=around, method="bounded", options={"xatol": 1e-9})
            return float(nearest.x) if nearest.fun <= 10 * BALANCED else None
    if high is None:
        return None
    while high - low > 1e-7 * high:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if lacks(middle) <= BALANCED else (middle, high)
    return high


def _both(
    step: ContactProgram,
    k: int,
    wanted: Array,
    pairs: NDArray[np.str_],
    touching: NDArray[np.bool_],
    lacks: Callable[[Array], float],
) -> InfeasibleStep:
    """Say what every pair needs where none alone is what is short, beginning with µ (C,) that do."""
    words, has, mu = [], [], step.mu[0]
    for pair in dict.fromkeys(pairs[touching].tolist()):
        ours = (pairs == pair) & touching
        others = wanted
        least = _least(
            lambda value, ours=ours, others=others: lacks(np.where(ours, value, others)), float(mu[ours].max()), False
        )
        wanted = np.where(ours, least, wanted) if least is not None else wanted
        words.append(f"µ ≥ {float(wanted[ours].max()):.3g} at the {pair}")
        has.append(f"{float(mu[ours].max()):.3g}")
    c = int(np.flatnonzero(touching)[0])
    reason = f"needs {' and '.join(words)}, has {' and '.join(has)}"
    return InfeasibleStep(k, step.names[c], float(wanted[c]), float(mu[c]), reason)


def _tightest(step: ContactProgram, mu: Array, ours: Array, hard: bool, held: NDArray[np.bool_] | None) -> int:
    """Return the contact among ``ours`` that carries most tangential force for its normal force."""
    forces = _lacks(step, mu[None], hard, held)[1][0]
    ratio = np.abs(forces[:, 1]) / np.maximum(forces[:, 0], 1e-6 * np.abs(forces).max())
    return int(np.where(ours & (forces[:, 0] > 0), ratio, -1.0).argmax()) if ours.any() else 0


def _hopeless(step: ContactProgram, hard: bool, held: NDArray[np.bool_] | None) -> tuple[int, str]:
    """Return the contact to name and why no µ is enough."""
    modes, load = step.modes[0], step.eo_load
    assert step.eo_jacobian is not None and load is not None
    touching = np.flatnonzero(modes != FREE)
    if len(touching) == 0:
        return 0, "no contact is there to balance the object"
    ground = [int(c) for c in touching if step.names[c].startswith("ground")]
    pushing = [int(c) for c in touching if c not in ground]
    unlimited = np.where(modes == STICK, np.inf, step.mu[0])[None]
    if len(ground) == 1 and pushing:
        normal, across = step.eo_jacobian[0, ground[0], :, :]
        turned = np.array([[0.0, -1.0], [1.0, 0.0]])
        x, y = np.linalg.solve(np.stack([normal[:2], across[:2]]) @ turned, [normal[2], across[2]])
        levers = step.eo_jacobian[0, pushing, 0] @ [y, -x, 1.0]  # of the normals, about that point
        if np.abs(levers).max() < 0.02 * step.length:
            return pushing[0], f"the force passes through the pivot, '{step.names[ground[0]]}': no µ is enough"
    if _lacks(step, unlimited, hard, held)[0][0] <= BALANCED:
        return int(touching[0]), f"even µ = {MOST:g} is not enough"
    lacks, forces = _lacks(step, unlimited, hard, held, pull=1e-3)
    if lacks[0] <= BALANCED and forces[0, :, 0].min() < 0:
        c = int(forces[0, :, 0].argmin())
        return c, f"would have to pull with {-forces[0, c, 0]:.3g} N: no µ is enough"
    missing = lacks[0] * force_scale(step)[0]
    words = f"no force in the modes' directions balances the object: {missing:.3g} N lack"
    return int(touching[0]), f"{words} (moments by {step.length:g} m), whatever µ"


def _wish(step: ContactProgram, k: int) -> InfeasibleStep | None:
    """Judge the wish of P2: f_n ≥ 0 where there is a contact, and in the cone where it sticks."""
    for c, mode in enumerate(step.modes[0]):
        (normal, across), has = step.desired[0, c], float(step.mu[0, c])
        tolerance = BALANCED * max(abs(normal), abs(across))
        if mode == FREE or max(abs(normal), abs(across)) == 0:
            continue
        if normal < -tolerance or (mode == STICK and normal <= tolerance < abs(across)):
            reason = f"the desired force pulls (f_n = {normal:.3g} N), and a contact only pushes: no µ is enough"
            return InfeasibleStep(k, step.names[c], np.inf, has, reason)
        if mode == STICK and abs(across) - has * normal > tolerance:
            return InfeasibleStep(k, step.names[c], abs(across) / normal, has)
    return None


def _answer(program: ContactProgram, wished: Array, ours: Array) -> Array:
    """Return forces (K, C, 2) that balance: at ``ours`` (K, C) what comes nearest to ``wished``, then those whose least
    distance to their cones' edges is largest."""
    assert program.eo_jacobian is not None and program.eo_load is not None
    (K, C), scale = program.modes.shape, force_scale(program, wished)
    divisor, n = np.array([1.0, 1.0, program.length]), 2 * C
    width = 2 * n + 1  # f, |f − wished|, the least margin
    equal, at_most, targets, limits, bounds, cost = ([] for _ in range(6))
    for k in range(K):
        unit = np.eye(width)
        A = (program.eo_jacobian[k].reshape(n, 3) / divisor).T
        rows, values = [np.hstack([A, np.zeros((3, n + 1))])], [-program.eo_load[k] / divisor]
        less, right = [], []
        for c, mode in enumerate(program.modes[k]):
            mu, normal, across = program.mu[k, c], unit[2 * c], unit[2 * c + 1]
            if mode == FREE:
                rows.append(np.stack([normal, across]))
                values.append(np.zeros(2))
                continue
            if mode == STICK:
                less += [unit[-1] - (mu * normal - side) / np.hypot(1, mu) for side in (across, -across)]
                right += [0.0, 0.0]
            else:
                rows.append((across - mode * mu * normal)[None])
                values.append(np.zeros(1))
                less.append(unit[-1] - normal)
                right.append(0.0)
            for i, component in enumerate((normal, across)):
                if ours[k, c]:
                    less += [component - unit[n + 2 * c + i], -component - unit[n + 2 * c + i]]
                    right += [wished[k, c, i] / scale[k], -wished[k, c, i] / scale[k]]
        equal.append(np.vstack(rows))
        targets.append(np.concatenate(values) / scale[k])
        at_most.append(np.array(less).reshape(-1, width))
        limits.append(right)
        bounds += [(None, None)] * n + [(0.0, None)] * n + [(None, 10.0)]
        cost.append(np.concatenate([np.zeros(n), np.full(n, 1e4), [-1.0]]))
    x = _linear_program(cost, at_most, limits, equal, targets, bounds)
    if x is None:
        raise InfeasiblePlan(0, program.names[0], np.nan, np.nan, reason="a disturbed force cannot be balanced")
    return x.reshape(K, width)[:, :n].reshape(K, C, 2) * scale[:, None, None]
