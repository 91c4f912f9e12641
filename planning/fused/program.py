"""One contact program, compiled: a strictly convex QP of at most 8 force components, solved exactly.

What slips has one unknown, what is free none. With H the diagonal weights of these unknowns and g = √H x the program is

    min ½‖g − g_d‖² + ½‖B g + e‖²   subject to   A g = b,  G g ≥ 0,

with B g + e = √W s the weighted slack. For a set of active rows (the balance, then edges of cones) an orthonormal basis
Q of them is built row by row; a row that the ones before it span is left out, so redundant rows and coincident contacts
do no harm. Then g = g₀ − Mᵀ z with g₀ the point nearest to g_d on A g = b, M the part of B orthogonal to Q, and
(1 + M Mᵀ) z = B g₀ + e, which is also z = √W s: a least-squares problem, solved by orthogonal columns of (Mᵀ; 1), so
that weights that are far apart cost only the root of what forming the sum would. The same lines answer for derivatives.

The set that was active the last time is tried first, then what its violations suggest, then all sets, of which there
are at most 2⁸. One is taken where its Karush–Kuhn–Tucker conditions hold relative to the step's own forces.
"""

from __future__ import annotations

from math import sqrt

from planning.fused.layout import (
    ABSENT,
    BASE_RHS,
    CONE,
    CONTACT_OF,
    CONTACT_OF_EDGE,
    D_N,
    D_T,
    E0,
    EDGE_ROWS,
    EDGES,
    EO,
    EQUAL,
    EQUAL_RANK,
    F_N,
    F_T,
    GAMMA,
    GO,
    LAMBDA,
    LARGEST,
    LOAD_EO,
    LOAD_GO,
    MU,
    NEXT,
    NU,
    OMEGA,
    OPEN,
    PUSHING_RAY,
    RANK,
    ROOT_SLACK,
    ROW_OF,
    T_N,
    T_T,
    TARGET,
    U_N,
    U_T,
    UNKNOWNS,
    B,
    G,
    L,
    M,
    Q,
    R,
    Z,
)
from planning.fused.sources import inlined

SOLVED, INACCURATE, INFEASIBLE, FAILED = 0, 1, 2, 3
EXACT, ROUGH = 1e-9, 1e-6
"""Violation, relative to the step's forces, up to which a set of active rows is right, and up to which it may do."""
DEPENDENT = 1e-9
"""A row says nothing new if what of it lies outside the span of the rows before is smaller, relative to itself."""
NOISE = 1e-14
"""The same for a row of the slack, of which nothing is left but rounding."""
GUESSES = 8
"""Sets of active rows that are tried before all are."""


@inlined
def solve(w, c, i, kinds, k, contacts, eo, go, length, warm):
    """Solve the program in the contact table and the loads; forces to the table, multipliers to the workspace.

    ``warm`` is the set of edges (bit mask) to try first. Returns (status, set of active edges).
    """
    if not _prepare(w, c, i, kinds, k, contacts, eo, go, length):
        return FAILED, 0
    edges = i[EDGE_ROWS]
    mask, tries, sweep, best, least = warm & ((1 << edges) - 1), 0, -1, 0, 1e300
    while True:  # one call for guesses, for all sets and for the best of these: it is compiled into its place
        violation = _attempt(w, c, i, mask, contacts, eo, go, length)
        if violation <= EXACT or sweep == 1 << edges:
            break
        if sweep < 0:
            tries += 1
            if tries < GUESSES and i[NEXT] != mask:
                mask = i[NEXT]
                continue
        elif violation < least:
            best, least = mask, violation
        sweep += 1
        mask = sweep if sweep < 1 << edges else best
    _multipliers(w, i, length)
    if violation <= EXACT:
        return SOLVED, mask
    return (INACCURATE if violation <= ROUGH else INFEASIBLE), mask


