"""The mode-aware law on plants of first principles, which know nothing of its model of the contacts."""

from dataclasses import replace

import numpy as np
import pytest

from control.base import CONTROLLERS
from control.closed_loop_pi import ClosedLoopPI, PISettings
from control.mode_aware import ModeAware, ModeAwareSettings
from mechanics.friction import Mode
from mechanics.records import PlanarState
from tests.control.found_plan import plan_of
from tests.control.hand_plant import OnCorner, settle
from tests.drivers.sim.oracle.cases import pivot_task
from tests.drivers.sim.oracle.quasistatic import Oracle

MISLAID = [0.001, 0.0005, np.radians(1.5)]


def test_it_is_registered_by_name_and_integrates_alone():
    assert CONTROLLERS["mode_aware"] is ModeAware
    assert (ModeAwareSettings().k_p, ModeAwareSettings().k_i) == (0.0, 0.3)


@pytest.mark.parametrize("kappa", [0.8, 1.25])
def test_pose_and_wrench_of_a_corner_that_sticks_come_right_by_k_i_kappa_an_update(plan, kappa):
    states = settle(ModeAware(plan), OnCorner(kappa * plan.stiffness, lies=MISLAID))
    assert states[-1].wrench == pytest.approx(plan.wrench[0], abs=1e-3)
    assert states[-1].go == pytest.approx(plan.go[0], abs=1e-5)
    off = [np.linalg.norm(s.wrench - plan.wrench[0]) for s in states]
    assert off[8] < 1.05 * (1 - 0.3 * kappa) ** 8 * off[0]


def test_a_pose_felt_wrong_where_the_contact_blocks_does_not_turn_into_wrench(plan):
    # 0.3 mm up, against the ground, by a spring of 1 N/mm: the paper's sum of pose and wrench trades all of it
    felt = [0.0, 0.0003, 0.0]
    *_, taught = settle(ModeAware(plan), OnCorner(plan.stiffness, felt=felt))
    *_, summed = settle(ClosedLoopPI(plan), OnCorner(plan.stiffness, felt=felt))
    assert taught.wrench == pytest.approx(plan.wrench[0], abs=1e-3)
    assert summed.wrench[1] - plan.wrench[0, 1] == pytest.approx(-0.3, abs=0.01)


@pytest.fixture
def dragged(plan):
    """The hand's object, held back by friction as it slides to the right."""
    f_n, mu = 4.0, 0.33
    wrench = np.array([mu * f_n, -f_n, mu * f_n * 0.1])
    ee = plan.go[0] + [0.0, 0.1, 0.0] + np.linalg.solve(plan.stiffness, wrench)
    return replace(
        plan,
        go=np.zeros((2, 3)),
        ee=np.tile(ee, (2, 1)),
        wrench=np.tile(wrench, (2, 1)),
        contact_forces=np.tile([f_n, -mu * f_n], (2, 1, 1)),
        contact_modes=((Mode.SLIP_NEGATIVE,),) * 2,
    )


@pytest.mark.parametrize("kappa", [0.8, 1.25])
def test_a_corner_that_slips_is_put_to_where_it_belongs_with_the_force_that_it_should_have(dragged, kappa):
    plant = OnCorner(kappa * dragged.stiffness, lies=MISLAID, mu=0.33)
    first, *_, last = settle(ModeAware(dragged), plant)
    assert np.abs(first.wrench - dragged.wrench[0])[1] > 0.3
    assert last.wrench == pytest.approx(dragged.wrench[0], abs=1e-3)
    assert last.go == pytest.approx(dragged.go[0], abs=1e-5)


def test_friction_that_is_not_as_planned_is_no_reason_to_run_away(dragged):
    *_, last = settle(ModeAware(dragged), OnCorner(dragged.stiffness, mu=0.36))
    # 0.12 N of friction more than planned are shared by force, torque and pose, none of which comes out much worse
    assert np.abs(last.wrench - dragged.wrench[0])[:2].max() < 0.15
    assert last.go is not None and np.abs(last.go[:2]).max() < 0.5e-3


def test_the_update_stays_within_its_limits(plan):
    law = ModeAware(plan, ModeAwareSettings(limit_mm=0.5, limit_deg=1.0))
    for _ in range(30):
        law.in_contact(0, PlanarState(plan.ee[0], plan.go[0] + [0.01, 0.01, 0.3], None, plan.wrench[0] - 5.0))
    assert np.abs(law.correction) == pytest.approx([0.5e-3, 0.5e-3, np.radians(1.0)])


