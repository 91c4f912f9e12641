import json
import math
import pickle
from dataclasses import fields, replace

import numpy as np
import pytest

from mechanics import se2
from mechanics.friction import Mode
from planning.errors import InfeasiblePlan
from planning.p2 import Solution, solve_by_projection
from planning.plan import Plan
from planning.planner import plan
from planning.skills.base import SKILLS
from planning.task import ContactRequest, Task


def made(name, tall_box, **parameters):
    skill = SKILLS[name]
    return skill.task(skill.Parameters(**parameters), tall_box)


@pytest.fixture(params=["grasped_static", "grasped_pivoting"])
def task(request, tall_box):
    return made(request.param, tall_box)


def with_contacts(task, **changes):
    return replace(task, contacts=tuple(replace(contact, **changes) for contact in task.contacts))


def test_forces_and_moments_sum_to_zero_at_every_step(task, statics):
    made_plan = plan(task, "p")
    for k in range(made_plan.steps):
        np.testing.assert_allclose(statics.residual(made_plan, k, 0.1, 9.81), 0, atol=1e-13)


@pytest.mark.parametrize("part", ["", "preload_", "unload_"])
def test_the_end_effector_strains_the_finger_by_the_planned_wrench(task, statics, part):
    p = plan(task, "p")
    go, ee, wrench = (getattr(p, part + name) for name in ("go", "ee", "wrench"))
    for k in range(len(go)):
        np.testing.assert_allclose(statics.sensor_wrench(p.stiffness, go[k], p.X_go_gocf, ee[k]), wrench[k], atol=1e-11)


def test_the_sensor_presses_down_by_what_the_ground_and_the_weight_leave(tall_box):
    """4 N from the ground up, 0.981 N of weight down: the sensor presses 3.019 N down."""
    p = plan(made("grasped_pivoting", tall_box), "p")
    np.testing.assert_allclose(p.wrench[:, :2], [[0, -(4 - 0.981)]] * 20, atol=1e-12)
    assert p.contact_forces.shape == (20, 1, 2)


def test_ramps_rise_from_the_weight_to_the_first_wrench_and_fall_back(task):
    p = plan(task, "p")
    assert len(p.preload_ee) == len(p.unload_ee) == 11
    np.testing.assert_allclose(p.preload_wrench[-1], p.wrench[0], atol=1e-12)
    np.testing.assert_allclose(p.unload_wrench[0], p.wrench[-1], atol=1e-12)
    for ramp in (p.preload_wrench[0], p.unload_wrench[-1]):
        np.testing.assert_allclose(ramp[:2], [0, 0.981], atol=1e-12)  # the finger carries the weight alone
    np.testing.assert_allclose(np.diff(p.preload_wrench, n=2, axis=0), 0, atol=1e-12)
    np.testing.assert_array_equal(p.preload_go, np.broadcast_to(p.go[0], (11, 3)))
    np.testing.assert_array_equal(p.unload_go, np.broadcast_to(p.go[-1], (11, 3)))


def test_an_unloaded_ramp_end_holds_the_object_as_in_free_air(task):
    p = plan(task, "p")
    np.testing.assert_allclose(p.free_air_ee(p.go[0]), p.preload_ee[0], atol=1e-14)
    np.testing.assert_allclose(p.free_air_ee(p.go)[-1], p.unload_ee[-1], atol=1e-14)


def test_free_air_carries_the_weight_and_its_moment(task, statics):
    """Lying on its side the box hangs 45 mm off the grasp: 0.1 kg · 9.81 · 0.045 = 44.1 N·mm."""
    p = plan(task, "p")
    go = np.array([0.2, 0.3, math.pi / 2])
    wrench = statics.sensor_wrench(p.stiffness, go, p.X_go_gocf, p.free_air_ee(go))
    # turned by 90° the centre of mass lies to the right of the grasp centre: the sensor turns it counter-clockwise
    np.testing.assert_allclose(wrench, [0, 0.981, 0.981 * 0.045], atol=1e-12)


def test_both_backends_make_the_same_plan(task):
    exact, reference = plan(task, "p"), plan(task, "p", backend="cvxpylayers")
    np.testing.assert_allclose(reference.ee, exact.ee, atol=1e-10)
    np.testing.assert_allclose(reference.contact_forces, exact.contact_forces, atol=1e-6)
    assert (exact.planner, reference.planner) == ("projection", "cvxpylayers")
    assert exact.status == reference.status == "solved"