@inlined
def _prepare(w, c, i, kinds, k, contacts, eo, go, length):
    """Write unknowns and rows, and the basis of the balance. Returns False where a figure is not finite."""
    n, edges, total = 0, 0, 0.0
    for at in range(contacts):
        kind = kinds[k, at]
        if kind == ABSENT:
            continue
        total += c[at, MU] + c[at, U_N] + c[at, U_T] + c[at, D_N] + c[at, D_T]
        if kind in (OPEN, CONE):
            a, b = 1 / sqrt(c[at, U_N]), 1 / sqrt(c[at, U_T])
            w[T_N, n], w[T_T, n] = a, 0.0
            w[T_N, n + 1], w[T_T, n + 1] = 0.0, b
            w[TARGET, n], w[TARGET, n + 1] = c[at, D_N] / a, c[at, D_T] / b
            i[CONTACT_OF + n] = at
            i[CONTACT_OF + n + 1] = at
            if kind == CONE:
                for side in range(2):
                    for j in range(8):
                        w[EDGES + edges, j] = 0.0
                    w[EDGES + edges, n] = c[at, MU] * a
                    w[EDGES + edges, n + 1] = b if side else -b
                    i[CONTACT_OF_EDGE + edges] = at
                    edges += 1
            n += 2
        else:
            slope = c[at, MU]
            a = 1 / sqrt(c[at, U_N] + slope * slope * c[at, U_T])
            w[T_N, n], w[T_T, n] = a, slope * a
            w[TARGET, n] = a * (c[at, U_N] * c[at, D_N] + slope * c[at, U_T] * c[at, D_T])
            i[CONTACT_OF + n] = at
            if kind == PUSHING_RAY:
                for j in range(8):
                    w[EDGES + edges, j] = 0.0
                w[EDGES + edges, n] = a
                i[CONTACT_OF_EDGE + edges] = at
                edges += 1
            n += 1
    i[UNKNOWNS], i[EDGE_ROWS] = n, edges
    rank = 0
    if eo:
        for r in range(3):
            unit = 1 / length if r == 2 else 1.0
            for j in range(n):
                at = i[CONTACT_OF + j]
                w[EQUAL + r, j] = (w[T_N, j] * c[at, EO + r] + w[T_T, j] * c[at, EO + 3 + r]) * unit
                total += w[EQUAL + r, j]
            total += w[LOAD_EO, r]
            if _extend(w, n, rank, EQUAL + r):
                w[BASE_RHS, rank] = -w[LOAD_EO, r] * unit
                i[ROW_OF + rank] = r
                rank += 1
    i[EQUAL_RANK] = rank
    if go:
        for r in range(3):
            weight = w[ROOT_SLACK, r]
            for j in range(n):
                at = i[CONTACT_OF + j]
                w[B + r, j] = (w[T_N, j] * c[at, GO + r] + w[T_T, j] * c[at, GO + 3 + r]) * weight
                total += w[B + r, j]
            w[E0, r] = weight * w[LOAD_GO, r]
            total += w[E0, r]
    return total - total == 0.0


@inlined
def _extend(w, n, rank, row):
    """Add a row of the workspace to the basis; False where it depends on those that are in it."""
    size = 0.0
    for j in range(n):
        w[Q + rank, j] = w[row, j]
        size += w[row, j] * w[row, j]
    if size == 0.0 or rank == n:
        return False
    for m in range(rank):
        w[R + m, rank] = 0.0
    left = size
    for _ in range(2):  # Gram–Schmidt once, and once more where much was cancelled: twice is enough (Kahan, Parlett)
        before = left
        for m in range(rank):
            d = 0.0
            for j in range(n):
                d += w[Q + m, j] * w[Q + rank, j]
            w[R + m, rank] += d
            for j in range(n):
                w[Q + rank, j] -= d * w[Q + m, j]
        left = 0.0
        for j in range(n):
            left += w[Q + rank, j] * w[Q + rank, j]
        if left > 0.1 * before:
            break
    if left <= DEPENDENT * DEPENDENT * size:
        return False
    root = sqrt(left)
    w[R + rank, rank] = root
    for j in range(n):
        w[Q + rank, j] /= root
    return True


@inlined
def respond(w, n, rank, go, target, rhs, e, g, z):
    """g and z of the program with these active rows; arguments are rows of the workspace.

    ``target`` is what g is drawn to, ``rhs`` the right sides in the order of the basis, ``e`` the slack without forces.
    """
    for j in range(n):
        w[g, j] = w[target, j]
    for m in range(rank):
        y = w[rhs, m]
        for before in range(m):
            y -= w[R + before, m] * w[z, before]
        y /= w[R + m, m]
        w[z, m] = y  # the row is free until the slack is known
        for j in range(n):
            y -= w[Q + m, j] * w[g, j]
        for j in range(n):
            w[g, j] += y * w[Q + m, j]
    if not go:
        return
    for r in range(3):
        total = w[e, r]
        for j in range(n):
            total += w[B + r, j] * w[g, j]
        w[z, r] = total
    x, y, t = w[z, 0], w[z, 1], w[z, 2]
    for r in range(3):
        w[z, r] = w[L + r, 0] * x + w[L + r, 1] * y + w[L + r, 2] * t
        for j in range(n):
            w[g, j] -= w[M + r, j] * w[z, r]
    for r in range(2, -1, -1):
        for s in range(r + 1, 3):
            w[z, r] -= w[L + r, 3 + s] * w[z, s]
        w[z, r] /= w[L + r, 3 + r]


