"""Means, paired differences and rates with their intervals, against closed forms and printed tables."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.statistics import mean, paired, rate

#: Student's t, two-sided 95 %, as tables print it: by degrees of freedom
T_975 = {1: 12.706, 2: 4.303, 4: 2.776, 7: 2.365}


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_the_interval_of_a_mean_is_students(n):
    values = np.arange(n, dtype=float)
    half = T_975[n - 1] * math.sqrt(n * (n + 1) / 12) / math.sqrt(n)  # the variance of 0 … n − 1 is n (n + 1) / 12
    found = mean(values.tolist())
    assert found.mean == pytest.approx((n - 1) / 2)
    assert (found.low, found.high) == pytest.approx((found.mean - half, found.mean + half), abs=1e-3 * half)
    assert found.half == pytest.approx(half, rel=1e-3)
    assert found.n == n


def test_one_value_has_no_interval():
    found = mean([3.0])
    assert (found.mean, found.low, found.high, found.half, found.n) == (3.0, None, None, None, 1)


def test_equal_values_have_an_interval_of_no_width():
    assert (mean([2.0, 2.0]).low, mean([2.0, 2.0]).high) == (2.0, 2.0)


@pytest.mark.parametrize("values", [[], [1.0, math.nan], [math.inf]])
def test_a_mean_of_nothing_or_of_no_number_is_refused(values):
    with pytest.raises(ValueError, match="finite values"):
        mean(values)


def test_the_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    samples = [mean(rng.normal(1, 2, 5).tolist()) for _ in range(2000)]
    covered = [abs(found.mean - 1.0) <= (found.half or 0.0) for found in samples]
    assert np.mean(covered) == pytest.approx(0.95, abs=3 * math.sqrt(0.95 * 0.05 / 2000))


def test_what_pairs_have_in_common_does_not_widen_the_interval_of_their_difference():
    common = np.array([10.0, -20.0, 35.0, 4.0, 0.0])
    a, b = common + np.array([0.9, 1.1, 1.0, 1.2, 0.8]), common
    found = paired(a.tolist(), b.tolist())
    assert found.mean == pytest.approx(1.0)
    assert found.half == pytest.approx(T_975[4] * math.sqrt(0.025) / math.sqrt(5), rel=1e-3)


def test_pairs_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match=r"as many values of either, received \(2,\) and \(1,\)"):
        paired([1.0, 2.0], [1.0])


@given(st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilsons_interval_solves_its_equation(counts):
    """Its ends are the rates p with (p̂ − p)² = z² p (1 − p) / n."""
    successes, n = counts
    found, share, z = rate(successes, n), successes / n, 1.959964
    for end in (found.low, found.high):
        if 0 < end < 1:
            assert (share - end) ** 2 == pytest.approx(z**2 * end * (1 - end) / n, rel=1e-5, abs=1e-12)
    assert found.low <= share <= found.high
    assert found.share == share


def test_fifteen_of_fifteen_says_that_one_in_five_may_fail():
    """1 / (1 + z²/15), in closed form."""
    assert rate(15, 15).low == pytest.approx(1 / (1 + 1.959964**2 / 15), rel=1e-6)


def test_no_trial_says_nothing_and_more_successes_than_trials_are_refused():
    assert (rate(0, 0).share, rate(0, 0).low, rate(0, 0).high) == (None, 0.0, 1.0)
    with pytest.raises(ValueError, match="0 to 3 successes"):
        rate(4, 3)
