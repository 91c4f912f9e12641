"""What every optimiser keeps to, and the two that follow derivatives."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from planning.optimisers import ICEM, MPPI, OPTIMISERS, Gradient, LevenbergMarquardt, Warm
from planning.optimisers.lm import curvature
from tests.planning.optimiser_problems import LeastSquares, kinked, rosenbrock, separable, tracking, walled

ALL = [Gradient(), LevenbergMarquardt(), MPPI(1, 100), MPPI(10, 100), ICEM(10, 10), ICEM(50, 20)]
IDS = ["gradient", "lm", "mppi 1x100", "mppi 10x100", "icem 10x10", "icem 50x20"]
SAMPLERS = ALL[2:]


def run(optimiser, problem, seed=0):
    return optimiser.optimise(problem, problem.start, np.random.default_rng(seed))


def test_every_optimiser_has_its_name():
    assert {
        name: type(o) for name, o in [("gradient", ALL[0]), ("lm", ALL[1]), ("mppi", ALL[2]), ("icem", ALL[4])]
    } == (OPTIMISERS)


@pytest.mark.parametrize("optimiser", ALL, ids=IDS)
@pytest.mark.parametrize("problem", [separable, tracking, rosenbrock, walled, kinked])
def test_the_answer_is_better_than_the_start_is_what_was_evaluated_and_every_query_is_counted(optimiser, problem):
    made = problem()
    found = run(optimiser, made)
    assert found.queries == made.queries
    assert found.value == pytest.approx(made._value(found.z), rel=1e-12)
    assert found.value < made._value(made.start)
    assert found.value == found.curve.min()
    assert np.isfinite(found.curve).all() and np.isfinite(found.z).all()
    assert found.time_s > 0


@pytest.mark.parametrize("optimiser", ALL, ids=IDS)
def test_what_is_not_free_does_not_move(optimiser):
    free = np.ones((40, 3), dtype=bool)
    free[:, 1] = free[7] = False
    made = tracking(free=free)
    found = run(optimiser, made)
    assert (found.z[~free] == made.start[~free]).all()
    assert (found.z[free] != made.start[free]).all()


@pytest.mark.parametrize("optimiser", SAMPLERS, ids=IDS[2:])
def test_the_same_seed_gives_the_same_answer_and_another_one_another(optimiser):
    first, same, other = (run(optimiser, tracking(), seed) for seed in (1, 1, 2))
    assert (first.z == same.z).all() and (first.curve == same.curve).all()
    assert (first.z != other.z).any()


@pytest.mark.parametrize("optimiser", ALL, ids=IDS)
def test_a_start_without_a_finite_loss_is_refused(optimiser):
    made = walled()
    with pytest.raises(ValueError, match="start: expected a finite loss, received inf"):
        optimiser.optimise(made, np.full((6, 1), 1.5), np.random.default_rng(0))
    with pytest.raises(ValueError, match="received nan in step 2, variable 0"):
        optimiser.optimise(made, np.array([[0.0], [0], [np.nan], [0], [0], [0]]), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"shape \(6, 1\), received \(5, 1\)"):
        optimiser.optimise(made, np.zeros((5, 1)), np.random.default_rng(0))


@pytest.mark.parametrize("optimiser", ALL, ids=IDS)
def test_a_horizon_of_one_step_and_a_start_at_the_optimum_are_no_trouble(optimiser):
    found = run(optimiser, separable(K=1, D=2))
    assert np.isfinite(found.value)
    made = separable(K=4, D=2)
    found = optimiser.optimise(made, made.best, np.random.default_rng(0))
    assert found.value <= made._value(made.best)


@pytest.mark.parametrize(
    ("cls", "wrong", "says"),
    [
        (Gradient, {"iterations": 0}, "iterations"),
        (Gradient, {"rate": 0.0}, "rate"),
        (Gradient, {"betas": (0.9, 1.0)}, "betas"),
        (LevenbergMarquardt, {"damping": 0.0}, "damping"),
        (LevenbergMarquardt, {"iterations": 0}, "iterations"),
        (MPPI, {"samples": 2}, "samples"),
        (MPPI, {"temperature": 0.0}, "temperature"),
        (MPPI, {"effective": 1.0}, "effective"),
        (MPPI, {"sigma": (1.0, -1.0)}, "sigma"),
        (ICEM, {"elites": 11, "samples": 20}, "elites"),
        (ICEM, {"decay": 0.9}, "decay"),
        (ICEM, {"momentum": 1.0}, "momentum"),
    ],
)
def test_settings_that_make_no_sense_are_named(cls, wrong, says):
    with pytest.raises(ValueError, match=says):
        cls(**wrong)


# Adam


def test_adam_is_torchs_adam():
    made = rosenbrock()
    at = torch.tensor(made.start, requires_grad=True)
    torchs = torch.optim.Adam([at], lr=0.07, betas=(0.8, 0.99), eps=1e-6)
    expected = []
    for _ in range(60):
        value, slope = made.gradient(at.detach().numpy())
        expected.append(value)
        at.grad = torch.tensor(slope)
        torchs.step()
    found = run(Gradient(iterations=60, rate=0.07, betas=(0.8, 0.99), eps=1e-6), made)
    assert found.curve == pytest.approx(expected, rel=1e-12)
    assert found.value == pytest.approx(min(expected), rel=1e-12)


class WithAdam(LeastSquares):
    """An objective with Adam inside: written down once more, a variable at a time, as a compiled loop would have it."""

    def __init__(self, of):
        super().__init__(of.start, of.residuals, of.jacobian, of.free, of.inside)

    def adam(self, z, iterations, rate, betas, eps):
        self.asked = True
        at, best, least, curve = z.copy(), z.copy(), np.inf, []
        m, v = np.zeros(z.shape), np.zeros(z.shape)
        powers = [1.0, 1.0]
        for _ in range(iterations):
            value, slope = self.gradient(at)
            curve.append(value)
            if value < least:
                least, best = value, at.copy()
            powers = [powers[0] * betas[0], powers[1] * betas[1]]
            for k, i in np.ndindex(z.shape):
                m[k, i] = betas[0] * m[k, i] + (1 - betas[0]) * slope[k, i]
                v[k, i] = betas[1] * v[k, i] + (1 - betas[1]) * slope[k, i] ** 2
                at[k, i] -= rate * (m[k, i] / (1 - powers[0])) / (np.sqrt(v[k, i] / (1 - powers[1])) + eps)
        return best, np.array(curve)


def test_an_objective_with_adam_inside_is_asked_for_it_and_gives_the_same():
    made = WithAdam(tracking())
    inside, outside = run(Gradient(), made), run(Gradient(), tracking())
    assert made.asked
    assert inside.curve == pytest.approx(outside.curve, rel=1e-12)
    assert inside.z == pytest.approx(outside.z, rel=1e-9, abs=1e-9)
    assert inside.queries == outside.queries == 100


def test_behind_a_barrier_adam_halves_its_step_and_the_halvings_are_queries():
    made = walled()
    asked = []
    plain = made.gradient
    made.gradient = lambda z: asked.append(z.copy()) or plain(z)
    found = run(Gradient(rate=3.0, iterations=40), made)
    outside = [i for i, z in enumerate(asked) if (z >= 1).any()]
    assert outside  # it did run into the wall,
    for i in outside:  # stood where it was, and came back by half the way
        assert found.curve[i] == found.curve[i - 1]
        before = max(j for j in range(i) if j not in outside)
        if i + 1 < 40:
            assert asked[i + 1] == pytest.approx(asked[before] + (asked[i] - asked[before]) / 2, rel=1e-12)
    assert len(asked) == found.queries == 40
    assert found.value < 0.2 * made._value(made.start)


# Levenberg–Marquardt


@pytest.mark.parametrize("problem", [separable, tracking])
def test_lm_solves_a_linear_problem_as_numpy_does(problem):
    for seed in range(5):
        made = problem(seed=seed)
        found = run(LevenbergMarquardt(), made)
        assert found.status == "converged" and found.queries <= 6
        assert found.z == pytest.approx(made.best, abs=1e-6)
        assert found.value <= made.least * (1 + 1e-9) + 1e-12


def scipys(made):
    """The least loss by a quasi-Newton method of scipy's from many starts."""
    rng = np.random.default_rng(0)
    starts = [made.start, *(made.start + rng.normal(size=made.start.shape) for _ in range(10))]
    starts = [z for z in starts if made.inside(z)]

    def loss(z):
        value, slope = made.gradient(z.reshape(made.start.shape))
        return (value, slope.ravel()) if np.isfinite(value) else (1e9, np.zeros(z.size))

    return min(minimize(loss, z.ravel(), jac=True, method="L-BFGS-B", options={"ftol": 1e-15}).fun for z in starts)


