"""P2: the layer, an interior-point solver and the closed form must agree, in forces and in derivatives."""

import itertools
import math
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
import torch

from mechanics.friction import Mode, cone_margin
from planning import qp_reference
from planning.p2 import P2, solve_by_projection

MODES = (Mode.STICK, Mode.SLIP_POSITIVE, Mode.SLIP_NEGATIVE, Mode.FREE)
PATTERNS = [*itertools.product(MODES, repeat=1), *itertools.product(MODES, repeat=2)]


def random_problem(seed, patterns, spread=1.0):
    """Random programs, one per pattern, with normals all around and forces inside, beside and behind the cones."""
    rng = np.random.default_rng(seed)
    K, C = len(patterns), len(patterns[0])
    angle = rng.uniform(-math.pi, math.pi, (K, C))
    return P2(
        modes=tuple(patterns),
        desired=rng.normal(size=(K, C, 2)) * [3.0, 1.5] + [1.5, 0.0],
        mu=rng.uniform(0.05, 1.2, (K, C)),
        weights=np.exp(spread * rng.normal(size=(K, C, 2))),
        normals=np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        arms=rng.uniform(-0.1, 0.1, (K, C, 2)),
        gravity_wrench=rng.normal(size=(K, 3)),
        go=rng.normal(size=(K, 3)),
        X_go_gocf=np.array([0.01, 0.045, 0.1]),
        stiffness=np.diag([2000.0, 1900.0, 3.2]),
    )


def clarabel_forces(problem, k):
    """Step k by an interior-point solver, straight from the definition of P2."""
    C = len(problem.modes[k])
    f = cp.Variable((C, 2))
    rows = []
    for c, mode in enumerate(problem.modes[k]):
        mu, (normal, tangential) = problem.mu[k, c], (f[c, 0], f[c, 1])
        rows += {
            "stick": [tangential <= mu * normal, -tangential <= mu * normal],
            "slip+": [tangential == mu * normal, normal >= 0],
            "slip-": [tangential == -mu * normal, normal >= 0],
            "free": [normal == 0, tangential == 0],
        }[str(mode)]
    cost = 0.5 * cp.sum(cp.multiply(problem.weights[k], cp.square(f - problem.desired[k])))
    options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)
    cp.Problem(cp.Minimize(cost), rows).solve(solver=cp.CLARABEL, **options)
    return np.asarray(f.value)


def relative_error(a, b, problem):
    size = np.abs(problem.desired).max(axis=(1, 2))
    return np.abs(np.asarray(a) - b).max(axis=(1, 2)) / size


@pytest.mark.parametrize("contacts", [1, 2])
def test_three_solvers_agree_on_the_forces(contacts):
    """Layer, Clarabel and closed form: 4 and 16 patterns of modes, 160 programs each."""
    patterns = [p for p in PATTERNS if len(p) == contacts]
    problem = random_problem(contacts, (patterns * 160)[:160])
    layer, closed = qp_reference.solve(problem), solve_by_projection(problem)
    clarabel = np.stack([clarabel_forces(problem, k) for k in range(problem.steps)])
    assert set(layer.status) == {"solved"}
    assert relative_error(layer.forces, clarabel, problem).max() < 1e-6
    assert relative_error(closed.forces, clarabel, problem).max() < 1e-6
    assert relative_error(layer.forces, closed.forces, problem).max() < 5e-8
    assert layer.residual.max() < 1e-7


def test_every_pattern_has_its_own_layer_and_steps_keep_their_order():
    """Mixed patterns in one batch give each step what it gets alone."""
    problem = random_problem(7, [p for p in PATTERNS if len(p) == 2])
    together = qp_reference.solve(problem).forces
    for k in (0, 5, 11, 15):
        alone = replace(
            problem,
            modes=problem.modes[k : k + 1],
            **{
                name: getattr(problem, name)[k : k + 1]
                for name in ("desired", "mu", "weights", "normals", "arms", "gravity_wrench", "go")
            },
        )
        np.testing.assert_allclose(qp_reference.solve(alone).forces[0], together[k], atol=1e-7)


