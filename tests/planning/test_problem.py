"""What a problem refuses, with field and step, and the small cases that it takes."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mechanics.friction import Mode
from planning.consistency import travel_range
from planning.objective import TorchObjective
from planning.problem import Body, Form, Limits, LossWeights, PlanarArm, Problem, Touch

from .problems import KINDS, pivoting_pentagon, random_problem

SLIP = Mode.SLIP_NEGATIVE


@pytest.fixture(scope="module")
def pentagon() -> Problem:
    return pivoting_pentagon(steps=5)


def with_contact(problem: Problem, **changes) -> Problem:
    return replace(problem, contacts=(replace(problem.contacts[0], **changes), *problem.contacts[1:]))


def with_ground(problem: Problem, **changes) -> Problem:
    return replace(problem, ground=(replace(problem.ground[0], **changes), *problem.ground[1:]))


def spoiled(values, at, value=np.nan):
    values = np.array(values, dtype=float)
    values[at] = value
    return values


NOT_A_NUMBER = {
    "eo": lambda p: replace(p, eo=spoiled(p.eo, (3, 1))),
    "angle": lambda p: replace(p, angle=spoiled(p.angle, 3)),
    "travel": lambda p: replace(p, travel=spoiled(p.travel, 3, np.inf)),
    "angle_limits": lambda p: replace(p, angle_limits=spoiled(p.angle_limits, (3, 0))),
    "wish": lambda p: with_contact(p, wish=spoiled(p.contacts[0].wish, (3, 0))),
}


@pytest.mark.parametrize("field", NOT_A_NUMBER)
def test_numbers_that_are_none_are_refused_by_field_and_step(pentagon, field):
    with pytest.raises(ValueError, match=rf"{field}: step 3: expected finite numbers, received (nan|inf)"):
        NOT_A_NUMBER[field](pentagon)


SHAPES = {
    "eo": lambda p: replace(p, eo=np.zeros((5, 2))),
    "grasp": lambda p: replace(p, grasp=np.zeros(2)),
    "stiffness": lambda p: replace(p, stiffness=np.eye(2)),
    "angle": lambda p: replace(p, angle=np.zeros(4)),
    "travel": lambda p: replace(p, travel=0.0),
    "free": lambda p: replace(p, free=np.ones((5, 4), bool)),
    "angle_limits": lambda p: replace(p, angle_limits=np.zeros(2)),
    "wish": lambda p: with_contact(p, wish=np.zeros((4, 2))),
    "p_go": lambda p: with_contact(p, p_go=np.zeros(3)),
    "p_eo": lambda p: with_ground(p, p_eo=np.zeros(3)),
    "vertices": lambda p: replace(p, go_body=Body(np.zeros((4, 3)), 0.1, 0.04)),
    "workspace": lambda p: replace(p, limits=Limits(workspace=np.zeros((2, 2)))),
}


@pytest.mark.parametrize("field", SHAPES)
def test_another_shape_is_refused_by_field(pentagon, field):
    with pytest.raises(ValueError, match=rf"{field}: expected .*shape"):
        SHAPES[field](pentagon)


@pytest.mark.parametrize("name", [item.name for item in fields(LossWeights)])
def test_a_weight_is_not_negative(name):
    with pytest.raises(ValueError, match=rf"weights: {name}: expected a number ≥ 0, received -1"):
        LossWeights(**{name: -1.0})


FIGURES = [
    (lambda p: replace(p, eo=np.zeros((0, 3))), r"eo: expected shape \(K, 3\) with K ≥ 1"),
    (lambda p: replace(p, gravity=-1.0), "gravity: expected a number ≥ 0"),
    (lambda p: replace(p, force_weight=0.0), "force_weight: expected a number > 0"),
    (lambda p: replace(p, slack_weight=-1.0), "slack_weight: expected a number > 0"),
    (lambda p: replace(p, stiffness=-np.eye(3)), "positive definite"),
    (lambda p: replace(p, free=p.free * 1.0), "free: expected booleans"),
    (lambda p: with_contact(p, mu=-0.1), "mu: expected a number ≥ 0"),
    (lambda p: with_contact(p, normal=np.array([0.0, 1.1])), "normal: expected unit length, received 1.1"),
    (lambda p: with_contact(p, modes=("stick", "roll", "stick", "stick", "stick")), "step 1: expected one of .*'roll'"),
    (lambda p: with_contact(p, modes=(Mode.STICK,) * 4, wish=np.zeros((4, 2))), "modes: expected 5, one per step"),
    (lambda p: with_ground(p, modes=(Mode.STICK,) * 6), "'ground': modes: expected 5, one per step, received 6"),
    (lambda p: with_ground(p, name="object"), "expected distinct names"),
    (lambda p: replace(p, contacts=()), "contacts: expected 1 or 2"),
    (lambda p: replace(p, ground=()), "ground: expected 1 or 2"),
    (lambda p: replace(p, eo_body=None), "ground: expected none without an extrinsic object"),
    (lambda p: replace(p, go_body=Body(p.go_body.vertices, 0.1, 0.0)), "rho: expected a number > 0"),
    (lambda p: replace(p, go_body=Body(p.go_body.vertices, np.nan, 0.1)), "mass: expected a number ≥ 0"),
    (lambda p: replace(p, limits=Limits(force=0.0)), "force: expected a number > 0"),
    (lambda p: replace(p, limits=Limits(workspace=np.array([[0, 1], [1, 0], [0, 1.0]]))), "workspace: y: expected"),
    (lambda p: replace(p, angle_limits=p.angle_limits[:, ::-1]), "angle_limits: step 0: expected the least before"),
    (lambda p: replace(p, angle=spoiled(p.angle, 2, 1.0)), r"angle: step 2: expected between .* received 57.2958°"),
]


@pytest.mark.parametrize(("change", "message"), FIGURES)
def test_figures_that_mean_nothing_are_refused(pentagon, change, message):
    with pytest.raises(ValueError, match=message):
        change(pentagon)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"upper": 0.0}, "upper: expected a number > 0"),
        ({"elbow": 0}, "elbow: expected 1 or -1"),
        ({"limits": np.zeros((3, 2))}, "limits: shoulder: expected the least before the largest"),
        ({"tool": np.zeros(3)}, "tool: expected shape"),
    ],
)
def test_an_arm_that_cannot_be_is_refused(changes, message):
    limits = np.array([[-1.0, 1.0]] * 3)
    arm = {"base": np.zeros(2), "upper": 0.5, "fore": 0.4, "tool": np.zeros(2), "elbow": 1, "zero": np.zeros(3)}
    with pytest.raises(ValueError, match=message):
        PlanarArm(**({**arm, "limits": limits} | changes))


def test_a_contact_beyond_the_end_of_its_face_is_refused(pentagon):
    # the face beside the apex is 79.939 mm long, and the contact 8 mm from its upper end: travel is positive to there
    length = 2 * 68 * np.sin(np.pi / 5)
    assert travel_range(pentagon) == pytest.approx((8e-3 - length * 1e-3, 8e-3), abs=1e-6)
    sliding = with_contact(pentagon, modes=(SLIP,) * 5)
    replace(sliding, travel=np.linspace(0, 8e-3, 5))
    with pytest.raises(ValueError, match=r"travel: step 3: the contact is off the face, .* to 8 mm; received 8.1 mm"):
        replace(sliding, travel=np.array([0, 1, 2, 8.1, 8.2]) * 1e-3)


def test_a_point_that_is_on_no_face_with_its_normal_is_refused(pentagon):
    p = pentagon.contacts[0].p_eo
    with pytest.raises(ValueError, match="p_eo: expected a point on a face of the eo with outward normal"):
        with_contact(pentagon, p_eo=p * 1.01)
    with pytest.raises(ValueError, match="p_eo: expected a point on a face of the eo with outward normal"):
        with_contact(pentagon, normal=-pentagon.contacts[0].normal)


def test_what_touches_with_a_corner_touches_with_a_corner(pentagon):
    with pytest.raises(ValueError, match=r"p_go: expected a corner of the go, .* 5 mm from the nearest"):
        with_contact(pentagon, p_go=pentagon.contacts[0].p_go + np.array([0, 0.005]))
    with pytest.raises(ValueError, match=r"'ground': p_eo: expected a vertex of the eo"):
        with_ground(pentagon, p_eo=pentagon.ground[0].p_eo + np.array([0.005, 0]))


def test_a_face_may_be_given_clockwise(pentagon):
    turned = replace(pentagon.eo_body, vertices=pentagon.eo_body.vertices[::-1])
    assert travel_range(replace(pentagon, eo_body=turned)) == pytest.approx(travel_range(pentagon))


def flat(**changes) -> Problem:
    """The eo on its face, touched by the go; three steps."""
    given = {"two_bodies": True, "touch": Touch.CORNER_ON_FACE, "mode": Mode.STICK, "ground": 2, "steps": 3}
    for seed in range(100):
        problem = random_problem(np.random.default_rng(seed), **(given | changes))
        if all(set(contact.modes) == {Mode.STICK} for contact in problem.ground):
            return problem
    raise AssertionError("no such problem")


def test_modes_that_contradict_the_nominal_motion_are_refused(pentagon):
    moving = np.array([0, 1, 2, 3, 4]) * 1e-3
    free = pentagon.free.copy()
    free[:, 1] = False
    fixed = replace(pentagon, free=free)
    with pytest.raises(
        ValueError, match=r"travel: step 1: contact 'object' moves by 1 mm, which is slip-, but .* stick"
    ):
        replace(fixed, travel=moving)
    with pytest.raises(
        ValueError, match=r"travel: step 1: contact 'object' moves by 1 mm, which is slip-, but .* slip\+"
    ):
        replace(with_contact(fixed, modes=(Mode.SLIP_POSITIVE,) * 5), travel=moving)
    replace(with_contact(fixed, modes=(SLIP,) * 5), travel=moving)
    shifted = np.array(pentagon.eo)
    shifted[4, 0] += 0.002
    with pytest.raises(ValueError, match=r"eo: step 4: contact 'ground' moves by 2 mm, which is slip-, but .* stick"):
        replace(pentagon, eo=shifted)
    replace(with_ground(pentagon, modes=(SLIP,) * 5), eo=shifted)
    lifted = np.array(pentagon.eo)
    lifted[4, 1] += 0.002
    with pytest.raises(ValueError, match=r"eo: step 4: contact 'ground' leaves the ground by 2 mm"):
        replace(pentagon, eo=lifted)


def test_modes_that_contradict_each_other_are_refused():
    problem = flat()
    left, right = problem.ground
    with pytest.raises(
        ValueError, match=r"modes: step 0: contact 'ground left' is to stick and 'ground right' to slip-"
    ):
        replace(problem, ground=(left, replace(right, modes=(SLIP,) * 3)))
    replace(problem, ground=(left, replace(right, modes=(Mode.FREE,) * 3)))


def test_a_contact_that_sticks_keeps_its_travel(pentagon):
    with pytest.raises(ValueError, match="free: step 0: contact 'object' sticks there: expected its travel not"):
        replace(pentagon, free=np.ones((5, 5), bool))


def test_a_wish_where_there_is_no_contact_is_refused(pentagon):
    modes = (*(Mode.STICK,) * 4, Mode.FREE)
    with pytest.raises(ValueError, match=r"wish: step 4 is free and carries no force: expected 0, received \(3, "):
        with_contact(pentagon, modes=modes)
    with_contact(pentagon, modes=modes, wish=spoiled(pentagon.contacts[0].wish, 4, 0.0))


def test_coincident_contact_points_are_refused():
    problem = flat()
    with pytest.raises(ValueError, match="step 0: 'ground left' and 'again' coincide"):
        replace(problem, ground=(problem.ground[0], replace(problem.ground[0], name="again")))
    standing = random_problem(np.random.default_rng(0), two_bodies=False, contacts=2, touch=Touch.CORNER_ON_FACE)
    with pytest.raises(ValueError, match="step 0: 'left' and 'again' coincide"):
        replace(standing, contacts=(standing.contacts[0], replace(standing.contacts[0], name="again")))


@pytest.mark.parametrize("touch", Touch)
def test_a_second_contact_closes_where_the_first_does(touch):
    lying = random_problem(
        np.random.default_rng(1), two_bodies=False, contacts=2, touch=touch, mode=Mode.STICK, steps=3
    )
    with pytest.raises(ValueError, match=r"'right': (angle|normal): step 1: "):
        replace(lying, angle=lying.angle + np.array([0.0, 0.01, 0.0]))
    free = lying.free.copy()
    free[2, 0] = True
    with pytest.raises(ValueError, match="free: step 2: 'left' and 'right' both touch, which fixes the angle"):
        replace(lying, free=free)
    first, second = lying.contacts
    up = replace(second, modes=(Mode.STICK, Mode.STICK, Mode.FREE), wish=spoiled(second.wish, 2, 0.0))
    replace(lying, contacts=(first, up), free=free, angle=lying.angle + np.array([0.0, 0.0, 0.01]))


def test_an_eo_that_does_not_lie_flat_is_refused():
    problem = flat()
    tilted = np.array(problem.eo)
    tilted[:, 2] += 0.01
    with pytest.raises(ValueError, match="eo: step 0: its contacts with the ground differ in height by"):
        replace(problem, eo=tilted)


SMALL = {
    "one step": lambda p: pivoting_pentagon(p.form, steps=1),
    "no gravity": lambda p: replace(with_contact(p, wish=p.contacts[0].wish * [1, 0]), gravity=0.0),
    "no motion": lambda p: replace(p, eo=np.tile(p.eo[0], (p.steps, 1))),
    "no mass": lambda p: replace(p, go_body=replace(p.go_body, mass=0.0)),
    "no friction": lambda p: with_contact(p, mu=0.0),
    "no weights": lambda p: replace(p, weights=LossWeights(*[0.0] * len(fields(LossWeights)))),
}


@pytest.mark.parametrize("form", Form)
@pytest.mark.parametrize("what", SMALL)
def test_small_cases_are_problems_like_any_other(pentagon, what, form):
    problem = SMALL[what](replace(pentagon, form=form))
    objective = TorchObjective(problem)
    value, gradient = objective.gradient(objective.start)
    assert np.isfinite(value)
    assert gradient.shape == (problem.steps, 5)
    assert np.isfinite(gradient).all()
    assert objective.values(objective.start[None]) == pytest.approx([value])
    assert objective.quadratic(objective.start).value == pytest.approx(value)
    terms = objective.evaluate(objective.start).terms
    assert ("smooth" in terms) == (what not in ("one step", "no weights"))
    assert bool(terms) == (what != "no weights")


def test_v3_is_not_free_in_the_closed_form(pentagon):
    assert not pentagon.free[:, 4].any()
    assert replace(pentagon, form=Form.PAPER, free=pentagon.free | (np.arange(5) == 4)).free[:, 4].all()


def test_the_arrays_are_a_copy_and_read_only(pentagon):
    angle = np.array(pentagon.angle)
    problem = replace(pentagon, angle=angle)
    angle[0] = 9.0
    assert problem.angle[0] == pentagon.angle[0]
    for array in (problem.angle, problem.eo, problem.contacts[0].wish, problem.eo_body.vertices, problem.free):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("kind", KINDS[::3], ids=str)
def test_the_generator_s_problems_are_taken(kind):
    problem = random_problem(np.random.default_rng(1), form=kind[0], two_bodies=kind[1], touch=kind[2], mode=kind[3])
    assert set(problem.contacts[0].modes) == {kind[3]}
    assert (problem.form, problem.contacts[0].touch, problem.eo_body is not None) == (kind[0], kind[2], kind[1])
