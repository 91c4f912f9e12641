"""The five skills on an extrinsic object: geometry, modes, and the friction that plain statics says they need.

The figures of friction are those of the notes' study, made by another program with the same geometry.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from mechanics import se2
from mechanics.catalogue import load_object
from mechanics.friction import Mode
from planning.closure import place
from planning.errors import InfeasiblePlan
from planning.planner import robustness
from planning.skills.base import SKILLS, SkillTask


class Row(NamedTuple):
    """A task of the notes: what it needs at the object and at the ground, and the friction it is given there."""

    skill: str
    shape: str
    parameters: dict
    needs: tuple[float, float]
    mu_ground: float = 0.33
    mass: float | None = None

    @property
    def name(self) -> str:
        return f"{self.skill} {self.shape}{' tilted' if self.parameters.get('angle_deg', (0,))[0] > 1 else ''}"


FLAT = (
    Row("static_in_contact", "hbox", {"tangential": (0.39, 0.65), "disturbance": 1.0}, (0.13, 0.06)),
    Row("relative_pivoting", "hbox", {}, (0.0, 0.0)),
    Row("relative_sliding", "hbox", {}, (0.33, 0.13)),
    Row("extrinsic_pushing", "hbox", {}, (0.0, 0.33)),
)
PIVOTS = (
    Row("extrinsic_pivoting", "tall_box", {"contact_mm": (7, 73.45)}, (0.18, 0.26)),
    Row("extrinsic_pivoting", "z", {"contact_mm": (0, 63.4)}, (0.18, 0.26)),
    Row("extrinsic_pivoting", "heptagon", {"from_apex_mm": 8}, (0.16, 0.26)),
    Row("extrinsic_pivoting", "pentagon", {"from_apex_mm": 8}, (0.21, 0.37), 0.5),
    Row("extrinsic_pivoting", "pentagon", {"from_apex_mm": 12, "angle_deg": (10, 35)}, (0.22, 0.24), mass=0.1),
    Row("extrinsic_pivoting", "triangle", {"from_apex_mm": 15}, (0.25, 0.70), 0.8),
    Row("extrinsic_pivoting", "triangle", {"from_apex_mm": 32, "angle_deg": (30, 55)}, (0.27, 0.27), mass=0.1),
)
ROWS = FLAT + PIVOTS


TASKS: dict[str, SkillTask] = {}


def of_row(row: Row, scene_of, **changes):
    """The row's task, made once."""
    key = f"{row.name} {changes}"
    if key not in TASKS:
        scene = scene_of(row.shape, row.mass, mu_ground=row.mu_ground)
        TASKS[key] = made(row.skill, scene, **(row.parameters | changes))
    return TASKS[key]


def made(name, scene, **parameters):
    return SKILLS[name].task(SKILLS[name].Parameters.model_validate(parameters), scene)


def placed(problem):
    return place(problem, problem.angle, problem.travel)


def weight_of(problem):
    """The force of gravity (2,) on the eo."""
    assert problem.eo_body is not None
    return np.array([0.0, -problem.eo_body.mass * 9.81])


def pushes(problem):
    """The go's wished force (K, 2) on the eo in W, where it acts (K, 2), and the contact's unit normal (K, 2)."""
    at, (contact,) = placed(problem), problem.contacts
    n = at.normals[:, 0]
    force = contact.wish[:, :1] * n + contact.wish[:, 1:] * np.column_stack([n[:, 1], -n[:, 0]])
    return force, at.points[:, 0], n


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_wishes_need_the_friction_that_the_notes_state(row, scene_of):
    problem = of_row(row, scene_of).problem
    push, _, n = pushes(problem)
    across = push[:, 0] * n[:, 1] - push[:, 1] * n[:, 0]
    at_object = np.abs(across) / (push * n).sum(axis=1)
    ground = -weight_of(problem) - push
    at_ground = np.abs(ground[:, 0]) / ground[:, 1]
    np.testing.assert_allclose([at_object.max(), at_ground.max()], row.needs, atol=0.01)
    assert at_object.max() <= 0.33 * (1 + 1e-9)
    assert at_ground.max() <= row.mu_ground * (1 + 1e-9)


