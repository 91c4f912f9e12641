"""The skills of a grasped object on the ground, and what all skills have in common."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from mechanics import se2
from mechanics.friction import Mode
from planning.closure import place
from planning.planner import plan
from planning.problem import Form
from planning.skills.base import SKILLS, Held, Scene, register

STATIC, PIVOTING, SLIDING = (SKILLS[f"grasped_{name}"] for name in ("static", "pivoting", "sliding"))
GRASPED = (STATIC, PIVOTING, SLIDING)
EXTRINSIC = {
    "static_in_contact": "hbox",
    "relative_pivoting": "hbox",
    "relative_sliding": "hbox",
    "extrinsic_pushing": "hbox",
    "extrinsic_pivoting": "tall_box",
}


def choose(skill, **parameters):
    return skill.Parameters.model_validate(parameters)


def made(skill, scene, **parameters):
    return skill.task(choose(skill, **parameters), scene)


def placed(task):
    return place(task.problem, task.problem.angle, task.problem.travel)


def test_the_eight_skills_of_the_paper_are_there_and_say_whether_they_need_an_extrinsic_object():
    assert set(SKILLS) == {"grasped_static", "grasped_pivoting", "grasped_sliding", *EXTRINSIC}
    assert {name for name, skill in SKILLS.items() if skill.needs_extrinsic} == set(EXTRINSIC)


@pytest.mark.parametrize("name", EXTRINSIC)
def test_a_skill_on_an_extrinsic_object_is_refused_where_the_scene_has_none(name, scene_of):
    with pytest.raises(ValueError, match=f"{name} moves an extrinsic object, but the scene has none"):
        made(SKILLS[name], scene_of())


@pytest.mark.parametrize("skill", GRASPED, ids=lambda skill: skill.name)
def test_the_contact_corner_is_where_it_was_put_and_nothing_is_below_the_ground(skill, scene_of, tall_box):
    task = made(skill, scene_of(), contact_x=0.12)
    (contact,) = task.problem.contacts
    at = placed(task)
    travelled = np.linspace(0, 0.04, 20) if skill is SLIDING else np.zeros(20)
    np.testing.assert_allclose(at.points[:, 0], np.column_stack([0.12 + travelled, np.zeros(20)]), atol=1e-15)
    corners = np.stack([se2.transform(at.go, vertex) for vertex in tall_box.vertices])
    assert corners[..., 1].min() > -1e-12
    # a corner that moves to the right sees the ground move along -t
    assert set(contact.modes) == {Mode.SLIP_NEGATIVE if skill is SLIDING else Mode.STICK}
    np.testing.assert_array_equal(at.normals[:, 0], [[0, 1]] * 20)
    assert (task.rest, task.back, task.supported) == (None, False, False)


def test_static_by_default_ramps_three_to_five_newtons_at_fifteen_degrees(scene_of):
    task = made(STATIC, scene_of())
    np.testing.assert_allclose(np.rad2deg(task.problem.angle), 15)
    np.testing.assert_allclose(task.problem.contacts[0].wish[[0, -1]], [[3, 0], [5, 0]])


def test_a_counter_clockwise_tilt_stands_on_the_left_corner(scene_of):
    assert made(STATIC, scene_of(), angle_deg=15).problem.contacts[0].p_go[0] < 0
    assert made(STATIC, scene_of(), angle_deg=-15).problem.contacts[0].p_go[0] > 0


def test_pivoting_by_default_turns_from_ten_to_thirty_five_degrees_at_four_newtons(scene_of):
    task = made(PIVOTING, scene_of())
    np.testing.assert_allclose(np.rad2deg(task.problem.angle), np.linspace(10, 35, 20))
    np.testing.assert_allclose(task.problem.contacts[0].wish, [[4, 0]] * 20)


@pytest.mark.parametrize(("travel", "mode", "sign"), [(25, "slip-", -1), (-25, "slip+", 1)])
def test_sliding_friction_holds_back(travel, mode, sign, scene_of):
    task = made(SLIDING, scene_of(), travel_mm=travel, force=2.0)
    (contact,) = task.problem.contacts
    assert set(contact.modes) == {Mode(mode)}
    np.testing.assert_allclose(contact.wish, [[2.0, sign * 0.66]] * 20)
    np.testing.assert_allclose(np.diff(placed(task).go[:, 0]), travel * 1e-3 / 19)


def test_one_number_stands_for_a_force_that_does_not_change(scene_of):
    task = made(PIVOTING, scene_of(), force=2.5)
    np.testing.assert_array_equal(task.problem.contacts[0].wish, [[2.5, 0]] * 20)


@pytest.mark.parametrize("skill", [STATIC, SLIDING], ids=lambda skill: skill.name)
def test_a_flat_stance_has_two_contacts_that_share_the_force(skill, scene_of, statics):
    task = made(skill, scene_of(), angle_deg=0, force=(3, 5))
    assert [contact.name for contact in task.problem.contacts] == ["left corner", "right corner"]
    np.testing.assert_allclose([contact.p_go[0] for contact in task.problem.contacts], [-0.025, 0.025])
    p = plan(task, "flat")
    friction = 0.33 if skill is SLIDING else 0.0
    for k, force in ((0, 3.0), (19, 5.0)):
        np.testing.assert_allclose(statics.residual(p, k, 0.1, 9.81), 0, atol=1e-12)
        np.testing.assert_allclose(p.contact_forces[k], [[force / 2, -friction * force / 2]] * 2, atol=1e-12)
    # evenly loaded, only friction, 118.45 mm below the grasp centre, turns the object
    np.testing.assert_allclose(p.wrench[0], [3 * friction, -(3 - 0.981), 3 * friction * 0.11845], atol=1e-12)


def test_a_collinear_vertex_in_the_lowest_face_is_not_a_contact(scene_of, tall_box):
    vertices = np.insert(tall_box.vertices, 1, [0.0, -0.07345], axis=0)
    task = made(STATIC, Scene(replace(tall_box, vertices=vertices)), angle_deg=0)
    np.testing.assert_allclose([contact.p_go[0] for contact in task.problem.contacts], [-0.025, 0.025])


@pytest.mark.parametrize("name", SKILLS)
def test_a_horizon_of_one_step_is_the_first_step(name, scene_of):
    skill, scene = SKILLS[name], scene_of(EXTRINSIC.get(name))
    # what is left open is chosen for the whole motion
    chosen = {"contact_mm": (7, 73.45), "tilt_deg": 20} if name == "extrinsic_pivoting" else {}
    one, many = made(skill, scene, steps=1, **chosen), made(skill, scene, **chosen)
    for field in ("eo", "angle", "travel"):
        np.testing.assert_allclose(getattr(one.problem, field), getattr(many.problem, field)[:1], atol=1e-15)
    assert plan(one, "one").steps == 1


@pytest.mark.parametrize("name", SKILLS)
def test_a_motion_of_no_length_and_no_gravity_is_planned(name, scene_of, tall_box):
    still = {
        "grasped_pivoting": {"angle_deg": (20, 20)},
        "grasped_sliding": {"travel_mm": 0},
        "relative_pivoting": {"tilt_deg": (20, 20)},
        "relative_sliding": {"travel_mm": 0},
        "extrinsic_pushing": {"distance_mm": 0},
        "extrinsic_pivoting": {"angle_deg": (0.3, 0.3)},
    }.get(name, {})
    shape = EXTRINSIC.get(name)
    standing = plan(made(SKILLS[name], scene_of(shape), steps=3, **still), "still")
    np.testing.assert_allclose(standing.go, np.broadcast_to(standing.go[0], (3, 3)), atol=1e-9)
    if name in ("grasped_static", "grasped_pivoting", "grasped_sliding", "static_in_contact", "relative_pivoting"):
        weightless = replace(scene_of(shape), held=replace(tall_box, gravity=0.0))
        plan(made(SKILLS[name], weightless, steps=3, **{"disturbance": 0.0}), "weightless")


def test_a_pivot_that_starts_flat_is_refused_naming_angle_and_step(scene_of):
    with pytest.raises(ValueError, match=r"angle_deg: step 0 \(0°\): .* a face"):
        made(PIVOTING, scene_of(), angle_deg=(0, 20))


def test_a_pivot_over_the_flat_stance_is_refused_naming_the_other_corner(scene_of):
    with pytest.raises(ValueError, match=r"angle_deg: step 1 .*\(-25, -73.45\) mm of step 0, but \(25, -73.45\) mm"):
        made(PIVOTING, scene_of(), angle_deg=(10, -20), steps=3)


@settings(max_examples=25)
@given(st.floats(-179, 179), st.floats(0.1, 20))
def test_any_stance_stands_on_the_ground(angle, force):
    vertices = np.array([[-0.03, -0.02], [0.05, -0.03], [0.01, 0.06]])
    held = Held(vertices, 0.1, np.zeros(3), np.diag([1000.0, 1000.0, 3.0]), 0.5)
    task = made(STATIC, Scene(held), angle_deg=angle, force=force, steps=1)
    at = placed(task)
    heights = se2.transform(at.go[0], vertices)[:, 1]
    assert math.isclose(heights.min(), 0, abs_tol=1.1e-6)
    np.testing.assert_allclose(at.points[..., 1], 0, atol=1.1e-6)
    assert math.isclose(sum(contact.wish[0, 0] for contact in task.problem.contacts), force, rel_tol=1e-12)


@pytest.mark.parametrize(
    ("name", "parameters", "key"),
    [
        ("grasped_static", {"steps": 0}, "steps"),
        ("grasped_static", {"force": 0}, "force"),
        ("grasped_static", {"force": (3, -1)}, "force"),
        ("grasped_static", {"force": True}, "force"),
        ("grasped_static", {"angle_deg": 400}, "angle_deg"),
        ("grasped_static", {"angle_deg": math.nan}, "angle_deg"),
        ("grasped_static", {"tangential": (0, 0, 0)}, "tangential"),
        ("grasped_pivoting", {"force": -4}, "force"),
        ("grasped_pivoting", {"angle_deg": (10,)}, "angle_deg"),
        ("grasped_pivoting", {"colour": "red"}, "colour"),
        ("grasped_sliding", {"travel_mm": math.inf}, "travel_mm"),
        ("static_in_contact", {"touch": "face_on_face"}, "touch"),
        ("static_in_contact", {"contact_mm": (1, 2, 3)}, "contact_mm"),
        ("relative_pivoting", {"tilt_deg": 20}, "tilt_deg"),
        ("extrinsic_pushing", {"height": 1.0}, "height"),
        ("extrinsic_pivoting", {"pivot": "middle"}, "pivot"),
        ("extrinsic_pivoting", {"angle_deg": (-5, 25)}, "angle_deg"),
        ("extrinsic_pivoting", {"disturbance": -1}, "disturbance"),
    ],
)
def test_parameters_out_of_range_are_refused_by_key(name, parameters, key):
    with pytest.raises(ValidationError) as caught:
        choose(SKILLS[name], **parameters)
    assert {error["loc"][0] for error in caught.value.errors()} == {key}


@pytest.mark.parametrize("name", SKILLS)
def test_parameters_are_frozen_and_come_back_from_json(name):
    skill = SKILLS[name]
    parameters = skill.Parameters()
    with pytest.raises(ValidationError):
        parameters.__setattr__("steps", 3)
    assert skill.Parameters.model_validate_json(parameters.model_dump_json()) == parameters


def test_a_force_is_a_number_or_two_in_the_schema():
    forms = STATIC.Parameters.model_json_schema()["properties"]["force"]["anyOf"]
    assert {form["type"] for form in forms} == {"number", "array"}


@pytest.mark.parametrize("name", SKILLS)
def test_the_form_and_its_variables_reach_the_problem(name, scene_of):
    skill, scene = SKILLS[name], scene_of(EXTRINSIC.get(name))
    parameters = choose(skill, steps=2)
    for form, free in ((Form.CLOSED, 2), (Form.PAPER, 3)):
        problem = skill.task(parameters, scene, form=form).problem
        assert problem.form is form
        assert not problem.free[:, 1].any()  # where the contact travels is the skill's to say
        assert problem.free[:, 2:].sum() == 2 * free
        assert problem.free[:, 0].all() == (name == "extrinsic_pivoting")


def test_a_polygon_of_two_points_is_refused(tall_box):
    with pytest.raises(ValueError, match="vertices: expected three or more"):
        replace(tall_box, vertices=[[0, 0], [1, 0]])


def test_the_radius_of_gyration_is_that_of_the_outline(tall_box):
    """A rectangle's is √((w² + h²)/12)."""
    assert math.isclose(tall_box.rho, math.hypot(0.05, 0.1469) / math.sqrt(12), rel_tol=1e-12)


def test_a_second_skill_of_the_same_name_is_refused():
    with pytest.raises(ValueError, match="registered twice"):
        register(type("Other", (), {"name": "grasped_static"}))  # type: ignore[arg-type]
