"""The wrist wrench against moments worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.force_torque import FreeAirLoad, WristSensor, mean_wrench
from mechanics.readings import Stamp, Status, WrenchReading

SENSOR = WristSensor(X_ee_s=np.array([0.0, 0.2, 0.0]), offset=np.zeros(3))
finite = st.floats(-3, 3)


def spatial(fx, fy, tau):
    """The planar wrench in the axes of a spatial sensor: plane x is X, plane y is Z, counter-clockwise is about −Y."""
    return np.array([fx, 0.0, fy, 0.0, -tau, 0.0])


def test_a_hanging_weight_pulls_on_the_sensor_and_is_carried_by_the_fingers():
    # 0.1 kg below the sensor: the tool side pulls the sensor down, so the sensor's fingers lift the object
    wrench = SENSOR.wrench_on_go(spatial(0.0, -0.981, 0.0), np.array([0.0, 0.3, 0.0]), np.array([0.0, 0.3]))
    assert wrench == pytest.approx([0.0, 0.981, 0.0])


def test_a_push_at_the_grasp_centre_has_the_sensors_lever_as_torque_and_none_about_itself():
    # the object pushes the fingers by +2 N in x, 0.2 m below the sensor: −y × x is a counter-clockwise 0.4 N·m there
    wrench = SENSOR.wrench_on_go(spatial(2.0, 0.0, 0.4), np.array([0.1, 0.3, 0.0]), np.array([0.1, 0.3]))
    assert wrench == pytest.approx([-2.0, 0.0, 0.0], abs=1e-12)


def test_a_turned_sensor_reads_in_its_own_axes():
    # turned by 90°, its x axis is W's y: a reading of −1 N along x is a pull down
    wrench = WristSensor(np.zeros(3), np.zeros(3)).wrench_on_go(
        spatial(-1.0, 0.0, 0.0), np.array([0.0, 0.0, np.pi / 2]), np.zeros(2)
    )
    assert wrench == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


@given(st.tuples(finite, finite, finite), st.tuples(finite, finite, finite), st.tuples(finite, finite))
def test_reading_of_is_the_inverse_of_wrench_on_go(wrench, pose, centre):
    sensor = WristSensor(np.array([0.01, 0.2, 0.3]), np.zeros(3))
    reading = spatial(*sensor.reading_of(np.array(wrench), np.array(pose), np.array(centre)))
    assert sensor.wrench_on_go(reading, np.array(pose), np.array(centre)) == pytest.approx(wrench, abs=1e-9)


def test_zeroing_in_free_air_removes_the_bias_and_keeps_the_weight():
    load = FreeAirLoad(0.1, np.array([0.0, 0.0]), 10.0)
    X_W_go, grasp, X_W_ee = np.array([0.0, 0.2, 0.0]), np.array([0.0, 0.05, 0.0]), np.array([0.0, 0.25, 0.0])
    bias = np.array([0.3, -0.2, 0.01])
    reading = spatial(*(np.array([0.0, -1.0, 0.0]) + bias))
    sensor = SENSOR.zeroed(reading, X_W_ee, X_W_go, grasp, load)
    assert sensor.offset == pytest.approx(bias)
    assert sensor.wrench_on_go(reading, X_W_ee, X_W_go[:2]) == pytest.approx([0.0, 1.0, 0.0])


def test_the_weight_of_a_tilted_object_has_a_moment_about_the_grasp():
    # centre of mass 50 mm left of the grasp centre: the fingers must turn the object clockwise to carry it level
    load = FreeAirLoad(0.1, np.array([-0.05, 0.0]), 10.0)
    assert load.wrench_on_go(np.zeros(3), np.zeros(2)) == pytest.approx([0.0, 1.0, -0.05])


def test_only_trustworthy_readings_are_averaged():
    def reading(value, status):
        return WrenchReading(Stamp(0, 0, 0, "s", status), np.full(6, value))

    assert mean_wrench([reading(1.0, Status.OK), reading(9.0, Status.SATURATED)]) == pytest.approx(np.ones(6))
    with pytest.raises(ValueError, match="no trustworthy"):
        mean_wrench([reading(9.0, Status.SATURATED)])


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_a_known_tool_weighs_nothing_however_the_arm_turns_after_zeroing(zeroed_at, turned_to):
    load = FreeAirLoad(0.0, np.zeros(2), 10.0)
    bias = np.array([0.3, -0.2, 0.01])
    sensor = WristSensor(np.array([0.0, 0.2, 0.0]), np.zeros(3), 1.1, np.array([0.005, 0.09]), 10.0)

    def reading(angle):
        # 11 N down at the tool's centre, 110 mm below the sensor and 5 mm to its right; in the sensor's axes
        down = 11.0 * np.array([-np.sin(angle), -np.cos(angle)])
        return spatial(*(np.array([*down, 0.005 * down[1] + 0.11 * down[0]]) + bias))

    at, to = np.array([0.1, 0.3, zeroed_at]), np.array([-0.1, 0.2, turned_to])
    sensor = sensor.zeroed(reading(zeroed_at), at, at, np.zeros(3), load)
    assert sensor.offset == pytest.approx(bias)
    assert sensor.wrench_on_go(reading(turned_to), to, to[:2]) == pytest.approx(np.zeros(3), abs=1e-12)
