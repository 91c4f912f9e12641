"""When a trial has failed, by its wrench and by one corner on the ground, and that one that has not is left alone."""

from dataclasses import replace

import numpy as np
import pytest

from control.monitor import ContactMonitor
from mechanics.friction import Mode
from mechanics.records import PlanarState

NO_WEIGHT = np.zeros(2)
TOLERANCE = 0.001


@pytest.fixture
def monitor(plan):
    return ContactMonitor(plan, TOLERANCE, force_limit=30.0)


def state(go=(0.0, 0.0, 0.0), wrench=(0.0, -4.0, 0.0)):
    return PlanarState(np.zeros(3), None if go is None else np.array(go), None, np.array(wrench))


# -- the wrench --------------------------------------------------------------------------------------------------------


def test_a_trial_that_follows_its_plan_goes_on(monitor, plan):
    assert monitor.check(0, state(plan.go[0]), NO_WEIGHT) is None
    assert monitor.check(1, state(plan.go[1]), NO_WEIGHT) is None


def test_a_wrench_without_contact_force_is_a_lost_contact(monitor):
    deviation = monitor.check(0, state(wrench=(0.0, -0.1, 0.0)), NO_WEIGHT)
    assert deviation.status == "lost_contact" and "4.00 N" in deviation.reason
    assert (deviation.step, deviation.contact) == (0, None)


def test_the_weight_of_the_object_is_no_contact_force(monitor):
    # the fingers carry 1 N of weight and nothing else: the table does not push
    deviation = monitor.check(0, state(wrench=(0.0, 1.0, 0.0)), np.array([0.0, -1.0]))
    assert deviation is not None and deviation.status == "lost_contact"


def test_a_force_beyond_the_limit_stops(monitor):
    assert monitor.check(0, state(wrench=(0.0, -31.0, 0.0)), NO_WEIGHT).status == "stopped"


@pytest.mark.parametrize("broken", [{"wrench": (np.nan, 0.0, 0.0)}, {"go": (0.0, np.inf, 0.0)}])
def test_a_measurement_that_is_not_finite_is_a_divergence(monitor, broken):
    assert monitor.check(0, state(**broken), NO_WEIGHT).status == "diverged"


# -- a corner that is to stick -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("way", "mode"), [(1, "slip-"), (-1, "slip+")])
def test_a_sticking_corner_that_moves_has_slipped_so_far_and_that_way(monitor, way, mode):
    # a body that slides to the right sees the ground move along -t: slip-
    assert monitor.check(0, state(), NO_WEIGHT) is None
    deviation = monitor.check(1, state((way * 0.0023, 0.0, 0.1)), NO_WEIGHT)
    assert deviation.status == "slipped"
    assert deviation.reason == f"waypoint 1: contact 'corner' has slipped by 2.3 mm ({mode}) since waypoint 0"
    assert (deviation.step, deviation.contact) == (1, "corner")
    assert deviation.slip == pytest.approx(-way * 0.0023)


def test_turning_about_the_sticking_corner_is_no_slip(monitor):
    assert monitor.check(0, state(), NO_WEIGHT) is None
    assert monitor.check(1, state((0.0, 0.0, 0.3)), NO_WEIGHT) is None


def test_a_corner_that_landed_elsewhere_has_to_stick_where_it_landed(monitor):
    # the go lies otherwise in the fingers: 6 mm to the right, turned by 2 degrees
    assert monitor.check(0, state((0.006, 0.001, 0.035)), NO_WEIGHT) is None
    assert monitor.check(1, state((0.006, 0.001, 0.135)), NO_WEIGHT) is None
    deviation = monitor.check(1, state((0.0, 0.001, 0.1)), NO_WEIGHT)
    assert deviation is not None
    assert deviation.status == "slipped" and "6.0 mm (slip+)" in deviation.reason


def test_a_corner_that_leaves_the_ground_is_a_lost_contact_whatever_else_it_does(monitor):
    assert monitor.check(0, state(), NO_WEIGHT) is None
    deviation = monitor.check(1, state((0.003, 0.002, 0.1)), NO_WEIGHT)
    assert deviation.status == "lost_contact"
    assert deviation.reason == "waypoint 1: contact 'corner' has opened by 2.0 mm since waypoint 0"
    assert deviation.contact == "corner"


def test_an_object_out_of_view_is_judged_by_its_wrench_alone(monitor):
    assert monitor.check(0, state(go=None), NO_WEIGHT) is None
    assert monitor.check(1, state(go=None, wrench=(0.0, 0.0, 0.0)), NO_WEIGHT).status == "lost_contact"


def test_an_object_that_comes_into_view_late_is_watched_from_then_on(plan):
    monitor = ContactMonitor(plan, TOLERANCE, 30.0)
    assert monitor.check(0, state(go=None), NO_WEIGHT) is None
    assert monitor.check(1, state((0.004, 0.0, 0.1)), NO_WEIGHT) is None
    assert monitor.check(1, state((0.006, 0.0, 0.1)), NO_WEIGHT) is not None