def away_from_ties(problem, step):
    """Whether no contact's active set changes within ``step`` of the desired force."""
    scaled_mu = problem.mu * np.sqrt(problem.weights[..., 1] / problem.weights[..., 0])
    scaled = problem.desired * np.sqrt(problem.weights)
    margins = np.abs(cone_margin(scaled, scaled_mu))
    # the other edge of the picture: the polar cone, beyond which the force is zero
    wn, wt = problem.weights[..., 0], problem.weights[..., 1]
    slip = np.vectorize(lambda mode: mode.slip_sign)(np.array(problem.modes, dtype=object))
    slope = np.where(slip == 0, np.sign(problem.desired[..., 1]), slip) * problem.mu
    polar = np.abs(wn * problem.desired[..., 0] + wt * slope * problem.desired[..., 1])
    return ((margins > step) & (polar > step)).all()


def value(name, array, problem, direction):
    """One number of the whole chain: forces, wrench and end-effector pose."""
    changed = replace(problem, **{name: array})
    forces = qp_reference.solve(changed).forces
    wrench = changed.wrench(forces)
    ee = changed.ee(wrench)
    return (forces * direction[0]).sum() + (wrench * direction[1]).sum() + (ee * direction[2]).sum()


@pytest.mark.parametrize("name", ["desired", "mu", "weights"])
def test_gradients_through_forces_wrench_and_pose_match_central_differences(name):
    checked = 0
    for seed, pattern in enumerate(PATTERNS):
        problem = random_problem(100 + seed, [pattern], spread=0.5)
        if not away_from_ties(problem, 1e-2):
            continue
        checked += 1
        rng = np.random.default_rng(seed)
        direction = [rng.normal(size=shape) for shape in ((1, len(pattern), 2), (1, 3), (1, 3))]
        base = torch.tensor(np.array(getattr(problem, name)), requires_grad=True)
        tensors = [torch.tensor(d) for d in direction]
        (gradient,) = torch.autograd.grad(value(name, base, problem, tensors), base)
        array, step = np.array(getattr(problem, name)), 1e-3
        differences = np.zeros_like(array)
        for index in np.ndindex(array.shape):

            def at(offset, index=index, array=array, problem=problem, direction=direction):
                moved = array.copy()
                moved[index] += offset
                return value(name, moved, problem, direction)

            # fourth order, so that a step well above the solver's noise is accurate enough
            differences[index] = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
        np.testing.assert_allclose(gradient.numpy(), differences, rtol=1e-5, atol=1e-5)
    assert checked >= 12


@pytest.mark.parametrize("pattern", [(Mode.STICK,), (Mode.SLIP_POSITIVE,), (Mode.STICK, Mode.SLIP_NEGATIVE)])
def test_the_closed_form_has_the_layers_gradients(pattern):
    problem = random_problem(3, [pattern] * 60)
    gradients = []
    for solve in (qp_reference.solve, solve_by_projection):
        inputs = {
            name: torch.tensor(np.array(getattr(problem, name)), requires_grad=True)
            for name in ("desired", "mu", "weights")
        }
        forces = solve(replace(problem, **inputs)).forces
        assert isinstance(forces, torch.Tensor)
        (forces**2).sum().backward()
        gradients.append([tensor.grad.numpy() for tensor in inputs.values() if tensor.grad is not None])
    assert len(gradients[0]) == 3
    for layer, closed in zip(*gradients, strict=True):
        np.testing.assert_allclose(layer, closed, rtol=1e-5, atol=1e-5)


