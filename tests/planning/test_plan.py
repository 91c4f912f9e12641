"""Plans as values: JSON, checks of what they are made of, and moving them with the table."""

import json
import math
from dataclasses import fields, replace

import numpy as np
import pytest

from mechanics import se2
from planning.plan import Plan
from planning.planner import plan
from planning.skills.base import SKILLS


@pytest.fixture(params=["grasped_static", "static_in_contact"], scope="module")
def p(request, scene_of):
    skill = SKILLS[request.param]
    shape = "hbox" if skill.needs_extrinsic else None
    return plan(skill.task(skill.Parameters(), scene_of(shape)), "p", provenance={"git": "abc", "seed": 3})


@pytest.fixture(scope="module")
def hover(p):
    """A plan that touches nothing."""
    none = np.empty((p.steps, 0, 2))
    return replace(
        p,
        contact_names=(),
        contact_points=none,
        contact_normals=none,
        contact_forces=none,
        contact_modes=((),) * p.steps,
        contact_mu=np.empty(0),
        contact_bodies=(),
    )


def same(a, b):
    return all(
        np.array_equal(x, y) and type(x) is type(y)
        for x, y in ((getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    )


def test_a_plan_comes_back_from_json_to_the_last_bit(p):
    assert same(p, Plan.from_dict(json.loads(json.dumps(p.to_dict(), allow_nan=False))))


def test_a_plan_without_contacts_comes_back_too(hover):
    back = Plan.from_dict(json.loads(json.dumps(hover.to_dict())))
    assert same(hover, back)
    assert back.contact_points.shape == (20, 0, 2)


def test_a_plan_of_another_schema_or_with_other_keys_is_refused(p):
    plain = p.to_dict()
    with pytest.raises(ValueError, match="schema: expected 2, received 1"):
        Plan.from_dict(plain | {"schema": 1})
    with pytest.raises(ValueError, match=r"not known \['colour'\]"):
        Plan.from_dict(plain | {"colour": "red"})
    del plain["go"]
    with pytest.raises(ValueError, match=r"missing \['go'\]"):
        Plan.from_dict(plain)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: {"go": p.go[1:]}, r"go: expected shape \(20, 3\), received \(19, 3\)"),
        (lambda p: {"wrench": p.wrench * np.nan}, "wrench: expected finite"),
        (lambda p: {"preload_eo": np.zeros((3, 3))}, r"preload_eo: expected shape \(11, 3\), received \(3, 3\)"),
        (lambda p: {"contact_bodies": ()}, "contact_bodies: expected"),
        (lambda p: {"contact_modes": p.contact_modes[1:]}, "contact_modes: expected 20 rows"),
        (lambda p: {"provenance": {"where": object()}}, "provenance: expected what JSON can hold"),
        (lambda p: {"provenance": {"loss": math.nan}}, "provenance: expected what JSON can hold"),
    ],
)
def test_a_plan_whose_parts_do_not_fit_is_refused_by_name(p, change, message):
    with pytest.raises(ValueError, match=message):
        replace(p, **change(p))


def test_contacts_are_the_gos_with_the_ground_where_nobody_says_otherwise(p):
    unsaid = replace(p, contact_bodies=None)
    assert unsaid.contact_bodies == (("go", "ground"),) * len(p.contact_names)


def test_a_plans_arrays_cannot_be_written(p):
    with pytest.raises(ValueError, match="read-only"):
        p.ee[0, 0] = 1.0


def test_reanchoring_moves_points_on_bodies_as_the_table_moves(p, statics):
    eo = np.tile([0.1, 0.05, 0.2], (20, 1))
    here = replace(p, eo=eo, preload_eo=eo[:11], unload_eo=eo[:11])
    moved = here.reanchored(np.array([0.05, -0.02, 0.1]))
    shift = statics.rotation(0.1)
    for name in ("ee", "go", "eo", "preload_ee", "preload_eo", "unload_go", "unload_eo"):
        before, after = getattr(here, name), getattr(moved, name)
        np.testing.assert_allclose(after[:, :2], before[:, :2] @ shift.T + [0.05, -0.02], atol=1e-14)
        np.testing.assert_allclose(after[:, 2], before[:, 2] + 0.1, atol=1e-14)
    np.testing.assert_allclose(moved.contact_points, here.contact_points @ shift.T + [0.05, -0.02], atol=1e-14)
    np.testing.assert_allclose(moved.contact_normals, here.contact_normals @ shift.T, atol=1e-14)
    np.testing.assert_allclose(moved.wrench[:, :2], here.wrench[:, :2] @ shift.T, atol=1e-14)
    np.testing.assert_array_equal(moved.wrench[:, 2], here.wrench[:, 2])
    np.testing.assert_array_equal(moved.contact_forces, here.contact_forces)
    felt = statics.sensor_wrench(here.stiffness, moved.go[3], here.X_go_gocf, moved.ee[3])
    np.testing.assert_allclose(felt, moved.wrench[3], atol=1e-11)


def test_reanchoring_there_and_back_changes_nothing(p):
    table = np.array([0.05, -0.02, 0.1])
    back = p.reanchored(table).reanchored(se2.inverse(table))
    for name in ("ee", "go", "wrench", "contact_points", "contact_normals", "preload_wrench"):
        np.testing.assert_allclose(getattr(back, name), getattr(p, name), atol=1e-14)


@pytest.mark.parametrize("skill", ["grasped_sliding", "extrinsic_pivoting"])
def test_a_plan_taken_to_other_fingers_is_the_plan_that_would_have_been_made_for_them(skill, scene_of, statics):
    scene = scene_of("tall_box" if SKILLS[skill].needs_extrinsic else None)
    stiff = scene.held.stiffness @ np.diag([3.0, 5.0, 0.2])
    stiff = (stiff + stiff.T) / 2
    parameters = SKILLS[skill].Parameters()
    soft_plan = plan(SKILLS[skill].task(parameters, scene), "p")
    stiffer = replace(scene, held=replace(scene.held, stiffness=stiff))
    made = plan(SKILLS[skill].task(parameters, stiffer), "p")  # the nominal trajectory knows no stiffness
    taken = soft_plan.with_stiffness(stiff)
    assert np.abs(taken.ee - soft_plan.ee).max() > 2e-4
    for field in fields(made):
        ours, theirs = getattr(taken, field.name), getattr(made, field.name)
        if isinstance(theirs, np.ndarray):
            np.testing.assert_allclose(ours, theirs, atol=1e-12, err_msg=field.name)
    for part in ("", "preload_", "unload_"):
        go, ee, wrench = (getattr(taken, f"{part}{name}") for name in ("go", "ee", "wrench"))
        felt = statics.sensor_wrench(stiff, go[-1], taken.X_go_gocf, ee[-1])
        np.testing.assert_allclose(felt, wrench[-1], atol=1e-9)


def test_a_plan_taken_to_its_own_fingers_stays_as_it_is(p):
    taken = p.with_stiffness(p.stiffness)
    for name in ("ee", "preload_ee", "unload_ee"):
        np.testing.assert_allclose(getattr(taken, name), getattr(p, name), atol=1e-14)


def test_a_plan_is_taken_to_no_finger_that_gives_way_without_limit(p):
    with pytest.raises(ValueError, match="positive definite"):
        p.with_stiffness(np.diag([1000.0, 1000.0, -1.0]))
