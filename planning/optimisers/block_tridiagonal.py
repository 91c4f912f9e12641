"""Symmetric positive definite systems of K blocks of D whose neighbours only are coupled: Cholesky in O(K D³).

The matrix is H = [D₀ B₀ᵀ; B₀ D₁ B₁ᵀ; …] with ``diagonal`` (K, D, D) and ``below`` (K−1, D, D), the block of row k+1 and
column k. Only the lower triangles of the diagonal blocks are read.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mechanics.readings import Array


def solve(diagonal: Array, below: Array, rhs: Array) -> Array:
    """Return x (K, D) with H x = ``rhs`` (K, D). Raises numpy's LinAlgError where H is not positive definite."""
    diagonal, below, rhs = _checked(diagonal, below, rhs)
    x = np.empty_like(rhs)
    zero = np.zeros_like(rhs)
    if not damped_solve(diagonal, below, rhs, np.ones(rhs.shape, dtype=np.bool_), zero, x):
        raise np.linalg.LinAlgError("block_tridiagonal.solve: the matrix is not positive definite")
    return x


def _checked(diagonal: Array, below: Array, rhs: Array) -> tuple[Array, Array, Array]:
    diagonal, below, rhs = (np.ascontiguousarray(a, dtype=np.float64) for a in (diagonal, below, rhs))
    K, D = rhs.shape
    for name, array, shape in (("diagonal", diagonal, (K, D, D)), ("below", below, (K - 1, D, D))):
        if array.shape != shape:
            raise ValueError(f"block_tridiagonal.solve: {name}: expected shape {shape}, received {array.shape}")
    return diagonal, below, rhs


@njit(cache=True, fastmath=False, error_model="numpy")
def damped_solve(diagonal, below, rhs, free, damping, x):
    """Write into ``x`` what solves (H + diag(``damping``)) x = ``rhs`` in the ``free`` variables, and 0 for the others.

    Arrays (K, D) but for the blocks. Return whether the matrix is positive definite; ``x`` means nothing where not.
    Rows of ``below`` that are zero, variables that no neighbour is tied to, cost nothing.
    """
    K, D = rhs.shape
    L = np.empty((K, D, D))  # Cholesky factor: its diagonal blocks, with 1 / L_ii on the diagonal,
    M = np.empty((max(K - 1, 0), D, D))  # and those below, M_k = B_k L_k⁻ᵀ
    index, count = np.empty((K, D), np.int64), np.zeros(K, np.int64)  # the free variables of a step, and how many
    rows, tied = np.empty((K, D), np.int64), np.zeros(K, np.int64)  # where in `index` M's rows are that are not zero
    for k in range(K):
        for i in range(D):
            x[k, i] = 0.0
            if free[k, i]:
                index[k, count[k]] = i
                count[k] += 1
    for k in range(K):
        n, before = count[k], count[k - 1] if k > 0 else 0
        for a in range(n):
            for b in range(a + 1):
                L[k, a, b] = diagonal[k, index[k, a], index[k, b]]
        if k > 0:
            for p in range(tied[k]):
                a = rows[k, p]
                for q in range(p + 1):
                    b = rows[k, q]
                    for c in range(before):
                        L[k, a, b] -= M[k - 1, a, c] * M[k - 1, b, c]
        for a in range(n):
            i = index[k, a]
            y = rhs[k, i]
            for b in range(a):
                entry = L[k, a, b]
                for c in range(b):
                    entry -= L[k, a, c] * L[k, b, c]
                L[k, a, b] = entry * L[k, b, b]
                y -= L[k, a, b] * x[k, index[k, b]]
            entry = L[k, a, a] + damping[k, i]
            for c in range(a):
                entry -= L[k, a, c] * L[k, a, c]
            if not entry > 1e-15 * abs(diagonal[k, i, i]):  # what is left of a singular matrix is rounding
                return False
            L[k, a, a] = 1.0 / np.sqrt(entry)
            # forward: L y = rhs
            x[k, i] = (y + x[k, i]) * L[k, a, a]
        if k == K - 1:
            break
        for a in range(count[k + 1]):
            i, some = index[k + 1, a], False
            for b in range(n):
                entry = below[k, i, index[k, b]]
                some = some or entry != 0.0
                M[k, a, b] = entry
            if not some:
                continue
            rows[k + 1, tied[k + 1]] = a
            tied[k + 1] += 1
            for b in range(n):
                entry = M[k, a, b]
                for c in range(b):
                    entry -= M[k, a, c] * L[k, b, c]
                M[k, a, b] = entry * L[k, b, b]
                x[k + 1, i] -= M[k, a, b] * x[k, index[k, b]]
    # backward: Lᵀ x = y
    for k in range(K - 1, -1, -1):
        for a in range(count[k] - 1, -1, -1):
            i = index[k, a]
            y = x[k, i]
            if k < K - 1:
                for p in range(tied[k + 1]):
                    c = rows[k + 1, p]
                    y -= M[k, c, a] * x[k + 1, index[k + 1, c]]
            for c in range(a + 1, count[k]):
                y -= L[k, c, a] * x[k, index[k, c]]
            x[k, i] = y * L[k, a, a]
    return True