def test_no_gradient_is_lost_to_a_frictionless_contact():
    """µ = 0 puts zeros where the solver would drop them: the force is the normal part, its slope is 1."""
    problem = replace(random_problem(5, [(Mode.STICK,)]), mu=np.zeros((1, 1)), desired=np.array([[[2.0, 0.7]]]))
    desired = torch.tensor(problem.desired, requires_grad=True)
    forces = qp_reference.solve(replace(problem, desired=desired)).forces
    np.testing.assert_allclose(forces.detach().numpy(), [[[2.0, 0.0]]], atol=1e-7)
    forces.sum().backward()
    assert desired.grad is not None
    np.testing.assert_allclose(desired.grad.numpy(), [[[1.0, 0.0]]], atol=1e-6)


def test_solving_without_gradients_works_under_no_grad():
    problem = random_problem(5, [(Mode.STICK,)])
    with torch.no_grad():
        forces = qp_reference.solve(replace(problem, desired=torch.tensor(problem.desired))).forces
    np.testing.assert_allclose(np.asarray(forces), solve_by_projection(problem).forces, atol=1e-7)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_accuracy_does_not_depend_on_the_unit_of_force(scale):
    problem = random_problem(9, [(Mode.STICK, Mode.SLIP_POSITIVE)] * 20)
    problem = replace(problem, desired=problem.desired * scale)
    error = relative_error(qp_reference.solve(problem).forces, solve_by_projection(problem).forces, problem)
    assert error.max() < 1e-6


def test_a_solver_that_refuses_is_told_per_step_and_never_is_nan(monkeypatch):
    """The layer throws for the whole batch; the solution says which step it was."""
    import diffcp

    problem = random_problem(11, [(Mode.STICK,)] * 4)
    target = np.array([1.0, 0.0])
    problem = replace(problem, desired=np.where(np.arange(4)[:, None, None] == 2, target, problem.desired))
    layer = qp_reference._layer((Mode.STICK,))

    class Refusing:
        sizes = layer.sizes

        def __call__(self, desired, *rest):
            if (desired == torch.tensor(target)).all(dim=-1).any():
                raise diffcp.SolverError("Solver scs returned status infeasible")
            return layer(desired, *rest)

    monkeypatch.setattr(qp_reference, "_layer", lambda pattern: Refusing())
    problem = replace(problem, weights=np.ones_like(problem.weights))
    solution = qp_reference.solve(problem)
    assert solution.status == ("solved", "solved", "failed", "solved")
    np.testing.assert_array_equal(solution.forces[2], 0)
    assert np.isfinite(solution.forces).all()
    assert math.isinf(solution.residual[2])
    np.testing.assert_allclose(solution.forces[3], solve_by_projection(problem).forces[3], atol=1e-6)


def test_a_loose_solve_is_called_inaccurate(monkeypatch):
    monkeypatch.setitem(qp_reference.SOLVER_ARGS, "eps", 1e-2)
    qp_reference._layer.cache_clear()
    problem = random_problem(12, [(Mode.STICK,)] * 20)
    try:
        solution = qp_reference.solve(problem)
    finally:
        qp_reference._layer.cache_clear()
    assert "inaccurate" in solution.status
    worst = relative_error(solution.forces, solve_by_projection(problem).forces, problem)
    assert all(error < 1e-4 for error, status in zip(worst, solution.status, strict=True) if status == "solved")


@pytest.mark.parametrize(
    ("field", "bad", "message"),
    [
        ("desired", np.full((1, 1, 2), np.nan), "desired: expected finite"),
        ("weights", np.zeros((1, 1, 2)), "weights: expected positive"),
        ("mu", np.full((1, 1), -0.1), "mu: expected numbers"),
        ("arms", np.zeros((1, 2, 2)), r"arms: expected shape \(1, 1, 2\), received \(1, 2, 2\)"),
    ],
)
def test_data_that_make_no_program_are_refused_by_name(field, bad, message):
    with pytest.raises(ValueError, match=message):
        replace(random_problem(0, [(Mode.STICK,)]), **{field: bad})
