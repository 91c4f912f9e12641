"""The covariance of a zeroed wrist sensor, against what the errors that it names do one by one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from estimation.force_torque import WristSensor
from estimation.wrench_errors import ForceTorqueErrors, Zero
from mechanics.readings import Array

NOTHING = np.zeros(3)
S = 1_000_000_000


def deviation(
    errors: ForceTorqueErrors,
    seconds: float = 0.0,
    load: ArrayLike = NOTHING,
    readings: int = 1,
    wrist: WristSensor | None = None,
    ee: ArrayLike = NOTHING,
) -> Array:
    zero = Zero(5 * S, np.zeros(3))
    wrist = wrist or WristSensor(np.array([0.0, 0.2, 0.0]), NOTHING)
    at = 5 * S + round(seconds * S)
    return np.sqrt(np.diag(zero.covariance(errors, wrist, at, np.asarray(ee, float), np.asarray(load), readings)))


def only(**figures: object) -> ForceTorqueErrors:
    return ForceTorqueErrors(**({"noise": (0, 0, 0), "drift": (0, 0, 0), "gain": 0.0, "tool": 0.0} | figures))  # type: ignore[arg-type]


def test_noise_falls_with_the_root_of_the_number_of_readings() -> None:
    assert deviation(only(noise=(0.03, 0.02, 0.001)), readings=100) == pytest.approx([0.003, 0.002, 0.0001])


def test_the_zero_walks_away_with_the_root_of_time() -> None:
    drifts = only(drift=(0.05, 0.04, 0.002))
    assert deviation(drifts) == pytest.approx(np.zeros(3))
    assert deviation(drifts, seconds=120.0) == pytest.approx([0.1, 0.08, 0.004])


def test_a_wrong_gain_is_a_share_of_the_load() -> None:
    assert deviation(only(gain=0.01), load=[3.0, -4.0, 0.5]) == pytest.approx([0.03, 0.04, 0.005])


def test_a_tool_of_another_weight_shows_as_the_arm_turns() -> None:
    # 1 kg at the sensor's own origin: a quarter turn takes its weight from −y to −x of the sensor
    wrist = WristSensor(np.array([0.0, 0.2, 0.0]), NOTHING, 1.0, np.array([0.0, 0.2]), 9.81)
    heavy = only(tool=0.02)
    assert deviation(heavy, wrist=wrist) == pytest.approx(np.zeros(3))
    turned = deviation(heavy, wrist=wrist, ee=[0.0, 0.0, np.pi / 2])
    assert turned == pytest.approx([0.02 * 9.81, 0.02 * 9.81, 0.0], abs=1e-12)


def test_errors_are_those_of_sensors_that_are_drawn_with_them() -> None:
    rng, errors = np.random.default_rng(0), ForceTorqueErrors()
    load, wrist = np.array([1.0, -4.0, 0.3]), WristSensor(np.array([0.0, 0.2, 0.0]), NOTHING, 1.1, np.array([0.0, 0.1]))
    ee = np.array([0.0, 0.1, 0.4])

    def tool(turn: float) -> np.ndarray:  # its weight in the sensor, whose lever to it is 0.1 m along −y
        weight = 1.1 * 9.81 * np.array([-np.sin(turn), -np.cos(turn)])
        return np.array([*weight, 0.1 * weight[0]])

    moved = tool(0.4) - tool(0.0)
    drawn = [
        np.array(errors.noise) / 10 * rng.standard_normal(3)
        + np.array(errors.drift) * np.sqrt(20 / 30) * rng.standard_normal(3)
        + errors.gain * rng.standard_normal(3) * (load + moved)
        + errors.tool * rng.standard_normal() * moved
        for _ in range(4000)
    ]
    expected = np.std(drawn, axis=0)
    assert deviation(errors, 20.0, load, 100, wrist, ee) == pytest.approx(expected, rel=0.05)
