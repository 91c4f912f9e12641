import math

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given
from hypothesis import strategies as st

from mechanics import se2

COORDINATE = st.floats(-10, 10)
ANGLE = st.floats(-math.pi, math.pi)
POSE = st.tuples(COORDINATE, COORDINATE, st.floats(-8, 8)).map(np.array)
TWIST = st.tuples(COORDINATE, COORDINATE, ANGLE).map(np.array)
POINT = st.tuples(COORDINATE, COORDINATE).map(np.array)


def homogeneous(pose):
    x, y, theta = pose
    return np.array([[math.cos(theta), -math.sin(theta), x], [math.sin(theta), math.cos(theta), y], [0, 0, 1.0]])


def hat(twist):
    return np.array([[0, -twist[2], twist[0]], [twist[2], 0, twist[1]], [0, 0, 0]])


@given(POSE)
def test_matrix_is_the_homogeneous_matrix(pose):
    np.testing.assert_allclose(se2.matrix(pose), homogeneous(pose), rtol=0, atol=1e-15)


@given(POSE, POSE)
def test_compose_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(homogeneous(se2.compose(a, b)), homogeneous(a) @ homogeneous(b), atol=1e-13)


@given(POSE)
def test_inverse_is_the_inverse_matrix(pose):
    np.testing.assert_allclose(homogeneous(se2.inverse(pose)), np.linalg.inv(homogeneous(pose)), atol=1e-12)


@given(POSE, POSE)
def test_between_is_the_relative_matrix_with_its_angle_wrapped(a, b):
    relative = se2.between(a, b)
    np.testing.assert_allclose(homogeneous(relative), np.linalg.solve(homogeneous(a), homogeneous(b)), atol=1e-12)
    assert -math.pi < relative[2] <= math.pi


@given(TWIST)
def test_exp_is_the_matrix_exponential(twist):
    np.testing.assert_allclose(homogeneous(se2.exp(twist)), scipy.linalg.expm(hat(twist)), atol=1e-12)


@given(TWIST.filter(lambda twist: abs(twist[2]) < 3))
def test_log_undoes_the_matrix_exponential(twist):
    matrix = scipy.linalg.expm(hat(twist))
    pose = np.array([matrix[0, 2], matrix[1, 2], math.atan2(matrix[1, 0], matrix[0, 0])])
    np.testing.assert_allclose(se2.log(pose), twist, atol=1e-11)


@pytest.mark.parametrize("omega", [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 0.59, 0.61, 3.0, math.pi])
def test_exp_is_accurate_at_every_size_of_angle(omega):
    import mpmath

    with mpmath.workdps(50):
        w = mpmath.mpf(omega)
        s = mpmath.sin(w) / w if w else mpmath.mpf(1)
        c = (1 - mpmath.cos(w)) / w if w else mpmath.mpf(0)
        expected = [float(s * 2 - c * 3), float(c * 2 + s * 3), omega]
    np.testing.assert_allclose(se2.exp([2.0, 3.0, omega]), expected, rtol=4e-16, atol=4e-16)


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction_and_lands_in_the_half_open_circle(angle):
    wrapped = float(se2.wrap(angle))
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-11)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-11)


def test_wrap_takes_minus_pi_to_pi_and_leaves_small_angles_alone():
    np.testing.assert_array_equal(se2.wrap([-math.pi, math.pi, 1e-300, -3.0]), [math.pi, math.pi, 1e-300, -3.0])


@given(POSE, TWIST)
def test_adjoint_conjugates_twists(X_AB, twist_B):
    X = homogeneous(X_AB)
    expected = X @ hat(twist_B) @ np.linalg.inv(X)
    np.testing.assert_allclose(hat(se2.adjoint(X_AB) @ twist_B), expected, atol=1e-11)


@given(POSE, POINT)
def test_transform_takes_points_as_the_matrix_does(X_AB, p_B):
    np.testing.assert_allclose(se2.transform(X_AB, p_B), (homogeneous(X_AB) @ [*p_B, 1])[:2], atol=1e-13)


@given(POSE, POSE, st.floats(0, 1))
def test_interpolation_follows_the_screw_at_constant_rate(a, b, s):
    relative = np.linalg.solve(homogeneous(a), homogeneous(b))
    if relative[0, 0] < -0.99:  # near half a turn both ways round are as short
        return
    expected = homogeneous(a) @ scipy.linalg.expm(s * np.real(scipy.linalg.logm(relative)))
    np.testing.assert_allclose(homogeneous(se2.interpolate(a, b, s)), expected, atol=1e-9)


def test_interpolate_broadcasts_the_fraction():
    path = se2.interpolate([0, 0, 0], [1, 0, 0], np.linspace(0, 1, 5))
    np.testing.assert_allclose(path, [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0], [0.75, 0, 0], [1, 0, 0]], atol=1e-15)


def test_interpolate_takes_the_short_way_across_half_a_turn():
    halfway = se2.interpolate([0, 0, 3.0], [0, 0, -3.0], 0.5)
    assert math.isclose(math.cos(halfway[2]), -1.0, abs_tol=1e-12)


FUNCTIONS = {
    "compose": (se2.compose, (3, 3)),
    "inverse": (se2.inverse, (3,)),
    "between": (se2.between, (3, 3)),
    "exp": (se2.exp, (3,)),
    "log": (se2.log, (3,)),
    "matrix": (se2.matrix, (3,)),
    "adjoint": (se2.adjoint, (3,)),
    "transform": (se2.transform, (3, 2)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_torch_and_numpy_agree_over_batches_and_single_values(name):
    function, sizes = FUNCTIONS[name]
    rng = np.random.default_rng(3)
    batches = [rng.normal(size=(4, 5, size)) for size in sizes]
    whole = function(*batches)
    np.testing.assert_allclose(function(*map(torch.tensor, batches)).numpy(), whole, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(function(*(batch[1, 2] for batch in batches)), whole[1, 2], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.2, 0.7, -2.5])
def test_derivatives_to_second_order_match_finite_differences(name, angle):
    function, sizes = FUNCTIONS[name]
    rng = np.random.default_rng(4)
    inputs = []
    for size in sizes:
        value = rng.normal(size=size)
        value[2:] = angle
        inputs.append(torch.tensor(value, requires_grad=True))
    assert torch.autograd.gradcheck(function, inputs, atol=1e-7)
    assert torch.autograd.gradgradcheck(function, inputs, atol=1e-6)


def test_interpolate_is_differentiable_where_the_poses_coincide():
    a, b = (torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, requires_grad=True) for _ in range(2))
    s = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(se2.interpolate, (a, b, s))


def test_a_wrong_shape_is_named_with_what_was_expected_and_received():
    with pytest.raises(ValueError, match=r"compose: X_BC: expected shape \(\.\.\., 3\), received \(4, 2\)"):
        se2.compose(np.zeros(3), np.zeros((4, 2)))


def test_leading_dimensions_that_do_not_broadcast_are_named():
    with pytest.raises(ValueError, match=r"compose: .*X_AB \(2, 3\), X_BC \(4, 3\)"):
        se2.compose(np.zeros((2, 3)), np.zeros((4, 3)))


def test_numpy_constants_follow_torch_arguments():
    answer = se2.compose(np.array([1.0, 0.0, 0.0]), torch.zeros(3, dtype=torch.float64))
    assert isinstance(answer, torch.Tensor)
    assert answer.dtype == torch.float64
