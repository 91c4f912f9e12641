import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from mechanics import se2
from mechanics.friction import Mode
from planning.planner import plan
from planning.skills.base import SKILLS, Held, register

STATIC, PIVOTING = SKILLS["grasped_static"], SKILLS["grasped_pivoting"]


def choose(skill, **parameters):
    return skill.Parameters.model_validate(parameters)


def world_points(task, points):
    return np.stack([se2.transform(task.go, point) for point in points], axis=1)


@pytest.mark.parametrize("name", sorted(SKILLS))
def test_the_contact_corner_stays_where_it_was_put_and_nothing_is_below_the_ground(name, tall_box):
    skill = SKILLS[name]
    task = skill.task(choose(skill, contact_x=0.12), tall_box)
    (contact,) = task.contacts
    np.testing.assert_allclose(world_points(task, [contact.p_goC])[:, 0], [[0.12, 0.0]] * task.steps, atol=1e-15)
    assert world_points(task, tall_box.vertices)[..., 1].min() > -1e-12
    assert set(contact.modes) == {Mode.STICK}
    np.testing.assert_array_equal(contact.normal, [[0, 1]] * task.steps)


def test_static_by_default_ramps_three_to_five_newtons_at_fifteen_degrees(tall_box):
    task = STATIC.task(choose(STATIC), tall_box)
    np.testing.assert_allclose(task.go, np.broadcast_to(task.go[0], (20, 3)))
    assert math.isclose(math.degrees(task.go[0, 2]), 15)
    np.testing.assert_allclose(task.contacts[0].force[[0, -1]], [[3, 0], [5, 0]])


def test_a_counter_clockwise_tilt_stands_on_the_left_corner(tall_box):
    assert STATIC.task(choose(STATIC, angle_deg=15), tall_box).contacts[0].p_goC[0] < 0
    assert STATIC.task(choose(STATIC, angle_deg=-15), tall_box).contacts[0].p_goC[0] > 0


def test_pivoting_by_default_turns_from_ten_to_thirty_five_degrees_at_four_newtons(tall_box):
    task = PIVOTING.task(choose(PIVOTING), tall_box)
    np.testing.assert_allclose(np.rad2deg(task.go[:, 2]), np.linspace(10, 35, 20))
    np.testing.assert_allclose(task.contacts[0].force, [[4, 0]] * 20)


def test_one_number_stands_for_a_force_that_does_not_change(tall_box):
    task = PIVOTING.task(choose(PIVOTING, force=2.5), tall_box)
    np.testing.assert_array_equal(task.contacts[0].force, [[2.5, 0]] * 20)


def test_a_flat_stance_has_two_contacts_that_share_the_force(tall_box, statics):
    task = STATIC.task(choose(STATIC, angle_deg=0, tangential=0.5), tall_box)
    assert [contact.name for contact in task.contacts] == ["left corner", "right corner"]
    np.testing.assert_allclose([contact.p_goC[0] for contact in task.contacts], [-0.025, 0.025])
    total = np.sum([contact.force for contact in task.contacts], axis=0)
    np.testing.assert_allclose(total[[0, -1]], [[3, 0.5], [5, 0.5]])
    for backend in ("projection", "cvxpylayers"):
        p = plan(task, "flat", backend=backend)
        for k in (0, 19):
            np.testing.assert_allclose(statics.residual(p, k, 0.1, 9.81), 0, atol=1e-12)
        # evenly loaded, only the 0.5 N of friction, 118.45 mm below the grasp centre, turns the object
        np.testing.assert_allclose(p.wrench[0], [-0.5, -(3 - 0.981), -0.5 * 0.11845], atol=1e-6)


def test_a_collinear_vertex_in_the_lowest_face_is_not_a_contact(tall_box):
    vertices = np.insert(tall_box.vertices, 1, [0.0, -0.07345], axis=0)
    task = STATIC.task(choose(STATIC, angle_deg=0), replace(tall_box, vertices=vertices))
    np.testing.assert_allclose([contact.p_goC[0] for contact in task.contacts], [-0.025, 0.025])


