"""What a device notices of its own readings: no false alarm, and no alarm that it promises missing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.config import WorldConfig
from drivers.interfaces import Arm, ArmTarget, Sensor
from drivers.sim.faults import MotionGuard, WrenchGuard
from drivers.sim.world import World
from mechanics.readings import Status

NOISE = (0.02, 0.02, 0.03, 0.0004, 0.0004, 0.0004)
DIGITS = (0.025, 0.025, 0.05, 0.00125, 0.00125, 0.00125)


@pytest.mark.parametrize("profile", ["ideal", "lab", "hard"])
def test_a_sound_station_raises_no_alarm_while_it_moves(station, make_scene, profile):
    world = World(station.model_copy(update={"world": WorldConfig(profile=profile)}))
    for device in world.devices.values():
        device.connect()
    world.reset(3, make_scene())
    arm = world.devices["arm"]
    assert isinstance(arm, Arm)
    arm.acquire("test")
    x, y, theta = make_scene().start
    for step in range(8):  # up to a peak of 0.15 m/s, away and back
        goal = np.array([x + 0.03 * (step % 2), y + 0.02 * (step % 3), theta + 0.2 * (step % 2)])
        arm.command(ArmTarget(goal, np.zeros(3), 0.4))
        world.sleep(0.6)
    for device in world.devices.values():
        assert isinstance(device, Sensor)
        assert {reading.stamp.status for reading in device.since(0)} <= {Status.OK}
    for device in world.devices.values():
        device.close()


@given(st.integers(0, 10**6), st.floats(-5, 5))
def test_a_stuck_wrench_is_stale_and_a_noisy_one_is_not(seed, load):
    rng = np.random.default_rng(seed)
    guard = WrenchGuard(NOISE, DIGITS, perfect=False)
    digits = np.rint((load * np.array([1, 0, 1, 0, 0.1, 0]) + NOISE * rng.standard_normal((300, 6))) / DIGITS) * DIGITS
    values = [tuple(row) for row in digits.tolist()]
    assert {guard.check(value, i) for i, value in enumerate(values)} == {Status.OK}
    # at most 30 more of the same: chance would have it less than once in 1e12
    assert Status.STALE in {guard.check(values[-1], i) for i in range(30)}


def test_a_noise_free_wrench_is_never_stale():
    guard = WrenchGuard((0.0,) * 6, (0.0,) * 6, perfect=True)
    assert {guard.check((1.0, 0.0, 2.0, 0.0, 0.3, 0.0), i) for i in range(10_000)} == {Status.OK}


@pytest.mark.parametrize("axis", [1, 3, 5])
def test_a_jump_out_of_the_plane_is_invalid_for_as_long_as_it_lasts(axis):
    guard = WrenchGuard(NOISE, DIGITS, perfect=False)
    rng = np.random.default_rng(0)
    readings = 0.3 + np.array(NOISE) * rng.standard_normal((6000, 6))
    readings[1000:5000, axis] += 0.5
    seen = [guard.check(tuple(row), i) for i, row in enumerate(readings.tolist())]
    assert set(seen[:1000]) == set(seen[5000:]) == {Status.OK}
    assert set(seen[1000:5000]) == {Status.INVALID}


def test_a_slow_drift_is_no_jump():
    guard = WrenchGuard(NOISE, DIGITS, perfect=False)
    seen = {guard.check((0.0, 1e-5 * i, 0.0, 0.0, 0.0, 0.0), i) for i in range(100_000)}  # 1 N in 100 s at 1 kHz
    assert seen == {Status.OK}


def test_a_fast_motion_that_was_asked_for_is_no_jump():
    asked = [0.0]
    guard = MotionGuard((1.7,), (1e-4,), lambda: asked)
    for i, x in enumerate((0.0, 0.1, 0.2, 0.3)):  # 10 m/s at 100 Hz
        asked[0] = x
        assert guard.check((x,), i * 10**7) is Status.OK
    assert guard.check((1.3,), 4 * 10**7) is Status.INVALID
