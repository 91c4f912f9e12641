"""Receding-horizon control against a plant by hand whose stiffness, grasp and friction are not the believed ones."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from control.base import CONTROLLERS
from control.monitor import Deviation, slips
from control.mpc import Mpc, MpcSettings
from mechanics import se2
from mechanics.records import PlanarState
from planning.errors import InfeasiblePlan
from planning.planner import plan
from planning.skills.base import SKILLS, Held, Scene
from tests.control.corner_plant import CornerPlant, cross, turn

BUBBLE = np.array([[2208.96, -143.31, 399.86], [-143.31, 1875.92, -313.57], [399.86, -313.57, 1608.49]])
S = np.diag([1, 1, 0.0448])
HELD = Held(
    vertices=np.array([[-25, -73.45], [25, -73.45], [25, 73.45], [-25, 73.45]]) * 1e-3,
    mass=0.1,
    grasp=np.array([0.0, 0.045, 0.0]),
    stiffness=S @ BUBBLE @ S,
    mu=0.33,
)
#: what the fingers really are: 20 % stiffer, 1 mm and 1.5° from where they are to hold the object
STIFFER, GRASPED_OFF = 1.2, np.array([8e-4, -6e-4, np.radians(1.5)])
LIFTED = np.array([0.0, 0.01, 0.0])


def task_of(skill, **parameters):
    return SKILLS[skill].task(SKILLS[skill].Parameters.model_validate(parameters), Scene(HELD))


def about_planned_grasp(plant, go, ee):
    """The plant's wrench (3,) about where the go should be held: by hand, the true grasp's moved by its lever."""
    w, lever = plant.wrench(go, ee), turn(go[2]) @ (plant.grasp - HELD.grasp)[:2]
    return np.append(w[:2], w[2] + cross(lever, w[:2]))


class Trial:
    """A trial of a task on the plant, waypoint by waypoint."""

    def __init__(self, task, mu=0.33, stiffer=STIFFER, off=GRASPED_OFF, bias=(0, 0, 0), blind=False, **settings):
        self.task, self.plan = task, plan(task, "p")
        self.law = Mpc(self.plan, MpcSettings.model_validate(settings), task=task)
        corner = task.problem.contacts[0].p_go
        self.plant = CornerPlant(stiffer * HELD.stiffness, HELD.grasp + off, corner, mu, HELD.mass)
        self.bias, self.blind = np.array(bias), blind
        up = self.plan.preload_go[0] + LIFTED
        ee_up = self.plan.free_air_ee(up)
        for _ in range(3):
            ee = self.law.command(up, ee_up)
            self.law.in_air(up, self._told(ee, self.plant.hang(ee)))
        self.plant.move(self.law.command(up, ee_up))
        for go, ee in zip(self.plan.preload_go, self.plan.preload_ee, strict=True):
            self.plant.move(self.law.command(go, ee))

    def _told(self, ee, go):
        seen = None if self.blind else go + self.bias
        return PlanarState(np.array(ee), seen, None, about_planned_grasp(self.plant, go, ee))

    @property
    def told(self):
        return self._told(self.plant.ee, self.plant.go)

    @property
    def stands(self):
        """Where the corner touches the ground."""
        assert self.plant.place is not None
        return self.plant.place

    def visit(self, k):
        """(go error (3,), ground force error (f_t, f_n)) at waypoint k; what slips is corrected after it."""
        self.plant.move(self.law.waypoint(k))
        if not slips(self.plan):
            self.law.in_contact(k, self.told)
            self.plant.move(self.law.waypoint(k))
        f = self.plan.contact_forces[k, 0]
        off = self.plant.go - self.plan.go[k], self.plant.force - f[::-1]
        if slips(self.plan):
            self.law.in_contact(k, self.told)
        return off

    def run(self):
        go, force = zip(*(self.visit(k) for k in range(self.plan.steps)), strict=True)
        return np.array(go), np.array(force)


def test_it_is_registered_by_its_name_and_asks_for_the_task():
    assert CONTROLLERS["mpc"] is Mpc and Mpc.needs_task and Mpc.feedback


def test_without_the_task_of_its_plan_it_refuses():
    task = task_of("grasped_static", steps=3)
    with pytest.raises(ValueError, match="needs the task"):
        Mpc(plan(task, "p"))
    with pytest.raises(ValueError, match="grasped_pivoting"):
        Mpc(plan(task, "p"), task=task_of("grasped_pivoting", steps=3))


def test_a_figure_that_makes_no_sense_is_refused():
    for wrong in ({"horizon": 0}, {"pose": 0.0}, {"grasp": 1.5}, {"iterations": 0}, {"unknown": 1}):
        with pytest.raises(ValidationError):
            MpcSettings.model_validate(wrong)


@pytest.mark.parametrize("skill", ["grasped_static", "grasped_pivoting"])
def test_with_stiffness_and_grasp_wrong_a_contact_that_sticks_ends_without_offset(skill):
    go, force = Trial(task_of(skill, steps=12, force=4.0)).run()
    assert np.abs(force[4:]).max() < 0.05  # N, of 4; the linear spring is off by 20 %
    assert np.abs(go[4:, :2]).max() < 5e-5
    assert np.degrees(np.abs(go[4:, 2]).max()) < 0.02


def test_a_force_that_changes_is_followed_with_the_lag_of_an_integrator():
    # by 0.4 N a step; the spring is off by 20 %, so 0.08 N are new each time, and (1 - g)/g of them are left
    _, force = Trial(task_of("grasped_static", steps=12, force=(2.0, 6.4)), grasp=0.5).run()
    assert np.abs(force[8:, 1]) == pytest.approx(0.08 * 1.2 * 0.5 / 0.5, rel=0.5)


def test_what_it_starts_from_is_off_by_far_more():
    # the same plant under the plan as it is: what the test above takes away
    trial = Trial(task_of("grasped_static", steps=12))
    trial.plant.move(trial.plan.ee[0])
    assert np.abs(trial.plant.force - trial.plan.contact_forces[0, 0, ::-1]).max() > 0.5


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_contact_that_slips_gets_where_it_should_and_its_friction_is_learned(way):
    trial = Trial(task_of("grasped_sliding", steps=12, travel_mm=way * 24.0), mu=0.9 * 0.33)
    go, force = trial.run()
    assert np.abs(go[8:, :2]).max() < 2e-4
    assert np.degrees(np.abs(go[8:, 2]).max()) < 0.1
    assert trial.law._belief.mu == pytest.approx([0.9 * 0.33], rel=0.02)
    # friction leaves the tangential force short by 0.13 N whatever is done; the normal force need not be
    assert np.abs(force[8:, 1]).max() < 0.1


def test_what_has_slipped_too_far_is_never_pulled_back():
    trial = Trial(task_of("grasped_sliding", steps=4, travel_mm=8.0))
    for k in range(4):
        trial.plant.move(trial.law.waypoint(k))
        place = trial.stands
        ahead = trial.plant.go + np.array([2e-3, 0.0, 0.0])  # so it is said
        trial.law.in_contact(k, PlanarState(trial.told.ee, ahead, None, trial.told.wrench))
        trial.plant.move(trial.law.waypoint(k))
        assert trial.stands >= place - 5e-5


@pytest.mark.parametrize("bias", [(0.0, 3e-4, 0.0), (0.0, -3e-4, 0.0)])
def test_a_pose_that_is_seen_wrongly_where_the_ground_blocks_it_does_not_change_the_force(bias):
    _, force = Trial(task_of("grasped_static", steps=8, force=4.0), bias=bias).run()
    assert np.abs(force[4:]).max() < 0.03  # 0.3 mm of the fingers are 0.7 N


def test_a_go_that_is_not_seen_leaves_the_force_to_be_controlled():
    trial = Trial(task_of("grasped_static", steps=8, force=4.0), off=np.zeros(3), blind=True)
    _, force = trial.run()
    assert np.abs(force[3:]).max() < 0.03


def test_a_face_on_the_ground_gets_force_and_torque():
    # a rigid go flat on the ground: it cannot move, so the wrench is the spring's
    task = task_of("grasped_static", angle_deg=0.0, steps=6)
    made = plan(task, "p")
    law = Mpc(made, task=task)
    fingers = CornerPlant(STIFFER * HELD.stiffness, HELD.grasp, task.problem.contacts[0].p_go, 0.33, HELD.mass)
    ee = law.waypoint(0)
    for k in range(made.steps):
        for _ in range(2):
            law.in_contact(k, PlanarState(ee, made.go[k], None, fingers.wrench(made.go[k], ee)))
            ee = law.waypoint(k)
        off = fingers.wrench(made.go[k], ee) - made.wrench[k]
        assert np.abs(off / [1.0, 1.0, 0.0448]).max() < 0.05
        ee = law.waypoint(min(k + 1, made.steps - 1))


def test_on_a_table_that_stands_elsewhere_and_leans_it_commands_the_same_there():
    task = task_of("grasped_pivoting", steps=4)
    made, table = plan(task, "p"), np.array([0.02, -0.003, np.radians(0.4)])
    here, there = Mpc(made, task=task), Mpc(made.reanchored(table), task=task)
    state = PlanarState(made.ee[1] + [1e-4, 2e-4, 1e-3], made.go[1] + [1e-4, 0, 2e-3], None, made.wrench[1] * 1.1)
    w = state.wrench.copy()
    w[:2] = turn(table[2]) @ w[:2]
    assert state.go is not None
    there.in_contact(1, PlanarState(se2.compose(table, state.ee), se2.compose(table, state.go), None, w))
    here.in_contact(1, state)
    assert there.waypoint(2) == pytest.approx(se2.compose(table, here.waypoint(2)), abs=1e-9)


# -- slips -----------------------------------------------------------------------------------------------------------


def slipped_trial(**settings):
    """A corner that is to stick at f_t/f_n = 0.3 on a ground of µ = 0.25, and has slipped."""
    task = task_of("grasped_static", force=4.0, tangential=(0.0, 1.2), steps=10)
    trial = Trial(task, mu=0.25, stiffer=1.0, **settings)
    for k in range(9):
        trial.visit(k)
    assert abs(trial.stands - trial.plan.contact_points[0, 0, 0]) > 2e-4
    return trial


def deviation(status="slipped", contact="corner"):
    return Deviation(status, "as a test says", 8, contact, -1e-3)


def test_a_slip_is_taken_in_with_the_friction_seen_and_no_more_is_asked_of_the_contact():
    trial = slipped_trial(slip_mm=50.0)
    assert trial.law.replan(8, trial.told, deviation()) is True
    assert trial.law._belief.mu == pytest.approx([0.25], rel=0.02)
    trial.plant.move(trial.law.waypoint(9))
    place = trial.stands
    trial.law.in_contact(9, trial.told)
    trial.plant.move(trial.law.waypoint(9))
    assert abs(trial.stands - place) < 1e-4  # at the edge of the cone it stays
    assert trial.law.told()["slips"] == 1


def test_a_contact_seen_far_from_where_it_stood_has_slipped_there_without_being_told():
    law = Trial(task_of("grasped_static", steps=4), slip_mm=1.0).law
    go = np.array(law.plan.go[1])
    for x in (0.0, 0.0, 2e-3):
        law.in_contact(1, PlanarState(law.plan.ee[1], go + np.array([x, 0, 0]), None, law.plan.wrench[1]))
    assert law._belief.seen(1).travel == pytest.approx(2e-3, abs=1e-6)


def test_slips_are_taken_in_so_often_and_no_more():
    trial = slipped_trial(slip_mm=50.0, slips=1)
    assert trial.law.replan(8, trial.told, deviation())
    assert not trial.law.replan(9, trial.told, deviation())


@pytest.mark.parametrize("status", ["lost_contact", "stopped", "diverged"])
def test_nothing_but_a_slip_is_taken_in(status):
    trial = slipped_trial(slip_mm=50.0)
    assert trial.law.replan(8, trial.told, deviation(status)) is False


# -- failures --------------------------------------------------------------------------------------------------------


def test_a_replan_that_fails_leaves_the_plan_in_the_grasp_as_estimated_and_is_counted(monkeypatch):
    trial = Trial(task_of("grasped_static", steps=5))

    def fails(*_):
        raise InfeasiblePlan(2, "corner", 0.5, 0.3)

    trial.visit(0)
    trial.visit(1)
    monkeypatch.setattr(trial.law._receding, "solve", fails)
    go, force = trial.visit(2)
    assert np.abs(force).max() < 0.05 and np.abs(go[:2]).max() < 1e-4
    told = trial.law.told()
    assert told["failed"] == 1 and "corner" in told["reason"] and told["replans"] > told["failed"]


def test_a_measurement_that_is_no_number_does_not_become_a_command():
    trial = Trial(task_of("grasped_static", steps=5))
    trial.visit(0)
    good = trial.told
    trial.law.in_contact(0, PlanarState(good.ee, np.full(3, np.nan), None, good.wrench))
    assert np.isfinite(trial.law.waypoint(0)).all()
    assert trial.law.waypoint(0) == pytest.approx(trial.plant.ee, abs=5e-4)


def test_a_wild_measurement_moves_the_grasp_no_farther_than_its_limit():
    trial = Trial(task_of("grasped_static", steps=5), limit_mm=1.0, limit_deg=1.0)
    before = trial.law._belief.grasp.copy()
    wild = replace(trial.told, ee=trial.told.ee + np.array([0.05, 0.05, 0.5]))
    trial.law.in_contact(0, wild)
    off = np.abs(trial.law._belief.grasp - before)
    assert (off <= [1e-3 + 1e-9, 1e-3 + 1e-9, np.radians(1.0) + 1e-9]).all() and off.max() > 9e-4


def test_its_row_says_how_often_and_how_fast_it_planned():
    trial = Trial(task_of("grasped_static", steps=4))
    trial.run()
    told = trial.law.told()
    assert told["replans"] == 5 and told["failed"] == 0  # one before the first measurement
    assert 0 < told["median_ms"] <= told["max_ms"]
