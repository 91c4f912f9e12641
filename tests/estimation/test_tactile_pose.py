"""The contract of tactile poses: a finger's frame, open directions, and how fingers are joined."""

import numpy as np
import pytest

from estimation.tactile_pose import (
    ANGLE_LENGTH,
    UNOBSERVED_BEYOND,
    FingerModel,
    GraspPrior,
    PoseStatus,
    TactilePose,
    fuse,
    left_difference,
    left_moved,
    open_directions,
)
from mechanics import se2
from mechanics.camera import CameraModel

CAMERA = CameraModel(224, 171, np.array([[186.0, 0, 111.5], [0, 186.0, 85.0], [0, 0, 1]]))
LEFT = [[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]
RIGHT = [[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]
PRIOR = GraspPrior(np.array([0.01, -0.045, 0.2]))


def seen(true: np.ndarray, information: np.ndarray) -> TactilePose:
    """The posterior of a perfect image of an object at ``true`` under `PRIOR`, in closed form."""
    total = PRIOR.information + information
    delta = np.asarray(np.linalg.solve(total, information @ left_difference(true, PRIOR.pose)), float)
    covariance = np.asarray(np.linalg.inv(total), float)
    return TactilePose(
        left_moved(PRIOR.pose, delta), covariance, information, open_directions(information), edges=np.zeros((2, 2))
    )


def described(X) -> dict:
    return {"sensor": "soft_bubble", "camera": CAMERA.as_dict(), "X_ee_finger": X}


@pytest.mark.parametrize(("X", "sign"), [(LEFT, 1.0), (RIGHT, -1.0)])
def test_the_right_finger_sees_x_from_behind(X, sign: float) -> None:
    finger = FingerModel.of(described(X), np.zeros((171, 224), np.uint16))
    np.testing.assert_allclose(finger.in_ee([0.01, 0.02]), [sign * 0.01, 0.02])
    points = np.random.default_rng(0).normal(size=(4, 3, 2))
    np.testing.assert_allclose(finger.in_finger(finger.in_ee(points)), points)


def test_a_description_that_lacks_something_is_refused_by_name() -> None:
    for key in ("sensor", "camera", "X_ee_finger"):
        with pytest.raises(ValueError, match=key):
            FingerModel.of({k: v for k, v in described(LEFT).items() if k != key}, np.zeros((171, 224), np.uint16))
    with pytest.raises(ValueError, match="take the reference anew"):
        FingerModel.of(described(LEFT), np.zeros((172, 224), np.uint16))


def test_a_direction_is_open_from_the_stated_deviation_on() -> None:
    tight, loose = (0.9 * UNOBSERVED_BEYOND) ** -2, (1.1 * UNOBSERVED_BEYOND) ** -2
    assert len(open_directions(np.diag([tight, tight, tight * ANGLE_LENGTH**2]))) == 0
    np.testing.assert_allclose(np.abs(open_directions(np.diag([tight, loose, tight]))), [[0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(np.abs(open_directions(np.diag([tight, tight, loose * ANGLE_LENGTH**2]))), [[0, 0, 1]])
    assert open_directions(np.zeros((3, 3))).shape == (3, 3)


def test_open_directions_are_orthonormal_and_say_what_is_open() -> None:
    # one edge across the direction (cos, sin), 20 mm long: along it nothing is known
    n = np.array([np.cos(0.4), np.sin(0.4)])
    J = np.array([[*n, 0.01], [*n, -0.01]])
    found = open_directions(J.T @ J / 1e-10)
    assert found.shape == (1, 3)
    np.testing.assert_allclose(np.abs(found[0, :2]), np.abs([-n[1], n[0]]), atol=1e-6)


def test_two_fingers_that_see_different_things_together_see_both() -> None:
    true = left_moved(PRIOR.pose, np.array([0.002, -0.001, 0.03]))
    a, b = seen(true, np.diag([1e10, 0.0, 0.0])), seen(true, np.diag([0.0, 1e10, 1e8]))
    both = fuse(PRIOR, [a, b])
    assert len(a.unobserved) == 2 and len(b.unobserved) == 1 and len(both.unobserved) == 0
    np.testing.assert_allclose(left_difference(both.pose, true), 0, atol=1e-6)
    expected = np.linalg.inv(PRIOR.information + np.diag([1e10, 1e10, 1e8]))
    np.testing.assert_allclose(both.covariance, expected, rtol=1e-6, atol=1e-20)
    assert len(both.edges) == 4


def test_the_prior_counts_once_however_many_fingers_look() -> None:
    true = left_moved(PRIOR.pose, np.array([0.003, 0.0, 0.0]))
    information = np.diag([1 / 0.003**2] * 2 + [1e3])  # as good as the prior
    pose = fuse(PRIOR, [seen(true, information)] * 2)
    # the image twice, the prior once: two thirds of the way
    assert left_difference(pose.pose, PRIOR.pose)[0] == pytest.approx(0.002, rel=1e-6)


def test_a_finger_without_a_pose_adds_nothing() -> None:
    true = left_moved(PRIOR.pose, np.array([0.001, 0.001, 0.0]))
    good = seen(true, np.eye(3) * 1e9)
    blind = TactilePose.unknown(PRIOR, PoseStatus.TORN, "half of it is missing")
    assert fuse(PRIOR, [blind, good]) is good
    nothing = fuse(PRIOR, [blind, blind])
    assert (nothing.status, nothing.reason) == (PoseStatus.TORN, "half of it is missing")
    np.testing.assert_array_equal(nothing.pose, PRIOR.pose)
    assert len(nothing.unobserved) == 3 and not nothing.information.any()
    assert fuse(PRIOR, []).status is PoseStatus.NO_CONTACT


def test_a_turn_about_the_grasp_centre_moves_nothing_there() -> None:
    pose = left_moved(np.array([0.01, -0.045, 0.0]), np.array([0.0, 0.0, 0.1]))
    # a point of the object that was at ee's origin stays there
    z = complex(*pose[:2]) + np.exp(1j * pose[2]) * complex(-0.01, 0.045)
    assert abs(z) < 1e-12


def test_left_perturbations_are_those_of_the_group() -> None:
    rng = np.random.default_rng(0)
    for pose, origin, delta in rng.uniform(-2.0, 2.0, (50, 3, 3)):
        np.testing.assert_allclose(
            se2.matrix(left_difference(pose, origin)),
            se2.matrix(pose) @ np.linalg.inv(se2.matrix(origin)),
            atol=1e-14,
        )
        np.testing.assert_allclose(
            se2.matrix(left_moved(pose, delta)), se2.matrix(delta) @ se2.matrix(pose), atol=1e-14
        )
        np.testing.assert_array_equal(left_moved(pose, delta[None])[0], left_moved(pose, delta))
