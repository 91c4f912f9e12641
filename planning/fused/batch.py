"""A batch of contact programs, one after the other, compiled."""

from __future__ import annotations

import numpy as np

from planning.fused.layout import (
    COLUMNS,
    CONE,
    CONTACT_OF_EDGE,
    CONTACTS,
    D_N,
    D_T,
    EO,
    EQUAL_RANK,
    F_N,
    F_T,
    GO,
    INTS,
    LAMBDA,
    LOAD_EO,
    LOAD_GO,
    MU,
    NU,
    OMEGA,
    PUSHING_RAY,
    RANK,
    RAY,
    ROOT_SLACK,
    ROW_OF,
    ROWS,
    U_N,
    U_T,
)
from planning.fused.program import INFEASIBLE, solve
from planning.fused.sources import entry, fingerprint, kernel


def _entry(sources):
    @entry
    def solve_batch(kinds, slope, desired, weights, J_eo, load_eo, J_go, load_go, slack, eo, go, length):
        """Forces (K, C, 2), ν (K, 3), λ (K, C, 3) and a status (K) each, for kinds and slopes (K, C)."""
        steps, contacts = kinds.shape
        forces, balance = np.zeros((steps, contacts, 2)), np.zeros((steps, 3))
        cone, status = np.zeros((steps, contacts, 3)), np.full(steps, sources * 0, np.int64)
        w, c, i = np.zeros((ROWS, 8)), np.zeros((CONTACTS, COLUMNS)), np.zeros(INTS, np.int64)
        for r in range(3):
            w[ROOT_SLACK, r] = np.sqrt(slack[r])
        for k in range(steps):
            for at in range(contacts):
                c[at, MU] = slope[k, at]
                c[at, U_N], c[at, U_T] = weights[k, at, 0], weights[k, at, 1]
                c[at, D_N], c[at, D_T] = desired[k, at, 0], desired[k, at, 1]
                for j in range(6):
                    c[at, EO + j] = J_eo[k, at, j // 3, j % 3]
                    c[at, GO + j] = J_go[k, at, j // 3, j % 3]
            for r in range(3):
                w[LOAD_EO, r], w[LOAD_GO, r] = load_eo[k, r], load_go[k, r]
            status[k], _ = solve(w, c, i, kinds, k, contacts, eo, go, length, 0)
            if status[k] >= INFEASIBLE:
                continue
            for r in range(3):
                balance[k, r] = w[NU, r]
            for at in range(contacts):
                forces[k, at, 0], forces[k, at, 1] = c[at, F_N], c[at, F_T]
                _cone_multipliers(w, c, at, kinds[k, at], cone[k, at], eo, go)
            for m in range(i[EQUAL_RANK], i[RANK]):
                e = i[ROW_OF + m] - 3
                at = i[CONTACT_OF_EDGE + e]
                if kinds[k, at] == CONE:
                    second = e > 0 and i[CONTACT_OF_EDGE + e - 1] == at
                    cone[k, at, 1 if second else 0] = max(w[LAMBDA, m], 0.0)
        return forces, balance, cone, status

    return solve_batch


@kernel
def _cone_multipliers(w, c, at, kind, cone, eo, go):
    """λ of a contact that slips, or cannot but stick (µ = 0), from its stationarity."""
    if kind not in (RAY, PUSHING_RAY):
        return
    g_n, g_t = c[at, U_N] * (c[at, F_N] - c[at, D_N]), c[at, U_T] * (c[at, F_T] - c[at, D_T])
    for r in range(3):
        if eo:
            g_n -= c[at, EO + r] * w[NU, r]
            g_t -= c[at, EO + 3 + r] * w[NU, r]
        if go:
            g_n += c[at, GO + r] * w[OMEGA, r]
            g_t += c[at, GO + 3 + r] * w[OMEGA, r]
    cone[1] = g_t
    if kind == PUSHING_RAY:
        cone[2] = max(g_n + c[at, MU] * g_t, 0.0)


solve_batch = _entry(fingerprint())