@pytest.mark.parametrize("problem", [rosenbrock, walled, kinked])
def test_lm_gets_as_low_as_scipy_through_valleys_walls_and_kinks(problem):
    made = problem()
    found = run(LevenbergMarquardt(), made)
    assert found.value <= scipys(made) * (1 + 1e-6) + 1e-9
    assert (np.diff(found.curve) <= 0).all()


def large_residual(K=20, pull=60.0):
    """Positions (10 cos z, 10 sin z) pulled to a point far outside the circle; Gauss–Newton's model is far
    too flat, since the residuals are large. Neighbours are tied. All angles are π/4 at the optimum."""
    ties = np.diff(np.eye(K), axis=0)

    def residuals(z):
        z = z.ravel()
        return np.concatenate([10 * np.cos(z) - pull, 10 * np.sin(z) - pull, ties @ z])

    def jacobian(z):
        z = z.ravel()
        return np.vstack([np.diag(-10 * np.sin(z)), np.diag(10 * np.cos(z)), ties])

    return LeastSquares(np.linspace(0.5, 1.2, K)[:, None], residuals, jacobian)


def test_what_gauss_newton_leaves_out_is_the_exact_hessians_by_central_differences():
    made = large_residual(K=7)
    z = made.start
    rest, asked = curvature(made, z, made.quadratic(z))
    h, exact = 1e-5, []
    for i in range(7):
        step = h * np.eye(7)[i][:, None]
        exact.append((made.gradient(z + step)[1] - made.gradient(z - step)[1]).ravel() / (2 * h))
    exact = np.array(exact)
    J = made.jacobian(z)
    left_out = exact - 2 * J.T @ J
    assert np.abs(left_out).max() > 100
    assert rest.diagonal.ravel() == pytest.approx(np.diag(left_out), rel=1e-4, abs=1e-3)
    assert rest.below.ravel() == pytest.approx(np.diag(left_out, -1), abs=1e-3)
    assert asked == 3


