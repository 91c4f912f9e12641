"""The fused kernel's contact programs: forces as by an interior-point solver, multipliers, and the edges."""

from dataclasses import replace

import numpy as np
import pytest

from planning import qp_fused
from planning.program import FREE, SLIP_MINUS, SLIP_PLUS, STICK, ContactProgram, kkt_residual, take

from .programs import PATTERNS, clarabel, random_programs, relative_error

LEVER = 0.06


def standing(modes, *, mu=0.5, lever=LEVER, desired=0.0, load=(0.0, -10.0, 0.0), **changes) -> ContactProgram:
    """A body on the ground at (±lever, −0.05) from its centre of mass, as one step: normal up, tangent to the right."""
    C = len(modes)
    arms = np.array([[-lever, -0.05], [lever, -0.05], [lever, -0.05]][:C])
    J = np.zeros((1, C, 2, 3))
    J[0, :, 0] = [[0, 1, x] for x, _ in arms]
    J[0, :, 1] = [[1, 0, -y] for _, y in arms]
    fields = {
        "names": tuple(f"ground {c}" for c in range(C)),
        "modes": np.array([modes], dtype=np.int8),
        "desired": np.full((1, C, 2), desired),
        "mu": np.full((1, C), mu),
        "weights": np.ones((1, C, 2)),
        "relaxed": (False,) * C,
        "eo_jacobian": J,
        "eo_load": np.array([load]),
    }
    return ContactProgram(**(fields | changes))


def test_forces_equal_those_of_an_interior_point_solver_on_1000_programs_of_all_modes():
    programs = random_programs(np.random.default_rng(7), 1000)
    assert sum(program.steps for program in programs) == 1000
    for program in programs:
        solution = qp_fused.solve(program)
        assert set(solution.status) == {"solved"}
        assert relative_error(solution.forces, clarabel(program), program).max() < 1e-6


def test_forces_and_multipliers_meet_the_optimality_conditions():
    for program in random_programs(np.random.default_rng(8), 1000):
        found = qp_fused.solve(program)
        assert kkt_residual(program, found.forces, found.balance, found.cone).max() < 1e-9
        assert (found.residual < 1e-9).all()


def test_a_body_at_rest_shares_its_weight_evenly():
    found = qp_fused.solve(standing([STICK, STICK]))
    np.testing.assert_allclose(found.forces[0], [[5, 0], [5, 0]], atol=1e-12)


def test_coincident_contacts_share_their_force_evenly():
    """Three contacts, two of which are one point: of ½Σf² the two carry a half of its 5 N each."""
    found = qp_fused.solve(standing([STICK, STICK, STICK]))
    assert found.status == ("solved",)
    np.testing.assert_allclose(found.forces[0], [[5, 0], [2.5, 0], [2.5, 0]], atol=1e-12)


def test_coincident_contacts_at_the_edge_of_their_cones_are_solved():
    """A push of 4 N at the height of the ground with µ = 0.4: every cone is at its edge, its rows are redundant."""
    pushed = standing([STICK, STICK, STICK], mu=0.4, load=(4.0, -10.0, 4.0 * 0.05))
    found = qp_fused.solve(pushed)
    assert found.status == ("solved",)
    np.testing.assert_allclose(found.forces[0].sum(axis=0), [10, -4], atol=1e-9)
    np.testing.assert_allclose(found.forces[0, :, 1], -0.4 * found.forces[0, :, 0], atol=1e-9)


@pytest.mark.parametrize("modes", [[STICK, STICK], [SLIP_PLUS, SLIP_PLUS], [SLIP_MINUS, SLIP_MINUS]])
def test_without_friction_the_ground_only_pushes_up(modes):
    found = qp_fused.solve(standing(modes, mu=0.0, desired=1.0))
    np.testing.assert_allclose(found.forces[0], [[5, 0], [5, 0]], atol=1e-12)
    assert found.residual[0] < 1e-12


def test_without_friction_a_push_along_the_ground_is_infeasible():
    found = qp_fused.solve(standing([STICK, STICK], mu=0.0, load=(0.1, -10.0, 0.005)))
    assert found.status == ("infeasible",)
    assert not found.forces.any()


def test_where_all_is_free_only_no_load_balances():
    assert qp_fused.solve(standing([FREE, FREE], desired=1.0, load=(0.0, 0.0, 0.0))).status == ("solved",)
    assert qp_fused.solve(standing([FREE, FREE])).status == ("infeasible",)


def test_more_equalities_than_unknowns_are_solved_where_they_agree_and_refused_where_not():
    """One contact below the centre of mass balances, one beside it does not."""
    below = qp_fused.solve(standing([STICK], lever=0.0))
    assert below.status == ("solved",)
    np.testing.assert_allclose(below.forces[0], [[10, 0]], atol=1e-12)
    beside = qp_fused.solve(standing([STICK], lever=0.01))
    assert beside.status == ("infeasible",)
    assert np.isinf(beside.residual).all()


def test_one_infeasible_and_one_broken_step_leave_the_others_as_they_are():
    program = random_programs(np.random.default_rng(3), 40, PATTERNS[0])[0]
    alone = qp_fused.solve(program)
    load, desired = np.array(program.eo_load), np.array(program.desired)
    k = int(np.argmax((program.modes == FREE).all(axis=1)))
    load[k] = [0.0, -1.0, 0.0]
    desired[5] = np.nan
    found = qp_fused.solve(replace(program, eo_load=load, desired=desired))
    others = [n for n in range(40) if n not in (k, 5)]
    assert (found.status[k], found.status[5]) == ("infeasible", "failed")
    assert [found.status[n] for n in others] == ["solved"] * 38
    assert not found.forces[[k, 5]].any()
    np.testing.assert_array_equal(found.forces[others], alone.forces[others])


@pytest.mark.parametrize(
    ("weight", "slack", "allowed"),
    [
        (1e-6, 1.0, {"solved"}),
        (1.0, 1e6, {"solved"}),
        (1e4, 1e-2, {"solved"}),
        (1e-6, 1e6, {"solved", "inaccurate"}),  # 1e12 apart: the last bit of a lever moves some forces by 1e-4
    ],
)
def test_extreme_weights_are_solved_or_said_to_be_inaccurate(weight, slack, allowed):
    for pattern in (p for p in PATTERNS if p.paper):
        program = random_programs(np.random.default_rng(11), 20, pattern)[0]
        scaled = replace(program, weights=weight * program.weights, slack_weights=slack * np.array([1.0, 1.0, 500.0]))
        found = qp_fused.solve(scaled)
        assert set(found.status) <= allowed, (pattern, found.residual.max())


def test_steps_do_not_depend_on_their_batch():
    program = random_programs(np.random.default_rng(1), 64, PATTERNS[5])[0]
    together = qp_fused.solve(program).forces
    for k in (0, 17, 63):
        np.testing.assert_array_equal(qp_fused.solve(take(program, [k])).forces[0], together[k])


def test_an_empty_batch_has_an_empty_solution():
    found = qp_fused.solve(take(standing([STICK, STICK]), []))
    assert found.forces.shape == (0, 2, 2)
    assert found.status == ()


def test_more_contacts_than_the_kernel_takes_are_refused():
    five = standing([STICK], eo_jacobian=None, eo_load=None)
    many = {n: np.repeat(getattr(five, n), 5, axis=1) for n in ("modes", "desired", "mu", "weights")}
    with pytest.raises(ValueError, match="at most 4, received 5"):
        qp_fused.solve(replace(five, names=tuple("abcde"), relaxed=(False,) * 5, **many))
