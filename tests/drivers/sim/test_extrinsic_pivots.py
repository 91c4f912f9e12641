"""Extrinsic pivoting, open loop, on the plant without mismatch: statics by hand says where the end-effector goes.

Each object of the catalogue that can be turned about its corner is turned by 25°, in 40 steps of quintic ramps of
0.2 s, after a preload that ramps the force at fixed pose of the go while the object lies flat.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.sim.plant import Plant

from .oracle.cases import PIVOTS, PivotTask, pivot_task
from .oracle.motion import Hand, tell

ANGLES = -np.radians(np.linspace(0.3, 25.0, 40))


def preloaded(task: PivotTask) -> Hand:
    """The object flat on the ground, about to turn."""
    hand = Hand(Plant(task.scene()))
    hand.ramp(task.ee(0.0, 0.0), 0.3)
    hand.rest(0.15)
    for level in np.linspace(0, 1, 11)[1:]:
        hand.ramp(task.ee(0.0, level), 0.1)
    hand.rest(0.2)
    return hand


def turned(task: PivotTask) -> tuple[Plant, np.ndarray]:
    """Errors (40, 3) at the settled steps: place of go and eo [m], their angle [rad], force of the fingers [N]."""
    hand = preloaded(task)
    plant, errors = hand.plant, []
    before = plant.contact_changes
    for angle in ANGLES:
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


@pytest.mark.parametrize("name", ["study_pentagon", *PIVOTS])
def test_object_follows_statics_through_a_pivot_of_25_degrees(name):
    task = pivot_task(name)
    needs = np.max([task.pivot.needs(a, task.force) for a in ANGLES], axis=0)
    torque = max(abs(task.wrench(a)[2]) for a in ANGLES)
    plant, errors = turned(task)
    worst, mean = errors.max(axis=0), errors.mean(axis=0)
    tell(
        f"{name:15} needs {needs[0]:.2f}/{needs[1]:.2f}, has {task.mu_object:.2f}/{task.mu_ground:.2f}, "
        f"torque {torque * 1e3:3.0f} N·mm, worst (mean): {worst[0] * 1e6:4.1f} ({mean[0] * 1e6:3.1f}) µm, "
        f"{np.degrees(worst[1]):.4f} ({np.degrees(mean[1]):.4f})°, {worst[2] * 1e3:3.1f} ({mean[2] * 1e3:3.1f}) mN, "
        f"at the end {plant.deepest() * 1e6:.2f} µm deep"
    )
    # the study's figures for the same geometry, made by another program
    np.testing.assert_allclose(needs, task.needs, atol=0.01)
    assert worst[0] <= 0.01e-3
    assert worst[1] <= np.radians(0.01)
    assert worst[2] <= 0.02


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
