"""Grasped pivoting, open loop: the plant follows the statics of a pencil and paper, without mismatch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.scene import Scene
from drivers.sim.plant import Plant

MASS, GRAVITY = 0.1, 9.81
GRASP = np.array([0.0, 0.045])
CORNER = np.array([-0.025, -0.07345])
STEP = 0.001


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def moment(lever, force) -> float:
    return lever[0] * force[1] - lever[1] * force[0]


def statics(angle: float, push, stiffness) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of go and ee, and the wrench of the fingers on the go about the grasp centre.

    The corner stands at W's origin, where the table pushes it with ``push`` (2,).
    """
    R = turn(angle)
    p_go = -R @ CORNER
    grasp = p_go + R @ GRASP
    weight = np.array([0.0, -MASS * GRAVITY])
    force = -weight - push
    torque = -moment(p_go - grasp, weight) - moment(-grasp, push)
    x = np.linalg.solve(stiffness, np.append(R.T @ force, torque))
    return np.append(p_go, angle), np.append(grasp + R @ x[:2], angle + x[2]), np.append(force, torque)


class Hand:
    """Moves the plant's end-effector along quintic ramps."""

    def __init__(self, plant: Plant):
        self.plant, self.at = plant, plant.ee

    def ramp(self, goal, seconds: float) -> None:
        start, n = self.at, round(seconds / STEP)
        step = np.asarray(goal) - start
        for i in range(1, n + 1):
            s = i / n
            place = s**3 * (10 - 15 * s + 6 * s * s)
            speed = 30 * s * s * (1 - s) ** 2 / seconds
            self.plant.step(tuple((start + place * step).tolist()), tuple((speed * step).tolist()))
        self.at = start + step

    def rest(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.plant.step(tuple(self.at.tolist()), (0.0, 0.0, 0.0))


@pytest.fixture
def preloaded(make_scene) -> Callable[..., Hand]:
    """The go stands on its corner and is pressed with ``push``, which was brought up at fixed pose."""

    def make(angle: float, push, **parts) -> Hand:
        stiffness = np.array(make_scene(**parts).stiffness)
        touch = statics(angle, np.zeros(2), stiffness)[1]
        scene: Scene = make_scene(start=(touch[0], touch[1] + 0.01, touch[2]), **parts)
        hand = Hand(Plant(scene))
        hand.ramp(touch, 0.4)
        hand.rest(0.1)
        for level in np.linspace(0, 1, 11)[1:]:
            hand.ramp(statics(angle, level * np.asarray(push), stiffness)[1], 0.1)
        hand.rest(0.3)
        return hand

    return make


def test_pivoting_open_loop_follows_statics(preloaded):
    push = np.array([0.0, 4.0])
    hand = preloaded(np.radians(10), push)
    plant = hand.plant
    stiffness = np.array(plant.scene.stiffness)
    errors, changes = [], plant.contact_changes
    for angle in np.radians(np.linspace(10, 35, 20)):
        go, ee, wrench = statics(angle, push, stiffness)
        hand.ramp(ee, 0.2)
        hand.rest(0.3)
        (contact,) = plant.contacts()
        assert (contact.on, contact.by, contact.mode) == ("go", "ground", "stick")
        # the contact is at the lowest corner, which has not walked
        assert np.hypot(*contact.point) < 0.01e-3
        assert np.abs(contact.force - push).max() < 0.02
        errors.append(np.concatenate([plant.go - go, plant.coupling_wrench() - wrench]))
    worst = np.abs(errors).max(axis=0)
    assert worst[:2].max() < 0.02e-3
    assert worst[2] < np.radians(0.02)
    assert worst[3:5].max() < 0.02
    assert worst[5] < 0.02 * 0.0448
    # no contact point came or went since the first waypoint
    assert plant.contact_changes == changes


@pytest.mark.parametrize("share", [-0.95, 0.95])
def test_corner_near_the_cone_holds(preloaded, share):
    push = np.array([share * 0.33 * 4.0, 4.0])
    hand = preloaded(np.radians(15), push)
    before = hand.plant.contacts()[0].point
    hand.rest(2.0)
    (contact,) = hand.plant.contacts()
    assert contact.mode == "stick"
    assert np.abs(contact.point - before).max() < 1e-6
    assert np.abs(contact.force - push).max() < 0.02


@pytest.mark.parametrize("direction", [-1, 1])
def test_dragged_corner_slips_with_the_signs_of_the_convention(preloaded, direction):
    hand = preloaded(np.radians(15), np.array([0.0, 4.0]))
    hand.ramp(hand.at + np.array([direction * 0.03, 0, 0]), 1.0)
    # stop half-way through a ramp, while the corner moves
    start = hand.at
    for i in range(300):
        x = start[0] + direction * 0.02 * (i + 1) * STEP
        hand.plant.step((x, start[1], start[2]), (direction * 0.02, 0.0, 0.0))
    (contact,) = hand.plant.contacts()
    # n is up into the go, t = n turned by −90° is +x; the ground moves against the go's motion
    assert contact.mode == ("slip-" if direction > 0 else "slip+")
    assert contact.force[0] / contact.force[1] == pytest.approx(-direction * 0.33, rel=0.02)


def test_fingers_push_with_stiffness_times_displacement(preloaded):
    plant = preloaded(np.radians(20), np.array([0.5, 4.0])).plant
    go, ee = plant.go, plant.ee
    R = turn(go[2])
    grasp = go[:2] + R @ GRASP
    x = np.append(R.T @ (ee[:2] - grasp), ee[2] - go[2])
    w = np.array(plant.scene.stiffness) @ x
    np.testing.assert_allclose(plant.coupling_wrench(), np.append(R @ w[:2], w[2]), atol=1e-6)


def test_ground_carries_what_fingers_and_weight_press(preloaded):
    plant = preloaded(np.radians(20), np.array([0.5, 4.0])).plant
    about = np.array([0.03, -0.2])
    fingers = plant.coupling_wrench(about)
    weight = np.array([0.0, -MASS * GRAVITY])
    load = fingers + np.append(weight, moment(plant.go[:2] - about, weight))
    np.testing.assert_allclose(plant.ground_wrench(about), load, atol=1e-5)
    (contact,) = plant.contacts()
    np.testing.assert_allclose(-contact.force, plant.ground_wrench()[:2], atol=1e-9)


def test_stiffness_scale_softens_the_fingers_and_nothing_else(make_scene):
    scene = make_scene()
    nominal, soft = Plant(scene), Plant(scene, stiffness_scale=0.8)
    weight = MASS * GRAVITY
    # the go hangs below the ee by the compliance: 1.25 times as far
    x, x_soft = (np.linalg.solve(k * np.array(scene.stiffness), [0, weight, 0]) for k in (1.0, 0.8))
    assert soft.coupling_wrench()[1] == pytest.approx(weight, rel=1e-12)
    assert (soft.ee - soft.go)[2] / (nominal.ee - nominal.go)[2] == pytest.approx(x_soft[2] / x[2], rel=0.02)


def test_stiff_fingers_are_resolved(preloaded):
    """Four times the GelSlim's printed K, whose fastest motion one step of 1 ms could not follow."""
    printed = np.array([[5060.26, -1261.90, -158.71], [-1261.90, 9998.16, 334.56], [-158.71, 334.56, 37.6311]])
    gelslim = tuple(map(tuple, (4 * printed).tolist()))
    push = np.array([0.0, 4.0])
    plant = preloaded(np.radians(15), push, stiffness=gelslim).plant
    go, _, wrench = statics(np.radians(15), push, np.array(gelslim))
    # the corner sinks in by a micrometre or two, which at this stiffness is a tenth of a newton
    assert np.abs(plant.go - go)[:2].max() < 0.005e-3
    assert np.abs(plant.coupling_wrench() - wrench)[:2].max() < 0.15
