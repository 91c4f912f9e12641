"""The membrane of a Soft Bubble against closed forms and against finite elements."""

from __future__ import annotations

from collections.abc import Callable
from math import log, pi

import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from drivers.sim.bubble_geometry import Dome
from drivers.sim.bubble_membrane import Membrane

R, TOP = 0.045, 0.035
ROUND = Dome(a=R, b=R, top=TOP, gas=1.5e6)
BOX = np.array([[-0.025, -0.04], [0.025, -0.04], [0.025, 0.04], [-0.025, 0.04]])
Z = 0.5 * np.array(
    [
        [0.0173, -0.0634], [0.0173, 0.0288], [0.0518, 0.0288], [0.0518, 0.0634],
        [-0.0173, 0.0634], [-0.0173, -0.0288], [-0.0518, -0.0288], [-0.0518, -0.0634],
    ]
)  # fmt: skip


def disc(radius: float, corners: int = 720) -> np.ndarray:
    t = np.linspace(0, 2 * pi, corners, endpoint=False)
    return radius * np.stack((np.cos(t), np.sin(t)), axis=1)


def placed(outline: np.ndarray, x: float, y: float, theta: float) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return outline @ np.array([[c, s], [-s, c]]) + (x, y)


def cap(r):
    return TOP * np.sqrt(1 - (r / R) ** 2)


def cap_slope(r):
    return -TOP * r / R**2 / np.sqrt(1 - (r / R) ** 2)


def root(function: Callable[[float], float], low: float, high: float) -> float:
    found = brentq(function, low, high)
    assert isinstance(found, float)
    return found


def pressed_disc(punch: float, indentation: float, gas: float):
    """Profile d(r) and load of a round dome pressed by a round punch, in closed form.

    Outside the contact d = L r²/4 + A ln r + B with d(R) = 0. The contact ends at the punch's edge, or before it where
    the membrane leaves the face without a kink.
    """

    def gap(r):
        return cap(r) - (TOP - indentation)

    def outside(load):
        def profile(edge):
            slope_part = gap(edge) - 0.25 * load * (edge**2 - R**2)
            a = slope_part / log(edge / R)
            return a, lambda r: 0.25 * load * (r**2 - R**2) + a * np.log(r / R)

        def kink(edge):
            return 0.5 * load * edge + profile(edge)[0] / edge - cap_slope(edge)

        edge = root(kink, 1e-4, R * 0.98) if kink(punch) > 0 else punch
        return edge, profile(edge)[1]

    def volume(load):
        edge, d = outside(load)
        r_in, r_out = np.linspace(0, edge, 4001), np.linspace(edge, R, 4001)
        return np.trapezoid(2 * pi * r_in * gap(r_in), r_in) + np.trapezoid(2 * pi * r_out * d(r_out), r_out)

    load = root(lambda load: gas * volume(load) - load, 0.0, 200.0) if gas else 0.0
    edge, d = outside(load)
    return load, edge, lambda r: np.where(r < edge, gap(np.minimum(r, edge)), d(np.maximum(r, edge)))


@pytest.mark.parametrize("gas", [0.0, 1.5e6, 6e6])
@pytest.mark.parametrize("punch", [0.006, 0.0171, 0.04])
def test_round_punch_agrees_with_the_closed_form(punch: float, gas: float) -> None:
    membrane = Membrane(Dome(a=R, b=R, top=TOP, gas=gas))
    membrane.press(disc(punch), 0.01)
    load, edge, profile = pressed_disc(punch, 0.01, gas)
    r = np.linspace(0.0005, 0.9 * R, 60)
    for direction in (0.0, 0.3, pi / 4, 2.0):
        found = cap(r) - membrane.height(r * np.cos(direction), r * np.sin(direction))
        # around the smallest punch the slope is 1.7, which takes a finer grid
        np.testing.assert_allclose(found, profile(r), atol=6e-5 if punch < 0.01 else 2e-5)
    assert membrane.load == pytest.approx(load, rel=0.003, abs=1e-9)
    assert (edge == punch) == (punch < 0.02)  # the cases are what they should be


def test_the_gas_answers_itself_as_on_a_disc() -> None:
    # −∇²φ = 1 on a disc: φ = (R² − r²)/4, ∫φ = π R⁴/8
    assert ROUND.feedback == pytest.approx(1.5e6 * pi * R**4 / 8)


