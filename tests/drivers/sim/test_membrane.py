"""The membrane against closed forms: loop area, relaxation and creep of the standard linear solid, stiffening."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.sim.coupling import Coupling
from drivers.sim.membrane import Membrane, MembraneSpring
from drivers.sim.plant import Plant

K = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])
#: mean translational stiffness, which turns energies into lengths
MEAN = (K[0, 0] + K[1, 1]) / 2
REST = (0.0, 0.0, 0.0)

directions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-25, 25)).filter(lambda d: np.abs(d).max() > 0.1)


def unit(direction) -> np.ndarray:
    """The displacement in this direction that stores the energy of a plain translation by 1 m."""
    d = np.array(direction)
    return d / np.sqrt(d @ K @ d / MEAN)


def at_origin(**figures) -> MembraneSpring:
    """A membrane that has come to rest undisplaced."""
    spring = MembraneSpring(K, Membrane(**figures))
    spring.wrench(*REST)
    spring.advance(0.0)
    return spring


def moved(spring: MembraneSpring, x, dt: float = 0.0) -> np.ndarray:
    wrench = np.array(spring.wrench(*x))
    spring.advance(dt)
    return wrench


def work(spring: MembraneSpring, path: np.ndarray) -> float:
    """∮ w·dx along a path (n, 3), by trapezoids."""
    wrenches = np.array([moved(spring, x) for x in path])
    return float((0.5 * (wrenches[1:] + wrenches[:-1]) * np.diff(path, axis=0)).sum())


# -- hysteresis ----------------------------------------------------------------------------------------------------


@given(direction=directions, amplitude=st.floats(0.7e-3, 4e-3), share=st.floats(0.05, 0.5))
def test_loop_encloses_the_area_of_an_elastoplastic_element(direction, amplitude, share):
    spring = at_origin(hysteresis=share, yield_length=0.6e-3)
    d, n = unit(direction), 400
    up, down = np.linspace(-1, 1, n)[1:], np.linspace(1, -1, n)[1:]
    first = np.linspace(0, -1, n)
    work(spring, amplitude * first[:, None] * d)  # onto the loop
    loop = amplitude * np.concatenate([[-1], up, down])[:, None] * d
    area = 4 * share * MEAN * 0.6e-3 * (amplitude - 0.6e-3)
    # the two corners of the loop fall between samples
    assert work(spring, loop) == pytest.approx(area, abs=4 * share * MEAN * (2 * amplitude / n) ** 2)


@given(direction=directions)
def test_motion_within_the_yield_leaves_no_trace(direction):
    spring = at_origin(hysteresis=0.2, yield_length=0.6e-3)
    x = 0.59e-3 * unit(direction)
    np.testing.assert_allclose(moved(spring, x), 1.2 * K @ x, rtol=1e-12)
    np.testing.assert_allclose(moved(spring, REST), 0.0, atol=1e-12)


@given(direction=directions)
def test_unloading_to_nothing_leaves_the_yield_force_behind(direction):
    spring = at_origin(hysteresis=0.2, yield_length=0.6e-3)
    d = unit(direction)
    moved(spring, 3e-3 * d)
    # it went 3 mm, of which 0.6 mm are elastic, and came back by 3 mm: from +yield to −yield
    np.testing.assert_allclose(moved(spring, REST), 0.2 * K @ (-0.6e-3 * d), rtol=1e-9)


def test_element_yields_along_its_own_force_in_every_direction():
    """Dragged round a corner, z ends up in the last direction (the element forgets), of the yield's length."""
    spring = at_origin(hysteresis=0.2, yield_length=0.6e-3)
    one, other = unit((1, 0, 0)), unit((0, 0, 1))
    other = other - one * (one @ K @ other) / MEAN
    other = unit(other)
    wrench = moved(spring, 5e-3 * one)
    for way in np.linspace(0, 10e-3, 2000):
        wrench = moved(spring, 5e-3 * one + way * other)
    z = np.linalg.solve(K, wrench - K @ (5e-3 * one + 10e-3 * other)) / 0.2
    np.testing.assert_allclose(z, 0.6e-3 * other, atol=2e-6 * np.abs(other).max())


# -- creep ---------------------------------------------------------------------------------------------------------


@given(direction=directions, creep=st.floats(0.01, 0.5), seconds=st.floats(0.1, 30))
def test_held_displacement_relaxes_as_the_standard_linear_solid(direction, creep, seconds):
    spring = at_origin(creep=creep, creep_time=8.0)
    x = 2e-3 * unit(direction)
    moved(spring, x)
    spring.advance(seconds)
    expected = (1 + creep * np.exp(-seconds / 8.0)) * K @ x
    np.testing.assert_allclose(spring.wrench(*x), expected, rtol=1e-9)


def test_held_load_creeps_by_the_share_with_the_retardation_time():
    creep, tau, dt = 0.08, 8.0, 0.001
    spring = at_origin(creep=creep, creep_time=tau)
    load = np.array([3.0, -4.0, 0.05])
    at_once = np.linalg.solve((1 + creep) * K, load)
    u = np.zeros(3)
    shares = []
    for _ in range(20_000):
        # the displacement that balances the load now, with the law solved by hand
        x = (np.linalg.solve(K, load) + creep * u) / (1 + creep)
        np.testing.assert_allclose(spring.wrench(*x), load, rtol=1e-6)
        spring.advance(dt)
        u += (1 - np.exp(-dt / tau)) * (x - u)
        shares.append(x[0] / at_once[0])
    t = np.arange(20_000) * dt
    expected = (1 + creep) * (1 - creep / (1 + creep) * np.exp(-t / ((1 + creep) * tau)))
    np.testing.assert_allclose(shares, expected, atol=1e-5)


