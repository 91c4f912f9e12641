"""What gains do to a ratio of forces, against a sensor whose axes are really scaled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.friction_gain import gain_sensitivity, shares
from mechanics import se2


def read(force: np.ndarray, angle: float, gains: tuple[float, float]) -> np.ndarray:
    """What a sensor at ``angle`` says of a force, told again in the contact's axes."""
    own = se2.rotate(-angle, force) * (1 + np.array(gains))
    return se2.rotate(angle, own)


@given(
    ratio=st.one_of(st.floats(0.1, 2.0), st.floats(-2.0, -0.1)),
    angle=st.floats(-1.5, 1.5),
    both=st.floats(-0.1, 0.1),
)
def test_the_sensitivity_is_the_change_of_the_ratio_that_a_scaled_axis_makes(
    ratio: float, angle: float, both: float
) -> None:
    small = 1e-6
    f_t, f_n = read(np.array([ratio, 1.0]), angle, (both + small, both))
    f_t0, f_n0 = read(np.array([ratio, 1.0]), angle, (both, both))
    assert f_t0 / f_n0 == pytest.approx(ratio, rel=1e-9), "a gain of both axes changes no ratio"
    change = ((f_t / f_n) / ratio - 1) * (1 + both) / small
    assert change == pytest.approx(gain_sensitivity(ratio, angle), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_force_along_an_axis_shows_its_ratio_whatever_the_gains_are(sign: int) -> None:
    mu = 0.33
    # dragged to the left the ground pushes to the right: the force leans by atan(µ), and so does the axis
    assert gain_sensitivity(sign * mu, -sign * np.arctan(mu)) == pytest.approx(0.0, abs=1e-15)
    # leaning the other way by as much, force and axis are twice that apart
    assert gain_sensitivity(sign * mu, sign * np.arctan(mu)) == pytest.approx(2 * np.cos(2 * np.arctan(mu)))


def test_alike_sensors_are_believed_alike_and_two_halve_the_variance() -> None:
    share, left = shares([1.0, -1.0], gain_error=0.005, noise=0.0)
    np.testing.assert_allclose(share, [0.5, 0.5])
    assert left == pytest.approx(0.005 * np.sqrt(2) / np.sqrt(2))


def test_what_is_left_is_the_least_that_any_shares_leave() -> None:
    sensitivities = np.array([1.0, 0.3])
    share, left = shares(sensitivities, gain_error=0.005, noise=0.0)
    tried = np.linspace(0, 1, 2001)
    each = np.sqrt(2) * 0.005 * np.hypot(tried * sensitivities[0], (1 - tried) * sensitivities[1])
    assert left == pytest.approx(each.min(), rel=1e-6)
    assert share[0] == pytest.approx(tried[each.argmin()], abs=1e-3)


def test_one_sensor_alone_is_believed_whatever_it_is_and_leaves_both_of_its_errors() -> None:
    share, left = shares([1.4], gain_error=0.005, noise=0.003)
    np.testing.assert_allclose(share, [1.0])
    assert left == pytest.approx(np.hypot(1.4 * 0.005 * np.sqrt(2), 0.003))
