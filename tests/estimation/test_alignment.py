"""The alignment step against boundary points made by hand."""

import numpy as np
import pytest

from estimation.alignment import BoundaryPoints, Systematic, align
from estimation.tactile_pose import GraspPrior, PoseStatus, left_difference, left_moved
from mechanics.catalogue import load_object
from mechanics.polygon import Polygon

NONE = Systematic(1e-9, 1e-9, 1e-9, 1e-9)
BOX = load_object("tall_box").polygon
PRIOR = GraspPrior(np.array([0.0, -0.045, 0.0]))
OFF = np.array([0.002, -0.003, np.radians(3.0)])


def seen_of(outline: Polygon, pose, rng=None, sigma: float = 1e-4, view: float = 0.033, normals: bool = True):
    """Points every 2 mm of the outline within ``view`` of the finger's middle, by complex numbers."""
    boundary = outline.boundary(2e-3)
    z = (boundary.points[:, 0] + 1j * boundary.points[:, 1]) * np.exp(1j * pose[2]) + complex(*pose[:2])
    n = (boundary.normals[:, 0] + 1j * boundary.normals[:, 1]) * np.exp(1j * pose[2])
    if rng is not None:
        z = z + n * sigma * rng.standard_normal(len(z))
    on = np.abs(z) < view
    points, facing = (np.column_stack((w.real, w.imag))[on] for w in (z, n))
    return BoundaryPoints(points, sigma, facing if normals else None), boundary.faces[on]


@pytest.mark.parametrize("name", ["tall_box", "triangle", "pentagon", "heptagon", "z"])
@pytest.mark.parametrize("normals", [True, False])
def test_perfect_points_give_the_pose_and_each_its_edge(name: str, normals: bool) -> None:
    outline = load_object(name).polygon
    prior = GraspPrior(np.array([0.0, -0.045, 0.0]))
    true = left_moved(prior.pose, OFF)
    points, faces = seen_of(outline, true, normals=normals)
    aligned = align(outline, points, prior, systematic=NONE)
    assert aligned.pose.status is PoseStatus.OK
    np.testing.assert_allclose(left_difference(aligned.pose.pose, true), 0, atol=2e-5)
    assert np.mean(aligned.edges == faces) > 0.97  # at a corner two edges are as near
    assert aligned.explained > 0.97


def test_known_edges_are_kept_to() -> None:
    points, faces = seen_of(BOX, left_moved(PRIOR.pose, OFF))
    told = BoundaryPoints(points.points, points.sigma, None, faces)
    assert (align(BOX, told, PRIOR).edges == faces).all()


def test_along_parallel_sides_the_pose_stays_at_the_prior_and_says_so() -> None:
    prior = GraspPrior(np.zeros(3))
    true = np.array([0.002, 0.004, 0.05])
    points, _ = seen_of(BOX, true)  # the box's middle: its ends are 73 mm away
    for metric in ("line", "point"):
        pose = align(BOX, points, prior, metric=metric).pose
        (open_,) = pose.unobserved
        sides = np.array([-np.sin(true[2]), np.cos(true[2]), 0.0])
        assert abs(open_ @ sides) > 0.995
        left = left_difference(pose.pose, prior.pose)
        # what is known is that the sides pass through the true pose: the prior chooses the nearest such pose
        assert abs(left[:2] @ [np.cos(true[2]), np.sin(true[2])] - true[:2] @ [np.cos(true[2]), np.sin(true[2])]) < 2e-4
        assert abs(left[:2] @ sides[:2]) < 4e-4
        assert np.sqrt(sides @ pose.covariance @ sides) == pytest.approx(0.003, rel=0.1)


