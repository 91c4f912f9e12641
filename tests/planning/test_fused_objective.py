"""The compiled loss is the loss in torch, with exact derivatives, for every kind of problem."""

import subprocess
import sys
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from mechanics.friction import Mode
from planning.fused.objective import FusedObjective
from planning.fused.trajectory import run
from planning.objective import TorchObjective
from planning.optimisers.gradient import adam
from planning.problem import Form, Limits, LossWeights, Touch

from .problems import KINDS, pivoting_pentagon, random_problem, random_z

SETTINGS = (30, 0.1, (0.9, 0.999), 1e-8)


def problem_of(kind, seed, **changes):
    form, two_bodies, touch, mode = kind
    return random_problem(
        np.random.default_rng(seed), form=form, two_bodies=two_bodies, touch=touch, mode=mode, **changes
    )


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "-".join(map(str, kind)).replace(" ", "_"))
def test_loss_gradient_and_model_are_those_of_torch(kind):
    for seed, limits in enumerate((False, True)):
        problem = problem_of(kind, seed, limits=limits)
        z = random_z(problem, np.random.default_rng(100 + seed))
        objective = FusedObjective(problem)
        fused, expected = objective.quadratic(z), TorchObjective(problem).quadratic(z)
        assert np.isfinite(expected.value)
        value, gradient = objective.gradient(z)
        assert value == pytest.approx(expected.value, rel=1e-9)
        close = 1e-7 * max(1.0, np.abs(expected.gradient).max())
        np.testing.assert_allclose(gradient, expected.gradient, rtol=0, atol=close)
        assert fused.value == pytest.approx(expected.value, rel=1e-9)
        for name in ("gradient", "diagonal", "below"):
            made, due = getattr(fused, name), getattr(expected, name)
            np.testing.assert_allclose(made, due, rtol=0, atol=1e-7 * max(1.0, np.abs(due).max(initial=0.0)))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "-".join(map(str, kind)).replace(" ", "_"))
def test_the_gradient_is_that_of_central_differences(kind):
    problem = problem_of(kind, 5, limits=True)
    objective, z, h = FusedObjective(problem), random_z(problem, np.random.default_rng(6)), 1e-5
    value, gradient = objective.gradient(z)
    at = np.argwhere(problem.free)
    moved = np.repeat(z[None], 2 * len(at), axis=0)
    for n, (k, j) in enumerate(at):
        moved[2 * n, k, j] += h
        moved[2 * n + 1, k, j] -= h
    values = objective.values(moved)
    expected = np.zeros_like(z)
    expected[tuple(at.T)] = (values[::2] - values[1::2]) / (2 * h)
    assert np.isfinite(value)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-5 * max(1.0, np.abs(gradient).max()))


@pytest.mark.parametrize("form", Form)
@pytest.mark.parametrize("loss", [item.name for item in fields(LossWeights)])
def test_each_loss_alone_has_the_gradient_of_torch(form, loss):
    weights = LossWeights(**{item.name: float(item.name == loss) for item in fields(LossWeights)})
    gradients = []
    for two_bodies, touch in (
        (True, Touch.CORNER_ON_FACE),
        (True, Touch.FACE_ON_CORNER),
        (False, Touch.FACE_ON_CORNER),
    ):
        problem = problem_of((form, two_bodies, touch, Mode.STICK), 11, limits=True)
        problem = replace(problem, weights=weights)
        z = random_z(problem, np.random.default_rng(12), 2.0)
        (value, gradient), (due, expected) = FusedObjective(problem).gradient(z), TorchObjective(problem).gradient(z)
        assert value == pytest.approx(due, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-7 * np.abs(expected).max() + 1e-16)
        gradients.append(np.abs(expected).max())
    assert (max(gradients) > 1e-8) == ((form, loss) != (Form.CLOSED, "slack"))  # which has none


def test_a_displacement_that_is_not_free_stays_at_the_nominal_one():
    """The paper form's nominal displacement balances the go; it is found only where it is kept."""
    problem = pivoting_pentagon(Form.PAPER, steps=6)
    free = np.array(problem.free)
    free[2, 3] = free[4, 2:] = False
    kept = replace(problem, free=free)
    z = random_z(kept, np.random.default_rng(4))
    z[~free] += 5.0
    (value, gradient), (due, expected) = FusedObjective(kept).gradient(z), TorchObjective(kept).gradient(z)
    assert value == pytest.approx(due, rel=1e-9)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-7 * max(1.0, np.abs(expected).max()))
    np.testing.assert_array_equal(FusedObjective(kept).start, kept.start)


@pytest.mark.parametrize("form", Form)
def test_a_batch_has_the_values_of_its_members_and_of_torch(form):
    problem = pivoting_pentagon(form)
    rng = np.random.default_rng(0)
    z = np.stack([random_z(problem, rng, spread) for spread in np.linspace(0, 4, 12)])
    values = FusedObjective(problem).values(z)
    np.testing.assert_allclose(values, TorchObjective(problem).values(z), rtol=1e-9)
    np.testing.assert_allclose(values, [FusedObjective(problem).gradient(one)[0] for one in z], rtol=1e-12)


def test_active_sets_of_earlier_calls_change_nothing():
    problem = problem_of((Form.PAPER, True, Touch.CORNER_ON_FACE, Mode.STICK), 3, ground=2, steps=12)
    rng, used = np.random.default_rng(1), FusedObjective(problem)
    for _ in range(20):
        z = random_z(problem, rng, 3.0)
        (value, gradient), (fresh, due) = used.gradient(z), FusedObjective(problem).gradient(z)
        assert value == pytest.approx(fresh, rel=1e-12)
        np.testing.assert_allclose(gradient, due, atol=1e-9 * max(1.0, np.abs(due).max()))