@inlined
def _project_slack(w, n, rank):
    """Orthonormal columns of (Mᵀ; 1), n parts to M and 3 to L, and beside these the triangle that makes it of them."""
    for r in range(3):
        size, left = 0.0, 0.0
        for j in range(n):
            w[M + r, j] = w[B + r, j]
            size += w[B + r, j] * w[B + r, j]
        for m in range(rank):
            d = 0.0
            for j in range(n):
                d += w[Q + m, j] * w[M + r, j]
            for j in range(n):
                w[M + r, j] -= d * w[Q + m, j]
        for j in range(n):
            left += w[M + r, j] * w[M + r, j]
        if rank == n or left <= NOISE * NOISE * size:  # what is left is rounding, which weights far apart would magnify
            for j in range(n):
                w[M + r, j] = 0.0
        for j in range(6):
            w[L + r, j] = 0.0
        w[L + r, r] = 1.0
        for _ in range(2 if r else 1):
            for s in range(r):
                d = 0.0
                for j in range(n):
                    d += w[M + s, j] * w[M + r, j]
                for j in range(3):
                    d += w[L + s, j] * w[L + r, j]
                w[L + s, 3 + r] += d
                for j in range(n):
                    w[M + r, j] -= d * w[M + s, j]
                for j in range(3):
                    w[L + r, j] -= d * w[L + s, j]
        square = 0.0
        for j in range(n):
            square += w[M + r, j] * w[M + r, j]
        for j in range(3):
            square += w[L + r, j] * w[L + r, j]
        root = sqrt(square)
        w[L + r, 3 + r] = root
        for j in range(n):
            w[M + r, j] /= root
        for j in range(3):
            w[L + r, j] /= root


@inlined
def _attempt(w, c, i, mask, contacts, eo, go, length):
    """Solve with the edges of ``mask`` active; returns the largest violation, relative; the next guess goes to NEXT."""
    n, edges, rank = i[UNKNOWNS], i[EDGE_ROWS], i[EQUAL_RANK]
    equal = rank
    taken = 0
    if mask:
        for e in range(edges):
            if mask >> e & 1 and _extend(w, n, rank, EDGES + e):
                w[BASE_RHS, rank] = 0.0
                i[ROW_OF + rank] = 3 + e
                taken |= 1 << e
                rank += 1
    i[RANK] = rank
    if go:
        _project_slack(w, n, rank)
    respond(w, n, rank, go, TARGET, BASE_RHS, E0, G, Z)

    for at in range(contacts):
        c[at, F_N] = 0.0
        c[at, F_T] = 0.0
        w[LARGEST, at] = 0.0
    size, largest = 1e-300, 0.0
    if eo:
        size = max(abs(w[LOAD_EO, 0]), abs(w[LOAD_EO, 1]), abs(w[LOAD_EO, 2]) / length, size)
    for j in range(n):
        at = i[CONTACT_OF + j]
        c[at, F_N] += w[T_N, j] * w[G, j]
        c[at, F_T] += w[T_T, j] * w[G, j]
        total = w[G, j] - w[TARGET, j]
        if go:
            for r in range(3):
                total += w[B + r, j] * w[Z, r]
        w[GAMMA, j] = total
    for at in range(contacts):
        size = max(size, abs(c[at, F_N]), abs(c[at, F_T]))
    for m in range(rank - 1, -1, -1):
        total = 0.0
        for j in range(n):
            total += w[Q + m, j] * w[GAMMA, j]
        for after in range(m + 1, rank):
            total -= w[R + m, after] * w[LAMBDA, after]
        w[LAMBDA, m] = total / w[R + m, m]

    violation, following = 0.0, taken
    if eo and equal < 3:  # a row that was left out may contradict the others
        for r in range(3):
            total = w[LOAD_EO, r] / length if r == 2 else w[LOAD_EO, r]
            for j in range(n):
                total += w[EQUAL + r, j] * w[G, j]
            violation = max(violation, abs(total) / size)
    if edges == 0:
        i[NEXT] = following
        return violation
    if taken:
        # multipliers are judged by the terms that they balance: the contact's own, and what rounding leaves of others
        for j in range(n):
            at = i[CONTACT_OF + j]
            stretch = max(w[T_N, j], abs(w[T_T, j]))
            term = size / (stretch * stretch)
            if go:
                for r in range(3):
                    term = max(term, abs(w[B + r, j] * w[Z, r]) / stretch)
            w[LARGEST, at] = max(w[LARGEST, at], term)
            largest = max(largest, term)
        for m in range(equal, rank):
            e = i[ROW_OF + m] - 3
            scale = w[LARGEST, i[CONTACT_OF_EDGE + e]] + 1e-4 * largest
            relative = -w[LAMBDA, m] / scale
            if relative > EXACT:
                following &= ~(1 << e)
            violation = max(violation, relative)
    for e in range(edges):
        if taken >> e & 1:
            continue
        total = 0.0
        for j in range(n):
            total += w[EDGES + e, j] * w[G, j]
        relative = -total / size
        if relative > EXACT:
            following |= 1 << e
        violation = max(violation, relative)
    i[NEXT] = following
    return violation


@inlined
def _multipliers(w, i, length):
    """Multipliers of the two balances in the units of the balances."""
    for r in range(3):
        w[NU, r] = 0.0
        w[OMEGA, r] = w[ROOT_SLACK, r] * w[Z, r]
    for m in range(i[EQUAL_RANK]):
        r = i[ROW_OF + m]
        w[NU, r] = w[LAMBDA, m] / length if r == 2 else w[LAMBDA, m]
