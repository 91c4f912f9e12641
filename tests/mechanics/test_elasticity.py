import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mechanics.elasticity import Elasticity, check_positive_definite, scaled

# K_bubbles as the paper prints it, and the radius of gyration of the grasped object (blueprint, section 3)
PRINTED = np.array([[2208.96, -143.31, 399.86], [-143.31, 1875.92, -313.57], [399.86, -313.57, 1608.49]])
BUBBLE = Elasticity(scaled(PRINTED, 0.0448))
DIAGONAL = Elasticity(np.diag([1000.0, 2000.0, 4.0]))

POSE = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1)).map(np.array)
GRASP = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-1, 1)).map(np.array)
WRENCH = st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(-0.3, 0.3)).map(np.array)


def test_scaling_turns_the_printed_stiffness_into_si():
    K = scaled(PRINTED, 0.0448)
    assert math.isclose(K[2, 2], 1608.49 * 0.0448**2)  # 3.2 N·m/rad
    assert math.isclose(K[0, 2], 399.86 * 0.0448)
    assert K[0, 1] == -143.31


def test_pushing_the_finger_right_pushes_the_object_right():
    """2 mm along +x at 1000 N/m: 2 N on the object along +x."""
    np.testing.assert_allclose(DIAGONAL.wrench_at([0, 0, 0], [0, 0, 0], [0.002, 0, 0]), [2, 0, 0])


def test_displacement_is_taken_in_the_grasp_frame():
    """The grasp frame stands at 90°: world +y is its +x, where the finger has 1000 N/m."""
    grasp = [0.01, 0.0, math.pi / 2]
    w = DIAGONAL.wrench_at([0, 0, 0], grasp, [0.01, 0.003, math.pi / 2])
    np.testing.assert_allclose(w, [0, 3, 0], atol=1e-12)


def test_at_zero_wrench_the_end_effector_sits_on_the_grasp_frame():
    np.testing.assert_allclose(BUBBLE.ee_pose([1, 2, 0.3], [0, 0.045, 0], [0, 0, 0])[2], 0.3)
    np.testing.assert_allclose(
        BUBBLE.ee_pose([1, 2, 0.3], [0, 0.045, 0], [0, 0, 0])[:2],
        [1 - 0.045 * math.sin(0.3), 2 + 0.045 * math.cos(0.3)],
    )


def test_the_displacement_is_a_pose_and_not_a_twist():
    """2 mm and 5° at once: through the exponential the force would differ by 0.2 N."""
    w = BUBBLE.wrench_at([0, 0, 0], [0, 0, 0], [0.002, 0.0, math.radians(5)])
    np.testing.assert_allclose(w, scaled(PRINTED, 0.0448) @ [0.002, 0.0, math.radians(5)], rtol=1e-12)


@given(POSE, GRASP, WRENCH)
def test_wrench_comes_back_from_the_pose_it_needs(X_W_go, grasp, w):
    X_W_ee = BUBBLE.ee_pose(X_W_go, grasp, w)
    np.testing.assert_allclose(BUBBLE.wrench_at(X_W_go, grasp, X_W_ee), w, atol=1e-9)


@given(POSE, GRASP, WRENCH)
def test_go_pose_inverts_ee_pose(X_W_go, grasp, w):
    X_W_ee = BUBBLE.ee_pose(X_W_go, grasp, w)
    np.testing.assert_allclose(BUBBLE.go_pose(X_W_ee, grasp, w), X_W_go, atol=1e-12)


def test_hanging_weight_sags_by_the_compliance():
    """0.1 kg held at its centre of mass: the object hangs 0.981 N / 2000 N/m below the finger."""
    X_W_ee = DIAGONAL.ee_pose([0, 0, 0], [0, 0, 0], [0, 0.981, 0])
    np.testing.assert_allclose(X_W_ee, [0, 0.981 / 2000, 0])


def test_a_full_turn_of_the_object_does_not_strain_the_finger():
    w = DIAGONAL.wrench_at([0, 0, 3.0], [0, 0, 0], [0, 0, 3.0 - 2 * math.pi])
    np.testing.assert_allclose(w, 0, atol=1e-12)


def test_torch_differentiates_through_poses_wrenches_and_stiffness():
    rng = np.random.default_rng(0)
    go, grasp = (torch.tensor(0.3 * rng.normal(size=(2, 3)), requires_grad=True) for _ in range(2))
    w = torch.tensor([[1.0, -3.0, 0.05], [0.3, 2.0, -0.1]], dtype=torch.float64, requires_grad=True)
    L = torch.linalg.cholesky(torch.tensor(np.array(BUBBLE.stiffness)) / 1000).requires_grad_()

    def ee(go, grasp, w, L):
        return Elasticity(1000 * L @ L.mT).ee_pose(go, grasp, w)

    def back(go, grasp, w, L):
        return Elasticity(1000 * L @ L.mT).go_pose(go, grasp, w)

    def felt(go, grasp, w, L):
        # displacements of millimetres, so that the angle stays away from half a turn
        return Elasticity(1000 * L @ L.mT).wrench_at(go, grasp, go + 0.001 * w)

    for function in (ee, back, felt):
        assert torch.autograd.gradcheck(function, (go, grasp, w, L), atol=1e-5)


def test_go_pose_and_its_derivative_hold_where_the_wrench_turns_a_soft_finger():
    """A weak angle coupled to the force: the object turns by a quarter of a radian, and its angle's equation bends."""
    soft = Elasticity([[100.0, 0, 1.0], [0, 100.0, -1.0], [1.0, -1.0, 0.1]])
    X_W_go, grasp, w = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.02, 0.1]), np.array([1.0, -1.0, 0.0])
    X_W_ee = soft.ee_pose(X_W_go, grasp, w)
    assert abs(X_W_ee[2] - X_W_go[2] - grasp[2]) > 0.2
    np.testing.assert_allclose(soft.go_pose(X_W_ee, grasp, w), X_W_go, atol=1e-12)
    inputs = [torch.tensor(value, requires_grad=True) for value in (X_W_ee, grasp, w)]
    assert torch.autograd.gradcheck(soft.go_pose, inputs)


def test_a_wrench_beyond_what_the_finger_carries_is_refused():
    soft = Elasticity(np.array([[100.0, 0, 0.9], [0, 100.0, 0], [0.9, 0, 0.01]]))
    with pytest.raises(ValueError, match="expected a wrench that the finger can carry"):
        soft.go_pose([0, 0, 0], [0, 0, 0], [100.0, 50.0, 0.0])


def test_an_indefinite_stiffness_is_refused_with_its_smallest_eigenvalue():
    with pytest.raises(ValueError, match="smallest eigenvalue -1"):
        check_positive_definite(np.diag([2.0, 3.0, -1.0]))
    with pytest.raises(ValueError, match="smallest eigenvalue -1"):
        Elasticity(np.diag([2.0, 3.0, -1.0]))


def test_an_asymmetric_stiffness_is_refused():
    with pytest.raises(ValueError, match="symmetric"):
        Elasticity([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])


def test_a_length_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="rho"):
        scaled(PRINTED, 0.0)