def test_a_tilted_force_beyond_the_cone_is_infeasible_and_says_where_and_by_how_much(tall_box):
    task = made("grasped_static", tall_box, force=(3, 3), tangential=(0.0, 1.2))
    with pytest.raises(InfeasiblePlan) as caught:
        plan(task, "p")
    # f_t reaches 0.33 · 3 N = 0.99 N between steps 15 (0.947) and 16 (1.011)
    assert (caught.value.step, caught.value.contact, caught.value.have) == (16, "corner", 0.33)
    assert math.isclose(caught.value.need, 1.2 * 16 / 19 / 3)
    assert str(caught.value).startswith("ground contact 'corner', step 16: needs µ ≥ 0.337, has 0.33")


def test_an_infeasible_plan_survives_a_trip_between_processes():
    error = InfeasiblePlan(12, "corner", 0.387, 0.33)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_force_on_the_very_edge_of_the_cone_is_feasible(tall_box):
    task = made("grasped_static", tall_box, force=(3, 3), tangential=(0.99, -0.99))
    np.testing.assert_allclose(np.abs(plan(task, "p").contact_forces[0, 0]), [3, 0.99])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"force": np.array([-2.0, 0.0])}, "a contact only pushes"),
        ({"modes": (Mode.FREE,)}, "is free"),
        ({"modes": (Mode.SLIP_NEGATIVE,), "force": np.array([4.0, 0.0])}, "f_t must be -1.32 N"),
    ],
)
def test_wishes_that_a_mode_forbids_are_named(tall_box, change, words):
    task = with_contacts(made("grasped_pivoting", tall_box), **change)
    with pytest.raises(InfeasiblePlan, match=words) as caught:
        plan(task, "p")
    assert caught.value.step == 0


def test_a_slipping_contact_carries_the_edge_of_the_cone(tall_box, statics):
    """A go that slides right on the ground is held back: slip-, force to the left."""
    task = with_contacts(
        made("grasped_pivoting", tall_box), modes=(Mode.SLIP_NEGATIVE,), force=np.array([4.0, -0.33 * 4.0])
    )
    p = plan(task, "p")
    np.testing.assert_allclose(p.contact_forces[:, 0], [[4, -1.32]] * 20, atol=1e-12)
    np.testing.assert_allclose(p.wrench[:, 0], 1.32, atol=1e-12)  # the sensor pushes it on, to the right
    np.testing.assert_allclose(statics.residual(p, 7, 0.1, 9.81), 0, atol=1e-13)


def test_a_solver_that_gives_up_makes_no_plan(task):
    def broken(problem):
        solution = solve_by_projection(problem)
        status = tuple("failed" if k == 5 else "solved" for k in range(problem.steps))
        return Solution(solution.forces, status, solution.residual)

    with pytest.raises(InfeasiblePlan, match="step 5: the broken solver found no force"):
        plan(task, "p", backend=broken)


def test_an_unknown_backend_is_refused_with_the_known_ones(task):
    with pytest.raises(ValueError, match="cvxpylayers, projection, received 'simplex'"):
        plan(task, "p", backend="simplex")


