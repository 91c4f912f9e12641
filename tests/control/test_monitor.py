"""When a trial has failed, and that a trial that has not is left alone."""

import numpy as np
import pytest

from control.monitor import ContactMonitor
from mechanics.records import PlanarState

NO_WEIGHT = np.zeros(2)


@pytest.fixture
def monitor(plan):
    return ContactMonitor(plan, slip_tolerance=0.005, force_limit=30.0)


def state(go=(0.0, 0.0, 0.0), wrench=(0.0, -4.0, 0.0)):
    return PlanarState(np.zeros(3), None if go is None else np.array(go), None, np.array(wrench))


def test_a_trial_that_follows_its_plan_goes_on(monitor):
    assert monitor.check(0, state(), NO_WEIGHT) is None


def test_a_wrench_without_contact_force_is_a_lost_contact(monitor):
    deviation = monitor.check(0, state(wrench=(0.0, -0.1, 0.0)), NO_WEIGHT)
    assert deviation.status == "lost_contact" and "4.00 N" in deviation.reason


def test_the_weight_of_the_object_is_no_contact_force(plan):
    # the fingers carry 1 N of weight and nothing else: the table does not push
    monitor = ContactMonitor(plan, 0.005, 30.0)
    deviation = monitor.check(0, state(wrench=(0.0, 1.0, 0.0)), np.array([0.0, -1.0]))
    assert deviation is not None and deviation.status == "lost_contact"


def test_a_sticking_corner_that_has_moved_is_a_slip(monitor):
    deviation = monitor.check(0, state(go=(0.006, 0.0, 0.0)), NO_WEIGHT)
    assert deviation.status == "slipped" and "'corner'" in deviation.reason and "6.0 mm" in deviation.reason


def test_turning_about_the_sticking_corner_is_no_slip(monitor):
    assert monitor.check(1, state(go=(0.0, 0.0, 0.3)), NO_WEIGHT) is None


def test_a_corner_that_landed_elsewhere_has_to_stick_where_it_landed(plan):
    # the object was seen 6 mm to the right in free air, and 2 mm too high, which touching down takes away
    monitor = ContactMonitor(plan, 0.005, 30.0, lies=np.array([0.006, 0.002, 0.0]))
    assert monitor.check(0, state(go=(0.006, 0.0, 0.0)), NO_WEIGHT) is None
    deviation = monitor.check(1, state(go=(0.0, 0.0, 0.0)), NO_WEIGHT)
    assert deviation is not None
    assert deviation.status == "slipped" and "6.0 mm" in deviation.reason


def test_a_force_beyond_the_limit_stops(monitor):
    assert monitor.check(0, state(wrench=(0.0, -31.0, 0.0)), NO_WEIGHT).status == "stopped"


def test_a_measurement_that_is_not_finite_is_a_divergence(monitor):
    assert monitor.check(0, state(wrench=(np.nan, 0.0, 0.0)), NO_WEIGHT).status == "diverged"


def test_an_object_out_of_view_is_judged_by_its_wrench_alone(monitor):
    assert monitor.check(0, state(go=None), NO_WEIGHT) is None
