"""The compiled loops: the kink's equations against finite differences of its model, the others against plain numpy."""

import numpy as np

from estimation import strip_kernels as kernels
from estimation.tactile_pose import left_moved
from mechanics import se2

SQUARE = np.array([[0.0, 0.0], [0.02, 0.0], [0.02, 0.02], [0.0, 0.02]])
WIDTH = 5e-3
STARTS = np.array([0, 4, 8, 12, 16])
#: how far inside and outside points count, how near an edge's ends not, how far the kink is spread [m]
WINDOW = np.array([3e-3, 4e-3, 1e-3, 1e-6])
TRUST, GATE = 4e8, 1e-3
UNKNOWNS = 6 + 12 + 16


def lines_of(vertices: np.ndarray) -> np.ndarray:
    side = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(side, axis=1, keepdims=True)
    return np.hstack((vertices, side / length, length))


def off_the_face(points: np.ndarray, edge: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The model at points beside an edge each, for unknowns ``z`` (34,): Δ, plane, then own of edges, then slopes."""
    lines = lines_of(se2.transform(left_moved(np.zeros(3), z[:3]), SQUARE))[edge]
    own, slopes = z[6:18].reshape(4, 3)[edge], z[18:]
    r = points - lines[:, :2]
    along = r[:, 0] * lines[:, 2] + r[:, 1] * lines[:, 3]
    beyond = r[:, 0] * lines[:, 3] - r[:, 1] * lines[:, 2]
    a = np.maximum(beyond - own[:, 0] - own[:, 1] * (along - 0.01), 0.0)
    strip = STARTS[edge] + np.minimum((along / WIDTH).astype(int), 3)
    return z[3] + points @ z[4:6] + slopes[strip] * a - 0.5 * own[:, 2] * a * a


def equations(points, values, edge, z, place) -> tuple[np.ndarray, np.ndarray]:
    count = int(place.max()) + 1
    H, g = np.full((count, count), np.nan), np.full(count, np.nan)
    kernels.kink_equations(
        points, np.zeros_like(points), values, edge, lines_of(SQUARE), STARTS, WIDTH, z[18:].copy(),
        z[6:18].reshape(4, 3).copy(), z[3:6].copy(), np.ones(16, bool), WINDOW, TRUST, GATE, place, H, g,
        np.zeros((16, 3)), np.zeros(16)
    )  # fmt: skip
    return H, g


def beside_the_edges() -> tuple[np.ndarray, np.ndarray]:
    """Points off the edges and away from the ends of strips, and the edge that each lies beside."""
    rng = np.random.default_rng(1)
    edge = rng.integers(0, 4, 400)
    lines = lines_of(SQUARE)[edge]
    along = rng.uniform(1.5e-3, 18.5e-3, 400)
    off = np.where(rng.random(400) < 0.5, rng.uniform(-2.5e-3, -2e-4, 400), rng.uniform(2e-4, 3.5e-3, 400))
    points = lines[:, :2] + along[:, None] * lines[:, 2:4] + off[:, None] * lines[:, [3, 2]] * [1, -1]
    return points, edge


def test_the_equations_are_those_of_the_models_derivatives() -> None:
    points, edge = beside_the_edges()
    rng = np.random.default_rng(2)
    z = np.concatenate((np.zeros(3), [1e-4, 0.01, -0.02], np.zeros(12), rng.uniform(0.2, 0.4, 16)))
    z[8:18:3] = 60.0
    values = off_the_face(points, edge, z) + 1e-4 * rng.standard_normal(400)
    step = np.where(np.isin(np.arange(UNKNOWNS), range(8, 18, 3)), 1e-2, 1e-7)
    J = np.column_stack(
        [
            (off_the_face(points, edge, z + d) - off_the_face(points, edge, z - d)) / (2 * step[i])
            for i, d in enumerate(np.diag(step))
        ]
    )
    r = values - off_the_face(points, edge, z)
    weight = TRUST * np.square(np.maximum(1 - (r / GATE) ** 2, 0.0))
    H, g = equations(points, values, edge, z, np.arange(UNKNOWNS))
    wanted = J.T @ (weight[:, None] * J)
    scale = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(H / scale / scale[:, None], wanted / scale / scale[:, None], atol=1e-6)
    np.testing.assert_allclose(g / scale, J.T @ (weight * r) / scale, atol=1e-6 * np.abs(g / scale).max())


def test_equations_of_some_unknowns_are_those_rows_of_all() -> None:
    points, edge = beside_the_edges()
    z = np.zeros(UNKNOWNS)
    z[18:] = 0.3
    values = off_the_face(points, edge, z) + 1e-4 * np.random.default_rng(3).standard_normal(400)
    used = np.setdiff1d(np.arange(UNKNOWNS), [9, 10, 11, 22, 23, 24, 25, 30])
    place = np.full(UNKNOWNS, -1)
    place[used] = np.arange(len(used))
    H, g = equations(points, values, edge, z, np.arange(UNKNOWNS))
    some_H, some_g = equations(points, values, edge, z, place)
    np.testing.assert_array_equal(some_H, H[np.ix_(used, used)])
    np.testing.assert_array_equal(some_g, g[used])


def test_the_pixels_about_a_face_lie_where_the_homography_and_the_finger_have_them():
    rng = np.random.default_rng(2)
    near, beyond = rng.random((7, 9)) < 0.4, rng.normal(size=(7, 9)).astype(np.float32)
    back = np.array([[1e-3, 2e-5, 0.01], [-1e-5, 1.1e-3, -0.02], [1e-3, 2e-3, 1.0]])
    to_ee = np.array([[0.0, -1.0, 0.03], [1.0, 0.0, -0.01]])
    across, down = np.linspace(-0.5, 0.5, 9, dtype=np.float32), np.linspace(-0.4, 0.4, 7, dtype=np.float32)[:, None]
    turn = rng.normal(size=(2, 3))
    count = int(near.sum())
    points, rays, values = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
    kernels.pixels_about(near, beyond, back, to_ee, across, down, turn, points, rays, values)
    rows, columns = np.nonzero(near)
    on_face = np.column_stack((columns, rows, np.ones(count))) @ back.T
    ones = np.ones((count, 1))
    np.testing.assert_allclose(points, np.hstack((on_face[:, :2] / on_face[:, 2:], ones)) @ to_ee.T, atol=1e-14)
    slopes = np.column_stack((across[columns], down[rows, 0], np.ones(count)))
    np.testing.assert_allclose(rays, slopes @ turn.T @ to_ee[:, :2].T, atol=1e-14)
    np.testing.assert_array_equal(values, beyond[rows, columns])


def test_the_plane_of_most_of_the_points_is_found_though_a_third_lie_millimetres_off_it():
    rng = np.random.default_rng(3)
    across, down = rng.uniform(-0.4, 0.4, (2, 3000))
    true = np.array([10.0, 0.6, -0.4])  # 0.1 m away and leaning
    z = 1 / (true[0] + true[1] * across + true[2] * down)
    z[::3] += rng.uniform(2e-3, 8e-3, 1000)
    w = np.array([1 / 0.1003, 0.6 * 0.9, -0.4 * 0.9])
    kernels.inverse_depth_plane(z, across, down, np.array([2e-3, 1e-3, 0.5e-3, 0.2e-3, 0.2e-3]), w)
    np.testing.assert_allclose(w, true, atol=1e-6)
