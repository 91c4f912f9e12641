"""Friction coefficients against cones that were drawn with a known one."""

import numpy as np
import pytest

from estimation.errors import FitError
from estimation.friction_fit import baselines, fit_friction, sliding_forces
from experiments.bench.identification import contact_forces

MU = 0.33


def cone(seed, n=800, slipping=0.4, sides=(-1, 1), mu=MU, low=1.0):
    """Forces (n, 2) of a contact that slips on ``sides`` and sticks uniformly within the cone; noise 0.02 N."""
    rng = np.random.default_rng(seed)
    normal = rng.uniform(low, 8.0, n)
    slips = rng.random(n) < slipping
    inside = rng.uniform(-1, 1, n) if len(sides) == 2 else sides[0] * rng.uniform(0, 1, n)
    ratio = np.where(slips, rng.choice(sides, n), inside) * mu
    return np.column_stack([normal, ratio * normal]) + 0.02 * rng.standard_normal((n, 2))


@pytest.mark.parametrize("slipping", [0.1, 0.4, 0.9])
def test_the_edge_is_found_whatever_the_share_that_slips(slipping):
    fit = fit_friction(cone(0, slipping=slipping))
    assert fit.mu == pytest.approx(MU, rel=0.02)
    assert fit.interval[0] < MU < fit.interval[1]
    assert fit.slipping == pytest.approx(slipping, abs=0.06)
    assert fit.sides == (-1, 1)


def test_outliers_that_ruin_maximum_and_hull_move_the_likelihood_by_little():
    forces = cone(1)
    forces[:24, 1] = np.linspace(-2, 2, 24) * forces[:24, 0]
    simple = baselines(forces)
    assert simple["maximum"] > 3 * MU and simple["hull"] > 1.5 * MU
    fit = fit_friction(forces)
    assert fit.mu == pytest.approx(MU, rel=0.02)
    assert 0.01 < fit.outliers < 0.06


def test_a_zero_that_is_off_moves_the_apex_and_not_the_coefficient():
    fit = fit_friction(cone(2) + np.array([0.06, -0.1]))
    assert fit.mu == pytest.approx(MU, rel=0.02)
    assert fit.apex[1] == pytest.approx(-0.1, abs=0.03)


def test_slip_to_one_side_only_is_told_and_widens_the_interval():
    both, one = fit_friction(cone(3)), fit_friction(cone(3, sides=(1,)))
    assert one.sides == (1,)
    assert one.standard_error > both.standard_error
    assert one.interval[0] < MU < one.interval[1]


def test_a_steeper_cone_is_as_well_found():
    assert fit_friction(cone(4, mu=0.8)).mu == pytest.approx(0.8, rel=0.02)


def test_known_slip_speeds_part_the_samples():
    rng = np.random.default_rng(5)
    slides, sticks = cone(5, n=100, slipping=1.0), cone(6, n=700, slipping=0.0)
    speed = np.concatenate([np.full(100, 0.02), np.zeros(700)]) + 0.001 * rng.standard_normal(800)
    fit = fit_friction(np.vstack([slides, sticks]), slip_speed=speed, slip_speed_noise=0.001)
    assert fit.mu == pytest.approx(MU, rel=0.02)
    assert fit.slipping == pytest.approx(100 / 800, abs=0.03)


def test_in_a_lab_the_error_is_below_two_percent():
    fit = fit_friction(contact_forces(np.random.default_rng(11)))
    assert fit.mu == pytest.approx(MU, rel=0.02)
    assert fit.interval[0] < MU < fit.interval[1]


@pytest.mark.slow
def test_the_interval_covers_in_nine_labs_of_ten_and_errors_stay_below_two_percent():
    fits = [fit_friction(contact_forces(np.random.default_rng(seed))) for seed in range(100)]
    assert np.mean([fit.interval[0] <= MU <= fit.interval[1] for fit in fits]) >= 0.9
    errors = np.array([fit.mu / MU - 1 for fit in fits])
    assert np.mean(np.abs(errors) < 0.02) >= 0.95
    assert abs(errors.mean()) < 0.003


def test_a_contact_that_never_slips_is_refused_and_not_taken_for_its_largest_ratio():
    with pytest.raises(FitError, match="no slip seen along the tangential axis, µ is at least"):
        fit_friction(cone(7, slipping=0.0))