def test_after_a_restart_only_what_happens_then_counts(monitor):
    assert monitor.check(0, state(), NO_WEIGHT) is None
    assert monitor.check(1, state((0.005, 0.0, 0.1)), NO_WEIGHT) is not None
    monitor.restart(1, state((0.005, 0.0, 0.1)))
    assert monitor.check(1, state((0.0055, 0.0, 0.1)), NO_WEIGHT) is None
    assert monitor.check(1, state((0.0075, 0.0, 0.1)), NO_WEIGHT).slip == pytest.approx(-0.0025)


def test_a_table_that_leans_takes_the_tangent_along(plan):
    # turned by 90 degrees: the ground is a wall, and along it is up
    leaning = plan.reanchored(np.array([0.0, 0.0, np.pi / 2]))
    monitor = ContactMonitor(leaning, TOLERANCE, 30.0)
    push = (4.0, 0.0, 0.0)
    assert monitor.check(0, state(leaning.go[0], push), NO_WEIGHT) is None
    along = monitor.check(1, state(leaning.go[1] + np.array([0.0, 0.002, 0.0]), push), NO_WEIGHT)
    off = monitor.check(1, state(leaning.go[1] - np.array([0.002, 0.0, 0.0]), push), NO_WEIGHT)
    assert along is not None and (along.status, along.slip) == ("slipped", pytest.approx(-0.002))
    assert off is not None and off.status == "lost_contact"


# -- a corner that is to slip ------------------------------------------------------------------------------------------

STEPS, EACH = 11, 0.002


@pytest.fixture
def sliding(plan):
    """Twenty millimetres to the right in steps of two."""
    along = np.zeros((STEPS, 3))
    along[:, 0] = EACH * np.arange(STEPS)
    return replace(
        plan,
        ee=plan.ee[0] + along,
        go=along,
        wrench=np.tile(plan.wrench[0], (STEPS, 1)),
        contact_points=along[:, None, :2],
        contact_normals=np.tile([0.0, 1.0], (STEPS, 1, 1)),
        contact_forces=np.tile([4.0, -1.32], (STEPS, 1, 1)),
        contact_modes=((Mode.SLIP_NEGATIVE,),) * STEPS,
    )


def ended(plan, x):
    """What is found of a go at ``x`` (K,) [m], and where; None where nothing is."""
    monitor = ContactMonitor(plan, TOLERANCE, 30.0)
    for k, at in enumerate(x):
        found = monitor.check(k, state((at, 0.0, 0.0)), NO_WEIGHT)
        if found is not None:
            return found
    return None


def test_a_corner_that_slides_as_planned_goes_on_however_far_it_goes(sliding):
    assert ended(sliding, sliding.go[:, 0]) is None
    assert ended(sliding, sliding.go[:, 0] + 0.005) is None  # where it landed


def test_a_corner_that_slides_late_or_early_slides_all_the_same(sliding):
    x, late = sliding.go[:, 0], np.r_[0.0, np.full(STEPS - 1, 0.9)] * EACH
    assert ended(sliding, x - late) is None
    assert ended(sliding, x + 3 * late) is None


@pytest.mark.parametrize("stuck_at", [0, 4])
def test_a_corner_that_is_to_slide_and_sticks_is_found_two_waypoints_later(sliding, stuck_at):
    found = ended(sliding, np.minimum(sliding.go[:, 0], stuck_at * EACH))
    assert found is not None and found.status == "slipped" and found.step == stuck_at + 2
    planned = (stuck_at + 2) * EACH * 1e3
    assert f"sticks: it has slipped by {stuck_at * EACH * 1e3:.1f} mm" in found.reason
    assert f"{planned:.1f} mm (slip-) are planned" in found.reason


@pytest.mark.parametrize("turns_at", [0, 5])
def test_a_corner_that_slides_the_wrong_way_is_found_at_once(sliding, turns_at):
    x = np.where(np.arange(STEPS) <= turns_at, 1, -1) * EACH * np.abs(np.arange(STEPS) - turns_at)
    x = np.where(np.arange(STEPS) <= turns_at, sliding.go[:, 0], x + turns_at * EACH)
    found = ended(sliding, x)
    assert found is not None and found.status == "slipped" and found.step == turns_at + 1
    assert "slips the wrong way" in found.reason


def test_a_corner_that_is_to_stick_after_a_slide_is_marked_where_it_stops(sliding):
    sticks = (Mode.SLIP_NEGATIVE,), (Mode.STICK,)
    modes = tuple(sticks[k >= 4] for k in range(STEPS))
    stopped = np.minimum(sliding.go[:, 0], 4 * EACH)
    at = np.column_stack([stopped, np.zeros((STEPS, 2))])
    plan = replace(sliding, contact_modes=modes, go=at, contact_points=at[:, None, :2])
    off = np.where(np.arange(STEPS) < 4, 0.0, 0.0015)  # late, but where it then stays
    assert ended(plan, stopped - off) is None
    found = ended(plan, stopped - np.where(np.arange(STEPS) < 7, 0.0, 0.0015))
    assert found is not None and found.step == 7 and "since waypoint 4" in found.reason


def test_a_contact_that_is_not_planned_is_not_watched(sliding):
    free = replace(sliding, contact_modes=((Mode.FREE,),) * STEPS)
    assert ended(free, -sliding.go[:, 0]) is None
