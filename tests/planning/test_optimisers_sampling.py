"""MPPI and iCEM: their noise, weights, budgets, and what theory and their reference implementations say.

The figures named "reference" come from runs of pytorch_mppi 0.9.1 and of the code published with the iCEM paper on the
problems of this file, with the settings given here: means and standard errors over seeds.
"""

import numpy as np
import pytest
from scipy.stats import truncnorm

from planning.optimisers import ICEM, MPPI, Elites
from planning.optimisers.mppi import weights
from planning.optimisers.noise import coloured
from tests.planning.optimiser_problems import LeastSquares, linear, separable, tracking, walled


def run(optimiser, problem, seed=0):
    return optimiser.optimise(problem, problem.start, np.random.default_rng(seed))


def watched(problem):
    """The problem, and a list that gets every batch that it is asked for."""
    batches, plain = [], problem.values

    def values(z):
        batches.append(z.copy())
        return plain(z)

    problem.values = values
    return problem, batches


# noise


@pytest.mark.parametrize("beta", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("steps", [16, 17])
def test_noise_has_the_power_of_its_colour_at_every_frequency(beta, steps):
    noise = coloured(np.random.default_rng(0), (4000, steps, 2), beta)
    power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean(axis=(0, 2))
    f = np.fft.rfftfreq(steps)
    f[0] = f[1]
    assert power / power[1] == pytest.approx((f / f[1]) ** -beta, rel=0.1)
    assert (noise - noise.mean(axis=1, keepdims=True)).var() == pytest.approx(1 - (beta == 0) / steps, rel=0.03)
    assert np.abs(noise.mean(axis=0)).max() < 0.1
    assert abs(np.mean(noise[..., 0] * noise[..., 1])) < 0.05


def test_noise_of_one_step_is_white():
    noise = coloured(np.random.default_rng(0), (10000, 1, 1), 3.0)
    assert noise.std() == pytest.approx(1.0, abs=0.03)


# weights


def test_weights_are_the_softmin_and_infinite_losses_weigh_nothing():
    losses = np.array([3.0, 1.0, np.inf, 2.0])
    expected = np.exp([-1.5, -0.5, -np.inf, -1.0])
    assert weights(losses, 2.0, 0.1) == pytest.approx(expected / expected.sum(), rel=1e-12)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e6, 0.0), (1e-9, 0.0), (1.0, 1e5)])
def test_an_adapted_temperature_keeps_the_effective_share_whatever_the_losses_unit(scale, offset):
    losses = np.append(np.random.default_rng(0).gamma(2.0, size=200), np.inf) * scale + offset
    omega = weights(losses, None, 0.1)
    assert 1 / np.sum(omega**2) == pytest.approx(20.0, rel=1e-3)
    assert omega[-1] == 0.0


def test_tied_losses_weigh_the_same():
    assert weights(np.full(8, 3.0), None, 0.1) == pytest.approx(np.full(8, 1 / 8))


# MPPI


def last_mean(optimiser, problem, seed=0):
    """Where the mean ends: the last query of all."""
    problem, batches = watched(problem)
    run(optimiser, problem, seed)
    return batches[-1][0]


@pytest.mark.parametrize("temperature", [0.5, 2.0])
def test_with_many_samples_the_mean_is_that_of_the_product_of_two_gaussians(temperature):
    """exp(−a (z − m)²/λ) times the density of the samples, N(u, σ²), is a Gaussian whose mean is known."""
    a, m, u, sigma = np.array([0.5, 2.0]), np.array([1.5, 3.5]), np.array([2.0, 2.0]), np.array([0.8, 1.5])
    problem = linear(np.diag(np.sqrt(a)), np.sqrt(a) * m, u[None])
    optimiser = MPPI(1, 40_000, sigma=tuple(sigma), beta=0.0, temperature=temperature, elite=False, shrink=1.0)
    expected = (u / sigma**2 + 2 * a * m / temperature) / (1 / sigma**2 + 2 * a / temperature)
    assert last_mean(optimiser, problem)[0] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(("temperature", "reference", "error"), [(0.5, 0.932, 0.058), (2.0, 1.346, 0.035)])
