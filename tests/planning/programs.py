"""Random contact programs on the catalogue's shapes, an oracle that solves one step, and what tells a tie."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np
import scipy.sparse

from mechanics.catalogue import load_object
from mechanics.contact import jacobian
from planning.program import FREE, INEQUALITY, SLIP_MINUS, SLIP_PLUS, STICK, ContactProgram, rows, take

SHAPES = ("hbox", "heptagon", "pentagon", "tall_box", "triangle", "z")
TOLERANCE = 1e-12
CODES = (STICK, SLIP_PLUS, SLIP_MINUS, FREE)


@dataclass(frozen=True)
class Pattern:
    """What a batch has in common: how many contacts with the ground and with the object (P2: no ``ground``), whether
    the object's are relaxed, and whether the go's balance is a slack (paper form)."""

    ground: int
    objects: int
    relaxed: bool
    paper: bool

    @property
    def contacts(self) -> int:
        return self.ground + self.objects

    def mode_combinations(self):
        return list(itertools.product(CODES, repeat=self.contacts))


PATTERNS = [
    Pattern(ground, objects, relaxed, paper)
    for ground, objects in ((1, 1), (2, 1), (1, 2), (2, 2), (0, 1), (0, 2), (0, 3))
    for relaxed in (False, True)
    for paper in (False, True)
    if ground > 0 or not relaxed
]
"""Ground contacts first: P1 with 1 or 2 on the ground and 1 or 2 of the object, P2 with 1 to 3."""


def random_programs(rng: np.random.Generator, count: int, pattern: Pattern | None = None) -> list[ContactProgram]:
    """Return programs that have ``count`` steps in all, every one with a solution.

    With no ``pattern`` there is one program for each of `PATTERNS`, and the steps go round through all combinations of
    modes of all of them (484 of P1 and P2, in either form: some 900) in an order that ``rng`` draws.
    """
    of = [pattern] if pattern is not None else PATTERNS
    wanted = [(one, modes) for one in of for modes in one.mode_combinations()]
    order = np.concatenate([rng.permutation(len(wanted)) for _ in range(-(-count // len(wanted)))])[:count]
    steps: dict[Pattern, list[tuple[int, ...]]] = {}
    for index in order:
        one, modes = wanted[index]
        steps.setdefault(one, []).append(modes)
    return [_program(rng, one, np.array(modes, dtype=np.int8)) for one, modes in steps.items()]


def _program(rng: np.random.Generator, pattern: Pattern, modes: np.ndarray) -> ContactProgram:
    K, C = modes.shape
    mu = rng.uniform(0.1, 1.0, (K, C))
    witness = _admitted(rng, modes, mu)
    witness[:, pattern.ground :] += pattern.relaxed * _pulls(rng, modes, mu)[:, pattern.ground :]
    geometry = [_geometry(rng, pattern) for _ in range(K)]
    J_eo, J_go = (np.stack([one[i] for one in geometry]) for i in (0, 1))
    weight = 10 ** rng.uniform(-1, 3)
    go_load = -np.einsum("kcij,kci->kj", J_go, witness) + rng.normal(size=(K, 3)) * [0.5, 0.5, 0.02]
    names = ("ground left", "ground right")[: pattern.ground]
    return ContactProgram(
        names=(*names, *(f"object {i}" for i in range(pattern.objects))),
        modes=modes,
        desired=rng.normal(size=(K, C, 2)) * [2.0, 1.0] + [1.0, 0.0],
        mu=mu,
        weights=np.exp(rng.normal(size=(K, C, 2))),
        relaxed=(False,) * pattern.ground + (pattern.relaxed,) * pattern.objects,
        eo_jacobian=J_eo if pattern.ground else None,
        eo_load=-np.einsum("kcij,kci->kj", J_eo, witness) if pattern.ground else None,
        go_jacobian=J_go if pattern.paper else None,
        go_load=go_load if pattern.paper else None,
        slack_weights=weight * np.array([1.0, 1.0, 0.045**-2]) if pattern.paper else None,
    )


def _admitted(rng, modes, mu):
    """Forces (K, C, 2) strictly inside what the modes admit: they make the loads, so that every step has a solution."""
    normal = rng.uniform(0.5, 5.0, modes.shape)
    across = np.where(modes == STICK, rng.uniform(-0.9, 0.9, modes.shape), modes) * mu * normal
    return np.stack([normal, across], axis=-1) * (modes != FREE)[..., None]


def _pulls(rng, modes, mu):
    """What a relaxed contact may add to them: anything where it sticks, either way along the edge where it slips."""
    normal = rng.normal(size=modes.shape)
    across = np.where(modes == STICK, rng.normal(size=modes.shape), modes * mu * normal)
    return np.stack([normal, across], axis=-1) * (modes != FREE)[..., None]


def _geometry(rng, pattern: Pattern):
    """J_eo and J_go (C, 2, 3) of a shape that stands on the ground, tilted where it has one contact there."""
    eo = load_object(str(rng.choice(SHAPES))).polygon
    theta = 0.0 if pattern.ground == 2 else rng.uniform(-0.7, 0.7)
    outline = eo.transformed([0.0, 0.0, theta])
    lowest = sorted(outline.vertices[list(outline.lowest_vertices())].tolist())
    points = [lowest[0], lowest[-1]][: pattern.ground] if pattern.ground else []
    samples = outline.boundary(0.01)
    height = samples.points[:, 1] - outline.vertices[:, 1].min()
    upper = np.flatnonzero((height > 0.02) & (samples.normals[:, 1] > -0.1))
    chosen = rng.choice(upper, pattern.objects, replace=False)
    normals = np.concatenate([np.tile([0.0, 1.0], (pattern.ground, 1)), -samples.normals[chosen]])
    points = np.concatenate([np.array(points).reshape(-1, 2), samples.points[chosen]])
    grasp = samples.points[chosen[0]] + samples.normals[chosen[0]] * 0.1 + rng.uniform(-0.03, 0.03, 2)
    J_go = jacobian(normals, points - grasp)
    if pattern.ground:
        J_go = -J_go * (np.arange(pattern.contacts) >= pattern.ground)[:, None, None]
    return jacobian(normals, points), J_go


def clarabel(program: ContactProgram, chunk: int = 64) -> np.ndarray:
    """Forces (K, C, 2) by an interior-point solver, straight from the definition; NaN where it finds none.

    ``chunk`` steps go into one call, as a sum of objectives that share nothing: building a model is what takes time.
    """
    parts = [_clarabel(take(program, slice(k, k + chunk))) for k in range(0, program.steps, chunk)]
    return np.concatenate(parts)


def _clarabel(program: ContactProgram) -> np.ndarray:
    K, C = program.modes.shape
    f, nothing, push = cp.Variable(2 * K * C), [], []
    for (k, c), mode in np.ndenumerate(program.modes):
        mu, normal = program.mu[k, c], np.zeros(2 * K * C)
        normal[2 * (k * C + c)] = 1.0
        across, hard = np.roll(normal, 1), not program.relaxed[c]
        if mode == FREE:
            nothing += [normal, across]
        elif mode == STICK:
            push += [mu * normal - across, mu * normal + across, normal] if hard else []
        else:
            nothing += [across - int(mode) * mu * normal]
            push += [normal] if hard else []
    constraints: list = [scipy.sparse.csr_array(np.array(nothing)) @ f == 0] if nothing else []
    constraints += [scipy.sparse.csr_array(np.array(push)) @ f >= 0] if push else []
    cost = program.weights.ravel() @ cp.square(f - program.desired.ravel())
    if program.eo_jacobian is not None and program.eo_load is not None:
        divisor = np.array([1.0, 1.0, program.length])
        wrench = scipy.sparse.block_diag([J.reshape(2 * C, 3).T / divisor[:, None] for J in program.eo_jacobian])
        constraints.append(wrench @ f + (program.eo_load / divisor).ravel() == 0)
    if program.go_jacobian is not None and program.go_load is not None and program.slack_weights is not None:
        wrench = scipy.sparse.block_diag([J.reshape(2 * C, 3).T for J in program.go_jacobian])
        cost += np.tile(program.slack_weights, K) @ cp.square(wrench @ f + program.go_load.ravel())
    problem = cp.Problem(cp.Minimize(0.5 * cost), constraints)
    try:
        with warnings.catch_warnings():  # it says so where it stops short of a tolerance that is beyond rounding
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.solve(solver=cp.CLARABEL, **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), TOLERANCE))
    except cp.SolverError:
        return np.full((K, C, 2), np.nan)
    return np.full((K, C, 2), np.nan) if f.value is None else f.value.reshape(K, C, 2)


def relative_error(forces, expected, program: ContactProgram) -> np.ndarray:
    """(K,) the largest difference of each step, by the largest force that step was asked for or got."""
    size = np.abs(np.concatenate([program.desired, expected], axis=1)).max(axis=(1, 2))
    return np.abs(np.asarray(forces) - expected).max(axis=(1, 2)) / size


def tie_margin(program: ContactProgram, solution) -> np.ndarray:
    """(K,) how far each step is from a change of its active set: the least over its inequalities of gap + multiplier,
    both as a fraction of the step's own size. Gradients jump where this is 0."""
    G, kind = rows(program)
    gap = np.abs((G * np.asarray(solution.forces)[:, :, None, :]).sum(-1))
    either = np.maximum(gap, np.abs(np.asarray(solution.cone)))
    either = np.where(kind == INEQUALITY, either, np.inf).reshape(program.steps, -1)
    return either.min(axis=1, initial=np.inf)


def with_field(program: ContactProgram, name: str, value) -> ContactProgram:
    """The program with one of its arrays changed."""
    return replace(program, **{name: value})
