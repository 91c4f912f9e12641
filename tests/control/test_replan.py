"""What is believed of a problem from what is measured: contacts by their modes, the grasp, and friction."""

import numpy as np
import pytest

from control.replan import Belief, Gains
from mechanics import se2
from mechanics.records import PlanarState
from planning.planner import plan
from planning.receding import tracking
from planning.skills.base import SKILLS, Extrinsic, Held, Scene
from tests.control.corner_plant import cross, turn
from tests.control.test_mpc import HELD
from tests.planning.problems import MOVED

from mechanics.catalogue import load_object  # isort: skip

ALL = Gains(pose=1.0, grasp=1.0, mu=1.0, slip=0.05, reach=np.array([0.05, 0.05, 0.5]))
PARTLY = Gains(pose=0.25, grasp=1.0, mu=1.0, slip=0.003, reach=np.array([0.05, 0.05, 0.5]))
#: every skill, and both touches where there are two objects
CASES = [
    ("grasped_static", {}),
    ("grasped_static", {"angle_deg": 0.0}),
    ("grasped_pivoting", {}),
    ("grasped_sliding", {}),
    ("grasped_sliding", {"travel_mm": -40.0}),
    *(
        (skill, {"touch": touch, "disturbance": 0.0})
        for skill in ("static_in_contact", "relative_pivoting", "extrinsic_pivoting")
        for touch in ("corner_on_face", "face_on_corner")
    ),
    ("relative_sliding", {}),
    ("relative_sliding", {"travel_mm": -20.0}),
    ("extrinsic_pushing", {}),
    ("extrinsic_pushing", {"distance_mm": -20.0}),
]
_made = {}


def made(skill, parameters=None, mu_ground=0.8, shape=None):
    """Problem and plan, made once."""
    key = skill, tuple((parameters or {}).items()), mu_ground, shape
    if key not in _made:
        scene = Scene(HELD)
        if skill in MOVED:
            on_table = load_object(shape or MOVED[skill])
            scene = Scene(HELD, Extrinsic(on_table.polygon.vertices, on_table.mass, 0.5, mu_ground))
        given = SKILLS[skill].Parameters.model_validate({"steps": 5, **(parameters or {})})
        task = SKILLS[skill].task(given, scene)
        whole = plan(task, "p")
        _made[key] = tracking(task.problem, whole, 10.0), whole
    return _made[key]


def as_planned(whole, k):
    return PlanarState(whole.ee[k], whole.go[k], None if whole.eo is None else whole.eo[k], whole.wrench[k])


def at(problem, k):
    return float(problem.angle[k])


def moved(state, *, by=(0.0, 0.0), go=True, eo=False):
    """The same with objects and ee (one rigid whole) elsewhere in W."""
    off = np.append(by, 0.0)
    return PlanarState(
        state.ee + off, state.go + off if go else state.go, state.eo + off if eo else state.eo, state.wrench
    )


@pytest.mark.parametrize(("skill", "parameters"), CASES)
def test_what_is_as_planned_changes_nothing(skill, parameters):
    problem, whole = made(skill, parameters)
    belief = Belief(problem, ALL)
    for k in range(whole.steps):
        belief.in_contact(k, as_planned(whole, k), at(problem, k))
        assert belief.grasp == pytest.approx(problem.grasp, abs=1e-7)
        seen = belief.seen(k)
        assert (seen.along, seen.travel) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert seen.mu == pytest.approx([c.mu for c in (*problem.contacts, *problem.ground)], rel=1e-6)
        assert belief.ahead == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(("skill", "parameters"), CASES)
def test_a_grasp_that_is_another_is_found_from_one_measurement_in_contact(skill, parameters):
    # by hand: the same objects and forces, held elsewhere; for the fingers the wrench is about another point, which
    # the one that is told, about the planned grasp on the go, does not know of
    problem, whole = made(skill, parameters)
    k, other = 2, problem.grasp + np.array([8e-4, -6e-4, np.radians(1.5)])
    go, w = whole.go[k], whole.wrench[k]
    before, after = (go[:2] + turn(go[2]) @ grasp[:2] for grasp in (problem.grasp, other))
    about = np.append(w[:2], w[2] + cross(before - after, w[:2]))
    angle = go[2] + other[2]
    x = np.linalg.solve(problem.stiffness, np.append(turn(angle).T @ about[:2], about[2]))
    ee = np.append(after + turn(angle) @ x[:2], angle + x[2])
    belief = Belief(problem, ALL)
    belief.in_contact(k, PlanarState(ee, go, as_planned(whole, k).eo, w), at(problem, k))
    assert belief.grasp == pytest.approx(other, abs=1e-6)