def test_one_iteration_gives_the_loss_that_pytorch_mppi_gives(temperature, reference, error):
    """1 × 1000 samples, σ = 1, white, from zero, where its noise cost vanishes; 30 seeds."""
    optimiser = MPPI(1, 1000, sigma=1.0, beta=0.0, temperature=temperature, elite=False, shrink=1.0)
    losses = []
    for seed in range(30):
        problem = separable(K=5, D=2)
        losses.append(problem._value(last_mean(optimiser, problem, seed)))
    assert np.mean(losses) == pytest.approx(reference, abs=4 * np.hypot(error, np.std(losses) / np.sqrt(29)))


def test_where_losses_tie_the_mean_stays_and_a_signed_cost_of_the_noise_would_move_it():
    """The trap of pytorch_mppi's pull request 3: with λ uᵀΣ⁻¹ε in the loss, ties are broken toward one side."""
    level = LeastSquares(np.full((3, 2), 5.0), lambda z: np.ones(1), lambda z: np.zeros((1, 6)))
    moved, signed = [], []
    for seed in range(100):
        problem, batches = watched(level)
        run(MPPI(1, 100, sigma=1.0, beta=0.0, temperature=1.0, elite=False, shrink=1.0), problem, seed)
        moved.append((batches[-1][0] - level.start).ravel())
        noise = (batches[-2][1:] - level.start).reshape(98, 6)
        omega = weights(noise @ level.start.ravel(), 1.0, 0.1)
        signed.append(omega @ noise)
    for shifts, still in ((np.array(moved), True), (np.array(signed), False)):
        error = shifts.std() / np.sqrt(shifts.size)
        assert bool(abs(shifts.mean()) < 4 * error) == still


def test_the_paths_of_pytorch_mppi_bias_toward_zero_are_not_ours():
    """The same task, moved by 5: the reference ends at 11.4 ± 0.5 instead of 1.5 ± 0.1, ours at the same."""
    optimiser = MPPI(10, 100, sigma=1.0, beta=0.0, temperature=0.5, elite=False, shrink=1.0)
    here, there = (run(optimiser, separable(K=5, D=2, offset=offset)).value for offset in (0.0, 5.0))
    assert here == pytest.approx(there, rel=1e-9)


@pytest.mark.parametrize(("iterations", "batches"), [(1, [99, 1]), (10, [100] * 9 + [99, 1])])
def test_mppis_samples_come_in_one_batch_per_iteration_and_the_last_mean_alone(iterations, batches):
    problem = tracking()
    found = run(MPPI(iterations, 100, sigma=1.0), problem)
    assert problem.batches == batches
    assert found.queries == 100 * iterations
    assert len(found.curve) == iterations and (np.diff(found.curve) <= 0).all()


def test_a_spread_draws_a_scale_for_each_sample():
    problem, batches = watched(tracking(K=400, D=1))
    run(MPPI(1, 3000, sigma=1.0, beta=0.0, spread=20.0), problem)
    scale = np.log(batches[0][1:].std(axis=(1, 2)))
    assert (scale.min(), scale.mean(), scale.max()) == pytest.approx((-np.log(20), -np.log(20) / 2, 0.0), abs=0.12)


def test_sigma_is_one_for_each_variable():
    problem, batches = watched(tracking())
    run(MPPI(1, 2000, sigma=(2.0, 0.5, 0.0), beta=0.0), problem)
    assert batches[0][1:].std(axis=(0, 1)) == pytest.approx([2.0, 0.5, 0.0], rel=0.02)


# iCEM


def test_one_fit_is_the_truncated_gaussian_of_the_elites():
    """The best tenth of N(0, 1) under (z − 0.4)² lies within r of 0.4; momentum keeps a tenth of what was."""
    problem, batches = watched(linear(np.eye(1), np.array([0.4]), np.zeros((1, 1))))
    run(ICEM(2, 20_000, sigma=1.0, elites=2000, decay=1.0, momentum=0.1), problem)
    r = 0.13612  # P(|z − 0.4| < r) = 0.1
    elite = truncnorm(0.4 - r, 0.4 + r)
    assert np.mean(np.abs(batches[0] - 0.4) < r) == pytest.approx(0.1, abs=0.01)
    assert batches[1][0, 0, 0] == pytest.approx(0.9 * elite.mean(), abs=0.01)  # the last batch starts with the mean
    assert batches[1].std() == pytest.approx(0.9 * elite.std() + 0.1, abs=0.01)


