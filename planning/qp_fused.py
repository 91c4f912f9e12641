"""Contact programs by the fused kernel: each solved exactly by its active set. Forces only, no gradients through torch.

See `planning.fused.program` for the method. The first use after an installation compiles it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.fused.layout import ABSENT, CONE, CONTACTS, OPEN, PUSHING_RAY, RAY
from planning.program import FREE, STICK, ContactProgram, Solution, as_numpy, kkt_residual

STATUS = ("solved", "inaccurate", "infeasible", "failed")
RESIDUAL = 1e-6
"""Largest `planning.program.kkt_residual` that still counts as solved."""


def kinds_of(
    modes: NDArray[np.int8], mu: NDArray[np.float64], relaxed: tuple[bool, ...]
) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Return what each contact (K, C) is to the kernel, and µ or the slope f_t / f_n of the ray that it is confined to.

    ``modes`` (K, C), ``mu`` (K, C) or (C,).

    A contact that sticks without friction has f_t = 0: a ray of slope 0.
    """
    soft, slips = np.array(relaxed, dtype=bool), np.abs(modes) == 1
    ray = slips | ((modes == STICK) & (mu == 0) & ~soft)
    kinds = np.where(ray, np.where(soft, RAY, PUSHING_RAY), np.where(soft, OPEN, CONE))
    slope = np.where(slips, modes * mu, mu)
    return np.where(modes == FREE, ABSENT, kinds).astype(np.int8), slope


def solve(program: ContactProgram) -> Solution:
    """Solve every step. A step without a solution, or whose figures are not finite, has status ``infeasible`` or
    ``failed`` and zero force. Raises ValueError for more contacts than the kernel takes."""
    from planning.fused.batch import solve_batch

    p = as_numpy(program)
    if p.contacts > CONTACTS:
        raise ValueError(f"solve: contacts: expected at most {CONTACTS}, received {p.contacts}")
    kinds, slope = kinds_of(p.modes, np.asarray(p.mu), p.relaxed)
    K, C = kinds.shape
    eo, go = p.eo_jacobian is not None, p.go_jacobian is not None
    forces, balance, cone, code = solve_batch(
        kinds,
        _flat(slope),
        _flat(p.desired),
        _flat(p.weights),
        _flat(p.eo_jacobian, (K, C, 2, 3)),
        _flat(p.eo_load, (K, 3)),
        _flat(p.go_jacobian, (K, C, 2, 3)),
        _flat(p.go_load, (K, 3)),
        _flat(p.slack_weights, (3,)),
        eo,
        go,
        float(p.length),
    )
    pinned = (p.modes == STICK) & (kinds == PUSHING_RAY)  # f_t = 0 is two inequalities there, each with its multiplier
    cone[pinned, 0], cone[pinned, 1] = np.maximum(-cone[pinned, 1], 0), np.maximum(cone[pinned, 1], 0)
    residual = kkt_residual(p, forces, balance if eo else None, cone) if K else np.empty(0)
    status = [STATUS[value] for value in code]
    for k, word in enumerate(status):
        if word in ("infeasible", "failed"):
            residual[k] = np.inf
        elif residual[k] > RESIDUAL:
            status[k] = "inaccurate"
    return Solution(forces, balance if eo else None, cone, residual, tuple(status))


def _flat(value: object, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """A float64 array of the one layout that is compiled for; zeros of ``shape`` where there is none."""
    return np.zeros(shape or ()) if value is None else np.require(value, np.float64, ["C", "W"])
