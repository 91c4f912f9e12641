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


@njit(cache=True, fastmath=False)
def damped_solve(diagonal, below, rhs, free, damping, x):
    """Write into ``x`` what solves (H + diag(``damping``)) x = ``rhs`` in the ``free`` variables, and 0 for the others.

    Arrays (K, D) but for the blocks. Return whether the matrix is positive definite; ``x`` means nothing where not.
    """
    K, D = rhs.shape
    L = np.zeros((K, D, D))  # Cholesky factor: its diagonal blocks,
    M = np.zeros((max(K - 1, 0), D, D))  # and those below, M_k = B_k L_k⁻ᵀ
    for k in range(K):
        for i in range(D):
            if not free[k, i]:
                # a row of the identity: the variable stays where it is
                L[k, i, i] = 1.0
                x[k, i] = 0.0
                continue
            y = rhs[k, i]
            for j in range(i + 1):
                if not free[k, j]:
                    continue
                entry = diagonal[k, i, j]
                if k > 0:
                    for c in range(D):
                        entry -= M[k - 1, i, c] * M[k - 1, j, c]
                for c in range(j):
                    entry -= L[k, i, c] * L[k, j, c]
                if i == j:
                    entry += damping[k, i]
                    if not entry > 1e-15 * abs(diagonal[k, i, i]):  # what is left of a singular matrix is rounding
                        return False
                    L[k, i, i] = np.sqrt(entry)
                else:
                    L[k, i, j] = entry / L[k, j, j]
            # forward: L y = rhs
            if k > 0:
                for c in range(D):
                    y -= M[k - 1, i, c] * x[k - 1, c]
            for c in range(i):
                y -= L[k, i, c] * x[k, c]
            x[k, i] = y / L[k, i, i]
        if k < K - 1:
            for i in range(D):
                if not free[k + 1, i]:
                    continue
                for j in range(D):
                    if not free[k, j]:
                        continue
                    entry = below[k, i, j]
                    for c in range(j):
                        entry -= M[k, i, c] * L[k, j, c]
                    M[k, i, j] = entry / L[k, j, j]
    # backward: Lᵀ x = y
    for k in range(K - 1, -1, -1):
        for i in range(D - 1, -1, -1):
            if not free[k, i]:
                continue
            y = x[k, i]
            if k < K - 1:
                for c in range(D):
                    y -= M[k, c, i] * x[k + 1, c]
            for c in range(i + 1, D):
                y -= L[k, c, i] * x[k, c]
            x[k, i] = y / L[k, i, i]
    return True
