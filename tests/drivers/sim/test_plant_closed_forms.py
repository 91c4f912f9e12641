"""The plant with both bodies in contact, against closed forms: where slip and tipping start, who carries what.

Friction is measured where it matters, at the force at which a contact gives way, from the fingers' wrench and the
weight alone: the contact solver's own account of its forces is not asked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.sim.plant import Plant

from .oracle.cases import PIVOTS, block_task, corner_of, ground_task, pivot_task
from .oracle.motion import Hand, tell
from .oracle.statics import turn

SHAPES = (*PIVOTS, "hbox")
MU = 0.33
GO_WEIGHT = np.array([0.0, -0.1 * 9.81])


def landed(task, angle: float, forces, ratio: float = 0.0, **parts) -> Hand:
    """The corner pressed at fixed pose of the go, up through ``forces``, with f_t / f_n = ``ratio``."""
    hand = Hand(Plant(task.scene(angle, **parts)))
    hand.ramp(task.ee(angle, (0.0, 0.0)), 0.3)
    hand.rest(0.15)
    for force in forces:
        hand.ramp(task.ee(angle, (ratio * force, force)), 0.15)
    hand.rest(0.2)
    return hand


def push_on_contact(plant: Plant) -> np.ndarray:
    """Force (2,) of the go on what it stands on, from the fingers and the weight."""
    return plant.coupling_wrench()[:2] + GO_WEIGHT


# -- friction ------------------------------------------------------------------------------------------------------


def ratio_at_slip(task, hand: Hand, angle: float, direction: int, moved: Callable[[], float]) -> float:
    """Turn the force toward the cone's edge at constant normal force, 0.3 of the cone in a second.

    Returns |f_t| / f_n at the last moment at which the contact had moved by less than 2 µm.
    """
    plant, start, reached = hand.plant, moved(), []
    edges = [task.ee(angle, (direction * r * 4.0, 4.0)) for r in (0.85 * MU, 1.15 * MU)]
    hand.ramp(edges[0], 0.5)
    hand.rest(0.2)
    for i in range(1, 1001):
        step = (edges[1] - edges[0]) / 1000
        plant.step(tuple(edges[0] + i * step), tuple(step / plant.timestep))
        if abs(moved() - start) > 2e-6:
            return reached[-1]
        push = push_on_contact(plant)
        reached.append(abs(push[0]) / -push[1])
    pytest.fail("the contact never slipped")


@pytest.mark.parametrize("direction", [-1, 1])
def test_corner_on_the_ground_gives_way_at_mu(direction):
    task, angle = ground_task("tall_box"), np.radians(30)
    hand = landed(task, angle, (2.0, 4.0))
    ratio = ratio_at_slip(task, hand, angle, direction, lambda: corner_of(hand.plant.go, task.held)[0])
    tell(f"slip at the ground starts at {ratio:.4f} of 0.33")
    assert ratio == pytest.approx(MU, rel=0.01)


@pytest.mark.parametrize("direction", [-1, 1])
def test_corner_on_an_object_gives_way_at_mu(direction):
    """The block below weighs 5 kg and stays, so it is the go's corner that slips."""
    task, angle = block_task(), np.radians(30)
    hand = landed(task, angle, (2.0, 4.0), mass=5.0)
    ratio = ratio_at_slip(
        task, hand, angle, direction, lambda: corner_of(hand.plant.go, task.held)[0] - hand.plant.eo[0]
    )
    tell(f"slip at the object starts at {ratio:.4f} of 0.33")
    assert ratio == pytest.approx(MU, rel=0.01)


def test_block_under_a_corner_gives_way_when_the_ground_cannot_hold_it():
    """f_t against µ (f_n + m g): the block slips, the corner on it does not."""
    mu, task, angle = 0.2, block_task(), np.radians(30)
    hand = landed(task, angle, (2.0, 4.0), mu_object=1.5, mu_ground=mu)
    plant = hand.plant
    start = plant.eo[0]
    limit = mu * (4.0 + 0.5 * 9.81)
    edges = [task.ee(angle, (-share * limit, 4.0)) for share in (0.85, 1.15)]
    hand.ramp(edges[0], 0.5)
    hand.rest(0.2)
    step, held = (edges[1] - edges[0]) / 1000, 0.0
    for i in range(1, 1001):
        plant.step(tuple(edges[0] + i * step), tuple(step / plant.timestep))
        if abs(plant.eo[0] - start) > 2e-6:
            break
        push = push_on_contact(plant)
        held = push[0] / (0.5 * 9.81 - push[1])
    else:
        pytest.fail("the block never slipped")
    tell(f"slip of a block under a corner starts at {held:.4f} of {mu}")
    assert held == pytest.approx(mu, rel=0.01)


