import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from mechanics.friction import (
    Mode,
    cone_margin,
    cone_rows,
    in_cone,
    project_to_cone,
    project_to_mode,
    required_friction,
    tangent,
)

NUMBER = st.floats(-10, 10)
FORCE = st.tuples(NUMBER, NUMBER).map(np.array)
MU = st.floats(0.01, 2)


def test_on_the_ground_the_tangent_points_right():
    np.testing.assert_array_equal(tangent([0.0, 1.0]), [1, 0])


def test_on_a_wall_to_the_left_of_the_body_the_tangent_points_down():
    np.testing.assert_array_equal(tangent([1.0, 0.0]), [0, -1])


@pytest.mark.parametrize(
    ("mode", "force", "admitted"),
    [
        ("stick", (10.0, 3.0), True),
        ("stick", (10.0, 3.4), False),
        ("stick", (10.0, -3.4), False),
        ("slip+", (10.0, 3.3), True),
        ("slip+", (10.0, -3.3), False),
        ("slip-", (10.0, -3.3), True),
        ("slip-", (10.0, 3.3), False),
        ("slip-", (10.0, 0.0), False),
        ("slip+", (-10.0, -3.3), False),
        ("free", (0.0, 0.0), True),
        ("free", (1.0, 0.0), False),
    ],
)
def test_cone_rows_admit_what_the_mode_allows_at_mu_033(mode, force, admitted):
    rows = cone_rows(Mode(mode), 0.33)
    holds = (rows.inequality @ force >= -1e-12).all() and np.allclose(rows.equality @ force, 0, atol=1e-12)
    assert holds == admitted


def test_required_friction_is_the_ratio_and_pulling_needs_more_than_any():
    forces = [[10.0, 3.87], [10.0, -3.87], [0.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]
    np.testing.assert_allclose(required_friction(forces), [0.387, 0.387, 0, math.inf, math.inf])


@given(FORCE, MU)
def test_margin_is_the_distance_to_the_boundary(force, mu):
    """Against a dense sampling of both edges of the cone."""
    s = np.linspace(0, 30, 30001)
    nearest = min(np.hypot(force[0] - s, force[1] - side * mu * s).min() for side in (1, -1))
    inside = abs(force[1]) <= mu * force[0]
    assert math.isclose(cone_margin(force, mu), nearest if inside else -nearest, abs_tol=2e-3)


def test_in_cone_agrees_with_the_margin_and_forgives_the_tolerance():
    np.testing.assert_array_equal(in_cone([[1.0, 0.2], [1.0, 0.34], [-1.0, 0.0]], 0.33), [True, False, False])
    assert in_cone([1.0, 0.34], 0.33, tolerance=0.02)


@given(FORCE, MU, st.tuples(st.floats(0.1, 10), st.floats(0.1, 10)))
def test_projection_to_the_cone_is_what_non_negative_least_squares_finds(force, mu, weights):
    """The cone is what its two edges span with weights that are not negative: an active-set solver is exact there."""
    edges, root = np.array([[1.0, 1.0], [mu, -mu]]), np.sqrt(weights)
    along, _ = nnls(root[:, None] * edges, root * force)
    np.testing.assert_allclose(project_to_cone(force, mu, np.array(weights)), edges @ along, atol=1e-9)


@given(FORCE, MU, st.sampled_from([Mode.SLIP_POSITIVE, Mode.SLIP_NEGATIVE]))
def test_projection_to_a_slipping_mode_is_the_nearest_point_of_its_ray(force, mu, mode):
    direction = np.array([1.0, mu if mode is Mode.SLIP_POSITIVE else -mu]) / math.hypot(1, mu)
    expected = max(0.0, force @ direction) * direction
    np.testing.assert_allclose(project_to_mode(force, mode, mu), expected, atol=1e-12)


@given(FORCE, MU)
def test_projection_leaves_the_cone_alone_and_is_idempotent(force, mu):
    once = project_to_cone(force, mu)
    if abs(force[1]) <= mu * force[0]:
        np.testing.assert_array_equal(once, force)
    np.testing.assert_allclose(project_to_cone(once, mu), once, atol=1e-12)


def test_free_contacts_carry_nothing():
    np.testing.assert_array_equal(project_to_mode([[3.0, 1.0]], Mode.FREE, 0.3), [[0, 0]])


def test_torch_agrees_with_numpy_and_differentiates_off_the_edges():
    rng = np.random.default_rng(2)
    forces, mu = rng.normal(size=(50, 2)), rng.uniform(0.1, 1, 50)
    weights = np.array([2.0, 0.5])
    np.testing.assert_allclose(
        project_to_cone(torch.tensor(forces), torch.tensor(mu), torch.tensor(weights)).numpy(),
        project_to_cone(forces, mu, weights),
    )
    tensors = [torch.tensor(value, requires_grad=True) for value in (forces, mu)]
    assert torch.autograd.gradcheck(project_to_cone, tensors)
    assert torch.autograd.gradcheck(cone_margin, tensors)


def test_the_derivative_at_no_force_is_finite():
    force = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    (cone_margin(force, 0.3) + project_to_cone(force, 0.3).sum()).backward()
    assert force.grad is not None
    assert force.grad.isfinite().all()


def test_negative_friction_is_refused():
    with pytest.raises(ValueError, match="mu"):
        cone_rows(Mode.STICK, -0.1)
