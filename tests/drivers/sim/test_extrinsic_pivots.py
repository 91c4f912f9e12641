"""Extrinsic pivoting, open loop, on the plant without mismatch: statics by hand says where the end-effector goes.

Each object of the catalogue that can be turned about its corner is turned by 25°, in 40 steps of quintic ramps of
0.2 s, after a preload that ramps the force at fixed pose of the go while the object lies flat. At the paper's friction
pentagon and triangle can be turned only from a tilt, at which nothing but the go's push holds them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.sim.plant import Plant

from .oracle.cases import PIVOTS, PivotTask, pivot_task, tilted_pivot_task
from .oracle.motion import Hand, tell

ANGLES = -np.radians(np.linspace(0.3, 25.0, 40))


def angles_of(task: PivotTask) -> np.ndarray:
    """The object's angle (40,) at each step."""
    return np.linspace(task.start, task.end, 40) if task.start else ANGLES


#: how deep tilted bodies are in each other at first: contacts that bear nothing yet fall shut otherwise
SUNK = 0.5e-6


def preloaded(task: PivotTask) -> Hand:
    """The object at its start, about to turn."""
    if task.start:
        return tilted(task)
    hand = Hand(Plant(task.scene()))
    hand.ramp(task.ee(0.0, 0.0), 0.3)
    hand.rest(0.15)
    for level in np.linspace(0, 1, 11)[1:]:
        hand.ramp(task.ee(0.0, level), 0.1)
    hand.rest(0.2)
    return hand


def tilted(task: PivotTask) -> Hand:
    """The tilted object in the balance that statics says, put there: no approach leads to it."""
    plant, ee, go, eo = Plant(task.scene()), task.ee(task.start), task.go(task.start), task.pivot.eo(task.start)
    c, s = np.cos(task.start), np.sin(task.start)
    go[:2] += SUNK * np.array([[c, -s], [s, c]]) @ task.pivot.normal
    for body in (go, eo):
        body[1] -= SUNK
    plant.data.qpos[:] = [*go, *eo]
    plant._ee = (float(ee[0]), float(ee[1]), float(ee[2]))
    plant._observe()
    hand = Hand(plant)
    hand.rest(0.3)
    return hand


def turned(task: PivotTask) -> tuple[Plant, np.ndarray]:
    """Errors (40, 3) at the settled steps: place of go and eo [m], their angle [rad], force of the fingers [N]."""
    hand = preloaded(task)
    plant, errors = hand.plant, []
    before = plant.contact_changes
    for angle in angles_of(task):
        hand.ramp(task.ee(angle), 0.2)
        hand.rest(0.2)
        eo, go = plant.eo - task.pivot.eo(angle), plant.go - task.go(angle)
        force = (plant.coupling_wrench() - task.wrench(angle))[:2]
        errors.append([np.hypot(*[eo[:2], go[:2]]).max(), abs(np.array([eo[2], go[2]])).max(), np.hypot(*force)])
        assert {(c.on, c.by): c.mode for c in plant.contacts()} == {("eo", "go"): "stick", ("eo", "ground"): "stick"}
    # at most the far corner's contact has gone
    assert plant.contact_changes - before <= 3
    assert plant.health()["flags"] == []
    return plant, np.array(errors)


FROM_FLAT = [pivot_task(name) for name in ("study_pentagon", *PIVOTS)]
TILTED = [tilted_pivot_task(name) for name in ("pentagon", "triangle")]


@pytest.mark.parametrize("task", [*FROM_FLAT, *TILTED], ids=lambda task: task.name)
def test_object_follows_statics_through_a_pivot_of_25_degrees(task):
    name, angles = task.name, angles_of(task)
    needs = np.max([task.pivot.needs(a, task.force) for a in angles], axis=0)
    torque = max(abs(task.wrench(a)[2]) for a in angles)
    plant, errors = turned(task)
    worst, mean = errors.max(axis=0), errors.mean(axis=0)
    tell(
        f"{name:16} needs {needs[0]:.2f}/{needs[1]:.2f}, has {task.mu_object:.2f}/{task.mu_ground:.2f}, "
        f"torque {torque * 1e3:3.0f} N·mm, worst (mean): {worst[0] * 1e6:4.1f} ({mean[0] * 1e6:3.1f}) µm, "
        f"{np.degrees(worst[1]):.4f} ({np.degrees(mean[1]):.4f})°, {worst[2] * 1e3:3.1f} ({mean[2] * 1e3:3.1f}) mN, "
        f"at the end {plant.deepest() * 1e6:.2f} µm deep"
    )
    # the study's figures for the same geometry, made by another program
    np.testing.assert_allclose(needs, task.needs, atol=0.01)
    assert worst[0] <= 0.01e-3
    assert worst[1] <= np.radians(0.01)
    assert worst[2] <= 0.02


@pytest.mark.parametrize("task", TILTED, ids=lambda task: task.name)
def test_shape_that_is_tilted_could_not_be_turned_from_flat_at_its_friction(task):
    assert task.mu_ground == task.mu_object == 0.33
    flat = pivot_task(task.name.removeprefix("tilted "))
    assert flat.pivot.needs(0.0, task.force)[1] > task.mu_ground


def test_pivot_wants_the_friction_that_statics_says():
    """2 % less at the ground than the first steps need, and the corner slips; 2 % more, and nothing does."""
    needs = max(pivot_task("pentagon").pivot.needs(a, 3.0)[1] for a in ANGLES)
    slips = []
    for share in (0.98, 1.02):
        task = replace(pivot_task("pentagon"), mu_ground=share * needs)
        hand = preloaded(task)
        for angle in ANGLES[:8]:
            hand.ramp(task.ee(angle), 0.2)
            hand.rest(0.2)
        eo = hand.plant.eo
        c, s = np.cos(eo[2]), np.sin(eo[2])
        slips.append((eo[:2] + np.array([[c, -s], [s, c]]) @ task.pivot.pivot)[0])
    assert slips[0] > 0.5e-3
    assert abs(slips[1]) < 5e-6


@pytest.mark.parametrize("name", PIVOTS)
def test_force_passes_near_the_grasp_centre_at_a_tilt_of_20_degrees(name):
    """It matters to the end-effector, which K⁻¹ of the torque turns; half the tilt, on the same corner, is worse."""
    task = pivot_task(name)
    steep = replace(task, tilt=task.tilt / 2)
    torque, more = (max(abs(t.wrench(a)[2]) for a in ANGLES) for t in (task, steep))
    assert torque < 0.05
    assert more > 1.6 * torque
    away = np.array([task.ee(a) for a in ANGLES]) - [[0.0, 0.0, task.go_angle(a)] for a in ANGLES]
    assert np.abs(away[:, 2]).max() < np.radians(1.0)
