"""What a contact program is, and when forces and multipliers solve it."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportOptionalOperand=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

from dataclasses import replace

import numpy as np
import pytest
import torch

from mechanics.friction import Mode
from planning.backends import BACKENDS
from planning.program import (
    FREE,
    SLIP_MINUS,
    SLIP_PLUS,
    STICK,
    ContactProgram,
    Solution,
    codes,
    force_scale,
    kkt_residual,
    mode_of,
    take,
)


def one(modes=(STICK,), desired=((3.0, 0.0),), mu=0.5, **changes):
    """One step of P2: what is asked for, and the cones."""
    fields = {
        "names": tuple(f"ground {i}" for i in range(len(modes))),
        "modes": [list(modes)],
        "desired": [list(desired)],
        "mu": np.full((1, len(modes)), mu),
        "weights": np.full((1, len(modes), 2), 2.0),
        "relaxed": (False,) * len(modes),
    }
    return ContactProgram(**(fields | changes))


def test_a_mode_and_its_code_are_one_to_one_and_a_slip_is_coded_by_its_sign():
    assert codes([list(Mode)]).tolist() == [[STICK, SLIP_PLUS, SLIP_MINUS, FREE]]
    assert [mode_of(code) for code in (STICK, SLIP_PLUS, SLIP_MINUS, FREE)] == list(Mode)
    assert all(int(codes([mode])[0]) == mode.slip_sign for mode in Mode if mode is not Mode.FREE)
    with pytest.raises(ValueError, match="glide"):
        codes(["glide"])
    with pytest.raises(ValueError, match="received 3"):
        mode_of(3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"modes": [[7]]}, "modes"),
        ({"names": ("a", "b")}, "names: expected 1"),
        ({"relaxed": ()}, "relaxed: expected 1"),
        ({"weights": np.ones((1, 2, 2))}, r"weights: expected shape \(1, 1, 2\), received \(1, 2, 2\)"),
        ({"weights": np.zeros((1, 1, 2))}, "weights: expected positive"),
        ({"mu": np.array([[-0.1]])}, "mu: expected numbers ≥ 0"),
        ({"eo_load": np.zeros((1, 3))}, "eo_load: expected together with eo_jacobian"),
        ({"go_load": np.zeros((1, 3))}, "go_load: expected together"),
        ({"length": 0.0}, "length"),
    ],
)
def test_a_field_that_does_not_fit_is_named(changes, words):
    with pytest.raises(ValueError, match=words):
        one(**changes)


def test_the_force_scale_is_the_largest_force_or_moment_over_length():
    jacobian = np.zeros((1, 1, 2, 3))
    program = one(eo_jacobian=jacobian, eo_load=np.array([[0.0, -2.0, 0.4]]), length=0.05)
    np.testing.assert_allclose(force_scale(program), [8.0])
    np.testing.assert_allclose(force_scale(program, np.array([[[0.0, -20.0]]])), [20.0])
    np.testing.assert_allclose(force_scale(one(desired=[[0.0, 0.0]])), [1.0])


def test_forces_inside_their_cones_with_no_multiplier_have_no_residual():
    np.testing.assert_array_equal(kkt_residual(one(), np.array([[[3.0, 0.0]]]), None, np.zeros((1, 1, 3))), 0)


def test_the_residual_of_stationarity_is_the_force_that_is_missing():
    """f_n = 2.7 N where 3 N is asked for and nothing stops it: 0.3 N of 3 N, whatever the weights are."""
    for weights in (1e-6, 1.0, 1e6):
        program = one(weights=np.full((1, 1, 2), weights))
        found = kkt_residual(program, np.array([[[2.7, 0.0]]]), None, np.zeros((1, 1, 3)))
        np.testing.assert_allclose(found, 0.1)


def test_the_edge_of_the_cone_solves_with_the_multiplier_of_its_row():
    """(1, 2) N onto the cone of µ = 0.5: f = 0.8 (2, 1) N; U (f − f_des) = 2 (0.6, −1.2) = 2.4 (0.5, −1) = 2.4 g."""
    program, forces = one(desired=[[1.0, 2.0]]), np.array([[[1.6, 0.8]]])
    cone = np.array([[[2.4, 0.0, 0.0]]])
    assert kkt_residual(program, forces, None, cone)[0] < 1e-15
    for wrong in (np.array([[[-2.4, 0.0, 0.0]]]), np.array([[[0.0, 2.4, 0.0]]]), np.zeros((1, 1, 3))):
        assert kkt_residual(program, forces, None, wrong)[0] > 0.1


@pytest.mark.parametrize("mode", [SLIP_PLUS, SLIP_MINUS])
def test_a_slip_off_its_line_and_a_free_contact_with_force_are_residuals(mode):
    program = one(modes=(mode,), desired=[[3.0, mode * 1.5]])
    on, off = np.array([[[3.0, mode * 1.5]]]), np.array([[[3.0, -mode * 1.5]]])
    none = np.zeros((1, 1, 3))
    assert kkt_residual(program, on, None, none)[0] == 0
    assert kkt_residual(program, off, None, none)[0] > 0.5
    assert kkt_residual(one(modes=(FREE,)), np.zeros((1, 1, 2)), None, none)[0] == 0
    assert kkt_residual(one(modes=(FREE,)), on, None, none)[0] == 1.0


def test_a_relaxed_contact_may_pull():
    program = one(desired=[[-3.0, 9.0]], relaxed=(True,))
    assert kkt_residual(program, np.array([[[-3.0, 9.0]]]), None, np.zeros((1, 1, 3)))[0] == 0


def test_what_balance_lacks_is_a_residual():
    jacobian = np.array([[[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]]])
    program = one(eo_jacobian=jacobian, eo_load=np.array([[0.0, -3.0, 0.0]]))
    zero = np.zeros((1, 1, 3))
    assert kkt_residual(program, np.array([[[3.0, 0.0]]]), np.zeros((1, 3)), zero)[0] == 0
    lifted = replace(program, eo_load=np.array([[0.0, -3.3, 0.0]]))
    np.testing.assert_allclose(kkt_residual(lifted, np.array([[[3.0, 0.0]]]), np.zeros((1, 3)), zero), 0.3 / 3.3)


def test_taking_steps_keeps_what_they_have_in_common():
    program = one(slack_weights=np.ones(3), go_jacobian=torch.zeros(1, 1, 2, 3).double(), go_load=np.zeros((1, 3)))
    three = ContactProgram(
        **{
            name: value.repeat(3, 1, 1, 1) if isinstance(value, torch.Tensor) else np.repeat(value, 3, axis=0)
            for name, value in vars(program).items()
            if name in ("modes", "desired", "mu", "weights", "go_jacobian", "go_load")
        },
        names=program.names,
        relaxed=program.relaxed,
        slack_weights=program.slack_weights,
    )
    part = take(three, [2, 0])
    assert part.steps == 2
    assert part.slack_weights is three.slack_weights
    assert part.go_jacobian is not None
    assert part.go_jacobian.shape == (2, 1, 2, 3)


def test_only_steps_with_forces_are_usable():
    words = ("solved", "inaccurate", "infeasible", "failed")
    solution = Solution(np.zeros((4, 1, 2)), None, np.zeros((4, 1, 3)), np.zeros(4), words)
    assert solution.usable.tolist() == [True, True, False, False]


@pytest.mark.parametrize("name", sorted(set(BACKENDS) - {"fused"}))
def test_every_backend_of_torch_projects_a_wish_onto_the_cone(name):
    """(1, 2) N with µ = 0.5 and equal weights: 0.8 (2, 1) N."""
    solution = BACKENDS[name]()(one(desired=[[1.0, 2.0]]))
    np.testing.assert_allclose(solution.forces, [[[1.6, 0.8]]], atol=1e-3 if name == "cvxpylayers-fast" else 1e-7)
    assert solution.status == ("solved",)