@pytest.mark.parametrize("row", PIVOTS, ids=lambda row: row.name)
def test_a_pivots_wish_has_no_moment_about_the_pivot_which_never_moves(row, scene_of, statics):
    task = of_row(row, scene_of)
    push, at, _ = pushes(task.problem)
    pivot = placed(task.problem).points[:, 1]
    np.testing.assert_allclose(pivot, 0, atol=1e-15)
    weight = weight_of(task.problem)
    for k in range(task.steps):
        moment = statics.cross(at[k], push[k]) + statics.cross(task.problem.eo[k, :2], weight)
        assert abs(moment) < 1e-12
    np.testing.assert_allclose(task.problem.contacts[0].wish[:, 0], 3.0)


@pytest.mark.parametrize("row", PIVOTS, ids=lambda row: row.name)
def test_a_pivot_turns_clockwise_about_its_right_end_by_what_is_asked(row, scene_of):
    problem = of_row(row, scene_of).problem
    start, end = row.parameters.get("angle_deg", (0.3, 25))
    np.testing.assert_allclose(np.rad2deg(problem.eo[:, 2]), -np.linspace(start, end, 40))
    (ground,) = problem.ground
    vertices = load_object(row.shape).polygon.vertices
    low = vertices[vertices[:, 1] < vertices[:, 1].min() + 1e-6]
    np.testing.assert_array_equal(ground.p_eo, low[low[:, 0].argmax()])
    assert {ground.name, *ground.modes, *problem.contacts[0].modes} == {"ground right", Mode.STICK}


@pytest.mark.parametrize("row", [row for row in PIVOTS if row.shape != "z"], ids=lambda row: row.name)
def test_a_pivot_to_the_left_is_the_mirror_image(row, scene_of):
    """All shapes but z are symmetric about their vertical axis."""
    x, y = row.parameters.get("contact_mm", (0, 0))
    mirrored = {"contact_mm": (-x, y)} if y else {}
    right, left = of_row(row, scene_of).problem, of_row(row, scene_of, pivot="left", **mirrored).problem
    np.testing.assert_allclose(left.eo, right.eo * [-1, 1, -1], atol=1e-15)
    np.testing.assert_allclose(left.contacts[0].wish, right.contacts[0].wish * [1, -1], atol=1e-12)
    np.testing.assert_allclose(left.contacts[0].p_eo, right.contacts[0].p_eo * [-1, 1], atol=1e-12)
    np.testing.assert_allclose(left.angle, -right.angle, atol=1e-12)
    assert left.ground[0].name == "ground left"


