"""The response against finite differences of an independent quasi-static solver, which knows nothing of modes."""

from dataclasses import replace

import numpy as np
import pytest

from control.response import response
from mechanics.friction import Mode
from tests.control.found_plan import plan_of
from tests.drivers.sim.oracle.cases import GRASP, block_task, ground_task, pivot_task
from tests.drivers.sim.oracle.quasistatic import Oracle
from tests.drivers.sim.oracle.statics import turn

#: one micrometre, and as much at a lever of 50 mm
STEP = np.array([1e-6, 1e-6, 2e-5])
#: a motion forward that keeps what slips slipping
FORWARD = 20.0


def state(oracle, has_eo):
    go = oracle.go
    centre = np.append(go[:2] + turn(go[2]) @ GRASP, go[2])
    return np.concatenate([centre, oracle.wrench, oracle.eo if has_eo else []])


def differences(oracle, ee, has_eo, forward=None):
    """Central differences (n, 3) of centre, wrench and eo by the ee's pose, axes of W.

    With ``forward`` (3,) all of them on the way there, so that what slips goes on slipping the same way.
    """
    columns = []
    for i in range(3):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.zeros(3) if forward is None else FORWARD * np.asarray(forward) * STEP
            moved[i] += sign * STEP[i]
            copy = oracle_at(oracle)
            copy.move(np.asarray(ee) + moved)
            ends.append(state(copy, has_eo))
        columns.append((ends[0] - ends[1]) / (2 * STEP[i]))
    return np.column_stack(columns)


def oracle_at(oracle):
    """A copy that can be moved without moving the original."""
    copy = object.__new__(Oracle)
    copy.__dict__.update(oracle.__dict__)
    copy._q, copy._slips = oracle._q.copy(), dict(oracle._slips)
    return copy


def told(plan):
    """`response` in the axes of W throughout, for the ee's motion in the axes of W."""
    found, R = response(plan, 0), np.eye(3)
    R[:2, :2] = turn(plan.go[0, 2])
    parts = [R @ found.go @ R.T, found.wrench @ R.T]
    return np.vstack(parts if found.eo is None else [*parts, found.eo @ R.T])


def assert_alike(found, expected):
    # lengths in mm, angles in units of 1/50 rad, forces in N, torques in 20 N·mm: entries of order 1
    rows = np.array([1e3, 1e3, 50.0, 1.0, 1.0, 50.0, 1e3, 1e3, 50.0])[: len(expected), None]
    columns = np.array([1e3, 1e3, 50.0])
    assert found * rows / columns == pytest.approx(expected * rows / columns, abs=5e-4)


def grasped(angle, push, forward=0.0):
    """The held box on its corner, and dragged along the ground by ``forward`` [m]."""
    task = ground_task("tall_box")
    oracle = Oracle(task.scene(angle))
    oracle.move(task.ee(angle, (0.0, 0.004)))
    oracle.move(ee := task.ee(angle, push), 20)
    if forward:
        oracle.move(ee := ee + np.array([forward, 0.0, 0.0]), 40)
    return oracle, ee


def test_in_air_the_go_follows_the_end_effector_but_for_its_weight():
    task = ground_task("tall_box")
    ee = task.ee(0.3, (0.0, 0.0), at=(0.0, 0.05))
    oracle = Oracle(task.scene(0.3))
    oracle.move(ee, 5)
    plan = plan_of(oracle, ee, {})
    assert_alike(told(plan), differences(oracle, ee, False))
    assert response(plan, 0).go == pytest.approx(np.eye(3), abs=0.06)


def test_the_response_is_that_of_a_corner_that_sticks():
    oracle, ee = grasped(np.radians(15), (0.3, 4.0))
    assert_alike(told(plan_of(oracle, ee, {("go", "ground"): "stick"})), differences(oracle, ee, False))


