"""What a law does that takes the fingers for rigid: worked out by hand."""

import numpy as np
import pytest

from control.base import CONTROLLERS
from control.closed_loop_pi import PISettings
from control.rigid_sensor import RigidSensor
from mechanics.records import PlanarState
from tests.control.hand_plant import OnCorner, settle


def test_it_is_registered_by_name():
    assert CONTROLLERS["rigid_sensor"] is RigidSensor


def test_where_the_contact_blocks_half_the_wrench_is_left(plan):
    *_, last = settle(RigidSensor(plan), OnCorner(plan.stiffness))
    assert last.wrench == pytest.approx(plan.wrench[0] / 2, abs=1e-6)


def blocked(plan, law, updates):
    """Normal forces [N] with an object that cannot move at all."""
    found = []
    law.in_air(plan.go[0], PlanarState(np.array([0.0, 0.1, 0.0]), plan.go[0], None, np.zeros(3)))
    for _ in range(updates):
        ee = law.waypoint(0)
        wrench = plan.stiffness @ (ee - [0.0, 0.1, 0.0])
        found.append(-wrench[1])
        law.in_contact(0, PlanarState(ee, plan.go[0], None, wrench))
    return found


@pytest.mark.parametrize("k_i", [0.15, 0.3])
def test_the_integral_takes_it_there_by_one_minus_twice_k_i(plan, k_i):
    found = blocked(plan, RigidSensor(plan, PISettings(k_p=0.0, k_i=k_i)), 5)
    assert found == pytest.approx([2.0 + 2.0 * (1 - 2 * k_i) ** n for n in range(5)])


def test_accumulated_in_full_it_would_swing_between_all_and_nothing(plan):
    law = RigidSensor(plan, PISettings(k_p=0.0, k_i=1.0, limit_mm=50.0))
    assert blocked(plan, law, 6) == pytest.approx([4.0, 0.0] * 3, abs=1e-9)


def test_a_turn_that_the_contact_lets_through_is_corrected_all_the_same(plan):
    # weightless and with a torque that the corner does not take, the object turns with the end-effector
    law = RigidSensor(plan)
    *_, last = settle(law, OnCorner(plan.stiffness, lies=[0.0, 0.0, np.radians(1.5)]))
    assert last.go is not None and last.go[2] == pytest.approx(0.0, abs=np.radians(0.02))


def test_the_pose_in_the_fingers_is_frozen_when_the_air_is_left(plan):
    law = RigidSensor(plan)
    ee = np.array([0.0, 0.1, 0.0])
    for noise in (0.0, 0.4e-3, -0.1e-3):
        law.in_air(plan.go[0], PlanarState(ee, np.array([noise, 0.0, 0.0]), None, np.zeros(3)))
    taught = law.correction
    # whatever is felt later: the go is believed to be 0.1 mm to the right of where the ee would have it
    plan_wrench = plan.wrench[0]
    law.in_contact(0, PlanarState(ee, np.array([0.05, 0.03, 0.4]), None, plan_wrench))
    assert law.correction - taught == pytest.approx([-0.1e-3 * 0.3, 0.0, 0.0], abs=1e-12)


def test_without_a_look_in_air_it_goes_by_the_wrench_alone(plan):
    law = RigidSensor(plan, PISettings(k_p=0.0, k_i=0.5))
    law.in_contact(0, PlanarState(plan.ee[0], plan.go[0] + 0.01, None, np.array([0.0, -3.0, 0.0])))
    assert law.correction == pytest.approx([0.0, -0.0005, 0.0])