def same(a, b):
    return all(
        np.array_equal(x, y) and type(x) is type(y)
        for x, y in ((getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    )


def test_a_plan_comes_back_from_json_to_the_last_bit(task):
    p = plan(task, "p")
    assert same(p, Plan.from_dict(json.loads(json.dumps(p.to_dict(), allow_nan=False))))


def test_a_plan_without_contacts_comes_back_too(tall_box):
    task = replace(made("grasped_static", tall_box), contacts=())
    p = plan(task, "hover")
    np.testing.assert_allclose(p.ee, p.free_air_ee(p.go), atol=1e-14)
    back = Plan.from_dict(json.loads(json.dumps(p.to_dict())))
    assert same(p, back)
    assert back.contact_points.shape == (20, 0, 2)


def test_a_plan_of_another_schema_or_with_other_keys_is_refused(task):
    plain = plan(task, "p").to_dict()
    with pytest.raises(ValueError, match="schema: expected 1, received 99"):
        Plan.from_dict(plain | {"schema": 99})
    with pytest.raises(ValueError, match=r"not known \['colour'\]"):
        Plan.from_dict(plain | {"colour": "red"})
    del plain["go"]
    with pytest.raises(ValueError, match=r"missing \['go'\]"):
        Plan.from_dict(plain)


def test_a_plan_with_arrays_that_do_not_fit_is_refused_by_name(task):
    p = plan(task, "p")
    with pytest.raises(ValueError, match=r"go: expected shape \(20, 3\), received \(19, 3\)"):
        replace(p, go=p.go[1:])
    with pytest.raises(ValueError, match="wrench: expected finite"):
        replace(p, wrench=p.wrench * np.nan)


def test_a_plans_arrays_cannot_be_written(task):
    with pytest.raises(ValueError, match="read-only"):
        plan(task, "p").ee[0, 0] = 1.0


def test_reanchoring_moves_points_on_bodies_as_the_table_moves(task, statics):
    p = replace(plan(task, "p"), eo=np.tile([0.1, 0.05, 0.2], (20, 1)))
    table = np.array([0.05, -0.02, 0.1])
    moved = p.reanchored(table)
    shift = np.array([[math.cos(0.1), -math.sin(0.1)], [math.sin(0.1), math.cos(0.1)]])
    for name in ("ee", "go", "eo", "preload_ee", "unload_go"):
        before, after = getattr(p, name), getattr(moved, name)
        np.testing.assert_allclose(after[:, :2], before[:, :2] @ shift.T + table[:2], atol=1e-14)
        np.testing.assert_allclose(after[:, 2], before[:, 2] + 0.1, atol=1e-14)
    np.testing.assert_allclose(moved.contact_points, p.contact_points @ shift.T + table[:2], atol=1e-14)
    np.testing.assert_allclose(moved.contact_normals[:, 0], [[-math.sin(0.1), math.cos(0.1)]] * 20, atol=1e-14)
    np.testing.assert_allclose(moved.wrench[:, :2], p.wrench[:, :2] @ shift.T, atol=1e-14)
    np.testing.assert_array_equal(moved.wrench[:, 2], p.wrench[:, 2])
    np.testing.assert_array_equal(moved.contact_forces, p.contact_forces)
    felt = statics.sensor_wrench(p.stiffness, moved.go[3], p.X_go_gocf, moved.ee[3])
    np.testing.assert_allclose(felt, moved.wrench[3], atol=1e-11)


def test_reanchoring_there_and_back_changes_nothing(task):
    p = plan(task, "p")
    table = np.array([0.05, -0.02, 0.1])
    back = p.reanchored(table).reanchored(se2.inverse(table))
    for name in ("ee", "go", "wrench", "contact_points", "contact_normals", "preload_wrench"):
        np.testing.assert_allclose(getattr(back, name), getattr(p, name), atol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"go": np.zeros((0, 3))}, r"go: expected shape \(K, 3\) with K ≥ 1"),
        ({"X_go_gocf": np.zeros(2)}, r"X_go_gocf: expected shape \(3,\), received \(2,\)"),
        ({"mass": -1.0}, "mass: expected a number ≥ 0"),
        ({"stiffness": -np.eye(3)}, "positive definite"),
    ],
)
def test_a_task_that_does_not_fit_is_refused_by_name(task, change, message):
    with pytest.raises(ValueError, match=message):
        replace(task, **change)


def test_contact_requests_are_checked_by_name(task):
    def request(**change):
        base = {"name": "corner", "p_goC": [0, 0], "normal": [0, 1], "modes": ("stick",), "mu": 0.3, "force": [1, 0]}
        return ContactRequest(**(base | change))

    def with_request(**change) -> Task:
        return replace(task, contacts=(request(**change),))

    assert with_request(modes="slip+").contacts[0].modes == (Mode.SLIP_POSITIVE,) * 20
    for change, message in (
        ({"normal": [0, 2]}, "normal: expected unit length, received 2"),
        ({"modes": ("stick", "stick")}, "modes: expected 20, one per step, received 2"),
        ({"mu": -0.1}, "mu: expected a number ≥ 0"),
        ({"force": [np.nan, 0]}, "force: expected finite"),
    ):
        with pytest.raises(ValueError, match=message):
            with_request(**change)
    with pytest.raises(ValueError, match="distinct names"):
        replace(task, contacts=(request(), request()))