def test_pressing_without_dragging_is_refused_by_axis():
    forces = cone(8)
    forces[:, 1] = 0.01 * np.random.default_rng(0).standard_normal(len(forces))
    with pytest.raises(FitError, match="the tangential axis is not excited"):
        fit_friction(forces)


def test_forces_that_do_not_press_are_refused_by_axis():
    with pytest.raises(FitError, match="the normal axis is not excited"):
        fit_friction(-cone(9))


def test_a_wrench_of_zero_is_refused():
    with pytest.raises(FitError, match="the normal axis is not excited"):
        fit_friction(np.zeros((100, 2)))


def test_too_few_samples_are_refused():
    with pytest.raises(FitError, match="at least 12"):
        fit_friction(cone(10)[:5])


def test_a_nan_is_refused_by_row_and_axis():
    forces = cone(10)
    forces[3, 1] = np.nan
    with pytest.raises(FitError, match=r"row 3 \(f_t\)"):
        fit_friction(forces)


def test_only_forces_of_motion_count_as_sliding():
    t = np.arange(0, 2, 0.01)
    x = np.where(t < 1, 0.0, 0.05 * (t - 1))
    moving = sliding_forces(np.column_stack([t, t]), t, np.column_stack([x, 0 * x]), t)
    assert moving[:, 0].min() == pytest.approx(1.0, abs=0.03)
    assert len(moving) == pytest.approx(97, abs=3)


def strokes_with_offsets(seed, count=16, n=24, offset=0.03, noise=0.01, turned=0.0, right=(2.0, 6.0)):
    """Forces of strokes that slip, each with a zero of its own that is off, and the stroke of each force.

    Strokes to the ``right`` press with other forces than those to the left; the axes are ``turned`` [rad].
    """
    rng = np.random.default_rng(seed)
    forces, number = [], np.repeat(np.arange(count), n)
    co, si = np.cos(turned), np.sin(turned)
    for k in range(count):
        low, high = right if k % 2 else (2.0, 6.0)
        normal = rng.uniform(low, high) + 0.3 * rng.uniform(-1, 1, n)
        tangential = (1 if k % 2 else -1) * MU * normal
        seen = np.column_stack([co * normal - si * tangential, si * normal + co * tangential])
        forces.append(seen + noise * rng.standard_normal((n, 2)) + offset * rng.standard_normal(2))
    return np.concatenate(forces), number


def test_readings_of_one_stroke_are_no_independent_evidence():
    """χ² of ten draws: within what one degree of freedom each allows with the strokes told, far beyond without."""
    told, untold = [], []
    for seed in range(10):
        forces, strokes = strokes_with_offsets(seed)
        for errors, numbers in ((told, strokes), (untold, None)):
            fit = fit_friction(forces, zero_error=0.01, gain_error=0.0, strokes=numbers)
            errors.append((fit.mu - MU) / fit.standard_error)
    assert np.sum(np.square(told)) < 23.2  # 99 % of χ² with 10 degrees of freedom
    assert np.sum(np.square(untold)) > 2 * 23.2


def test_offsets_much_larger_than_a_force_s_noise_are_integrated_all_the_same():
    """The peak of a stroke's likelihood is then a hundredth of what it is looked for in."""
    z = []
    for seed in range(5):
        forces, strokes = strokes_with_offsets(seed, noise=0.002, offset=0.02)
        fit = fit_friction(forces, zero_error=0.02, gain_error=0.0, strokes=strokes)
        assert fit.mu == pytest.approx(MU, rel=0.012)
        z.append((fit.mu - MU) / fit.standard_error)
    assert np.sum(np.square(z)) < 15.1  # 99 % of χ² with 5 degrees of freedom


def test_axes_that_are_turned_do_not_move_the_coefficient_even_where_one_side_presses_harder():
    """By 0.4 deg: that is 2.3 % of the ratio on either side."""
    z = []
    for seed in range(5):
        forces, strokes = strokes_with_offsets(seed, noise=0.004, offset=0.01, turned=0.007, right=(5.0, 8.0))
        fit = fit_friction(forces, zero_error=0.01, gain_error=0.0, strokes=strokes)
        z.append((fit.mu - MU) / fit.standard_error)
    assert np.sum(np.square(z)) < 15.1


def test_strokes_that_do_not_number_the_forces_are_refused():
    with pytest.raises(FitError, match="one number for each of 800 forces"):
        fit_friction(cone(0), strokes=[0, 1])
