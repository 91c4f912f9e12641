"""The batched active set: forces as by an interior-point solver, derivatives as by differences, and the edges."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportOptionalOperand=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

from dataclasses import replace

import mpmath
import numpy as np
import pytest
import torch

from planning import qp_torch
from planning.program import EQUALITY, FREE, INEQUALITY, SLIP_MINUS, SLIP_PLUS, STICK, ContactProgram, rows, take

from .programs import PATTERNS, Pattern, clarabel, random_programs, relative_error, tie_margin, with_field

FIELDS = ("desired", "mu", "weights", "eo_jacobian", "eo_load", "go_jacobian", "go_load")
P1 = Pattern(ground=2, objects=1, relaxed=True, paper=True)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_forces_equal_those_of_an_interior_point_solver_on_1000_programs_of_all_modes():
    programs = random_programs(np.random.default_rng(0), 1000)
    assert sum(program.steps for program in programs) == 1000
    for program in programs:
        solution = qp_torch.solve(program)
        assert set(solution.status) == {"solved"}
        assert relative_error(solution.forces, clarabel(program), program).max() < 1e-6


def test_steps_do_not_depend_on_their_batch():
    program = random_programs(np.random.default_rng(1), 64, P1)[0]
    together = qp_torch.solve(program).forces
    for k in (0, 17, 40, 63):
        np.testing.assert_allclose(qp_torch.solve(take(program, [k])).forces[0], together[k], atol=1e-12)


def test_a_warm_active_set_changes_nothing_but_the_time():
    programs = random_programs(np.random.default_rng(2), 300)
    for program in programs:
        cold = qp_torch.solve(program)
        shifted = replace(program, desired=program.desired[::-1].copy())
        for near in (cold, qp_torch.solve(shifted)):
            warm = qp_torch.solve(program, warm=near)
            assert warm.status == cold.status
            np.testing.assert_allclose(warm.forces, cold.forces, atol=1e-9)


def slope(program, name, forces_at, direction, h=1e-6):
    base = getattr(program, name)
    above, below = (forces_at(with_field(program, name, base + sign * h * direction)) for sign in (1, -1))
    return (above - below) / (2 * h)


def test_gradients_in_every_field_match_central_differences_away_from_ties():
    """Every pattern; where what balances is more than what can move, only changes that keep balance are defined, so
    that steps without a solution on either side are left out."""
    checked = dict.fromkeys(FIELDS, 0)
    rng = np.random.default_rng(100)
    for pattern in PATTERNS:
        program = random_programs(rng, 7, pattern)[0]
        base = qp_torch.solve(program)
        away = tie_margin(program, base) > 1e-3
        towards = rng.normal(size=base.forces.shape)
        for name in FIELDS:
            value = getattr(program, name)
            if value is None:
                continue
            at = torch.tensor(value, requires_grad=True)
            forces = qp_torch.solve(with_field(program, name, at)).forces
            (gradient,) = torch.autograd.grad((forces * torch.tensor(towards)).sum(), at)
            direction = rng.normal(size=value.shape)
            changed = [qp_torch.solve(with_field(program, name, value + s * 1e-6 * direction)) for s in (1, -1)]
            expected = ((changed[0].forces - changed[1].forces) * towards).sum((1, 2)) / 2e-6
            made = (gradient.numpy() * direction).reshape(program.steps, -1).sum(1)
            counts = away & changed[0].usable & changed[1].usable
            size = np.maximum(1.0, np.abs(expected))
            assert (np.abs(made - expected) / size)[counts].max(initial=0.0) < 1e-5, (pattern, name)
            checked[name] += int(counts.sum())
    assert min(checked.values()) > 40, checked


def test_derivatives_of_several_figures_may_be_asked_back_one_after_another():
    """As a Gauss–Newton model does: the rows of d f / d f_des, which is symmetric where U = 1 (paper form or not)."""
    program = random_programs(np.random.default_rng(5), 6, P1)[0]
    program = replace(program, weights=np.ones_like(program.weights))
    at = torch.tensor(program.desired, requires_grad=True)
    forces = qp_torch.solve(with_field(program, "desired", at)).forces.flatten(1)
    derivative = [torch.autograd.grad(forces[:, i].sum(), at, retain_graph=True)[0].flatten(1) for i in range(6)]
    D = torch.stack(derivative, 1)
    torch.testing.assert_close(D, D.mT)


# --- the edges ---


def flat(
    modes, desired, mu=0.5, load=(0.0, -2.0, 0.0), relaxed=None, points=((-0.04, -0.05), (0.04, -0.05)), **changes
):
    """One step of a body on the ground at ``points`` about its centre of mass, normals up."""
    C = len(modes)
    jacobian = np.array([[[0.0, 1.0, x], [1.0, 0.0, -y]] for x, y in points])
    fields = {
        "names": tuple(f"ground {i}" for i in range(C)),
        "modes": np.array([modes]),
        "desired": np.array([desired], dtype=float),
        "mu": np.full((1, C), mu),
        "weights": np.ones((1, C, 2)),
        "relaxed": relaxed or (False,) * C,
        "eo_jacobian": jacobian[None],
        "eo_load": np.array([load]),
    }
    return ContactProgram(**(fields | changes))


def test_coincident_contacts_share_their_force_evenly():
    """Two contacts at one point carry 2 N: f_n = 1 N each, though the rows of both are the same."""
    program = flat((STICK, STICK), np.zeros((2, 2)), points=((0.0, -0.05), (0.0, -0.05)))
    solution = qp_torch.solve(program)
    assert solution.status == ("solved",)
    np.testing.assert_allclose(solution.forces[0], [[1, 0], [1, 0]], atol=1e-12)


def test_coincident_contacts_have_gradients_by_differences():
    program = flat((STICK, STICK), [[2.0, 0.9], [0.3, 0.4]], points=((0.0, -0.05), (0.0, -0.05)))
    at = torch.tensor(program.desired, requires_grad=True)
    forces = qp_torch.solve(with_field(program, "desired", at)).forces
    (gradient,) = torch.autograd.grad(forces[0, 0, 0], at)
    for index in np.ndindex(1, 2, 2):
        direction = np.zeros((1, 2, 2))
        direction[index] = 1.0
        found = slope(program, "desired", lambda p: qp_torch.solve(p).forces, direction)[0, 0, 0]
        np.testing.assert_allclose(gradient[index], found, atol=1e-7)


@pytest.mark.parametrize("modes", [(STICK, STICK), (SLIP_PLUS, SLIP_MINUS), (STICK, SLIP_PLUS)])
def test_without_friction_the_ground_only_pushes_up(modes):
    """µ = 0: 2 N over two feet, no tangential force whatever is asked for."""
    solution = qp_torch.solve(flat(modes, [[0.0, 3.0], [0.0, -2.0]], mu=0.0))
    assert solution.status == ("solved",)
    np.testing.assert_allclose(solution.forces[0], [[1, 0], [1, 0]], atol=1e-12)
    assert (solution.cone[..., [0, 2]] >= 0).all()


def test_at_no_friction_the_gradient_is_that_of_a_little_more():
    """A contact that is asked to drag lies on the edge f_t = µ f_n as soon as there is one."""
    program = ContactProgram(("a",), np.array([[STICK]]), [[[2.0, 1.0]]], [[0.0]], [[[1.0, 1.0]]], (False,))
    at = torch.tensor(program.mu, requires_grad=True)
    forces = qp_torch.solve(with_field(program, "mu", at)).forces
    gradient = [torch.autograd.grad(forces[0, 0, i], at, retain_graph=True)[0].item() for i in range(2)]
    h = 1e-6
    expected = (qp_torch.solve(with_field(program, "mu", np.array([[h]]))).forces - forces.detach().numpy()) / h
    np.testing.assert_allclose(gradient, expected[0, 0], atol=1e-5)


def test_where_all_is_free_the_force_is_zero_and_only_no_load_balances():
    no_load = flat((FREE, FREE), np.ones((2, 2)), load=(0.0, 0.0, 0.0))
    solution = qp_torch.solve(no_load)
    assert solution.status == ("solved",)
    np.testing.assert_array_equal(solution.forces, 0)
    assert qp_torch.solve(flat((FREE, FREE), np.ones((2, 2)))).status == ("infeasible",)


def test_more_equalities_than_unknowns_are_solved_where_they_agree_and_refused_where_not():
    """Two feet that slip: two unknowns, three equations. Sliding right takes 0.5 · 2 N to the left off the load."""
    modes, nothing = (SLIP_MINUS, SLIP_MINUS), np.zeros((2, 2))
    agrees = flat(modes, nothing, load=(1.0, -2.0, 0.0))
    solution = qp_torch.solve(agrees)
    assert solution.status == ("solved",)
    np.testing.assert_allclose(solution.forces[0].sum(axis=0), [2.0, -1.0], atol=1e-12)
    assert qp_torch.solve(flat(modes, nothing, load=(0.9, -2.0, 0.0))).status == ("infeasible",)


def test_one_infeasible_and_one_broken_step_leave_the_others_as_they_are():
    program = random_programs(np.random.default_rng(8), 9, replace(P1, relaxed=False))[0]
    modes, desired, load = np.zeros_like(program.modes), program.desired.copy(), program.eo_load.copy()
    modes[3, 2], load[3] = FREE, [0.0, 5.0, 0.0]  # nothing but the ground's pull could hold it down
    program = replace(program, modes=modes, eo_load=load)
    alone = [qp_torch.solve(take(program, [k])) for k in range(9)]
    desired[6, 1, 0] = np.nan
    tensor = torch.tensor(desired, requires_grad=True)
    solution = qp_torch.solve(replace(program, desired=tensor))
    expected = [one.status[0] for one in alone]
    expected[6] = "failed"
    assert alone[3].status == ("infeasible",)
    assert solution.status == tuple(expected)
    assert np.isinf(solution.residual[6])
    solution.forces.sum().backward()
    for k in range(9):
        want = np.zeros((3, 2)) if k in (3, 6) else alone[k].forces[0]
        np.testing.assert_allclose(solution.forces[k].detach(), want, atol=1e-12)
    assert np.isfinite(tensor.grad.numpy()).all()
    assert (tensor.grad[[3, 6]] == 0).all()


def exact(program, k, active):
    """Step ``k``'s forces with the rows ``active`` (C, 3) at 0, in 60 digits."""
    mpmath.mp.dps = 60
    n, G = 2 * program.contacts, rows(program)[0][k].reshape(-1, 2)
    constraints, values = [], []
    for i in range(3):
        constraints.append(list(program.eo_jacobian[k, :, :, i].ravel()))
        values.append(-program.eo_load[k, i])
    for number, row in enumerate(G):
        if active.ravel()[number]:
            constraints.append([0.0] * n)
            constraints[-1][2 * (number // 3) : 2 * (number // 3) + 2] = list(row)
            values.append(0.0)
    m = len(constraints)
    M, right = mpmath.zeros(n + m), mpmath.zeros(n + m, 1)
    J = program.go_jacobian[k].reshape(n, 3)
    for i in range(n):
        M[i, i] += mpmath.mpf(program.weights[k].ravel()[i])
        right[i] += mpmath.mpf(program.weights[k].ravel()[i]) * mpmath.mpf(program.desired[k].ravel()[i])
        for a in range(3):
            w = mpmath.mpf(program.slack_weights[a]) * mpmath.mpf(J[i, a])
            right[i] -= w * mpmath.mpf(program.go_load[k, a])
            for j in range(n):
                M[i, j] += w * mpmath.mpf(J[j, a])
    for a in range(m):
        right[n + a] = mpmath.mpf(values[a])
        for i in range(n):
            M[i, n + a] = -mpmath.mpf(constraints[a][i])
            M[n + a, i] = mpmath.mpf(constraints[a][i])
    return np.array([float(v) for v in mpmath.lu_solve(M, right)[:n]]).reshape(-1, 2)


@pytest.mark.parametrize(("U", "slack", "objects"), [(1e-6, 1.0, 2), (1.0, 1e6, 2), (1e-6, 1e6, 1)])
def test_weights_far_apart_leave_the_forces_exact(U, slack, objects):
    """Against 60 digits with the same active rows, whose signs are then checked. (With two contacts of the object and
    both extremes at once the balance of the go decides on rounding.)"""
    program = random_programs(np.random.default_rng(11), 16, Pattern(2, objects, True, True))[0]
    program = replace(
        program,
        modes=np.zeros_like(program.modes),
        weights=U * program.weights,
        slack_weights=slack * np.array([1.0, 1.0, 0.045**-2]),
    )
    solution = qp_torch.solve(program)
    assert set(solution.status) == {"solved"}
    G, kind = rows(program)
    expected = np.stack([exact(program, k, solution.cone[k] != 0) for k in range(program.steps)])
    assert relative_error(solution.forces, expected, program).max() < 1e-9
    gaps = (G * expected[:, :, None, :]).sum(-1)
    assert gaps[kind == INEQUALITY].min() > -1e-9
    assert solution.cone[kind == INEQUALITY].min() >= 0
    assert not (kind == EQUALITY).any()