@pytest.mark.parametrize("row", PIVOTS, ids=lambda row: row.name)
def test_what_comes_before_a_pivot_is_the_object_flat_or_held_by_something_else(row, scene_of, statics):
    task = of_row(row, scene_of)
    assert task.back
    if row.parameters.get("angle_deg", (0,))[0] > 1:
        assert task.rest is None
        assert task.supported
        return
    assert not task.supported
    rest = task.rest
    assert rest is not None
    assert rest.steps == 1
    assert rest.eo[0, 2] == 0
    assert [contact.name for contact in rest.ground] == ["ground left", "ground right"]
    np.testing.assert_allclose(placed(rest).points[0, 1:, 1], 0, atol=1e-15)
    # at full force nothing is left on the far end: the object is about to turn
    push, at, _ = pushes(rest)
    right = placed(rest).points[0, 2]
    weight = weight_of(rest)
    moment = statics.cross(at[0] - right, push[0]) + statics.cross(rest.eo[0, :2] - right, weight)
    assert abs(moment) < 1e-12


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_bodies_touch_in_one_point_and_stay_above_the_ground_all_along(row, scene_of, tall_box):
    problem = of_row(row, scene_of).problem
    at, theirs = placed(problem), load_object(row.shape).polygon
    for k in (0, problem.steps // 2, problem.steps - 1):
        outline = theirs.transformed(problem.eo[k])
        corners = np.array([se2.transform(at.go[k], vertex) for vertex in tall_box.vertices])
        distance = outline.signed_distance(corners)
        nearest = int(np.abs(distance).argmin())
        assert abs(distance[nearest]) < 1e-9
        assert np.delete(distance, nearest).min() > 1e-3
        np.testing.assert_allclose(corners[nearest], at.points[k, 0], atol=1e-9)
        assert corners[:, 1].min() > 1e-3
        assert outline.vertices[:, 1].min() > -1e-12


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_the_notes_tasks_bear_the_default_disturbance(row, scene_of):
    margins = robustness(of_row(row, scene_of))
    assert margins.force > 0
    assert margins.nominal_force >= margins.force


def test_a_heavy_tall_box_can_be_pivoted_but_does_not_bear_two_newtons(scene_of):
    """The notes: at 0.3 kg it runs without bias, and loses contact in half of the biased runs."""
    scene = scene_of("tall_box", 0.3)
    task = made("extrinsic_pivoting", scene, contact_mm=(7, 73.45))
    with pytest.raises(InfeasiblePlan, match=r"does not bear ± 2 N more or less of the go's force"):
        robustness(task)
    assert robustness(made("extrinsic_pivoting", scene, contact_mm=(7, 73.45), disturbance=0.0)).force > 0


def test_by_default_a_pivot_is_touched_where_the_study_put_it(scene_of):
    """The study chose by hand what leaves the cones most room; this skill finds it."""
    for shape, mu, by_hand in (
        ("tall_box", 0.33, (7.0, 73.45)),
        ("z", 0.33, (0.0, 63.4)),
        ("heptagon", 0.33, (-7.2, 67.3)),
        ("pentagon", 0.5, (-6.5, 63.3)),
        ("triangle", 0.8, (-7.5, 60.3)),
    ):
        (contact,) = made("extrinsic_pivoting", scene_of(shape, mu_ground=mu)).problem.contacts
        assert np.hypot(*(contact.p_eo * 1e3 - by_hand)) < 3.0


def test_by_default_the_tilt_has_the_force_pass_near_the_grasp_centre(scene_of, statics, tall_box):
    """The torque about the grasp centre stays below 60 N·mm, as with the tilts that the plant's tests found."""
    for row in PIVOTS[:4]:
        problem = of_row(row, scene_of).problem
        push, at, _ = pushes(problem)
        go = placed(problem).go
        grasp = np.array([se2.transform(pose, tall_box.grasp[:2]) for pose in go])
        torque = [statics.cross(at[k] - grasp[k], -push[k]) for k in range(40)]
        assert np.abs(torque).max() < 0.06


# -- the four others ---------------------------------------------------------------------------------------------------


def test_static_stands_on_the_middle_of_the_top(scene_of):
    task = made("static_in_contact", scene_of("hbox"), ground_x=0.1)
    problem = task.problem
    np.testing.assert_allclose(problem.eo, [[0.1, 0.03, 0]] * 20)
    np.testing.assert_allclose(placed(problem).points[:, 0], [[0.1, 0.06]] * 20, atol=1e-15)
    np.testing.assert_allclose(placed(problem).go[:, 2], np.deg2rad(20))
    np.testing.assert_allclose(problem.contacts[0].wish[[0, -1]], [[3, 0], [5, 0]])
    modes = {mode for contact in (*problem.contacts, *problem.ground) for mode in contact.modes}
    assert modes == {Mode.STICK}
    assert (task.rest, task.back, task.supported) == (None, False, False)


def test_relative_pivoting_turns_the_go_about_a_point_of_the_object(scene_of):
    problem = made("relative_pivoting", scene_of("hbox")).problem
    np.testing.assert_allclose(np.rad2deg(placed(problem).go[:, 2]), np.linspace(10, 40, 20))
    np.testing.assert_allclose(placed(problem).points[:, 0], [[0, 0.06]] * 20, atol=1e-15)


@pytest.mark.parametrize(("travel", "mode"), [(30, "slip-"), (-30, "slip+")])
def test_relative_sliding_drags_the_object_along_the_way_it_goes(travel, mode, scene_of):
    problem = made("relative_sliding", scene_of("hbox"), travel_mm=travel).problem
    push, at, _ = pushes(problem)
    np.testing.assert_allclose(at[:, 0], np.linspace(-travel, travel, 20) * 0.5e-3, atol=1e-15)
    np.testing.assert_allclose(push, [[np.sign(travel) * 0.99, -3.0]] * 20, atol=1e-12)
    assert set(problem.contacts[0].modes) == {Mode(mode)}
    assert {kind for contact in problem.ground for kind in contact.modes} == {Mode.STICK}


@pytest.mark.parametrize(("distance", "mode", "side"), [(30, "slip-", -0.06), (-30, "slip+", 0.06)])
def test_pushing_is_what_the_grounds_friction_takes(distance, mode, side, scene_of):
    """0.33 · 0.5 kg · 9.81 m/s² = 1.62 N, at three quarters of the height, 45 mm."""
    problem = made("extrinsic_pushing", scene_of("hbox"), distance_mm=distance).problem
    push, at, _ = pushes(problem)
    way = np.linspace(0, distance * 1e-3, 20)
    np.testing.assert_allclose(problem.eo[:, 0], way, atol=1e-15)
    np.testing.assert_allclose(push, [[np.sign(distance) * 0.33 * 0.5 * 9.81, 0.0]] * 20, atol=1e-12)
    np.testing.assert_allclose(at, np.column_stack([way + side, np.full(20, 0.045)]), atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(placed(problem).go[:, 2]), 45 * np.sign(distance))
    assert {kind for contact in problem.ground for kind in contact.modes} == {Mode(mode)}
    assert set(problem.contacts[0].modes) == {Mode.STICK}


def test_pressing_down_while_pushing_takes_more_force(scene_of):
    """f_t = 0.2 N along −y: the ground bears 0.2 N more, so its friction is 0.33 · 0.2 N more."""
    wish = made("extrinsic_pushing", scene_of("hbox"), tangential=0.2, disturbance=0.0).problem.contacts[0].wish
    np.testing.assert_allclose(wish, [[0.33 * (0.5 * 9.81 + 0.2), 0.2]] * 20, atol=1e-12)


@pytest.mark.parametrize("skill", ["static_in_contact", "relative_sliding", "extrinsic_pushing", "extrinsic_pivoting"])
def test_a_face_of_the_go_can_lie_on_a_corner_of_the_object(skill, scene_of):
    parameters = {
        "static_in_contact": {"tilt_deg": -30, "disturbance": 0.5},
        "relative_sliding": {"tilt_deg": -30, "travel_mm": 20},
        "extrinsic_pushing": {"tilt_deg": 30},
        "extrinsic_pivoting": {},
    }[skill]
    shape = "tall_box" if skill == "extrinsic_pivoting" else "hbox"
    problem = made(skill, scene_of(shape), touch="face_on_corner", **parameters).problem
    corner = load_object(shape).polygon.vertices[3]  # the upper left one
    at = placed(problem)
    np.testing.assert_allclose(problem.contacts[0].p_eo, corner)
    for k in (0, problem.steps - 1):
        np.testing.assert_allclose(at.points[k, 0], se2.transform(problem.eo[k], corner), atol=1e-15)
        # the go's lower face passes through it: its axis is the normal, turned outward
        axis = np.array([-np.sin(at.go[k, 2]), np.cos(at.go[k, 2])])
        np.testing.assert_allclose(at.normals[k, 0], -axis, atol=1e-12)
        assert abs((at.points[k, 0] - at.go[k, :2]) @ axis + 0.07345) < 1e-12


# -- what cannot be ----------------------------------------------------------------------------------------------------


def test_a_pentagon_cannot_be_pivoted_from_flat_at_the_papers_friction(scene_of):
    """The notes: 0.37 at 8 mm from the apex; 0.35 at the least, wherever it is touched."""
    with pytest.raises(InfeasiblePlan) as caught:
        made("extrinsic_pivoting", scene_of("pentagon"), from_apex_mm=8)
    assert (caught.value.contact, caught.value.have) == ("ground right", 0.33)
    assert 0.34 < caught.value.need < 0.37
    assert str(caught.value).startswith(f"ground right, step {caught.value.step}: needs µ ≥ 0.3")
    with pytest.raises(InfeasiblePlan) as anywhere:
        made("extrinsic_pivoting", scene_of("pentagon"))
    assert anywhere.value.need > 0.34


def test_a_push_at_the_middle_of_the_face_goes_through_the_pivot(scene_of):
    """The notes: pushing the pentagon at the middle of its upper left face is infeasible."""
    with pytest.raises(InfeasiblePlan) as caught:
        made("extrinsic_pivoting", scene_of("pentagon", mu_ground=0.5), contact_mm=(-32.336, 44.507), tilt_deg=-20)
    assert caught.value.need > 0.5


def test_pushing_with_three_newtons_names_the_friction_and_the_mass_that_would_take_them(scene_of):
    """3 N / (0.5 kg · 9.81 m/s²) = 0.612, and 3 N / (0.33 · 9.81 m/s²) = 0.927 kg."""
    with pytest.raises(InfeasiblePlan, match=r"needs µ = 0\.612, or an object of 0\.927 kg"):
        made("extrinsic_pushing", scene_of("hbox"), force=3.0)
    assert made("extrinsic_pushing", scene_of("hbox", mu_ground=3 / (0.5 * 9.81)), force=3.0).steps == 20


def test_a_push_that_tips_the_object_is_refused(scene_of):
    """tall_box, pushed at 110 mm of its 147 mm: 0.33 · 110 mm is more than half its width of 50 mm."""
    with pytest.raises(InfeasiblePlan, match=r"ground left, step 0: is lifted .* the push tips the object"):
        made("extrinsic_pushing", scene_of("tall_box"))


def test_a_wish_outside_the_objects_cone_names_its_friction(scene_of):
    with pytest.raises(InfeasiblePlan) as caught:
        made("static_in_contact", scene_of("hbox"), tangential=(0.0, 2.0))
    assert caught.value.contact == "object"
    # f_t / f_n passes 0.33 between steps 14 (0.3294) and 15 (0.3448)
    assert caught.value.need == pytest.approx(2 * 15 / 19 / (3 + 2 * 15 / 19))
    assert caught.value.step == 15


def test_a_face_that_looks_down_cannot_be_pushed_along(scene_of):
    with pytest.raises(InfeasiblePlan, match="no push of the go makes it slip this way"):
        made("extrinsic_pushing", scene_of("hbox"), contact_mm=(60, 10), tilt_deg=45)


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("static_in_contact", {"contact_mm": (0, 40)}, r"contact_mm: .* \(0, 40\) mm, which lies 10 mm off it"),
        ("static_in_contact", {"contact_mm": (60, 30)}, r"contact_mm: expected a point on a face .* its corner"),
        ("static_in_contact", {"tilt_deg": 0}, "tilt_deg: expected the grasped object to stand on one corner"),
        ("static_in_contact", {"eo_angle_deg": 5}, "eo_angle_deg: expected the extrinsic object to lie on a face"),
        ("static_in_contact", {"go_contact_mm": (0, -73)}, "go_contact_mm: expected none"),
        ("static_in_contact", {"contact_mm": (-60, 5)}, "tilt_deg: expected the grasped object above the ground"),
        ("relative_pivoting", {"tilt_deg": (10, 95)}, r"tilt_deg: step 1[0-9]: the bodies would go into each other"),
        ("relative_sliding", {"travel_mm": 150}, "travel_mm: step 0: expected the contact to stay on its face"),
        (
            "static_in_contact",
            {"touch": "face_on_corner", "contact_mm": (0, 30)},
            "contact_mm: expected a corner of the extrinsic object",
        ),
        (
            "static_in_contact",
            {"touch": "face_on_corner", "go_contact_mm": (0, 0)},
            r"go_contact_mm: expected a point on the outline of the grasped object, .* lies 25 mm off it",
        ),
    ],
)
def test_what_the_geometry_of_hbox_does_not_allow_is_refused_by_parameter(name, parameters, message, scene_of):
    with pytest.raises(ValueError, match=f"^{message}"):
        made(name, scene_of("hbox"), **parameters)


