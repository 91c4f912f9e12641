"""Tool weight and zero against readings worked out from a hanging mass, and against the simulated lab's electronics."""

import numpy as np
import pytest

from drivers.sim.force_torque import Electronics
from drivers.sim.mismatch import load_profile
from estimation.errors import FitError
from estimation.force_torque import FreeAirLoad
from estimation.tool_identification import identify_tool, under_table_check

G = 9.81
X_EE_S = np.array([0.01, 0.2, 0.3])
MASS, CENTRE, OFFSET = 1.1, np.array([0.004, 0.09]), np.array([0.3, -0.2, 0.01])


def hanging(masses, points, X_W_ee):
    """The planar load on the sensor of point masses at ``points`` in ee, in the sensor's axes, by hand."""
    x, y, theta = X_W_ee
    c, s = np.cos(theta), np.sin(theta)
    turn = np.array([[c, -s], [s, c]])
    at = np.array([x, y]) + turn @ X_EE_S[:2]
    total = np.zeros(3)
    for mass, point in zip(masses, points, strict=True):
        lever = np.array([x, y]) + turn @ np.asarray(point) - at
        total += [0.0, -mass * G, lever[0] * -mass * G]
    phi = theta + X_EE_S[2]
    c, s = np.cos(phi), np.sin(phi)
    return np.array([c * total[0] + s * total[1], -s * total[0] + c * total[1], total[2]])


def spatial(planar):
    fx, fy, tau = planar
    return np.array([fx, 0.0, fy, 0.0, -tau, 0.0])


def poses(degrees):
    return np.array([[0.1 * k, 0.3, a] for k, a in enumerate(np.radians(degrees))])


def readings(at, offset=OFFSET, extra=()):
    masses, points = [MASS, *(m for m, _ in extra)], [CENTRE, *(p for _, p in extra)]
    return np.array([spatial(hanging(masses, points, pose) + offset) for pose in at])


def test_mass_centre_and_zero_come_back_exactly_from_readings_without_noise():
    at = poses([-40, -10, 25, 50])
    fit = identify_tool(readings(at), at, X_EE_S, G)
    assert fit.mass == pytest.approx(MASS)
    assert fit.p_ee_tool == pytest.approx(CENTRE)
    assert fit.offset == pytest.approx(OFFSET)


def test_the_fitted_sensor_reads_nothing_in_free_air_at_any_other_angle():
    at, other = poses([-40, -10, 25, 50]), poses([75.0])
    sensor = identify_tool(readings(at), at, X_EE_S, G).sensor(X_EE_S, G)
    assert sensor.wrench_on_go(readings(other)[0], other[0], other[0, :2]) == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_weight_of_an_object_in_the_fingers_is_not_taken_for_the_tool():
    at, point = poses([-40, -10, 25, 50]), np.array([0.0, -0.06])
    held = np.array([[*(p[:2] + _turn(p[2]) @ (point - [0.01, 0.02])), p[2]] for p in at])
    load = FreeAirLoad(0.25, np.array([0.01, 0.02]), G)
    fit = identify_tool(readings(at, extra=[(0.25, point)]), at, X_EE_S, G, load, held)
    assert fit.mass == pytest.approx(MASS)
    assert fit.p_ee_tool == pytest.approx(CENTRE)
    assert fit.offset == pytest.approx(OFFSET)


def _turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_with_the_labs_electronics_errors_are_small_and_as_large_as_the_covariance_says():
    figures = load_profile("lab").force_torque.model_copy(
        update={"gain_error": 0.0, "temperature_gain": 0.0, "drift_force": 0.0, "drift_torque": 0.0}
        | {"temperature_force": 0.0, "temperature_torque": 0.0, "bias_force": 0.0, "bias_torque": 0.0}
    )
    at = poses(np.linspace(-45, 45, 15))
    clean = readings(at)
    truth, z = np.array([MASS, *CENTRE, *OFFSET]), []
    for seed in range(60):
        sensor = Electronics(figures, 1000.0, np.random.default_rng(seed))
        read = np.array([np.mean([sensor.read(load)[0] for _ in range(20)], axis=0) for load in clean])
        fit = identify_tool(read, at, X_EE_S, G)
        error = np.array([fit.mass, *fit.p_ee_tool, *fit.offset]) - truth
        assert abs(error[0]) < 0.01 and np.abs(error[1:3]).max() < 0.001
        z.append(error / fit.standard_errors)
    # Student's t with 27 and 12 degrees of freedom: rms 1.04 and 1.10
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert ((rms > 0.75) & (rms < 1.45)).all(), rms


def test_alike_angles_are_refused_with_what_to_do():
    at = poses([10, 10.001, 10, 10])
    with pytest.raises(FitError, match=r"angles of the end-effector.*Turn the arm further"):
        identify_tool(readings(at), at, X_EE_S, G)


def test_two_angles_that_only_separate_the_force_are_refused():
    at = poses([-30, 30, -30, 30])
    with pytest.raises(FitError, match="three or more"):
        identify_tool(readings(at), at, X_EE_S, G)


def test_three_readings_leave_no_noise_to_judge_and_are_refused():
    at = poses([-30, 0, 30])
    with pytest.raises(FitError, match="at least 4"):
        identify_tool(readings(at), at, X_EE_S, G)


def test_a_nan_is_refused_by_row():
    at = poses([-40, -10, 25, 50])
    read = readings(at)
    read[2, 4] = np.nan
    with pytest.raises(FitError, match="row 2"):
        identify_tool(read, at, X_EE_S, G)


def test_readings_that_pull_upward_are_refused_as_no_tool():
    at = poses([-40, -10, 25, 50])
    with pytest.raises(FitError, match="tool: expected a mass above its own error"):
        identify_tool(-readings(at), at, X_EE_S, G)


NOISE = np.diag([0.03, 0.03]) ** 2


def test_the_table_carries_the_fingers_push_and_the_weight():
    # fingers press the go down with 3 N and to the right with 1 N, the go weighs 2 N: the table gets (1, −5) N
    check = under_table_check([1.0, -3.0, 0.1], 2.0, spatial((1.0, -5.0, 0.7)), NOISE)
    assert check.difference == pytest.approx(np.zeros(2))
    assert check.chi2 == pytest.approx(0.0) and check.probability == pytest.approx(1.0) and check.agrees


def test_a_turned_table_sensor_is_turned_back():
    # its x axis is W's y: the same push reads (−5, −1) there
    check = under_table_check([1.0, -3.0, 0.1], 2.0, spatial((-5.0, -1.0, 0.7)), NOISE, table_angle=np.pi / 2)
    assert check.difference == pytest.approx(np.zeros(2), abs=1e-12)


def test_a_disagreement_of_five_sigma_is_told():
    check = under_table_check([1.15, -3.0, 0.1], 2.0, spatial((1.0, -5.0, 0.7)), NOISE)
    assert check.chi2 == pytest.approx(25.0)
    assert not check.agrees


def test_noise_alone_is_taken_for_a_disagreement_as_often_as_agreed():
    rng = np.random.default_rng(1)
    away = rng.multivariate_normal(np.zeros(2), NOISE, 2000)
    refused = [
        not under_table_check([1 + dx, -3 + dy, 0.0], 2.0, spatial((1.0, -5.0, 0.0)), NOISE, significance=0.05).agrees
        for dx, dy in away
    ]
    assert np.mean(refused) == pytest.approx(0.05, abs=0.02)


def test_a_nan_of_the_table_is_refused():
    with pytest.raises(FitError, match="under-table reading"):
        under_table_check([1.0, -3.0, 0.1], 2.0, np.full(6, np.nan), NOISE)