def test_without_the_objects_pose_the_wrench_comes_right_and_the_free_turn_is_left_alone(plan):
    law, plant = ModeAware(plan), OnCorner(0.8 * plan.stiffness)
    for _ in range(40):
        law.in_contact(0, replace(plant.move(law.waypoint(0)), go=None))
    last = plant.move(law.waypoint(0))
    assert last.wrench == pytest.approx(plan.wrench[0], abs=0.02)
    assert last.go is not None and abs(last.go[2]) < np.radians(0.1)


def pivoted(scale):
    """The chain of go and eo halfway through a pivot, in fingers ``scale`` times as stiff as the plan has them."""
    task = pivot_task("tall_box")
    angle = 0.5 * (task.start + task.end)
    ideal, true = Oracle(task.scene()), Oracle(task.scene(), stiffness_scale=scale)
    for oracle in (ideal, true):
        oracle.move(task.ee(task.start, 0.0), 5)
        oracle.move(task.ee(task.start), 20)
        for part in np.linspace(task.start, angle, 20):
            oracle.move(task.ee(part), 2)
    plan = plan_of(ideal, task.ee(angle), {("go", "eo"): "stick", ("eo", "ground"): "stick"})
    return plan, true


def measured(oracle, ee, eo=True):
    return PlanarState(ee, oracle.go, oracle.eo if eo else None, oracle.wrench)


def test_an_object_that_is_turned_comes_to_where_it_belongs():
    plan, true = pivoted(0.75)
    law = ModeAware(plan)
    assert plan.eo is not None
    off = []
    for _ in range(25):
        off.append(np.append(true.eo - plan.eo[0], true.wrench - plan.wrench[0]))
        law.in_contact(0, measured(true, law.waypoint(0)))
        true.move(law.waypoint(0), 2)
    scale = [0.1e-3, 0.1e-3, np.radians(0.1), 0.1, 0.1, 4.5e-3]
    before, after = np.linalg.norm(off[0] / scale), np.linalg.norm(off[-1] / scale)
    assert before > 3 and after < 0.35 * before


def test_an_extrinsic_object_out_of_view_drops_out(plan):
    plan, true = pivoted(0.75)
    seen, unseen = ModeAware(plan), ModeAware(plan)
    seen.in_contact(0, measured(true, plan.ee[0]))
    unseen.in_contact(0, measured(true, plan.ee[0], eo=False))
    assert np.isfinite(unseen.correction).all()
    assert np.abs(seen.correction - unseen.correction).max() > 1e-6


def test_a_law_with_gains_of_its_own_may_have_the_paper_s_form(plan):
    # after the first updates, a proportional gain adds k_p of the newest error to k_i of each
    good = PlanarState(plan.ee[0], plan.go[0], None, plan.wrench[0])
    off = replace(good, wrench=np.array([0.0, -3.0, 0.0]))
    one, part = ModeAware(plan), ModeAware(plan, ModeAwareSettings(k_p=0.2, k_i=0.3))
    one.in_contact(0, off)
    for _ in range(9):
        part.in_contact(0, good)
    part.in_contact(0, off)
    assert part.correction == pytest.approx(0.5 * one.correction)
    assert isinstance(part.settings, PISettings)


def test_the_nth_update_undoes_an_nth_of_its_error_at_least(plan):
    # 1 N too little, by the same reading again and again: k_i = 0.3 takes over from 1/n at the fourth
    law, seen = ModeAware(plan), []
    for _ in range(6):
        law.in_contact(0, PlanarState(plan.ee[0], plan.go[0], None, np.array([0.0, -3.0, 0.0])))
        seen.append(law.correction)
    shares = np.linalg.norm(np.diff([np.zeros(3), *seen], axis=0), axis=1)
    assert shares / shares[0] == pytest.approx([1, 1 / 2, 1 / 3, 0.3, 0.3, 0.3])


def test_the_first_update_undoes_what_the_free_air_could_not_show(plan):
    # the pose is felt 0.2 mm off where the contact blocks, which nothing but the force tells
    before, after = settle(ModeAware(plan), OnCorner(plan.stiffness, felt=[0.0, 0.0002, 0.0]), updates=1)
    assert np.abs(before.wrench - plan.wrench[0])[1] > 0.15
    assert after.wrench == pytest.approx(plan.wrench[0], abs=0.02)