def test_information_is_that_of_the_points_and_the_prior_counts_once() -> None:
    # a single straight edge y = 0 seen at x = ±20 mm, sigma 0.1 mm: two points on a line
    plate = Polygon([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.0], [-0.1, 0.0]])
    points = BoundaryPoints([[-0.02, 0.0], [0.02, 0.0]], 1e-4, [[0, 1], [0, 1]])
    prior = GraspPrior(np.zeros(3))
    pose = align(plate, points, prior, systematic=NONE, least=2).pose
    expected = np.diag([0.0, 2 / 1e-8, 2 * 0.02**2 / 1e-8])
    np.testing.assert_allclose(pose.information, expected, rtol=1e-3, atol=1.0)
    np.testing.assert_allclose(pose.covariance, np.linalg.inv(expected + prior.information), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("systematic", [NONE, Systematic(0.3e-3, np.radians(0.3), 1e-9, 1e-9)])
def test_stated_covariance_is_the_scatter_of_the_estimates(systematic: Systematic) -> None:
    rng = np.random.default_rng(1)
    squared = []
    for _ in range(150):
        true = left_moved(PRIOR.pose, np.sqrt(np.diag(PRIOR.covariance)) * rng.standard_normal(3))
        points, faces = seen_of(BOX, true, rng)
        facing = np.asarray(points.normals)
        moved = points.points + facing * (systematic.offset * rng.standard_normal(4)[faces])[:, None]
        for face in np.unique(faces):
            own = faces == face
            along = moved[own] @ np.array([-facing[own][0, 1], facing[own][0, 0]])
            moved[own] += facing[own] * (systematic.tilt * rng.standard_normal() * (along - along.mean()))[:, None]
        pose = align(BOX, BoundaryPoints(moved, points.sigma, facing), PRIOR, systematic=systematic).pose
        error = left_difference(pose.pose, true)
        squared.append(error @ np.linalg.solve(pose.covariance, error))
    assert np.mean(squared) == pytest.approx(3.0, rel=0.3)


def test_points_of_nothing_are_left_out() -> None:
    rng = np.random.default_rng(2)
    true = left_moved(PRIOR.pose, OFF)
    points, _ = seen_of(BOX, true, rng)
    m = len(points)
    stray = rng.uniform(-0.012, 0.012, (m // 4, 2))
    both = BoundaryPoints(np.vstack((points.points, stray)), 1e-4)
    aligned = align(BOX, both, PRIOR)
    assert np.abs(left_difference(aligned.pose.pose, true) * (1, 1, 0.03)).max() < 1.5e-4
    assert aligned.weights[m:].max() < 0.5 < np.median(aligned.weights[:m])


def test_another_outline_is_a_mismatch() -> None:
    triangle = load_object("triangle").polygon
    points, _ = seen_of(triangle, np.array([0.0, -0.05, 0.3]))
    pose = align(BOX, points, PRIOR).pose
    assert pose.status is PoseStatus.MISMATCH and "outline" in pose.reason
    np.testing.assert_array_equal(pose.pose, PRIOR.pose)


def test_edges_far_from_where_the_grasp_should_have_them_are_a_mismatch() -> None:
    sure = GraspPrior(PRIOR.pose, np.diag([1e-4, 1e-4, 1e-3]) ** 2)
    points, _ = seen_of(BOX, left_moved(PRIOR.pose, np.array([0.003, 0.003, 0.0])))
    assert align(BOX, points, sure).pose.status is PoseStatus.MISMATCH


def test_too_few_points_are_no_edge() -> None:
    pose = align(BOX, BoundaryPoints(np.zeros((2, 2)), 1e-3), PRIOR).pose
    assert pose.status is PoseStatus.NO_EDGE
    assert len(pose.unobserved) == 3


@pytest.mark.parametrize(("points", "sigma"), [([[0, np.nan]], 1e-3), ([[0, 0]], 0.0), ([[0, 0]], np.inf)])
def test_points_that_are_not_finite_or_of_no_sigma_are_refused(points, sigma) -> None:
    with pytest.raises(ValueError, match="boundary points"):
        BoundaryPoints(points, sigma)