def test_a_go_that_would_stand_in_the_object_is_refused(scene_of):
    """On the foot of z, 28 mm to the left of its bar, there is no room for 50 mm of go."""
    with pytest.raises(ValueError, match=r"^tilt_deg: expected the bodies to touch in one point .* would overlap"):
        made("static_in_contact", scene_of("z"), contact_mm=(-45, -28.8), tilt_deg=20)


@pytest.mark.parametrize(
    ("shape", "parameters", "message"),
    [
        ("pentagon", {"from_apex_mm": 90}, "from_apex_mm: expected a point on the face of 79.94 mm"),
        ("heptagon", {"angle_deg": (0.3, 60)}, "angle_deg: step 3[0-9]: expected the object to turn about"),
        ("tall_box", {"eo_angle_deg": 30}, "eo_angle_deg: expected the extrinsic object to lie on a face"),
        (
            "z",
            {"touch": "face_on_corner", "contact_mm": (17.3, 28.8)},
            "contact_mm: expected a corner that points outward",
        ),
    ],
)
def test_what_a_pivot_does_not_allow_is_refused_by_parameter(shape, parameters, message, scene_of):
    with pytest.raises(ValueError, match=f"^{message}"):
        made("extrinsic_pivoting", scene_of(shape, mu_ground=0.5), **parameters)