def tied_and_alone(K=8):
    """Two variables a step, (z, u): z is tied to its neighbours by 3 sin Δz and to u by 2 z u, u to nothing else."""
    ahead = np.diff(np.eye(K), axis=0)

    def residuals(z):
        z, u = z.T
        return np.concatenate([3 * np.sin(np.diff(z)), 2 * z * u - 5, np.exp(u) + 2])

    def jacobian(z):
        z, u = z.T
        J = np.zeros((3 * K - 1, K, 2))
        J[: K - 1, :, 0] = 3 * np.cos(np.diff(z))[:, None] * ahead
        J[K - 1 : 2 * K - 1, :, 0], J[K - 1 : 2 * K - 1, :, 1] = 2 * np.diag(u), 2 * np.diag(z)
        J[2 * K - 1 :, :, 1] = np.diag(np.exp(u))
        return J.reshape(3 * K - 1, 2 * K)

    start = np.random.default_rng(4).uniform(0.2, 1.2, (K, 2))
    return LeastSquares(start, residuals, jacobian)


@pytest.mark.parametrize("K", [1, 2, 3, 8])
def test_what_is_tied_to_no_neighbour_is_asked_for_at_all_steps_at_once(K):
    made = tied_and_alone(K)
    z, at = made.start, np.arange(K)
    model = made.quadratic(z)
    rest, asked = curvature(made, z, model)
    assert asked == min(K, 3) + 1
    h, exact = 1e-5, np.zeros((K, 2, K, 2))
    for k, i in np.ndindex(K, 2):
        step = np.zeros((K, 2))
        step[k, i] = h
        exact[k, i] = (made.gradient(z + step)[1] - made.gradient(z - step)[1]) / (2 * h)
    assert (model.diagonal + rest.diagonal) == pytest.approx(exact[at, :, at, :], rel=1e-3, abs=1e-2)
    assert (model.below + rest.below) == pytest.approx(exact[at[1:], :, at[:-1], :], rel=1e-3, abs=1e-2)
    assert np.abs(rest.diagonal).max() > 1


