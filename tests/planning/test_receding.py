"""What remains of a problem, as it was seen: windows of it, and re-plans that keep to the plan and to what is seen."""

import numpy as np
import pytest

from mechanics import se2
from planning.errors import InfeasiblePlan
from planning.optimisers.lm import LevenbergMarquardt
from planning.planner import plan
from planning.problem import Form
from planning.receding import (
    Receding,
    Seen,
    as_seen,
    closing,
    held_ahead,
    place_on_face,
    shifted,
    table_of,
    tracking,
    window,
)
from planning.skills.base import SKILLS
from tests.planning.problems import MOVED, pivoting_pentagon


@pytest.fixture(scope="module")
def made(scene_of):
    """Task and plan of a skill with few steps, made once."""
    known = {}

    def make(name, form=Form.CLOSED, **parameters):
        key = name, form, tuple(parameters.items())
        if key not in known:
            skill, scene = SKILLS[name], scene_of(MOVED.get(name), mu_ground=0.8)
            task = skill.task(skill.Parameters.model_validate({"steps": 6, **parameters}), scene, form=form)
            known[key] = task, plan(task, "p", optimiser=LevenbergMarquardt(iterations=30))
        return known[key]

    return make


def nominal(problem, **changes):
    mu = [contact.mu for contact in (*problem.contacts, *problem.ground)]
    return Seen(**{"grasp": problem.grasp, "mu": np.array(mu), **changes})


def test_a_window_is_the_problem_from_one_step_to_another():
    long = pivoting_pentagon(steps=12)
    cut = window(long, 3, 5)
    assert cut.steps == 5
    for name in ("eo", "angle", "travel", "free", "angle_limits"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(long, name)[3:8])
    np.testing.assert_array_equal(cut.contacts[0].wish, long.contacts[0].wish[3:8])
    assert all(len(contact.modes) == 5 for contact in (*cut.contacts, *cut.ground))
    np.testing.assert_array_equal(cut.stiffness, long.stiffness)


def test_a_window_at_the_end_is_as_long_as_what_is_left():
    assert window(pivoting_pentagon(steps=12), 9, 5).steps == 3


def test_a_plan_moves_on_by_a_step_and_ends_with_its_last_one_twice():
    z = np.arange(15.0).reshape(3, 5)
    np.testing.assert_array_equal(shifted(z), [z[1], z[2], z[2]])


@pytest.mark.parametrize("name", sorted(SKILLS))
def test_where_nothing_else_is_seen_a_replan_from_any_step_is_the_plan(made, name):
    task, whole = made(name)
    receding = Receding(tracking(task.problem, whole, 10.0), horizon=4)
    for begin in (0, 3):
        found = receding.solve(begin, nominal(task.problem))
        assert len(found.ee) == (4 if begin == 0 else 3)
        np.testing.assert_allclose(found.ee, whole.ee[begin : begin + 4], atol=1e-4)
        np.testing.assert_allclose(found.wrench, whole.wrench[begin : begin + 4], atol=0.02)


def test_a_plan_in_the_papers_form_is_kept_to_in_the_closed_form(made):
    task, whole = made("grasped_static", Form.PAPER)
    found = Receding(tracking(task.problem, whole, 10.0)).solve(0, nominal(task.problem))
    np.testing.assert_allclose(found.wrench, whole.wrench, atol=0.02)


def test_the_go_is_held_in_the_grasp_that_was_seen_with_the_same_force(made, statics):
    task, whole = made("grasped_pivoting")
    problem = tracking(task.problem, whole, 10.0)
    grasp = problem.grasp + np.array([1e-3, -1e-3, np.radians(1.5)])
    found = Receding(problem).solve(0, nominal(problem, grasp=grasp))
    np.testing.assert_allclose(found.go, whole.go, atol=1e-6)
    np.testing.assert_allclose(found.wrench[:, :2], whole.wrench[:, :2], atol=1e-3)
    for k in range(whole.steps):
        by_hand = statics.sensor_wrench(problem.stiffness, found.go[k], grasp, found.ee[k])
        np.testing.assert_allclose(by_hand, found.wrench[k], atol=1e-6)