@pytest.mark.parametrize(("side", "mode"), [(1.0, "slip-"), (-1.0, "slip+")])
def test_the_response_is_that_of_a_corner_that_slips(side, mode):
    # what goes to the right sees the ground move along -t: slip-
    oracle, ee = grasped(np.radians(20), (0.0, 4.0), forward=side * 0.012)
    (touch,) = oracle.touches
    assert touch.force[0] == pytest.approx(-side * 0.33 * touch.force[1])
    found = differences(oracle, ee, False, forward=(side, 0.0, 0.0))
    assert_alike(told(plan_of(oracle, ee, {("go", "ground"): mode})), found)


def test_without_its_contacts_a_plan_has_the_response_of_the_air():
    oracle, ee = grasped(np.radians(15), (0.3, 4.0))
    plan = plan_of(oracle, ee, {("go", "ground"): "stick"})
    free = response(plan, 0, modes=(Mode.FREE,))
    assert free.wrench[:2] == pytest.approx(np.zeros((2, 3)), abs=1e-9)  # nothing but a constant weight to carry


def test_the_response_is_that_of_a_chain_that_turns_about_a_pivot():
    task = pivot_task("tall_box")
    oracle = Oracle(task.scene())
    oracle.move(task.ee(task.start, 0.0), 5)
    oracle.move(task.ee(task.start), 20)
    angle = task.start + 0.5 * (task.end - task.start)
    for part in np.linspace(task.start, angle, 20):
        oracle.move(task.ee(part), 2)
    plan = plan_of(oracle, task.ee(angle), {("go", "eo"): "stick", ("eo", "ground"): "stick"})
    assert plan.contact_bodies == (("go", "eo"), ("eo", "ground"))
    assert_alike(told(plan), differences(oracle, task.ee(angle), True))


def block_pressed(push):
    task = block_task()
    angle = np.radians(20)
    oracle = Oracle(task.scene(angle))
    oracle.move(task.ee(angle, (0.0, 0.004)), 5)
    oracle.move(ee := task.ee(angle, push), 20)
    return oracle, ee


def test_both_ends_of_a_resting_face_may_stick():
    # twice as many forces as the statics can tell, and yet one answer
    oracle, ee = block_pressed((0.3, 3.0))
    modes = {("go", "eo"): "stick", ("eo", "ground"): "stick"}
    plan = plan_of(oracle, ee, modes)
    assert sorted(plan.contact_bodies or ()) == [("eo", "ground"), ("eo", "ground"), ("go", "eo")]
    assert_alike(told(plan), differences(oracle, ee, True))


def test_the_response_is_that_of_a_corner_that_slips_over_an_object():
    oracle, ee = block_pressed((0.0, 3.0))
    oracle.move(ee := ee + np.array([0.012, 0.0, 0.0]), 40)
    over = oracle.touch("go", "eo").force
    assert over[0] == pytest.approx(-0.33 * over[1])
    # the go goes to the right and sees the object move along -t of the normal into the go
    plan = plan_of(oracle, ee, {("go", "eo"): "slip-", ("eo", "ground"): "stick"})
    assert_alike(told(plan), differences(oracle, ee, True, forward=(1.0, 0.0, 0.0)))


def test_the_response_is_that_of_an_object_that_is_pushed():
    # the corner on the left face of the block, which slides over the ground on both ends of its lower face
    task, angle = block_task(), np.radians(-45)
    scene = task.scene(angle)
    held = replace(task.held, corner=np.array(scene.grasped.vertices[1]))
    at, push = np.array([-0.06, 0.045]), np.array([-0.33 * 0.5 * 9.81, 0.0])
    away = held.ee(angle, at - [0.004, 0.0], np.zeros(2))
    oracle = Oracle(scene.model_copy(update={"start": tuple(float(v) for v in away)}))
    oracle.move(ee := held.ee(angle, at, push) + np.array([0.004, 0.0, 0.0]), 40)
    assert oracle.eo[0] > 0.002
    plan = plan_of(oracle, ee, {("go", "eo"): "stick", ("eo", "ground"): "slip-"})
    assert list(plan.contact_bodies or ()).count(("eo", "ground")) == 2
    found = differences(oracle, ee, True, forward=(1.0, 0.0, 0.0))
    assert_alike(told(plan), found)
    assert found[6, 0] > 0.9  # the object is pushed along
