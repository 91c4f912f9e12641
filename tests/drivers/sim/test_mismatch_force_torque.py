"""What a force/torque sensor adds to the load: noise, drift, gain, digits, the weight of the tool."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
import pytest
from scipy.signal import welch

from drivers.config import ForceTorqueConfig
from drivers.scene import Body
from drivers.sim.force_torque import RANGE, Electronics
from drivers.sim.mismatch import ForceTorqueFigures, Mismatch
from mechanics.readings import Status

from .profiles import about, device, profile, sigma_of


def digits(
    n: int, seed: int = 0, load: tuple[float, ...] = (0.0,) * 6, *, rate: float = 1000.0, **given: Any
) -> np.ndarray:
    """``n`` readings (n, 6) of one sensor under a load that stays."""
    electronics = Electronics(ForceTorqueFigures.model_validate(given), rate, np.random.default_rng(seed))
    return np.array([electronics.read(np.array(load))[0] for _ in range(n)])


def test_a_sensor_without_figures_reads_the_load_to_the_bit():
    load = (0.1, -0.2, 0.3, 1e-3, 2e-3, 1 / 3)
    np.testing.assert_array_equal(digits(3, load=load), [load] * 3)


def test_noise_has_its_size_in_each_axis_and_is_white():
    sizes = (0.02, 0.03, 0.04, 4e-4, 5e-4, 6e-4)
    n = 16384
    read = digits(n, noise=sizes)
    assert [sigma_of(column) for column in read.T] == [about(size, n) for size in sizes]
    correlation = np.corrcoef(read.T)
    assert np.abs(correlation - np.eye(6)).max() < 4 / sqrt(n)
    # flat: each octave of the spectrum holds 2 σ² / rate per hertz
    frequency, density = welch(read[:, 0], 1000.0, nperseg=512)
    for low in (4, 8, 16, 32, 64, 128, 250):
        band = density[(frequency >= low) & (frequency < 2 * low)]
        averages = len(band) * 2 * n / 512
        assert band.mean() == pytest.approx(2 * 0.02**2 / 1000, rel=4 / sqrt(averages / 2))


def test_drift_is_a_walk_that_reaches_its_figure_in_half_a_minute():
    ends, middles = [], []
    for seed in range(300):
        walk = digits(300, seed, rate=10.0, drift_force=0.05, drift_torque=0.002)
        ends.append(walk[-1])
        middles.append(walk[74])
    figure = np.repeat([0.05, 0.002], 3)
    assert sigma_of(np.array(ends) / figure) == about(1, 1800)
    # a quarter of the time: half of the way
    assert sigma_of(np.array(middles) / figure) == about(0.5, 1800)
    slope = np.diff(np.log(welch(digits(16384, drift_force=0.05)[:, 0], 1000.0, nperseg=4096)[1][[4, 256]]))[0]
    assert slope / np.log(256 / 4) == pytest.approx(-2, abs=0.4), "a walk's spectrum falls with the square"


def test_bias_and_gain_are_one_sensors_own():
    load = (10.0, 20.0, 30.0, 1.0, 2.0, 3.0)
    gains = np.array([digits(2, seed, load, gain_error=0.005) for seed in range(300)]) / load - 1
    np.testing.assert_array_equal(gains[:, 0], gains[:, 1])
    assert sigma_of(gains[:, 0]) == about(0.005, 1800)
    biases = np.array([digits(2, seed, bias_force=0.04, bias_torque=0.002) for seed in range(300)])
    np.testing.assert_array_equal(biases[:, 0], biases[:, 1])
    assert sigma_of(biases[:, 0, :3]) == about(0.04, 900) and sigma_of(biases[:, 0, 3:]) == about(0.002, 900)


def test_warming_moves_zero_and_gain_together_in_all_axes():
    warm: dict[str, Any] = {"temperature_walk": 1.0, "temperature_force": 0.02, "temperature_torque": 0.001}
    after_a_minute = np.array([digits(600, seed, rate=10.0, **warm)[-1] for seed in range(200)])
    # the product of two independent normal figures: coefficient by temperature
    assert sigma_of(after_a_minute[:, :3]) == pytest.approx(0.02, rel=0.25)
    assert sigma_of(after_a_minute[:, 3:]) == pytest.approx(0.001, rel=0.25)
    axes = digits(600, 1, rate=10.0, **warm)
    assert np.linalg.matrix_rank(axes, tol=1e-9) == 1, "one temperature"
    figures: dict[str, Any] = {"temperature_walk": 1.0, "temperature_gain": 5e-4}
    gains = np.array([digits(600, seed, (10.0,) * 6, rate=10.0, **figures)[-1] for seed in range(200)]) / 10 - 1
    assert sigma_of(gains) == pytest.approx(5e-4, rel=0.25)


def test_digits_are_whole_steps_and_hold_the_load_between_them():
    steps = (0.025, 0.025, 0.05, 0.00125, 0.00125, 0.00125)
    load = (1.013, -0.511, 2.03, 0.0101, 0.0009, -0.0006)
    np.testing.assert_allclose(
        digits(1, load=load, resolution=steps)[0], [1.025, -0.5, 2.05, 0.01, 0.00125, -0.0], atol=1e-12
    )
    noisy = digits(20000, load=load, resolution=steps, noise=[0.02, 0.02, 0.03, 1e-3, 1e-3, 1e-3])
    np.testing.assert_allclose(noisy / steps, np.rint(noisy / steps), atol=1e-6)
    # noise of a step's size carries the mean through the steps, and a rounding adds step²/12 to its variance
    assert (np.abs(noisy.mean(axis=0) - load) < 0.03 * np.array(steps)).all()
    assert noisy[:, 0].std() == pytest.approx(sqrt(0.02**2 + 0.025**2 / 12), rel=0.02)


def test_full_scale_is_reported_even_where_only_the_bias_reaches_it():
    electronics = Electronics(ForceTorqueFigures(bias_force=1.0), 1000.0, np.random.default_rng(0))
    bias = electronics.read(np.zeros(6))[0]
    axis = int(np.argmax(bias[:3]))
    assert bias[axis] > 0
    load = np.zeros(6)
    load[axis] = RANGE[axis] - 0.5 * bias[axis]
    read, saturated = electronics.read(load)
    assert saturated and read[axis] == RANGE[axis]


def test_a_saturated_reading_says_so(world_of):
    heavy = Body(name="iron", vertices=((-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)), mass=50.0)
    figures = profile(force_torque={"noise": [0.02] * 6})
    world = world_of(figures, extrinsic=heavy, extrinsic_pose=(0.05, 0.05, 0.0))
    world.advance(0.3)
    reading = device(world, "table_ft").latest()
    assert reading.stamp.status is Status.SATURATED and reading.wrench[2] == -RANGE[2]


def test_the_tools_weight_hangs_on_the_wrist_alone(station, world_of):
    level = ForceTorqueConfig(kind="force_torque", mount="wrist", pose=(0.0, 0.2, 0.0))
    config = station.model_copy(update={"devices": station.devices | {"wrist_ft": level}})
    tool = {"tool_mass": 1.1, "tool_centre_mm": [5, 90]}
    readings = {}
    for name, figures in (("bare", Mismatch()), ("tool", profile(force_torque=tool))):
        world = world_of(figures, config=config, start=(0.0, 0.3, 0.5))
        world.advance(0.01)
        readings[name] = device(world, "wrist_ft").latest().wrench, device(world, "table_ft").latest().wrench
    weight = readings["tool"][0] - readings["bare"][0]
    # the sensor leans by 0.5 rad to the left, the tool hangs 110 mm under it and 5 mm to its right
    np.testing.assert_allclose(weight[[0, 2]], 1.1 * 9.81 * np.array([-np.sin(0.5), -np.cos(0.5)]), atol=1e-12)
    lever = np.cos(0.5) * 0.005 + np.sin(0.5) * 0.11
    assert -weight[4] == pytest.approx(-lever * 1.1 * 9.81)
    np.testing.assert_array_equal(readings["tool"][1], readings["bare"][1])


def test_the_tool_is_known_as_well_as_it_was_weighed(world_of):
    known = []
    for seed in range(40):
        world = world_of(profile(force_torque={"tool_mass": 1.1, "tool_error": 0.01}), seed=seed)
        known.append(device(world, "wrist_ft").describe().extra["tool"]["mass"] / 1.1 - 1)
        assert "tool" not in device(world, "table_ft").describe().extra
    assert sigma_of(np.array(known)) == about(0.01, 40)
    assert "tool" not in device(world_of(Mismatch()), "wrist_ft").describe().extra


def test_what_a_trials_sensor_says_wrong_hangs_on_seed_and_trial_alone(world_of):
    world = world_of(profile(force_torque={"noise": (0.01,) * 6, "drift_force": 0.05, "bias_force": 0.04}))

    def said(trial: int) -> np.ndarray:
        world.regrasp(trial)
        world.advance(2.0)
        return np.array([reading.wrench for reading in device(world, "wrist_ft").since(world.now_ns() - 2 * 10**9)])

    first, other, again = said(4), said(5), said(4)
    np.testing.assert_allclose(first, again, atol=1e-9)  # the object swings alike but for rounding
    apart = np.abs(first.mean(axis=0) - other.mean(axis=0))
    assert 1e-3 < apart[:3].max() < 0.06, "another walk of the same zero"


def test_a_regrasp_after_much_drift_is_no_fault_of_the_sensor(world_of):
    world = world_of(profile(force_torque={"noise": (0.01,) * 6, "drift_force": 0.3}))
    world.regrasp(0)
    world.advance(60.0)
    before = world.now_ns()
    drifted = device(world, "wrist_ft").since(before - 10**9)[-1].wrench
    world.regrasp(1)
    world.advance(0.5)
    after = device(world, "wrist_ft").since(before)
    assert np.abs(after[0].wrench - drifted)[1] > 0.15, "the zero jumps, farther than noise does"
    assert {reading.stamp.status for reading in after} == {Status.OK}