def test_without_gas_nothing_bulges_and_with_gas_the_rest_does() -> None:
    outline = placed(BOX, 0.01, -0.02, 0.3)
    still, gassy = Membrane(Dome(gas=0.0)), Membrane(Dome())
    for membrane in (still, gassy):
        membrane.press(outline, 0.012)
    assert still.deformation.min() > -1e-6
    assert -2e-3 < gassy.deformation.min() < -5e-4
    # the gas is compressed by what remains: κ∫d is positive, and it is the integral of what is there
    area = (gassy.x[1] - gassy.x[0]) ** 2
    assert gassy.load == pytest.approx(gassy.dome.gas * gassy.deformation.sum() * area, rel=2e-3)


class FiniteElements:
    """Linear triangles on a polar mesh of the ellipse; the bound holds at its nodes; solved as a quadratic program."""

    def __init__(self, dome: Dome, rings: int, spokes: int):
        radius = np.linspace(0, 1, rings + 1)[1:]
        angle = np.arange(spokes) * 2 * pi / spokes
        self.dome = dome
        self.x = np.append(0.0, (radius[:, None] * dome.a * np.cos(angle)).ravel())
        self.y = np.append(0.0, (radius[:, None] * dome.b * np.sin(angle)).ravel())
        node = 1 + np.arange(rings * spokes).reshape(rings, spokes)
        after = np.roll(node, -1, axis=1)
        triangles = [np.stack((np.zeros(spokes, int), node[0], after[0]), axis=1)]
        triangles.append(np.stack((node[:-1], node[1:], after[1:]), axis=-1).reshape(-1, 3))
        triangles.append(np.stack((node[:-1], after[1:], after[:-1]), axis=-1).reshape(-1, 3))
        self.corners = np.concatenate(triangles)
        self.rim = node[-1]

    def press(self, outline: np.ndarray, indentation: float) -> tuple[np.ndarray, float]:
        n, tri, x, y = len(self.x), self.corners, self.x, self.y
        dx, dy = np.roll(x[tri], -1, 1) - np.roll(x[tri], 1, 1), np.roll(y[tri], -1, 1) - np.roll(y[tri], 1, 1)
        area = 0.5 * np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])
        rows = np.repeat(np.arange(len(tri)), 3)
        scale = 1 / (2 * np.sqrt(area))[:, None]
        D = sp.vstack([sp.csr_matrix(((g * scale).ravel(), (rows, tri.ravel())), (len(tri), n)) for g in (dx, dy)])
        weights = np.bincount(tri.ravel(), np.repeat(area / 3, 3), n)
        held = shapely.contains_xy(shapely.Polygon(outline), x, y)
        bound = self.dome.height(x, y) - (self.dome.top - indentation)
        d = cp.Variable(n)  # in millimetres
        volume = 1e6 * weights @ d  # in cubic millimetres of a millimetre's height
        energy = 0.5 * cp.sum_squares(D @ d) + 0.5 * self.dome.gas * 1e-12 * cp.square(volume)
        problem = cp.Problem(cp.Minimize(energy), [d[self.rim] == 0, d[held] >= 1e3 * bound[held]])
        problem.solve(solver=cp.CLARABEL)
        assert d.value is not None
        return 1e-3 * d.value, float(self.dome.gas * 1e-9 * (1e6 * weights @ d.value))


@pytest.mark.parametrize(
    ("outline", "pose", "indentation"),
    [(BOX, (0.0, -0.012, 0.0), 0.014), (BOX, (0.02, 0.01, 0.7), 0.01), (Z, (0.004, -0.003, 0.4), 0.014)],
)
def test_any_polygon_agrees_with_finite_elements(outline, pose, indentation) -> None:
    membrane = Membrane()
    membrane.press(placed(outline, *pose), indentation)
    errors = []
    # the elements know the edge only to their size, at the finer mesh 0.4 to 0.8 mm, so they converge slowly
    for rings in (30, 60):
        elements = FiniteElements(Dome(), rings, 3 * rings)
        expected, load = elements.press(placed(outline, *pose), indentation)
        found = membrane.dome.height(elements.x, elements.y) - membrane.height(elements.x, elements.y)
        errors.append(np.sqrt(((found - expected) ** 2).mean()))
    assert errors[1] < 8e-5 and errors[1] < 0.75 * errors[0]
    assert np.abs(found - expected).max() < 5e-4
    assert membrane.load == pytest.approx(load, rel=0.015)