def test_in_free_air_the_grasp_is_the_mean_of_all_looks():
    problem, whole = made("grasped_static")
    belief = Belief(problem, ALL)
    go = whole.preload_go[0] + [0, 0.01, 0]
    ee = whole.free_air_ee(go)
    weight = np.array([0.0, HELD.mass * 9.81, 0.0])
    for off in (3e-4, -1e-4, 4e-4):
        # the go is seen off by so much, along its own axes
        belief.in_air(PlanarState(ee, se2.compose(go, [off, 0, 0]), None, weight))
    assert belief.grasp - problem.grasp == pytest.approx([-2e-4, 0, 0], abs=1e-4)


def test_a_pose_that_the_ground_blocks_is_put_down_to_the_fingers():
    problem, whole = made("grasped_static")
    belief, state = Belief(problem, ALL), as_planned(whole, 1)
    sunk = PlanarState(state.ee, state.go - np.array([0, 4e-4, 0]), None, state.wrench)
    belief.in_contact(1, sunk, at(problem, 1))
    assert belief.grasp == pytest.approx(problem.grasp, abs=1e-7)  # seen in the ground, it is on it all the same


def test_a_place_that_sticks_is_the_mean_of_what_was_seen_and_needs_no_other_force():
    problem, whole = made("grasped_static")
    belief = Belief(problem, ALL)
    for x in (2e-4, 6e-4, 4e-4):
        belief.in_contact(1, moved(as_planned(whole, 1), by=np.array([x, 0.0])), at(problem, 1))
    assert belief.seen(1).travel == pytest.approx(4e-4)
    # the fingers moved along: at the newest place the grasp is the old one
    assert belief.grasp == pytest.approx(problem.grasp, abs=2e-4)


@pytest.mark.parametrize("gain", [0.25, 1.0])
def test_of_what_is_free_to_turn_a_part_of_the_innovation_is_believed(gain):
    problem, whole = made("grasped_static")
    gains = Gains(pose=gain, grasp=1.0, mu=1.0, slip=0.05, reach=np.array([0.05, 0.05, 0.5]))
    belief, state, turned = Belief(problem, gains), as_planned(whole, 1), np.radians(0.4)
    corner = whole.contact_points[1, 0]

    def about_corner(X, angle):
        return np.append(corner + turn(angle) @ (X[:2] - corner), X[2] + angle)

    seen = PlanarState(state.ee, about_corner(state.go, turned), None, state.wrench)
    belief.in_contact(1, seen, at(problem, 1))
    # the next command undoes the part that is believed: it turns the fingers back about the corner
    planned = se2.compose(whole.go[1], belief.grasp)
    expected = about_corner(se2.compose(whole.go[1], problem.grasp), -gain * turned)
    assert planned[:2] == pytest.approx(expected[:2], abs=3e-5)
    assert planned[2] == pytest.approx(expected[2], abs=1e-3)


def test_an_extrinsic_object_that_stands_elsewhere_is_met_there():
    problem, whole = made("extrinsic_pivoting", {"disturbance": 0.0})
    belief = Belief(problem, ALL)
    belief.in_contact(2, moved(as_planned(whole, 2), by=np.array([1.5e-3, 0]), eo=True), at(problem, 2))
    assert belief.seen(2).along == pytest.approx(1.5e-3)
    assert belief.seen(2).travel == pytest.approx(0.0, abs=1e-9)
    assert belief.grasp == pytest.approx(problem.grasp, abs=1e-7)


def test_an_object_that_is_first_seen_farther_away_than_a_slip_has_slid_from_where_it_was_planned():
    problem, whole = made("extrinsic_pivoting", {"disturbance": 0.0})
    belief, state = Belief(problem, PARTLY), as_planned(whole, 2)
    slid = with_force(moved(state, by=np.array([5e-3, 0]), eo=True), problem, [-0.6, 1.0])
    belief.in_contact(2, slid, at(problem, 2))
    weight = problem.eo_body.mass * 9.81
    assert belief.mu[1] == pytest.approx(max(0.6 / (1.0 + weight), 0.4))  # half of what was planned, at least
    near = Belief(problem, PARTLY)
    near.in_contact(2, moved(state, by=np.array([2e-3, 0]), eo=True), at(problem, 2))
    assert near.mu[1] == pytest.approx(0.8)


def test_an_extrinsic_object_that_is_not_seen_is_where_it_was_planned():
    problem, whole = made("extrinsic_pivoting", {"disturbance": 0.0})
    state, belief = as_planned(whole, 2), Belief(problem, ALL)
    belief.in_contact(2, PlanarState(state.ee, state.go, None, state.wrench), at(problem, 2))
    assert belief.grasp == pytest.approx(problem.grasp, abs=1e-7)