REFERENCE = [
    (tracking, 3.0, 10, 100, 0.219, 0.0065),
    (tracking, 3.0, 50, 20, 0.228, 0.0065),
    (separable, 0.0, 10, 100, 2.06, 0.11),
    (separable, 0.0, 50, 20, 1.85, 0.095),
]


@pytest.mark.parametrize(("problem", "beta", "iterations", "samples", "reference", "error"), REFERENCE)
def test_with_the_references_settings_the_losses_are_the_references(
    problem, beta, iterations, samples, reference, error
):
    """10 elites, decay 1.25, momentum 0.1, reuse 0.3, first deviation 1."""
    optimiser = ICEM(iterations, samples, sigma=1.0, elites=10, decay=1.25, beta=beta)
    losses = [run(optimiser, problem(), seed).value for seed in range(20)]
    assert np.mean(losses) == pytest.approx(reference, abs=4 * np.hypot(error, np.std(losses) / np.sqrt(19)))


@pytest.mark.parametrize(("iterations", "samples"), [(10, 10), (50, 20)])
def test_the_papers_budgets_are_spent_exactly_in_batches_that_do_not_shrink(iterations, samples):
    problem = tracking()
    found = run(ICEM(iterations, samples, sigma=1.0), problem)
    assert problem.batches == [samples] * iterations
    assert found.queries == iterations * samples


def test_few_samples_have_two_elites_and_many_shrink_as_in_the_reference():
    assert ICEM(10, 10).elite_count == 2
    assert ICEM(50, 20).elite_count == 10
    assert ICEM(3, 40).sizes == [40, 32, 25]
    assert ICEM(10, 100).sizes == [100, 80, 64, 51, 40, 32, 25, 20, 20, 20]
    assert ICEM(10, 100).elite_count == 10


def test_elites_are_handed_on_shifted_and_no_worse():
    warm = Elites()
    first = run(ICEM(10, 40, sigma=1.0, warm=warm), tracking())
    assert warm.z is not None
    problem, batches = watched(tracking())
    again = run(ICEM(10, 40, sigma=1.0, warm=warm), problem, seed=1)
    kept = len(warm.z)
    assert batches[0][1][:-1] == pytest.approx(first.z[1:])
    assert kept == 3 and (batches[0][0] == problem.start).all()
    assert again.value < 1.2 * first.value


def test_elites_of_another_horizon_are_refused():
    with pytest.raises(ValueError, match=r"warm: expected elites of shape \(40, 3\)"):
        run(ICEM(warm=Elites(np.zeros((3, 30, 3)))), tracking())


# both


@pytest.mark.parametrize(
    "optimiser",
    [MPPI(10, 100, sigma=1.0), ICEM(50, 20, sigma=1.0), ICEM(10, 10, sigma=1.0)],
    ids=["mppi", "icem", "icem 10"],
)
def test_samples_behind_a_wall_weigh_nothing(optimiser):
    """From beside the wall half of the samples are lost."""
    problem = walled(K=1)
    found = optimiser.optimise(problem, np.full((1, 1), 0.5), np.random.default_rng(0))
    assert found.value < problem._value(np.full((1, 1), 0.5))
    assert (found.z < 1).all()


@pytest.mark.parametrize("optimiser", [MPPI(10, 100, sigma=1.0), ICEM(10, 10, sigma=1.0)], ids=["mppi", "icem"])
def test_where_every_sample_is_lost_the_start_is_the_answer(optimiser):
    problem = separable()
    problem.inside = lambda z: bool((z == problem.start).all())
    found = run(optimiser, problem)
    assert (found.z == problem.start).all()
    assert found.value == problem._value(problem.start)
