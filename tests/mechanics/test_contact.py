import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mechanics.contact import force_in_world, frame, gravity_wrench, jacobian, mode_of_motion
from mechanics.friction import Mode

NUMBER = st.floats(-3, 3)
POINT = st.tuples(NUMBER, NUMBER).map(np.array)
TRIPLE = st.tuples(NUMBER, NUMBER, NUMBER).map(np.array)
NORMAL = st.floats(-math.pi, math.pi).map(lambda a: np.array([math.cos(a), math.sin(a)]))


def test_on_the_ground_the_frame_is_up_and_right():
    np.testing.assert_array_equal(frame([0.0, 1.0]), [[0, 1], [1, 0]])
    np.testing.assert_array_equal(force_in_world([0.0, 1.0], [5.0, 2.0]), [2, 5])


def test_a_turning_body_moves_its_right_hand_point_up():
    """ω = 2 rad/s counter-clockwise, point 0.5 m to the right: 1 m/s up, which is +n on the ground."""
    np.testing.assert_allclose(jacobian([0.0, 1.0], [0.5, 0.0]) @ [0, 0, 2.0], [1, 0])


def test_a_turning_body_moves_its_bottom_right():
    np.testing.assert_allclose(jacobian([0.0, 1.0], [0.0, -0.5]) @ [0, 0, 2.0], [0, 1])


@given(NORMAL, POINT, TRIPLE)
def test_jacobian_gives_the_points_velocity_along_the_frame(normal, p, twist):
    velocity = twist[:2] + twist[2] * np.array([-p[1], p[0]])
    t = np.array([normal[1], -normal[0]])
    np.testing.assert_allclose(jacobian(normal, p) @ twist, [velocity @ normal, velocity @ t], atol=1e-12)


@given(NORMAL, POINT, POINT)
def test_its_transpose_gives_the_wrench_of_the_force(normal, p, f):
    force = force_in_world(normal, f)
    moment = p[0] * force[1] - p[1] * force[0]
    np.testing.assert_allclose(jacobian(normal, p).T @ f, [*force, moment], atol=1e-12)


def test_weight_pulls_down_and_turns_clockwise_when_it_hangs_to_the_right():
    np.testing.assert_allclose(gravity_wrench(2.0, [0.1, 0.3], 9.81), [0, -19.62, -1.962])


@pytest.mark.parametrize(("speed", "mode"), [(0.1, "slip-"), (-0.1, "slip+"), (1e-9, "stick")])
def test_a_body_that_slides_right_is_held_back(speed, mode):
    """On the ground t = +x; the force on a body that slides right points left: f_t = −µ f_n, slip-."""
    assert mode_of_motion(speed, tolerance=1e-6) is Mode(mode)


def test_friction_never_feeds_energy_in():
    """For both slips the force on the body opposes its motion along t."""
    for speed in (0.2, -0.2):
        f_t = mode_of_motion(speed).slip_sign * 0.3 * 10
        assert f_t * speed < 0


def test_batches_and_torch_agree():
    rng = np.random.default_rng(0)
    angle, p = rng.normal(size=(4, 5)), rng.normal(size=(4, 5, 2))
    normals = np.stack([np.cos(angle), np.sin(angle)], -1)
    J = jacobian(normals, p)
    assert J.shape == (4, 5, 2, 3)
    np.testing.assert_allclose(jacobian(torch.tensor(normals), torch.tensor(p)).numpy(), J)
    np.testing.assert_allclose(jacobian(normals[2, 3], p[2, 3]), J[2, 3])
