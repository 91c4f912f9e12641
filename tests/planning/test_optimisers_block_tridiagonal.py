"""Block tridiagonal systems, against scipy's banded Cholesky and numpy's dense solver."""

import numpy as np
import pytest
from scipy.linalg import solveh_banded

from planning.optimisers import block_tridiagonal


def dense(diagonal, below):
    K, D = diagonal.shape[:2]
    H = np.zeros((K, D, K, D))
    for k in range(K):
        H[k, :, k] = diagonal[k]
    for k in range(K - 1):
        H[k + 1, :, k], H[k, :, k + 1] = below[k], below[k].T
    return H.reshape(K * D, K * D)


def random_system(rng, K, D, conditioning=1.0):
    """A positive definite one: JᵀJ of rows that couple neighbours, plus a little."""
    J = rng.normal(size=(K, 2 * D + 1, 2 * D)) * np.exp(conditioning * rng.normal(size=2 * D))
    square = np.swapaxes(J, 1, 2) @ J
    diagonal, below = np.zeros((K, D, D)), np.zeros((K - 1, D, D))
    for k in range(K):
        diagonal[k] += square[k, :D, :D] + 1e-3 * np.eye(D)
        if k + 1 < K:
            diagonal[k + 1] += square[k, D:, D:]
            below[k] = square[k, D:, :D]
    return diagonal, below, rng.normal(size=(K, D))


@pytest.mark.parametrize(("K", "D"), [(1, 5), (2, 3), (7, 1), (40, 5), (200, 5)])
def test_solutions_are_those_of_scipys_banded_cholesky(K, D):
    for seed in range(5):
        diagonal, below, rhs = random_system(np.random.default_rng(seed), K, D)
        H = dense(diagonal, below)
        bands = np.zeros((2 * D, K * D))
        for offset in range(min(2 * D, K * D)):
            bands[offset, : K * D - offset] = np.diagonal(H, -offset)
        expected = solveh_banded(bands, rhs.ravel(), lower=True).reshape(K, D)
        assert block_tridiagonal.solve(diagonal, below, rhs) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_damping_and_fixed_variables_are_those_of_the_dense_system_without_them():
    rng = np.random.default_rng(3)
    for _ in range(20):
        K, D = int(rng.integers(1, 12)), int(rng.integers(1, 6))
        diagonal, below, rhs = random_system(rng, K, D)
        free, damping = rng.random((K, D)) < 0.7, rng.random((K, D))
        x = np.full((K, D), np.nan)
        assert block_tridiagonal.damped_solve(diagonal, below, rhs, free, damping, x)
        chosen = free.ravel()
        H = (dense(diagonal, below) + np.diag(damping.ravel()))[np.ix_(chosen, chosen)]
        assert x[free] == pytest.approx(np.linalg.solve(H, rhs[free]), rel=1e-9, abs=1e-9)
        assert (x[~free] == 0).all()


def test_what_stands_above_the_diagonal_is_not_read():
    diagonal, below, rhs = random_system(np.random.default_rng(0), 6, 4)
    expected = block_tridiagonal.solve(diagonal, below, rhs)
    assert (block_tridiagonal.solve(np.tril(diagonal), below, rhs) == expected).all()


@pytest.mark.parametrize("broken", ["negative", "singular", "nan"])
def test_a_matrix_that_is_not_positive_definite_is_refused(broken):
    diagonal, below, rhs = random_system(np.random.default_rng(1), 5, 3)
    if broken == "negative":
        diagonal[3, 1, 1] = -1.0
    elif broken == "singular":  # rank one, on its own
        diagonal[4], below[3] = np.ones((3, 3)) / 3, 0.0
    else:
        diagonal[2, 0, 0] = np.nan
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        block_tridiagonal.solve(diagonal, below, rhs)


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"below: expected shape \(4, 2, 2\), received \(5, 2, 2\)"):
        block_tridiagonal.solve(np.zeros((5, 2, 2)), np.zeros((5, 2, 2)), np.zeros((5, 2)))
