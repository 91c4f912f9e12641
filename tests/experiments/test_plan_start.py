"""Where an optimiser sets out: off the nominal trajectory by as much as asked, and all of them from the same start."""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import numpy as np
import pytest

from experiments import registries, setup
from experiments.calibrate.store import Calibrations
from experiments.check import check
from experiments.files import Resolved, load
from experiments.planning.make import make, objective, task
from experiments.planning.schema import PlanStage
from experiments.planning.start import NoStart, disturbed
from experiments.table import jobs
from experiments.table.jobs import Options
from mechanics.yaml_input import InputError
from planning.optimisers.base import Objective, Optimum
from planning.optimisers.noise import coloured
from planning.problem import Limits, Problem

STEPS = ("stages.0.parameters.steps=12",)
#: a start off the nominal trajectory
OFF = (*STEPS, "stages.0.start.sigma=0.5")


def pivoting(*sets: str) -> tuple[Resolved, PlanStage, Problem]:
    resolved = load("extrinsic_pivoting", None, sets)
    stage = resolved.experiment.stages[0]
    assert isinstance(stage, PlanStage)
    return resolved, stage, task(resolved, stage, setup.believed(resolved, Calibrations())).problem


@pytest.fixture(scope="module")
def problem() -> Problem:
    return pivoting(*STEPS)[2]


@pytest.fixture
def seen(monkeypatch):
    """Where optimisers set out, and the next of their random numbers."""
    found: dict[str, tuple[np.ndarray, float]] = {}

    def spy(name):
        def optimise(_self, objective: Objective, z: np.ndarray, rng: np.random.Generator) -> Optimum:
            found[name] = (z, float(rng.random()))
            return Optimum(z, float(objective.values(z[None])[0]), np.zeros(1), 1, 0.0)

        return optimise

    for name, optimiser in registries.optimisers().items():
        monkeypatch.setattr(optimiser, "optimise", spy(name))

    def plan(name: str, *sets: str):
        resolved, stage, _ = pivoting(f"stages.0.optimiser={name}", *sets)
        made = make(resolved, stage, setup.believed(resolved, Calibrations()))
        return found[name], made

    return plan


# -- the same for all --------------------------------------------------------------------------------------------------


def test_every_optimiser_sets_out_from_the_start_of_the_plans_name_and_then_draws_on(seen, problem):
    rng = np.random.default_rng([0, crc32(b"tip")])
    noise = coloured(rng, (1, *problem.free.shape), 3.0)[0]
    expected, following = problem.start + 0.5 * np.where(problem.free, noise, 0.0), rng.random()
    for name in registries.optimisers():
        (z, number), made = seen(name, *OFF)
        np.testing.assert_array_equal(z, expected)
        assert number == following
        assert made.planner == name


def test_the_start_is_the_same_for_another_backend(seen):
    (fused, _), _ = seen("gradient", *OFF)
    (torch, _), _ = seen("gradient", *OFF, "stages.0.backend=torch")
    np.testing.assert_array_equal(fused, torch)


@pytest.mark.parametrize("other", ["seed=1", "stages=[{stage: plan, name: tap, skill: extrinsic_pivoting}]"])
def test_another_name_or_seed_is_another_start(seen, other):
    (first, _), _ = seen("lm", "stages.0.start.sigma=0.5")
    (second, _), _ = seen("lm", other, "stages.0.start.sigma=0.5")
    assert np.abs(first - second).max() > 0.1


def test_without_a_start_it_is_the_nominal_trajectory_and_nothing_is_drawn(seen, problem):
    (z, number), _ = seen("mppi", *STEPS)
    np.testing.assert_array_equal(z, problem.start)
    assert number == np.random.default_rng([0, crc32(b"tip")]).random()


def test_a_plan_says_where_it_began_beside_its_optimisers_settings():
    resolved, stage, _ = pivoting("stages.0.optimiser={name: gradient, iterations: 2}", *OFF)
    told = make(resolved, stage, setup.believed(resolved, Calibrations())).provenance
    assert told["start"] == {"sigma": 0.5, "beta": 3.0}
    assert (told["optimiser"]["name"], told["optimiser"]["iterations"]) == ("gradient", 2)


# -- what is drawn -----------------------------------------------------------------------------------------------------


def drawn(problem: Problem, beta: float, sigma: float = 0.1) -> np.ndarray:
    """Errors (N, K) of the angle in many starts."""
    loss, rng = objective("fused")(problem), np.random.default_rng(0)
    z = np.array([disturbed(problem, loss, rng, sigma, beta) for _ in range(200)])
    off = z - problem.start
    assert not off[:, ~problem.free].any()
    assert np.isfinite(loss.values(z)).all()
    return off[:, :, 0]


def test_white_noise_has_the_asked_deviation_and_leaves_alone_what_is_not_free(problem):
    np.testing.assert_allclose(drawn(problem, 0.0).std(axis=0), 0.1, rtol=0.2)


def test_a_guess_by_hand_is_off_for_stretches_together_and_by_about_as_much(problem):
    white, slow = drawn(problem, 0.0), drawn(problem, 3.0)
    assert 0.08 < slow.std() < 0.15
    assert np.diff(slow, axis=1).std() < 0.6 * np.diff(white, axis=1).std()


# -- where there is none -----------------------------------------------------------------------------------------------


def test_what_no_draw_finds_is_refused_with_the_reason():
    whole = pivoting()[2]
    turns = np.tile([-30.0, 30.0], (whole.steps, 1))
    tight = replace(whole, limits=Limits(force=5.0), angle_limits=turns)  # in some of 40 steps 40 N are asked for
    with pytest.raises(NoStart, match=r"no start has a finite loss.*step \d+: the sensor takes 5 N"):
        disturbed(tight, objective("fused")(tight), np.random.default_rng(0), 40.0)


def test_a_start_that_is_none_is_bad_input_before_anything_runs():
    for feasible in (True, False):
        with pytest.raises(InputError) as e:
            check(load("extrinsic_pivoting", None, ["stages.0.start.sigma=100"]), Calibrations(), feasible)
        [found] = e.value.problems
        assert found.key == "stages.0.start.sigma"
        assert "the relative angle is" in found.wrong


# -- the paper's Table 4 -----------------------------------------------------------------------------------------------


def test_the_optimisers_of_table_4_share_their_guesses_and_samplers_search_as_wide_as_those_are_off():
    table, _ = jobs.load_table("optimizers")
    starts: dict[str, set[str]] = {}
    for run in table.runs:
        for job in jobs.run_jobs_of(table, run, Options(), None):
            [stage] = [stage for stage in job.stages if stage["stage"] == "plan"]
            assert stage["start"] == {"sigma": 0.5, "beta": 3.0}
            assert stage["optimiser"].get("sigma", 0.5) == 0.5
            starts.setdefault(run.name, set()).add(stage["name"])
    assert starts.pop("grad_100_cvxpylayers") == {"tip_1"}
    assert set(map(frozenset, starts.values())) == {frozenset(f"tip_{n}" for n in range(1, 6))}