def test_what_slips_too_far_is_ahead_and_what_lags_is_not():
    problem, whole = made("grasped_sliding")
    belief = Belief(problem, ALL)
    belief.in_contact(1, moved(as_planned(whole, 1), by=np.array([7e-4, 0])), at(problem, 1))
    assert belief.ahead == pytest.approx((0.0, 7e-4))
    belief.in_contact(2, moved(as_planned(whole, 2), by=np.array([-7e-4, 0])), at(problem, 2))
    assert belief.ahead == (0.0, 0.0)
    assert belief.seen(2).travel == 0.0  # where it is to be stays where it was planned


def with_force(state, problem, force):
    """The state with this force (2,) of the environment on the go."""
    weight = np.array([0.0, -problem.go_body.mass * problem.gravity])
    return PlanarState(state.ee, state.go, state.eo, np.append(-(np.array(force) + weight), state.wrench[2]))


def test_friction_is_the_ratio_at_which_a_slipping_contact_came_to_rest():
    problem, whole = made("grasped_sliding")
    belief = Belief(problem, Gains(1.0, 1.0, 0.5, 0.05, ALL.reach))
    belief.in_contact(0, as_planned(whole, 0), at(problem, 0))
    belief.in_contact(1, with_force(as_planned(whole, 1), problem, [-0.27 * 4, 4.0]), at(problem, 1))
    assert belief.mu == pytest.approx([(0.33 + 0.27) / 2])


def test_a_contact_that_did_not_slip_as_it_should_tells_nothing_of_friction():
    problem, whole = made("grasped_sliding")
    belief = Belief(problem, ALL)
    belief.in_contact(0, as_planned(whole, 0), at(problem, 0))
    stuck = as_planned(whole, 0)
    belief.in_contact(1, with_force(stuck, problem, [-0.5, 4.0]), at(problem, 1))
    assert belief.mu == pytest.approx([0.33])


def test_friction_is_not_learned_from_next_to_no_force_nor_beyond_reason():
    problem, whole = made("grasped_sliding")
    for force, learned in (([-0.1, 0.2], 0.33), ([-4.0, 4.0], 0.66), ([-0.1, 4.0], 0.165)):
        belief = Belief(problem, ALL)
        belief.in_contact(0, as_planned(whole, 0), at(problem, 0))
        belief.in_contact(1, with_force(as_planned(whole, 1), problem, force), at(problem, 1))
        assert belief.mu == pytest.approx([learned])


def test_a_pushed_object_tells_the_grounds_friction():
    problem, whole = made("extrinsic_pushing")
    belief, weight = Belief(problem, ALL), problem.eo_body.mass * 9.81
    belief.in_contact(0, as_planned(whole, 0), at(problem, 0))
    # 3 N to the right and 1 N down on it: the ground carries the weight and that
    belief.in_contact(1, with_force(as_planned(whole, 1), problem, [-3.0, 1.0]), at(problem, 1))
    assert belief.mu[1:] == pytest.approx([3.0 / (weight + 1.0)] * 2)


def test_a_pivot_that_has_slipped_is_where_it_is_with_the_friction_that_was_seen():
    problem, whole = made("extrinsic_pivoting", {"disturbance": 0.0})
    belief = Belief(problem, ALL)
    assert belief.slipped(2, moved(as_planned(whole, 2), by=np.array([2e-3, 0]), eo=True), "ground right")
    assert belief.seen(2).along == pytest.approx(2e-3)
    f_n, f_t = whole.contact_forces[2, 1]
    assert belief.mu[1] == pytest.approx(max(abs(f_t) / f_n, 0.4))  # half of what was planned, at least
    assert belief.mu[0] == 0.5


def test_with_too_little_friction_seen_for_any_force_a_slip_is_the_end():
    # whatever the force: three of them must meet, and from flat the pentagon's need µ = 0.325 of the ground
    problem, whole = made("extrinsic_pivoting", {"disturbance": 0.0, "angle_deg": (0.3, 5.0)}, 0.5, "pentagon")
    belief, slid = Belief(problem, ALL), moved(as_planned(whole, 2), by=np.array([2e-3, 0]), eo=True)
    assert not belief.slipped(2, with_force(slid, problem, [0.0, 1.0]), "ground right")
    assert belief.mu[1] == pytest.approx(0.25)


def test_of_two_objects_the_one_that_slipped_on_the_other_is_found_along_the_face():
    problem, whole = made("static_in_contact", {"disturbance": 0.0})
    belief, state = Belief(problem, ALL), as_planned(whole, 2)
    theta = whole.eo[2][2]
    e = turn(theta) @ np.array([problem.contacts[0].normal[1], -problem.contacts[0].normal[0]])
    belief.slipped(2, moved(state, by=3e-3 * e), "object")
    assert belief.seen(2).travel == pytest.approx(3e-3)
    assert belief.seen(2).along == 0.0


def test_held_has_the_grasp_that_these_tests_work_with():
    assert isinstance(HELD, Held) and HELD.grasp == pytest.approx([0, 0.045, 0])
