"""The closed form of the friction-cone program against solvers that know nothing of it."""

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import nnls

from estimation.cone_projection import cone_rays, fit_sites, project, square_root
from mechanics.contact import jacobian
from mechanics.friction import in_cone

RNG = np.random.default_rng(4)
ABOUT = np.array([0.01, 0.04])


def random_information(rng=RNG, rank=3):
    """An information matrix whose force is known to about 0.05 N, whose torque to 10 N·mm, correlated."""
    columns = np.diag([20.0, 20.0, 100.0]) @ rng.normal(size=(3, rank))
    return columns @ columns.T


def random_candidates(n, mu, rng=RNG):
    angle = rng.uniform(-np.pi, np.pi, n)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return rng.uniform(-0.1, 0.1, (n, 2)), normals, cone_rays(normals, mu)


def grasp_map(point):
    """G (3, 2): a force at the point to its wrench."""
    x, y = point - ABOUT
    return np.array([[1.0, 0.0], [0.0, 1.0], [-y, x]])


def by_nnls(point, rays, wrench, root):
    columns = root @ grasp_map(point) @ rays.T
    shares, residual = nnls(columns, root @ wrench)
    return shares @ rays, residual**2


@pytest.mark.parametrize("mu", [0.0, 0.1, 0.33, 1.0, 3.0])
def test_every_candidate_equals_an_active_set_solver(mu):
    information = random_information()
    root = square_root(information)
    points, _, rays = random_candidates(150, mu)
    wrench = np.array([1.0, -2.0, 0.1])
    force, chi2 = project(points, rays, wrench, root, ABOUT)
    scale = float(wrench @ information @ wrench)
    for k in range(len(points)):
        expected_force, expected = by_nnls(points[k], rays[k], wrench, root)
        assert chi2[k] == pytest.approx(expected, rel=1e-9, abs=1e-12 * scale)
        assert force[k] == pytest.approx(expected_force, rel=1e-9, abs=1e-9)


def test_equals_an_interior_point_solver_on_the_cone_of_normal_and_tangent():
    mu = 0.33
    information = random_information()
    wrench = np.array([1.5, 2.0, -0.05])
    information = information / (wrench @ information @ wrench)  # the solver's tolerances are about one
    root = square_root(information)
    points, normals, rays = random_candidates(12, mu)
    chi2 = project(points, rays, wrench, root, ABOUT).chi2
    for k in range(len(points)):
        f = cp.Variable(2)  # (f_n, f_t)
        # the rows of the contact Jacobian are the normal's and the tangent's wrenches
        J = jacobian(normals[k], points[k] - ABOUT)
        residual = root @ wrench - (root @ J.T) @ f
        problem = cp.Problem(cp.Minimize(cp.sum_squares(residual)), [cp.abs(f[1]) <= mu * f[0]])
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
        assert f.value is not None
        least = float(np.sum((root @ wrench - root @ J.T @ f.value) ** 2))
        assert chi2[k] == pytest.approx(least, rel=1e-9, abs=1e-9)


def test_all_four_cases_occur_and_keep_to_the_cone():
    mu = 0.4
    root = square_root(np.diag([400.0, 400.0, 1e4]))
    normal = np.array([[0.0, 1.0]])
    rays, point = cone_rays(normal, mu), ABOUT[None]
    for wrench, force in [
        ([0.2, 2.0, 0.0], [0.2, 2.0]),  # inside
        ([2.0, 2.0, 0.0], np.array([mu, 1.0]) * (2 * mu + 2) / (1 + mu**2)),  # beyond one edge: the nearest point of it
        ([-2.0, 2.0, 0.0], np.array([-mu, 1.0]) * (2 * mu + 2) / (1 + mu**2)),
        ([0.3, -2.0, 0.0], [0.0, 0.0]),  # it pulls
    ]:
        fit = project(point, rays, np.array(wrench), root, ABOUT)
        assert fit.force[0] == pytest.approx(force, abs=1e-12)
        missed = np.array(wrench) - [*force, 0.0]
        assert fit.chi2[0] == pytest.approx(400 * missed @ missed, abs=1e-9)
        assert in_cone(np.array([fit.force[0, 1], fit.force[0, 0]]), mu, 1e-12)


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_what_was_not_measured_costs_nothing(rank):
    information = random_information(rank=rank) if rank else np.zeros((3, 3))
    root = square_root(information)
    points, _, rays = random_candidates(100, 0.33)
    wrench = np.array([1.0, 2.0, 0.02])
    chi2 = project(points, rays, wrench, root, ABOUT).chi2
    expected = [by_nnls(p, r, wrench, root)[1] for p, r in zip(points, rays, strict=True)]
    assert chi2 == pytest.approx(
        np.array(expected), rel=1e-8, abs=1e-9 * max(1.0, float(wrench @ information @ wrench))
    )


