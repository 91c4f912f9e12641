"""The health monitor: silent on a plant that is well, and it finds the sicknesses of contact solvers."""

from __future__ import annotations

import json
from math import inf, nan

import numpy as np
import pytest

from drivers.scene import Body
from drivers.sim import model
from drivers.sim.health import LOOK, MOST_CREEP, MOST_FLICKER, MOST_PENETRATION, Health, Touch
from drivers.sim.plant import Plant
from drivers.sim.world import World

REST = (0.0, 0.0, 0.0)


def rest(plant: Plant, seconds: float) -> None:
    for _ in range(round(seconds / plant.timestep)):
        plant.step(plant.ee_pose, REST)


@pytest.fixture
def block(make_scene):
    """A block on the table, pulled with 60 % of the friction it has, the go far away."""

    def make() -> Plant:
        vertices = ((-0.06, -0.03), (0.06, -0.03), (0.06, 0.03), (-0.06, 0.03))
        body = Body(name="hbox", vertices=vertices, mass=0.5)
        plant = Plant(make_scene(extrinsic=body, extrinsic_pose=(0.4, 0.03, 0.0)))
        plant.data.qfrc_applied[3] = 0.6 * 0.33 * 0.5 * 9.81
        return plant

    return make


def test_resting_block_is_well(block):
    plant = block()
    rest(plant, 2.0)
    health = plant.health()
    assert health["flags"] == []
    assert health["seconds"] == pytest.approx(2.0)
    assert health["resting_seconds"] == pytest.approx(1.85)
    assert health["flicker_per_s"] == 0
    # it was put down without weight on its contacts, and has swung in by some micrometres
    assert 0 < health["penetration_um"] < 25
    assert 0 < plant.deepest() < 3e-6
    assert health["creep_um"] < 1


@pytest.fixture
def untuned(monkeypatch):
    """The contacts that the engine has by default: soft, and no stiffer in friction than along the normal."""
    monkeypatch.setattr(model, "SOLIMP", (0.9, 0.95, 0.001, 0.5, 2.0))
    monkeypatch.setattr(model, "SOLREF", (-1 / 0.02**2, -2 / 0.02))
    monkeypatch.setattr(model, "FRICTION_IMPEDANCE", 1.0)


def test_untuned_contacts_sink_in(block, untuned):
    plant = block()
    rest(plant, 1.0)
    sunk = 0.03 - plant.data.qpos[4]
    assert sunk > MOST_PENETRATION
    # it has been deeper while it swung in
    assert sunk < plant.health()["penetration_um"] * 1e-6 < 2 * sunk
    assert any("sank" in flag for flag in plant.health()["flags"])


def test_untuned_friction_creeps(block, untuned):
    plant = block()
    rest(plant, 0.15 + LOOK)
    start = plant.data.qpos[3]
    rest(plant, 2.0)
    way = plant.data.qpos[3] - start
    assert way > MOST_CREEP
    assert plant.health()["creep_um"] == pytest.approx(way * 1e6, rel=0.1)
    assert any("crept" in flag for flag in plant.health()["flags"])


def test_pivoting_about_a_sticking_corner_is_not_creep(make_scene):
    """The corner's contact point moves on the go, which turns about it; only what slides past is creep."""
    plant = Plant(make_scene(start=(0.0, 0.123, 0.3)))
    for i in range(1, 401):
        plant.step((0.0, 0.123 - 1.5e-5 * i, 0.3), (0.0, -0.015, 0.0))
    rest(plant, 1.0)
    assert plant.contacts()
    assert plant.health()["creep_um"] < 5


class Patient:
    """A plant whose signs are set by hand: one contact of the go with the ground."""

    def __init__(self):
        self.contact_changes = 0
        self.ee_pose = REST
        self.finger_slip = self.finger_turn = 0.0
        self.depth = 1e-6
        self.x, self.share = 0.0, 0.5

    def deepest(self) -> float:
        return self.depth

    def touches(self) -> list[Touch]:
        return [Touch("go", "ground", self.x, 0.0, 1.0, 0.0, self.share)]

    def place(self, body: str) -> tuple[float, float, float]:
        return (self.x, 0.0, 0.0) if body == "go" else REST


def looks(health: Health, seconds: float) -> None:
    for _ in range(round(seconds / LOOK)):
        health.look()


def test_changes_at_rest_are_flicker_and_in_motion_are_not():
    patient = Patient()
    health = Health(patient)
    for i in range(100):
        patient.ee_pose = (1e-4 * (i + 1), 0.0, 0.0)
        patient.contact_changes += 3
        health.look()
    assert health.summary()["flicker_per_s"] == 0
    looks(health, 1.0)
    patient.contact_changes += MOST_FLICKER + 1
    looks(health, 0.5)
    assert health.summary()["flicker_per_s"] == MOST_FLICKER + 1
    assert "flicker" in health.summary()["flags"][0]


def test_contact_at_the_edge_of_its_cone_slips_and_does_not_creep():
    patient = Patient()
    patient.share = 0.99
    health = Health(patient)
    for _ in range(100):
        patient.x += 1e-5
        health.look()
    assert health.summary()["creep_um"] == 0


def test_creep_is_counted_per_rest():
    patient = Patient()
    health = Health(patient)
    for _ in range(3):
        patient.ee_pose = (patient.ee_pose[0] + 1e-3, 0.0, 0.0)
        looks(health, 0.3)
        patient.x += 4e-6
        looks(health, 0.3)
    assert health.summary()["creep_um"] == pytest.approx(4.0)
    assert health.summary()["flags"] == []


@pytest.mark.parametrize("depth", [nan, -inf])
def test_nonsense_never_enters_the_summary(depth):
    patient = Patient()
    patient.depth = depth
    health = Health(patient)
    looks(health, 1.0)
    assert json.loads(json.dumps(health.summary(), allow_nan=False))["penetration_um"] == 0


def test_deep_contact_and_slipped_grasp_are_told():
    patient = Patient()
    patient.depth, patient.finger_slip, patient.finger_turn = 2 * MOST_PENETRATION, 1.5e-3, np.radians(2)
    health = Health(patient)
    health.look()
    sank, slipped = health.summary()["flags"]
    assert "100 µm" in sank
    assert "1.50 mm, 2.00 deg" in slipped


def test_world_tells_its_health_and_starts_again_at_reset(station, make_scene):
    world = World(station)
    world.reset(0, make_scene())
    world.advance(1.0)
    assert world.health()["seconds"] == 1.0
    world.reset(0, make_scene())
    assert world.health()["seconds"] == 0.0