def kinks(membrane: Membrane, point: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Where the membrane bends most along the outward ``normal`` of an edge, from the edge; and by how much."""
    step = 5e-5
    s = np.arange(-2.5e-3, 2.5e-3, step)
    h = membrane.height(point[0] + s * normal[0], point[1] + s * normal[1])
    bend = np.diff(h, 2) / step
    at = int(bend.argmax())
    around = slice(max(at - 6, 0), at + 7)
    return float((s[1:-1][around] * bend[around]).sum() / bend[around].sum()), float(bend[around].sum())


def test_edge_of_the_membrane_is_the_edge_of_the_face() -> None:
    rng = np.random.default_rng(5)
    membrane = Membrane()
    places, sizes = [], []
    wide = np.array([[-0.04, -0.03], [0.04, -0.03], [0.04, 0.03], [-0.04, 0.03]])
    for _ in range(25):
        theta = rng.uniform(-pi, pi)
        normal = np.array([-np.sin(theta), np.cos(theta)])
        across = normal[::-1] * (1, -1)
        # the box's upper edge passes 16 mm from near the apex
        point = rng.uniform(-0.004, 0.004, 2) + 0.016 * normal
        middle = point - 0.03 * normal
        membrane.press(placed(wide, middle[0], middle[1], theta), 0.014)
        for shift in (-0.006, 0.0, 0.007):
            place, size = kinks(membrane, point + shift * across, normal)
            places.append(place)
            sizes.append(size)
    assert min(sizes) > 0.2  # there is an edge to see
    assert np.abs(places).max() < 1.5e-4
    assert abs(np.mean(places)) < 2e-5  # half a cell would be 4e-4


def test_slope_jump_at_an_edge_needs_the_gas() -> None:
    # at 10 mm of indentation there is a kink of about 0.3 with gas and none without
    edge = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.024], [-0.05, 0.024]])[:, ::-1]
    sizes = {}
    for gas in (1.5e6, 0.0):
        membrane = Membrane(Dome(gas=gas))
        membrane.press(edge, 0.01)
        sizes[gas] = kinks(membrane, np.array([0.024, 0.0]), np.array([1.0, 0.0]))[1]
    assert 0.2 < sizes[1.5e6] < 0.45
    assert sizes[0.0] < 0.06


def test_solution_does_not_hang_on_where_it_started() -> None:
    outline, fresh, used = placed(BOX, 0.01, -0.015, 0.2), Membrane(), Membrane()
    fresh.press(outline, 0.013)
    for x in (0.03, -0.02):
        used.press(placed(Z, x, 0.01, 1.0), 0.02)
    used.press(outline, 0.013)
    np.testing.assert_allclose(used.deformation, fresh.deformation, atol=1e-5)


def test_finer_grid_gives_the_same_membrane() -> None:
    outline = placed(BOX, 0.008, -0.0151, 0.35)
    coarse, fine = Membrane(), Membrane(spacing=3e-4)
    coarse.press(outline, 0.014)
    fine.press(outline, 0.014)
    x, y = np.random.default_rng(0).uniform((-0.04, -0.03), (0.04, 0.03), (500, 2)).T
    error = np.abs(coarse.height(x, y) - fine.height(x, y))
    assert np.sqrt((error**2).mean()) < 8e-6 and error.max() < 1e-4


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.04, 0.04),
    theta=st.one_of(st.floats(-pi, pi), st.sampled_from([0.0, pi / 2])),
    indentation=st.floats(5e-4, 0.03),
    outline=st.sampled_from([BOX, Z, disc(0.004, 12)]),
)
def test_nothing_reaches_into_the_face_and_the_solver_ends(x, y, theta, indentation, outline) -> None:
    membrane = Membrane()
    face = placed(outline, x, y, theta)
    membrane.press(face, indentation)
    assert membrane.cycles < 25
    points = np.random.default_rng(1).uniform((-0.05, -0.04), (0.05, 0.04), (300, 2))
    under = points[shapely.contains_xy(shapely.Polygon(face), points)]
    if len(under):
        assert membrane.height(*under.T).max() <= membrane.dome.top - indentation + 1e-12
    assert membrane.deformation.max() <= indentation + 1e-12


def test_face_beyond_the_rim_leaves_the_dome_alone() -> None:
    membrane = Membrane()
    membrane.press(placed(BOX, 0.2, 0.0, 0.0), 0.012)
    assert np.abs(membrane.deformation).max() == 0


def test_released_membrane_is_the_dome() -> None:
    membrane = Membrane()
    membrane.press(BOX, 0.012)
    membrane.release()
    x, y = np.random.default_rng(0).uniform((-0.05, -0.04), (0.05, 0.04), (200, 2)).T
    np.testing.assert_array_equal(membrane.height(x, y), membrane.dome.height(x, y))


@pytest.mark.parametrize("indentation", [0.0, -0.01, 0.041, np.nan])
def test_impossible_indentation_is_refused(indentation: float) -> None:
    with pytest.raises(ValueError, match="indentation"):
        Membrane().press(BOX, indentation)
