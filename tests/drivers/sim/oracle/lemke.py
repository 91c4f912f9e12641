"""Lemke's algorithm for linear complementarity problems: w = M z + q, w ≥ 0, z ≥ 0, w · z = 0.

Cottle, Pang, Stone: The Linear Complementarity Problem, algorithm 4.4.5, with the lexicographic ratio test of section
4.9, which cannot cycle: contacts that just touch make every problem degenerate.
"""

from __future__ import annotations

import numpy as np

#: entries smaller than this share of the problem's scale are zero to the pivoting
TINY = 1e-11


class RayTermination(ArithmeticError):
    """The algorithm left along a ray: there is no solution, or M is of a class that Lemke cannot process."""


def lemke(M: np.ndarray, q: np.ndarray, max_pivots: int = 500) -> np.ndarray:
    """Return z (n,) of the problem LCP(q, M), M (n, n). Raises RayTermination."""
    n = len(q)
    # what rounding has left of a zero must not start the pivoting
    q = np.where(np.abs(q) <= TINY * np.abs(q).max(initial=0.0), 0.0, q)
    if n == 0 or q.min() >= 0:
        return np.zeros(n)
    # w − M z − e z0 = q; columns: w (n, its block stays B⁻¹), z (n), z0, right-hand side
    T = np.hstack([np.eye(n), -M, -np.ones((n, 1)), q[:, None]])
    basis = list(range(n))
    artificial = 2 * n
    # lexicographically least (q, I): z0 comes in for it
    least = np.flatnonzero(q <= q.min() + TINY * np.abs(q).max())
    row = int(least[-1])
    entering = artificial
    for _ in range(max_pivots):
        leaving = basis[row]
        T[row] /= T[row, entering]
        column = T[:, entering].copy()
        column[row] = 0.0
        T -= np.outer(column, T[row])
        T[:, entering] = 0.0
        T[row, entering] = 1.0
        basis[row] = entering
        if leaving == artificial:
            z = np.zeros(2 * n + 1)
            z[basis] = T[:, -1]
            return np.maximum(z[n : 2 * n], 0.0)
        entering = leaving + n if leaving < n else leaving - n
        row = _blocking(T, entering, basis, artificial, n)
    raise RayTermination(f"no solution after {max_pivots} pivots")


def _blocking(T: np.ndarray, entering: int, basis: list[int], artificial: int, n: int) -> int:
    """The row whose ratio is lexicographically least; z0's where it ties on the right-hand side alone."""
    column = T[:, entering]
    rows = np.flatnonzero(column > TINY * max(1.0, np.abs(column).max()))
    if not rows.size:
        raise RayTermination("a secondary ray: nothing blocks the entering variable")
    ratios = T[rows, -1] / column[rows]
    tied = rows[ratios <= ratios.min() + TINY * (1.0 + np.abs(ratios.min()))]
    for row in tied:
        if basis[row] == artificial:
            return int(row)
    for j in range(n):
        if tied.size == 1:
            break
        ratios = T[tied, j] / column[tied]
        tied = tied[ratios <= ratios.min() + TINY * (1.0 + np.abs(ratios.min()))]
    return int(tied[0])