def test_what_is_not_free_is_not_asked_for():
    made = tied_and_alone()
    made.free[:, 1] = False
    assert curvature(made, made.start, made.quadratic(made.start))[1] == 3
    made.free[:] = [False, True]
    assert curvature(made, made.start, made.quadratic(made.start))[1] == 1


@pytest.mark.parametrize("missing", [0.6, 0.8, 0.95])
def test_in_a_valley_the_damping_becomes_the_curvature_that_gauss_newton_lacks(missing):
    """Σ z² + (c + b z²)² curves as 2 + 4 b c at its optimum, zero, of which Gauss–Newton sees 2: λ is to be 2 b c."""
    K, c = 5, 3.0
    b = missing / (2 * c)
    made = LeastSquares(
        np.linspace(0.02, 0.1, K)[:, None],
        lambda z: np.concatenate([z.ravel(), c + b * z.ravel() ** 2]),
        lambda z: np.vstack([np.eye(K), np.diag(2 * b * z.ravel())]),
    )
    warm = Warm()
    found = run(LevenbergMarquardt(exact=False, warm=warm, loss_tolerance=1e-12), made)
    assert found.z == pytest.approx(np.zeros((K, 1)), abs=1e-5)
    assert warm.damping == pytest.approx(missing, rel=0.05)
    assert found.queries <= 8


def test_with_large_residuals_the_curvature_saves_trials_and_both_arrive():
    made = large_residual()
    exact, plain = (run(LevenbergMarquardt(exact=on, iterations=500), made) for on in (True, False))
    for found in (exact, plain):
        assert found.z == pytest.approx(np.full((20, 1), np.pi / 4), abs=1e-3)
    assert len(exact.curve) < 0.5 * len(plain.curve)


def test_lm_says_that_its_trials_are_spent_and_keeps_to_them():
    found = run(LevenbergMarquardt(iterations=5, exact=False), rosenbrock())
    assert (found.status, found.queries, len(found.curve)) == ("iterations", 5, 5)


def test_a_descent_that_every_trial_refuses_has_stalled():
    made = tracking()
    start = made._value(made.start)
    honest = made.quadratic
    made.quadratic = lambda z: dataclasses.replace(honest(z), value=start + np.abs(z).max())
    found = run(LevenbergMarquardt(), made)
    assert found.status == "stalled"
    assert (found.z == made.start).all()


def test_a_warm_start_keeps_the_damping_and_does_not_change_the_answer():
    warm = Warm()
    first = run(LevenbergMarquardt(warm=warm), rosenbrock())
    assert warm.damping is not None and warm.damping < 1e-3
    made = rosenbrock()
    again = LevenbergMarquardt(warm=warm).optimise(made, first.z + 0.01, np.random.default_rng(0))
    assert again.status == "converged"
    assert again.z == pytest.approx(np.ones((12, 1)), abs=1e-5)


def test_a_warm_start_need_not_ask_for_the_curvature_again():
    made, warm = large_residual(), Warm()
    run(LevenbergMarquardt(warm=warm), made)
    assert warm.curvature is not None
    start = np.full((20, 1), np.pi / 4) + np.linspace(-0.02, 0.02, 20)[:, None]
    again, cold = (LevenbergMarquardt(warm=w).optimise(made, start, np.random.default_rng(0)) for w in (warm, None))
    assert again.value == pytest.approx(cold.value, rel=1e-6)
    assert again.queries == len(again.curve) < cold.queries


def test_damping_that_was_handed_on_a_hundred_times_still_answers_to_a_refusal():
    warm = Warm()
    for seed in range(100):
        run(LevenbergMarquardt(warm=warm), separable(seed=seed))
    found = run(LevenbergMarquardt(warm=warm), walled())
    assert found.status == "converged"
    assert found.value == pytest.approx(run(LevenbergMarquardt(), walled()).value, rel=1e-6)
