"""Slip between finger and object: the wrench stays on the limit surface, and the grasp gives way by what is left."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sim.limit_surface import LimitSurface
from drivers.sim.membrane import Membrane
from drivers.sim.plant import Plant

K = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])
REST = (0.0, 0.0, 0.0)
wrenches = st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(-1, 1))


# -- the surface ---------------------------------------------------------------------------------------------------


@given(w=wrenches, force=st.floats(1, 20), torque=st.floats(0.02, 0.5))
def test_slip_brings_the_wrench_onto_the_surface_along_its_normal(w, force, torque):
    surface = LimitSurface(force, torque, K)
    slip = np.array(surface.slip(w[0], w[1], w[2]))
    left = np.array(w) - K @ slip
    metric = np.diag([force**-2, force**-2, torque**-2])
    if w @ metric @ w <= 1:
        np.testing.assert_array_equal(slip, 0.0)
        return
    assert left @ metric @ left == pytest.approx(1.0, rel=1e-9)
    normal = metric @ left
    # maximum dissipation: the slip is a positive multiple of the normal
    assert slip @ normal > 0 or np.allclose(slip, 0, atol=1e-12)
    np.testing.assert_allclose(
        slip, normal * (slip @ normal) / (normal @ normal), atol=1e-9 * np.abs(slip).max() + 1e-15
    )


def test_equal_stiffness_slips_straight_along_the_force():
    surface = LimitSurface(5.0, inf, np.diag([1000.0, 1000.0, 3.0]))
    np.testing.assert_allclose(surface.slip(6.0, 8.0, 0.4), [0.6 * 5e-3, 0.8 * 5e-3, 0.0], atol=1e-12)


def test_torque_alone_turns_and_does_not_move():
    surface = LimitSurface(inf, 0.1, np.diag([1000.0, 1000.0, 2.0]))
    np.testing.assert_allclose(surface.slip(50.0, -50.0, -0.3), [0.0, 0.0, -0.1], atol=1e-12)


def test_fingers_without_limit_never_slip():
    surface = LimitSurface(inf, inf, K)
    assert surface.is_infinite and surface.load(1e6, 1e6, 1e6) == 0.0


@pytest.mark.parametrize("limit", [(0.0, 1.0), (1.0, -1.0), (float("nan"), 1.0)])
def test_limit_that_is_not_positive_is_refused(limit):
    force, torque = limit
    with pytest.raises(ValueError, match=r"scene\.finger_limit"):
        LimitSurface(force, torque, K)


# -- in the plant --------------------------------------------------------------------------------------------------

DIAGONAL = ((2000.0, 0.0, 0.0), (0.0, 1800.0, 0.0), (0.0, 0.0, 3.2))


def move(plant: Plant, way, seconds: float = 1.0) -> None:
    start, way = plant.ee, np.array(way)
    n = round(seconds / plant.timestep)
    for i in range(1, n + 1):
        plant.step(tuple((start + way * i / n).tolist()), tuple((way / seconds).tolist()))
    for _ in range(300):
        plant.step(plant.ee_pose, REST)


def held(make_scene, limit, **parts) -> Plant:
    """The go in fingers of a diagonal stiffness, a millimetre above the table with a grippy surface."""
    usual = {"stiffness": DIAGONAL, "start": (0.0, 0.1199, 0.0), "friction": {"go-ground": 1.0}}
    return Plant(make_scene(**(usual | parts)), finger_limit=limit)


def test_pressed_beyond_the_limit_the_grasp_gives_way_by_the_rest(make_scene):
    plant = held(make_scene, (5.0, inf))
    start = plant.ee[1] - plant.go[1]
    move(plant, (0, -6e-3, 0))
    fx, fy, _ = plant.coupling_wrench()
    assert np.hypot(fx, fy) == pytest.approx(5.0, rel=1e-6)
    assert fy < 0
    # what the hand came closer to the go is what the fingers bend less, or slipped
    came = start - (plant.ee[1] - plant.go[1])
    bent = (0.981 + 5.0) / 1800.0
    assert plant.finger_slip == pytest.approx(came - bent, rel=1e-3)
    assert plant.finger_turn == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(plant.coupling.grasp, [0.0, 0.045 - plant.finger_slip, 0.0], atol=1e-6)


def test_turned_beyond_the_limit_it_turns_in_the_fingers(make_scene):
    plant = held(make_scene, (inf, 0.02))
    move(plant, (0, -3e-3, 0))
    before = plant.ee[2] - plant.go[2]
    move(plant, (0, 0, 0.03))
    assert plant.coupling_wrench()[2] == pytest.approx(0.02, rel=1e-6)
    turned = plant.ee[2] - plant.go[2] - before
    assert plant.finger_turn == pytest.approx(turned - 0.02 / 3.2, rel=0.02)
    assert plant.finger_slip == pytest.approx(0.0, abs=1e-6)


def test_slip_stays_when_the_load_goes(make_scene):
    plant = held(make_scene, (5.0, inf))
    move(plant, (0, -6e-3, 0))
    slipped, grasp = plant.finger_slip, plant.coupling.grasp
    move(plant, (0, 12e-3, 0))
    assert plant.finger_slip == slipped
    np.testing.assert_array_equal(plant.coupling.grasp, grasp)
    # hanging again, from a grasp that has moved: lower in the fingers' frame by as much as it slipped up
    np.testing.assert_allclose(plant.coupling_wrench()[:2], [0.0, 0.981], atol=1e-6)
    assert plant.ee[1] - plant.go[1] == pytest.approx(0.045 - slipped + 0.981 / 1800.0, abs=1e-7)


def test_slow_slip_never_leaves_the_ellipsoid(make_scene):
    plant = held(make_scene, (5.0, 0.05), stiffness=tuple(map(tuple, K.tolist())))
    start, way = plant.ee, np.array([2e-3, -5e-3, 0.02])
    loads = []
    for i in range(1, 4001):
        plant.step(tuple((start + way * i / 4000).tolist()), tuple((way / 4).tolist()))
        fx, fy, tau = plant.coupling_wrench()
        loads.append(np.sqrt((fx**2 + fy**2) / 25.0 + tau**2 / 0.0025))
    assert max(loads) < 1.02, "the rest is damping"
    assert loads[-1] > 0.99
    assert plant.finger_slip > 5e-4


def test_membrane_with_everything_slips_on_the_same_surface(make_scene):
    rich = Membrane(stiffening=27.0, hysteresis=0.2, yield_length=0.6e-3, creep=0.08, creep_time=8.0)
    scene = make_scene(stiffness=DIAGONAL, start=(0.0, 0.1199, 0.0), friction={"go-ground": 1.0})
    plant = Plant(scene, membrane=rich, finger_limit=(5.0, inf))
    move(plant, (0, -6e-3, 0), seconds=2.0)
    # it relaxes while it stands still, so it is on the surface as long as it is pressed on
    x, y, angle = plant.ee_pose
    for i in range(1, 51):
        plant.step((x, y - 1e-5 * i, angle), (0.0, -0.01, 0.0))
    fx, fy, _ = plant.coupling_wrench()
    assert np.hypot(fx, fy) == pytest.approx(5.0, rel=1e-3)
    assert plant.finger_slip > 2e-3


def test_reset_puts_the_object_back_between_the_fingers(make_scene):
    plant = held(make_scene, (5.0, inf))
    move(plant, (0, -6e-3, 0))
    assert plant.finger_slip > 1e-3
    plant.reset()
    assert plant.finger_slip == plant.finger_turn == 0.0
    np.testing.assert_array_equal(plant.coupling.grasp, [0.0, 0.045, 0.0])


def test_object_too_heavy_for_the_fingers_is_refused(make_scene):
    with pytest.raises(ValueError, match=r"scene\.finger_limit: the weight of 0\.98 N slips out"):
        held(make_scene, (0.9, inf))