def test_a_batch_of_wrenches_is_each_wrench_alone():
    points, _, rays = random_candidates(50, 0.33)
    wrench = RNG.normal(size=(7, 3)) * [2, 2, 0.1]
    roots = square_root(np.array([random_information() for _ in range(7)]))
    force, chi2 = project(points, rays, wrench, roots, ABOUT)
    for i in range(7):
        alone = project(points, rays, wrench[i], roots[i], ABOUT)
        np.testing.assert_array_equal(force[i], alone.force)
        np.testing.assert_array_equal(chi2[i], alone.chi2)
    shared = project(points, rays, wrench, roots[0], ABOUT)
    np.testing.assert_array_equal(shared.chi2[0], chi2[0])


def test_shapes_that_do_not_fit_are_refused_by_name():
    points, _, rays = random_candidates(5, 0.33)
    with pytest.raises(ValueError, match=r"rays \(M, 2, 2\)"):
        project(points, rays[:4], np.zeros(3), np.eye(3), ABOUT)
    with pytest.raises(ValueError, match="expected one root or 2"):
        project(points, rays, np.zeros((2, 3)), np.tile(np.eye(3), (3, 1, 1)), ABOUT)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_square_root_restores_the_information(rank):
    information = random_information(rank=rank)
    root = square_root(information)
    np.testing.assert_allclose(root.T @ root, information, rtol=1e-9, atol=1e-9 * np.abs(information).max())


def site(start, along, length, count, rays, wrench, information, prior):
    fits = np.empty((1, 1, 6))
    fit_sites(np.array([start]), np.array([along]), np.array([length]), np.array([count]), rays[None], wrench[None],
              square_root(information)[None], ABOUT, np.array(prior), fits)  # fmt: skip
    return fits[0, 0]


@pytest.mark.parametrize("seed", range(8))
def test_the_refined_point_is_the_best_of_its_face(seed):
    rng = np.random.default_rng(seed)
    start, along, length = np.array([-0.03, -0.05]), np.array([1.0, 0.0]), 0.06
    rays = cone_rays(np.array([0.0, 1.0]), 0.33)
    information = random_information(rng)
    s = rng.uniform(0, length)
    force = 3 * np.array([rng.uniform(-0.5, 0.5), 1.0])  # often outside the cone
    wrench = grasp_map(start + s * along) @ force
    prior = (*(start + rng.uniform(0, length) * along), rng.choice([0.0, 0.005**-2]))
    fit = site(start, along, length, 60, rays, wrench, information, prior)
    root = square_root(information)

    def cost(t):
        p = start + t * along
        return by_nnls(p, rays, wrench, root)[1] + prior[2] * np.sum((p - prior[:2]) ** 2)

    dense = np.array([cost(t) for t in np.linspace(0, length, 1201)])
    assert fit[1] + fit[2] <= dense.min() + 1e-6
    assert fit[1] + fit[2] == pytest.approx(cost(fit[0]), rel=1e-6, abs=1e-6)


def test_the_information_along_the_face_is_that_of_the_whole_least_squares_problem():
    start, along = np.array([-0.03, -0.05]), np.array([1.0, 0.0])
    information = random_information()
    force = np.array([0.3, 3.0])
    fit = site(start, along, 0.06, 60, cone_rays(np.array([0.0, 1.0]), 0.33),
               grasp_map(start + 0.02 * along) @ force, information, (0.0, 0.0, 0.0))  # fmt: skip
    J = np.column_stack([grasp_map(start + fit[0] * along), [0.0, 0.0, along[0] * fit[4] - along[1] * fit[3]]])
    variance = np.linalg.inv(J.T @ information @ J)[2, 2]
    assert fit[5] == pytest.approx(1 / variance, rel=1e-9)