@pytest.mark.parametrize("touch", ["corner_on_face", "face_on_corner"])
def test_a_contact_that_was_seen_elsewhere_on_its_face_is_pushed_there(made, touch):
    task, whole = made("static_in_contact", touch=touch, disturbance=0.0)
    problem = tracking(task.problem, whole, 10.0)
    found = Receding(problem).solve(2, nominal(problem, travel=2e-3, along=-1e-3))
    contact = problem.contacts[0]
    for k in range(4):
        assert place_on_face(contact, found.eo[k], found.go[k]) == pytest.approx(problem.travel[2 + k] + 2e-3)
        assert found.eo[k] - whole.eo[2 + k] == pytest.approx([-1e-3, 0, 0])


def test_a_contact_that_left_its_face_is_no_problem_to_go_on_with(made):
    problem = made("static_in_contact")[0].problem
    with pytest.raises(ValueError, match="off the face"):
        as_seen(problem, nominal(problem, travel=0.2))


def test_with_less_friction_seen_than_the_pivot_needs_there_is_no_plan():
    # the pentagon from flat needs µ = 0.37 at the ground
    problem = pivoting_pentagon(steps=6)
    short = nominal(problem, mu=np.array([0.33, 0.30]))
    with pytest.raises(InfeasiblePlan):
        Receding(problem).solve(0, short)
    assert np.isfinite(Receding(problem).solve(0, nominal(problem)).value)


def test_a_slipping_contact_gets_the_force_that_its_friction_allows(made):
    task, whole = made("grasped_sliding")
    problem = tracking(task.problem, whole, 10.0)
    found = Receding(problem).solve(0, nominal(problem, mu=np.array([0.3])))
    on_go = -(found.wrench[:, :2] + [0.0, -problem.go_body.mass * problem.gravity])
    np.testing.assert_allclose(-on_go[:, 0] / on_go[:, 1], 0.3, rtol=1e-6)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_what_has_slipped_too_far_waits_there_and_is_never_planned_back(made, way):
    task, whole = made("grasped_sliding", travel_mm=way * 10.0)
    problem = tracking(task.problem, whole, 10.0)  # 2 mm a step
    ahead = held_ahead(window(problem, 1, 3), 0.0, 3e-3)
    assert ahead.travel * way == pytest.approx([5e-3, 5e-3, 6e-3])
    assert held_ahead(window(problem, 1, 3), 0.0, 0.0).travel * way == pytest.approx([2e-3, 4e-3, 6e-3])


def test_an_object_pushed_too_far_waits_there(made):
    task, whole = made("extrinsic_pushing", distance_mm=10.0)
    problem = tracking(task.problem, whole, 10.0)
    moved = held_ahead(window(problem, 1, 3), 3e-3, 0.0).eo - problem.eo[0]
    assert moved[:, 0] == pytest.approx([5e-3, 5e-3, 6e-3])


@pytest.mark.parametrize("name", ["grasped_static", "extrinsic_pivoting"])
def test_the_table_that_a_plan_was_anchored_to_is_found_again(made, name):
    task, whole = made(name)
    table = np.array([0.03, -0.002, 0.01])
    assert table_of(task.problem, whole.reanchored(table)) == pytest.approx(table)
    # and what is planned there is the same in the table's frame
    anchored = tracking(task.problem, whole.reanchored(table), 10.0)
    np.testing.assert_allclose(anchored.angle, tracking(task.problem, whole, 10.0).angle, atol=1e-12)


@pytest.mark.parametrize("touch", ["corner_on_face", "face_on_corner"])
def test_the_place_on_a_face_is_that_at_which_the_contact_closes(made, touch):
    contact = made("static_in_contact", touch=touch, disturbance=0.0)[0].problem.contacts[0]
    eo = np.array([0.1, 0.03, 0.2])
    go, point = closing(contact, eo, 0.7, 4e-3)
    assert place_on_face(contact, eo, go) == pytest.approx(4e-3)
    corner = se2.transform(go, contact.p_go) if touch == "corner_on_face" else se2.transform(eo, contact.p_eo)
    assert corner == pytest.approx(point)


def test_a_plan_of_another_problem_is_refused(made):
    (task, _), (_, other) = made("grasped_static"), made("grasped_pivoting")
    with pytest.raises(ValueError, match="grasped_pivoting"):
        tracking(task.problem, other, 10.0)


def test_an_optimiser_that_is_cut_off_after_one_trial_still_answers(made):
    task, whole = made("extrinsic_pivoting")
    receding = Receding(tracking(task.problem, whole, 10.0), iterations=1)
    found = receding.solve(0, nominal(task.problem, travel=1e-3))
    assert np.isfinite(found.ee).all()