@pytest.mark.parametrize("ratio", [-0.297, 0.297])
@pytest.mark.parametrize("where", ["ground", "object"])
def test_sticking_corner_at_nine_tenths_of_the_cone_creeps_less_than_a_micrometre_in_ten_seconds(where, ratio):
    angle = np.radians(30)
    task = ground_task("tall_box") if where == "ground" else block_task()
    parts = {} if where == "ground" else {"mass": 5.0}
    hand = landed(task, angle, (2.0, 4.0), **parts)
    hand.ramp(task.ee(angle, (ratio * 4.0, 4.0)), 0.5)
    hand.rest(0.2)
    before = corner_of(hand.plant.go, task.held)
    push = push_on_contact(hand.plant)
    assert abs(push[0]) / -push[1] == pytest.approx(abs(ratio), rel=0.01)
    hand.rest(10.0)
    crept = np.abs(corner_of(hand.plant.go, task.held) - before).max()
    tell(f"creep at the {where} at {ratio:+.3f}: {crept * 1e9:.0f} nm in 10 s")
    assert crept < 1e-6


# -- depth ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_corner_pressed_on_the_ground_sinks_in_by_less_than_three_micrometres(name):
    task, angle = ground_task(name), np.radians(15)
    hand = landed(task, angle, (2.0, 5.0))
    depth = -corner_of(hand.plant.go, task.held)[1]
    tell(f"{name} on its corner, 5 N: {depth * 1e6:.2f} µm deep")
    assert 0 < depth < 3e-6


@pytest.mark.parametrize("name", PIVOTS)
def test_object_pressed_with_three_newtons_sinks_in_by_less_than_three_micrometres(name):
    """At the ground and under the go's corner, with the object about to turn: all on one corner each."""
    task = pivot_task(name)
    hand = Hand(Plant(task.scene()))
    hand.ramp(task.ee(0.0, 0.0), 0.3)
    hand.rest(0.15)
    for level in (0.5, 1.0):
        hand.ramp(task.ee(0.0, level), 0.3)
    hand.rest(0.2)
    x, y, angle = hand.plant.eo
    R = turn(angle)
    in_ground = -(np.array([x, y]) + R @ task.pivot.pivot)[1]
    in_object = (R.T @ (corner_of(hand.plant.go, task.held) - [x, y]) - task.pivot.contact) @ task.pivot.normal
    tell(f"{name} under 3 N: {in_ground * 1e6:.2f} µm in the ground, the go {in_object * 1e6:.2f} µm in it")
    assert 0 < in_ground < 3e-6
    assert 0 < in_object < 3e-6


# -- who carries what ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("x", "ratio"), [(0.0, 0.0), (0.03, 0.0), (-0.02, 0.15), (0.02, -0.15)])
def test_block_shares_a_push_between_its_two_corners_by_the_lever(x, ratio):
    """Two-point support: of the push at x and 60 mm up, and of the weight, about each corner."""
    task = block_task(x)
    push, weight = np.array([-ratio * 3.0, -3.0]), 0.5 * 9.81
    hand = landed(task, np.radians(20), (1.0, 2.0, 3.0), ratio)
    plant = hand.plant
    carried = {round(c.point[0] * 1e3): c.force[1] for c in plant.contacts() if (c.on, c.by) == ("eo", "ground")}
    # moments about the left corner, over 120 mm
    right = (weight * 0.06 - (0.06 + x) * push[1] + 0.06 * push[0]) / 0.12
    assert carried == {
        60: pytest.approx(right, abs=0.01),
        -60: pytest.approx(weight - push[1] - right, abs=0.01),
    }
    np.testing.assert_allclose(plant.ground_wrench()[:2], [push[0], push[1] - weight], atol=0.01)


@pytest.mark.parametrize("name", PIVOTS)
def test_object_tips_at_the_push_that_balances_its_weight_about_the_corner(name):
    """1 % below that push the far corner still carries; 1 % above, the object has begun to turn."""
    task = pivot_task(name)
    hand = Hand(Plant(task.scene()))
    hand.ramp(task.ee(0.0, 0.0), 0.3)
    hand.rest(0.15)
    hand.ramp(task.ee(0.0, 0.9), 0.4)
    stood = []
    for level in (0.99, 1.01):
        hand.ramp(task.ee(0.0, level), 0.3)
        hand.rest(0.3)
        stood.append({round(c.point[0] * 1e3) for c in hand.plant.contacts() if (c.on, c.by) == ("eo", "ground")})
    assert len(stood[0]) == 2
    assert stood[1] == {0}
    assert hand.plant.eo[2] < 0