# -- stiffening ----------------------------------------------------------------------------------------------------


@given(direction=directions, size=st.floats(1e-5, 8e-3))
def test_secant_grows_with_the_displacement(direction, size):
    spring = at_origin(stiffening=0.08 / 3e-3)
    x = size * unit(direction)
    np.testing.assert_allclose(moved(spring, x), (1 + 0.08 * size / 3e-3) * K @ x, rtol=1e-9)


@given(direction=directions, size=st.floats(0, 8e-3), growth=st.floats(0, 100))
def test_law_at_rest_is_turned_around_exactly(direction, size, growth):
    spring = at_origin(stiffening=growth)
    x = size * unit(direction)
    w = moved(spring, x)
    np.testing.assert_allclose(spring.at_rest(np.linalg.solve(K, w)), x, atol=1e-14)


@given(one=directions, other=directions)
def test_stiffening_spring_is_no_source_of_energy(one, other):
    spring = at_origin(stiffening=0.08 / 3e-3)
    a, b = 3e-3 * unit(one), 3e-3 * unit(other)
    corners = [np.zeros(3), a, a + b, b, np.zeros(3)]
    path = np.concatenate([np.linspace(p, q, 300) for p, q in pairwise(corners)])
    stored = 0.5 * (a + b) @ K @ (a + b)
    assert abs(work(spring, path)) < 1e-5 * max(stored, MEAN * 1e-6)


# -- in the plant --------------------------------------------------------------------------------------------------

DIAGONAL = ((2000.0, 0.0, 0.0), (0.0, 1800.0, 0.0), (0.0, 0.0, 3.2))


def press(plant: Plant, way: float, seconds: float = 1.0) -> None:
    x, y, angle = plant.ee_pose
    n = round(seconds / plant.timestep)
    for i in range(1, n + 1):
        plant.step((x, y + way * i / n, angle), (0.0, way / seconds, 0.0))
    for _ in range(300):
        plant.step(plant.ee_pose, REST)


@pytest.fixture
def standing(make_scene):
    """The go, flat on the table, pressed by a hand that moved down by 4 mm from where it hung just above it."""

    def make(**figures) -> Plant:
        scene = make_scene(stiffness=DIAGONAL, start=(0.0, 0.119, 0.0))
        plant = Plant(scene, membrane=Membrane(**figures))
        press(plant, -4e-3)
        return plant

    return make


def test_plant_pressed_and_relieved_shows_both_branches(standing):
    plant = standing(hysteresis=0.2, yield_length=0.6e-3)
    loading = plant.coupling_wrench()[1]
    press(plant, -2e-3)
    press(plant, 2e-3)
    # both branches have yielded, so they are two yield forces apart
    length = 0.6e-3 * np.sqrt(1900.0 / 1800.0)
    assert plant.coupling_wrench()[1] - loading == pytest.approx(2 * 0.2 * 1800.0 * length, rel=0.01)


def test_pressed_plant_relaxes(standing):
    plant = standing(creep=0.1, creep_time=0.5)
    before = plant.coupling_wrench()[1]
    for _ in range(5000):
        plant.step(plant.ee_pose, REST)
    x = plant.go[1] + 0.045 - plant.ee[1]
    assert plant.coupling_wrench()[1] == pytest.approx(-1800.0 * x, rel=1e-4)
    # a tenth at once, of which most of the last quarter of a second's share was left
    assert 1.02 < before / plant.coupling_wrench()[1] < 1.1


def test_go_hangs_at_rest_from_a_membrane_with_everything(make_scene):
    figures = {"stiffening": 27.0, "hysteresis": 0.2, "yield_length": 0.6e-3, "creep": 0.08, "creep_time": 8.0}
    plant = Plant(make_scene(start=(0.1, 0.3, 0.6)), membrane=Membrane(**figures))
    before = plant.go
    for _ in range(500):
        plant.step(plant.ee_pose, REST)
    np.testing.assert_allclose(plant.go, before, atol=1e-12)
    np.testing.assert_allclose(plant.coupling_wrench()[:2], [0.0, 0.981], atol=1e-11)


def test_reset_forgets_what_the_membrane_remembers(standing):
    plant = standing(hysteresis=0.2, yield_length=0.6e-3, creep=0.08, creep_time=1.0)
    first = plant.data.qpos.tobytes() + plant.coupling_wrench().tobytes()
    plant.reset()
    press(plant, -4e-3)
    assert plant.data.qpos.tobytes() + plant.coupling_wrench().tobytes() == first


def test_stiff_membrane_has_the_step_that_it_needs():
    """Tangent stiffness up to (1 + 2 a s + h + c) K: the natural frequency goes with its root."""
    plain = Coupling(K, (0.0, 0.045, 0.0), 0.1, 2e-4)
    rich = Membrane(stiffening=50.0, hysteresis=0.3, yield_length=1e-3, creep=0.2, creep_time=1.0)
    assert Coupling(K, (0.0, 0.045, 0.0), 0.1, 2e-4, rich).fastest / plain.fastest == pytest.approx(np.sqrt(2.5))


@pytest.mark.parametrize(
    "figures",
    [{"hysteresis": 0.2}, {"creep": 0.1}, {"stiffening": -1.0}, {"creep": float("nan")}, {"yield_mm": 0.6}],
)
def test_membrane_that_cannot_be_is_refused(figures):
    with pytest.raises(ValidationError):
        Membrane(**figures)
