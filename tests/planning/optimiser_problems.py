"""Small problems with known optima for the tests of the optimisers: least squares, their Jacobians written down."""

import numpy as np

from planning.optimisers import Quadratic


class LeastSquares:
    """An objective Σ r² from ``residuals(z) -> (R,)`` and ``jacobian(z) -> (R, K D)``; counts what it is asked for."""

    best: np.ndarray  # the optimum and its loss, where they are known
    least: float

    def __init__(self, start, residuals, jacobian, free=None, inside=lambda z: True):
        self.start = np.asarray(start, dtype=float)
        self.free = np.ones(self.start.shape, dtype=bool) if free is None else free
        self.residuals, self.jacobian, self.inside = residuals, jacobian, inside
        self.queries, self.batches = 0, []

    def _value(self, z):
        return float(np.sum(self.residuals(z) ** 2)) if self.inside(z) else np.inf

    def values(self, z):
        self.queries += len(z)
        self.batches.append(len(z))
        return np.array([self._value(one) for one in z])

    def _model(self, z):
        self.queries += 1
        if not self.inside(z):
            return np.inf, np.full(z.shape, np.nan), np.full((z.size, z.size), np.nan)
        r, J = self.residuals(z), self.jacobian(z) * self.free.ravel()
        return float(r @ r), (2 * J.T @ r).reshape(z.shape), 2 * J.T @ J

    def gradient(self, z):
        return self._model(z)[:2]

    def quadratic(self, z):
        value, gradient, H = self._model(z)
        K, D = z.shape
        H = H.reshape(K, D, K, D)
        diagonal = np.stack([H[k, :, k] for k in range(K)])
        below = np.array([H[k + 1, :, k] for k in range(K - 1)]).reshape(K - 1, D, D)
        return Quadratic(value, gradient, diagonal, below)


def linear(A, b, start, free=None):
    """Σ (A z − b)² and its least-squares optimum over the free variables, by numpy's own solver."""
    problem = LeastSquares(start, lambda z: A @ z.ravel() - b, lambda z: A, free)
    chosen = problem.free.ravel()
    best = problem.start.ravel().copy()
    best[chosen] = np.linalg.lstsq(A[:, chosen], b - A[:, ~chosen] @ best[~chosen], rcond=None)[0]
    problem.best = best.reshape(problem.start.shape)
    problem.least = float(np.sum((A @ best - b) ** 2))
    return problem


def separable(K=10, D=3, seed=0, offset=0.0):
    """Σ a (z − target)²: every variable on its own, curvatures 0.3 to 3, targets about 1 from the start."""
    rng = np.random.default_rng(seed)
    target, root = offset + rng.normal(size=(K, D)), np.sqrt(np.exp(rng.uniform(np.log(0.3), np.log(3), (K, D))))
    return linear(np.diag(root.ravel()), (root * target).ravel(), np.full((K, D), offset))


def tracking(K=40, D=3, seed=0, smooth=3.0, free=None):
    """Follow a smooth path (1/K) Σ |z − path|², and be smooth, ``smooth``/(K − 1) Σ |Δz|². Start at zero."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, K)[:, None]
    path = rng.normal(size=D) + rng.normal(size=D) * s + rng.normal(size=D) * np.sin(np.pi * s)
    difference = np.diff(np.eye(K), axis=0) * np.sqrt(smooth / (K - 1))
    A = np.vstack([np.kron(np.eye(K), np.eye(D)) / np.sqrt(K), np.kron(difference, np.eye(D))])
    b = np.concatenate([path.ravel() / np.sqrt(K), np.zeros((K - 1) * D)])
    return linear(A, b, np.zeros((K, D)), free)


def rosenbrock(K=12):
    """Rosenbrock's valley as a chain, Σ 100 (z_{k+1} − z_k²)² + (1 − z_k)²: zero where all are one."""

    def residuals(z):
        z = z[:, 0]
        return np.concatenate([10 * (z[1:] - z[:-1] ** 2), 1 - z])

    def jacobian(z):
        J = np.zeros((2 * K - 1, K))
        rows = np.arange(K - 1)
        J[rows, rows + 1], J[rows, rows] = 10.0, -20.0 * z[:-1, 0]
        J[K - 1 :] = -np.eye(K)
        return J

    return LeastSquares(np.full((K, 1), -0.5), residuals, jacobian)


def walled(K=6):
    """Σ (z − 2)² + 1e-2 log²(1 − z), infinite from 1 on: the pull is into the wall."""

    def residuals(z):
        z = z.ravel()
        return np.concatenate([z - 2, 0.1 * np.log(1 - z)])

    def jacobian(z):
        z = z.ravel()
        return np.vstack([np.eye(K), np.diag(-0.1 / (1 - z))])

    return LeastSquares(np.full((K, 1), -3.0), residuals, jacobian, inside=lambda z: bool((z < 1).all()))


def kinked(K=8):
    """Σ (z_k − 1)² + 9 max(−z_k, 0)² + (|z_{k+1} − z_k|)²…, gradients that jump at z = 0 and between neighbours."""
    slope = np.where(np.arange(K) % 2 == 0, 1.0, 4.0)

    def residuals(z):
        z = z.ravel()
        hinge = np.where(z > 0, z, slope * z)
        return np.concatenate([hinge - 0.3 * (-1.0) ** np.arange(K), 0.5 * np.diff(z)])

    def jacobian(z):
        z = z.ravel()
        return np.vstack([np.diag(np.where(z > 0, 1.0, slope)), 0.5 * np.diff(np.eye(K), axis=0)])

    return LeastSquares(np.full((K, 1), 2.0), residuals, jacobian)
