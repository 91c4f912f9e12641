import math

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from mechanics import se2, wrench

NUMBER = st.floats(-10, 10)
TRIPLE = st.tuples(NUMBER, NUMBER, NUMBER).map(np.array)
POINT = st.tuples(NUMBER, NUMBER).map(np.array)


def test_a_force_up_right_of_the_point_turns_counter_clockwise():
    # 3 N up at 0.2 m to the right of the new point
    np.testing.assert_allclose(wrench.about([0, 3.0, 0], [0.2, 0], [0, 0]), [0, 3, 0.6])


def test_a_force_to_the_right_above_the_point_turns_clockwise():
    np.testing.assert_allclose(wrench.about([2.0, 0, 0], [0, 0.1], [0, 0]), [2, 0, -0.2])


def test_a_quarter_turn_of_axes_takes_x_to_y():
    np.testing.assert_allclose(wrench.rotated([1.0, 0, 5.0], math.pi / 2), [0, 1, 5], atol=1e-15)


@given(TRIPLE, POINT, POINT)
def test_change_of_point_matches_the_spatial_cross_product(w, p_from, p_to):
    moved = wrench.about(w, p_from, p_to)
    arm = np.array([*(p_from - p_to), 0.0])
    np.testing.assert_allclose(moved[2], w[2] + np.cross(arm, [w[0], w[1], 0.0])[2], atol=1e-12)
    np.testing.assert_array_equal(moved[:2], w[:2])


@given(TRIPLE, TRIPLE, TRIPLE)
def test_power_does_not_depend_on_the_frame(X_AB, w_B, twist_B):
    """w · twist is the same number in A and in B."""
    in_A = wrench.transform(X_AB, w_B) @ (se2.adjoint(X_AB) @ twist_B)
    assert math.isclose(in_A, w_B @ twist_B, rel_tol=1e-9, abs_tol=1e-9)


@given(TRIPLE, TRIPLE, TRIPLE)
def test_transforms_chain(X_AB, X_BC, w_C):
    chained = wrench.transform(X_AB, wrench.transform(X_BC, w_C))
    np.testing.assert_allclose(wrench.transform(se2.compose(X_AB, X_BC), w_C), chained, atol=1e-10)


def test_torch_and_numpy_agree_and_torch_differentiates():
    rng = np.random.default_rng(0)
    X, w = rng.normal(size=(2, 6, 3))
    np.testing.assert_allclose(wrench.transform(torch.tensor(X), torch.tensor(w)).numpy(), wrench.transform(X, w))
    tensors = [torch.tensor(value[:2], requires_grad=True) for value in (X, w)]
    assert torch.autograd.gradcheck(wrench.transform, tensors)


def test_one_wrench_broadcasts_over_many_points():
    moved = wrench.about([0.0, 1.0, 0.0], np.array([[1.0, 0], [2.0, 0], [3.0, 0]]), [0.0, 0.0])
    np.testing.assert_allclose(moved, [[0, 1, 1], [0, 1, 2], [0, 1, 3]])