@pytest.mark.parametrize("form", Form)
def test_adam_inside_is_the_optimisers_adam_step_for_step(form):
    problem = pivoting_pentagon(form)
    z = random_z(problem, np.random.default_rng(2), 0.5)
    best, curve = FusedObjective(problem).adam(z, *SETTINGS)
    reference: Any = FusedObjective(problem)
    due, due_curve = adam(reference, z, *SETTINGS)
    np.testing.assert_allclose(curve, due_curve, rtol=1e-11)
    np.testing.assert_allclose(best, due, rtol=0, atol=1e-10)


def test_adam_inside_steps_back_from_a_barrier_as_the_optimisers_adam():
    """The angle starts next to its limit; a large rate throws it across."""
    problem = pivoting_pentagon(steps=6)
    limits = np.array(problem.angle_limits)
    limits[:, 1] = problem.angle + 1e-3
    narrow = replace(problem, angle_limits=limits, weights=LossWeights(penetration=1e-6))
    best, curve = FusedObjective(narrow).adam(narrow.start, 20, 2.0, (0.9, 0.999), 1e-8)
    reference: Any = FusedObjective(narrow)
    due, due_curve = adam(reference, narrow.start, 20, 2.0, (0.9, 0.999), 1e-8)
    assert (np.diff(due_curve) == 0).any()  # steps were halved
    np.testing.assert_allclose(curve, due_curve, rtol=1e-11)
    np.testing.assert_allclose(best, due, rtol=0, atol=1e-10)


def test_outside_a_barrier_and_without_a_solution_the_loss_is_infinite():
    problem = pivoting_pentagon(steps=5)
    objective, z = FusedObjective(problem), np.array(problem.start)
    beyond = z.copy()
    beyond[3, 0] = (problem.angle_limits[3, 1] + 1e-6) / problem.scale[0]
    broken = z.copy()
    broken[2, 2] = np.nan
    values = objective.values(np.stack([z, beyond, broken]))
    assert np.isfinite(values[0])
    assert np.isposinf(values[1:]).all()
    value, gradient = objective.gradient(beyond)
    assert np.isposinf(value)
    assert not gradient.any()
    model = objective.quadratic(beyond)
    assert np.isposinf(model.value)
    assert not (model.gradient.any() or model.diagonal.any() or model.below.any())


def test_an_infeasible_step_makes_one_member_of_a_batch_infinite():
    """On a corner that cannot stick without friction nothing balances a push along the ground."""
    problem = pivoting_pentagon(steps=5)
    slippery = replace(problem, ground=tuple(replace(ground, mu=0.0) for ground in problem.ground))
    z = np.stack([slippery.start] * 3)
    expected = TorchObjective(slippery).values(z)
    np.testing.assert_array_equal(np.isinf(FusedObjective(slippery).values(z)), np.isinf(expected))


def test_a_sensor_that_takes_less_than_the_weight_makes_the_loss_infinite():
    problem = replace(pivoting_pentagon(steps=3), limits=Limits(force=0.5))
    assert np.isposinf(FusedObjective(problem).values(problem.start[None])).all()


def test_one_step_and_no_gravity_are_fine():
    problem = pivoting_pentagon(steps=1, gravity=0.0)
    fused, expected = FusedObjective(problem).quadratic(problem.start), TorchObjective(problem).quadratic(problem.start)
    assert fused.value == pytest.approx(expected.value, rel=1e-9)
    np.testing.assert_allclose(fused.gradient, expected.gradient, atol=1e-9)
    assert fused.below.shape == (0, 5, 5)


def test_what_is_not_free_stays_as_it_is():
    problem = pivoting_pentagon(steps=4)
    objective, z = FusedObjective(problem), np.array(problem.start)
    z[:, 1] += 3.0
    assert not problem.free[:, 1].any()
    assert objective.gradient(z)[0] == objective.gradient(problem.start)[0]
    assert not objective.gradient(z)[1][:, 1].any()


def test_a_wrong_z_is_refused():
    objective = FusedObjective(pivoting_pentagon(steps=4))
    with pytest.raises(ValueError, match=r"expected shape \(4, 5\), received \(3, 5\)"):
        objective.gradient(np.zeros((3, 5)))
    with pytest.raises(ValueError, match=r"expected shape \(B, 4, 5\), received \(4, 5\)"):
        objective.values(np.zeros((4, 5)))
    z = np.array(objective.start)
    z[2, 0] = np.inf
    with pytest.raises(ValueError, match="step 2: expected finite numbers"):
        objective.gradient(z)


def test_no_layout_of_the_input_is_compiled_anew():
    objective = FusedObjective(pivoting_pentagon(steps=4))
    objective.gradient(objective.start)
    before = len(run.signatures)
    frozen = np.array(objective.start)
    frozen.setflags(write=False)
    layouts: list[Any] = [
        frozen,
        np.asfortranarray(frozen),
        frozen.astype(np.float32),
        np.repeat(frozen, 2, axis=1)[:, ::2],
    ]
    for z in layouts:
        objective.gradient(z)
        objective.quadratic(z)
        objective.values(np.stack([z, z])[::-1])
    objective.adam(frozen, *SETTINGS)
    assert len(run.signatures) == before


def test_nothing_is_compiled_at_import():
    code = (
        "from planning.fused.trajectory import run; from planning.fused.batch import solve_batch;"
        "assert not run.signatures and not solve_batch.signatures"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)
