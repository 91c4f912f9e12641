"""The control laws against plants that can be solved by hand."""

import numpy as np
import pytest

from control.base import CONTROLLERS
from control.closed_loop import ClosedLoop
from control.open_loop import OpenLoop
from mechanics.records import PlanarState


def state(go, wrench=(0.0, -4.0, 0.0)):
    return PlanarState(np.zeros(3), None if go is None else np.array(go, float), None, np.array(wrench, float))


def test_both_controllers_of_the_paper_are_registered_by_name():
    assert {"open_loop": OpenLoop, "closed_loop": ClosedLoop}.items() <= CONTROLLERS.items()


@pytest.mark.parametrize("controller", [OpenLoop, ClosedLoop])
def test_without_a_measurement_the_plan_is_commanded_as_it_is(plan, controller):
    law = controller(plan)
    assert law.command(plan.go[1], plan.ee[1]) == pytest.approx(plan.ee[1])


def test_open_loop_ignores_what_it_is_told(plan):
    law = OpenLoop(plan)
    law.in_air(plan.go[0], state([0.01, 0.01, 0.1]))
    law.in_contact(0, state([0.01, 0.01, 0.1], [9, 9, 9]))
    assert law.command(plan.go[1], plan.ee[1]) == pytest.approx(plan.ee[1])


def test_a_grasp_offset_is_removed_by_one_update_in_air(plan):
    # in air the object moves with the end-effector: grasped 2 mm to the right, it stands right after moving 2 mm left
    law = ClosedLoop(plan)
    law.in_air(plan.go[0], state([0.002, 0.0, 0.0]))
    assert law.command(plan.go[0], plan.ee[0]) - plan.ee[0] == pytest.approx([-0.002, 0.0, 0.0])


@pytest.mark.parametrize("kappa", [0.6, 0.8, 1.0, 1.3])
def test_with_a_stiffness_error_the_wrench_error_shrinks_by_one_minus_kappa_per_update(plan, kappa):
    # the object cannot move, so the wrench is kappa K times the displacement of the end-effector
    law, errors = ClosedLoop(plan), []
    for _ in range(4):
        displacement = law.command(plan.go[0], plan.ee[0]) - [0.0, 0.1, 0.0]
        wrench = kappa * plan.stiffness @ displacement
        errors.append((plan.wrench[0] - wrench)[1])
        law.in_contact(0, state(plan.go[0], wrench))
    assert errors == pytest.approx([-4.0 * (1 - kappa) ** (n + 1) for n in range(4)], abs=1e-12)


def test_an_object_that_was_not_seen_leaves_the_pose_term_out(plan):
    law = ClosedLoop(plan)
    law.in_contact(0, state(None, [0.0, -3.0, 0.0]))
    assert law.correction == pytest.approx([0.0, -1.0 / 1000.0, 0.0])


def test_the_correction_is_applied_in_the_grasp_frame_of_each_waypoint(plan):
    law = ClosedLoop(plan)
    law.correction = np.array([0.001, 0.0, 0.0])
    moved = law.command(plan.go[1], plan.ee[1]) - plan.ee[1]
    assert moved == pytest.approx([0.001 * np.cos(0.1), 0.001 * np.sin(0.1), 0.0])