@pytest.mark.parametrize("skill", [STATIC, PIVOTING])
def test_a_horizon_of_one_step_is_the_first_step(skill, tall_box):
    one = skill.task(choose(skill, steps=1), tall_box)
    many = skill.task(choose(skill), tall_box)
    np.testing.assert_array_equal(one.go, many.go[:1])
    assert plan(one, "one").steps == 1


def test_a_pivot_that_starts_flat_is_refused_naming_angle_and_step(tall_box):
    with pytest.raises(ValueError, match=r"angle_deg: step 0 \(0°\): .* a face"):
        PIVOTING.task(choose(PIVOTING, angle_deg=(0, 20)), tall_box)


def test_a_pivot_over_the_flat_stance_is_refused_naming_the_other_corner(tall_box):
    with pytest.raises(ValueError, match=r"angle_deg: step 1 .*\(-25, -73.45\) mm of step 0, but \(25, -73.45\) mm"):
        PIVOTING.task(choose(PIVOTING, angle_deg=(10, -20), steps=3), tall_box)


@given(st.floats(-179, 179), st.floats(0.1, 20))
def test_any_stance_stands_on_the_ground(angle, force):
    vertices = np.array([[-0.03, -0.02], [0.05, -0.03], [0.01, 0.06]])
    held = Held(vertices, 0.1, np.zeros(3), np.diag([1000.0, 1000.0, 3.0]), 0.5)
    task = STATIC.task(choose(STATIC, angle_deg=angle, force=force, steps=1), held)
    heights = se2.transform(task.go[0], vertices)[:, 1]
    assert math.isclose(heights.min(), 0, abs_tol=1.1e-6)
    points = world_points(task, [contact.p_goC for contact in task.contacts])
    np.testing.assert_allclose(points[..., 1], 0, atol=1.1e-6)
    assert math.isclose(sum(contact.force[0, 0] for contact in task.contacts), force, rel_tol=1e-12)


@pytest.mark.parametrize(
    ("skill", "parameters", "key"),
    [
        (STATIC, {"steps": 0}, "steps"),
        (STATIC, {"force": 0}, "force"),
        (STATIC, {"force": (3, -1)}, "force"),
        (STATIC, {"force": True}, "force"),
        (STATIC, {"angle_deg": 400}, "angle_deg"),
        (STATIC, {"angle_deg": math.nan}, "angle_deg"),
        (STATIC, {"tangential": (0, 0, 0)}, "tangential"),
        (PIVOTING, {"force": -4}, "force"),
        (PIVOTING, {"angle_deg": (10,)}, "angle_deg"),
        (PIVOTING, {"colour": "red"}, "colour"),
    ],
)
def test_parameters_out_of_range_are_refused_by_key(skill, parameters, key):
    with pytest.raises(ValidationError) as caught:
        choose(skill, **parameters)
    assert {error["loc"][0] for error in caught.value.errors()} == {key}


@pytest.mark.parametrize("skill", [STATIC, PIVOTING])
def test_parameters_are_frozen_and_come_back_from_json(skill):
    parameters = skill.Parameters()
    with pytest.raises(ValidationError):
        parameters.steps = 3
    assert skill.Parameters.model_validate_json(parameters.model_dump_json()) == parameters
    forms = skill.Parameters.model_json_schema()["properties"]["force"]["anyOf"]
    assert {form["type"] for form in forms} == {"number", "array"}


def test_a_polygon_of_two_points_is_refused(tall_box):
    with pytest.raises(ValueError, match="vertices: expected three or more"):
        STATIC.task(choose(STATIC), replace(tall_box, vertices=[[0, 0], [1, 0]]))


def test_a_second_skill_of_the_same_name_is_refused():
    with pytest.raises(ValueError, match="registered twice"):
        register(type("Other", (), {"name": "grasped_static"}))  # type: ignore[arg-type]
