"""cvxpylayers, the reference: forces as an interior-point solver finds them, derivatives as differences do."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportOptionalOperand=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

from dataclasses import replace

import numpy as np
import pytest
import torch

from planning import qp_reference, qp_torch
from planning.program import FREE, STICK, ContactProgram, kkt_residual, take

from .programs import Pattern, clarabel, random_programs, relative_error, tie_margin, with_field

PAPER = Pattern(ground=2, objects=1, relaxed=True, paper=True)
CLOSED = Pattern(ground=1, objects=2, relaxed=False, paper=False)


def check_forces(programs):
    for program in programs:
        solution = qp_reference.solve_accurate(program)
        expected = clarabel(program)
        assert set(solution.status) == {"solved"}
        assert relative_error(solution.forces, expected, program).max() < 1e-6


def of_few_modes(pattern, combinations, each, seed):
    """A program of a few combinations of modes, each with several steps."""
    rng = np.random.default_rng(seed)
    program = random_programs(rng, each * len(pattern.mode_combinations()), pattern)[0]
    kinds, which = np.unique(program.modes, axis=0, return_inverse=True)
    chosen = rng.choice(len(kinds), combinations, replace=False)
    return take(program, np.flatnonzero(np.isin(which, chosen)))


SAMPLE = [(PAPER, 5), (CLOSED, 5), (Pattern(0, 2, False, True), 4)]


def test_forces_equal_those_of_an_interior_point_solver_on_a_sample():
    check_forces([of_few_modes(pattern, count, 4, seed) for seed, (pattern, count) in enumerate(SAMPLE)])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_forces_equal_those_of_an_interior_point_solver_on_1000_programs_of_all_modes():
    check_forces(random_programs(np.random.default_rng(0), 1000))


def test_fast_settings_are_good_to_a_thousandth():
    for seed, (pattern, count) in enumerate(SAMPLE):
        program = of_few_modes(pattern, min(count, 2), 4, seed)
        solution = qp_reference.solve_fast(program)
        assert set(solution.status) == {"solved"}
        assert relative_error(solution.forces, clarabel(program), program).max() < 1e-3


def test_multipliers_meet_the_optimality_conditions_of_the_program_as_it_was_given():
    program = of_few_modes(CLOSED, 3, 3, 1)
    solution = qp_reference.solve_accurate(program)
    found = kkt_residual(program, solution.forces, solution.balance, solution.cone)
    np.testing.assert_array_equal(found, solution.residual)
    assert found.max() < 1e-7
    without = kkt_residual(program, solution.forces, solution.balance * 0, solution.cone * 0)
    assert without.max() > 1e-2


@pytest.mark.parametrize("pattern", [PAPER, CLOSED])
def test_gradients_match_central_differences_away_from_ties(pattern):
    """The sides of the difference are solved by the active set, whose forces are exact."""
    rng, program = np.random.default_rng(7), of_few_modes(pattern, 4, 2, 3)
    base = qp_torch.solve(program)
    away, towards = tie_margin(program, base) > 1e-2, rng.normal(size=base.forces.shape)
    checked = 0
    for name in ("desired", "mu", "weights", "eo_jacobian", "eo_load", "go_jacobian", "go_load"):
        value = getattr(program, name)
        if value is None:
            continue
        at = torch.tensor(value, requires_grad=True)
        forces = qp_reference.solve_accurate(with_field(program, name, at)).forces
        (gradient,) = torch.autograd.grad((forces * torch.tensor(towards)).sum(), at)
        direction = rng.normal(size=value.shape)
        changed = [qp_torch.solve(with_field(program, name, value + s * 1e-6 * direction)) for s in (1, -1)]
        expected = ((changed[0].forces - changed[1].forces) * towards).sum((1, 2)) / 2e-6
        made = (gradient.numpy() * direction).reshape(program.steps, -1).sum(1)
        counts = away & changed[0].usable & changed[1].usable & one_to_one(program)
        assert (np.abs(made - expected) / np.maximum(1, np.abs(expected)))[counts].max() < 1e-5, name
        checked += int(counts.sum())
    assert checked > 10


def one_to_one(program):
    """(K,) whether forces have freedom left beside balance: without any, neither side of a difference is defined."""
    unknowns = np.where(program.modes == STICK, 2, np.where(program.modes == FREE, 0, 1)).sum(1)
    return unknowns >= 3


def test_without_gradients_the_fast_solver_is_not_handed_what_only_the_derivative_knows():
    program = of_few_modes(PAPER, 1, 1, 2)
    with torch.no_grad():
        asked = with_field(program, "desired", torch.tensor(program.desired, requires_grad=True))
        assert set(qp_reference.solve_fast(asked).status) == {"solved"}


def block(loads):
    """A body on two feet, both sticking."""
    K = len(loads)
    jacobian = np.array([[[0.0, 1.0, x], [1.0, 0.0, 0.05]] for x in (-0.04, 0.04)])
    return ContactProgram(
        names=("ground left", "ground right"),
        modes=np.zeros((K, 2)),
        desired=np.zeros((K, 2, 2)),
        mu=np.full((K, 2), 0.3),
        weights=np.ones((K, 2, 2)),
        relaxed=(False, False),
        eo_jacobian=np.tile(jacobian, (K, 1, 1, 1)),
        eo_load=np.array(loads),
    )


@pytest.mark.parametrize("solve", [qp_reference.solve_accurate, qp_reference.solve_fast])
def test_one_infeasible_and_one_broken_step_leave_the_others_as_they_are(solve):
    solution = solve(block([[0.0, -2.0, 0.0], [0.0, 2.0, 0.0], [np.nan, -2.0, 0.0], [0.0, -4.0, 0.0]]))
    assert solution.status == ("solved", "infeasible", "failed", "solved")
    np.testing.assert_allclose(solution.forces[[0, 3], :, 0], [[1, 1], [2, 2]], atol=1e-3)
    np.testing.assert_array_equal(solution.forces[1:3], 0)
    assert np.isinf(solution.residual[1:3]).all()


def test_a_solver_stopped_too_early_is_reported_by_its_residual():
    program = of_few_modes(PAPER, 1, 3, 5)
    lazy = replace(qp_reference.ACCURATE, name="lazy", solver=qp_reference.ACCURATE.solver | {"eps": 1e-3})
    solution = qp_reference.solve(program, lazy)
    assert set(solution.status) <= {"inaccurate", "failed"}
    assert solution.residual.min() > qp_reference.ACCURATE.residual


def test_where_all_is_free_there_is_nothing_to_solve_and_gradients_are_zero():
    program = replace(block([[0.0, 0.0, 0.0]]), modes=np.full((1, 2), FREE))
    at = torch.tensor(program.desired, requires_grad=True)
    solution = qp_reference.solve(with_field(program, "desired", at))
    solution.forces.sum().backward()
    assert solution.status == ("solved",)
    np.testing.assert_array_equal(at.grad, 0)
    assert qp_reference.solve(replace(program, eo_load=np.array([[0.0, -1.0, 0.0]]))).status == ("infeasible",)


def test_without_friction_the_ground_only_pushes_up():
    program = replace(block([[0.0, -2.0, 0.0]]), mu=np.zeros((1, 2)), desired=np.array([[[0.0, 3.0], [0.0, -1.0]]]))
    solution = qp_reference.solve(program)
    assert solution.status == ("solved",)
    np.testing.assert_allclose(solution.forces[0], [[1, 0], [1, 0]], atol=1e-7)
