"""Delays between streams: closed-form motions sampled exactly, repeated noise, and a recording of a real laboratory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.clock_fit import fit_delay, fresh
from estimation.errors import FitError
from tests.recordings import recording

Stream = tuple[np.ndarray, np.ndarray]


def motion(t: np.ndarray) -> np.ndarray:
    return np.sin(2 * np.pi * 0.7 * t) + 0.5 * np.sin(2 * np.pi * 1.9 * t + 1)


def sampled(rate: float, delay: float = 0.0, *, begin: float = 0.0, end: float = 10.0, phase: float = 0.0) -> Stream:
    """Stamps [ns] and the motion as a sensor shows it that is late by ``delay``."""
    t = np.arange(begin + phase, end, 1 / rate)
    return np.round(t * 1e9).astype(np.int64), motion(t - delay)


@given(st.floats(-0.3, 0.3), st.sampled_from([(100, 100), (100, 10), (10, 100), (85, 100)]), st.floats(0, 0.01))
@settings(max_examples=25)
def test_a_clean_motion_gives_delay_gain_and_offset(delay: float, rates: tuple[int, int], phase: float) -> None:
    first, second = sampled(rates[0]), sampled(rates[1], delay, phase=phase)
    fit = fit_delay(*first, second[0], -3.0 * second[1] + 2.0, max_delay=0.5)
    assert fit.delay == pytest.approx(delay, abs=1e-4)
    assert (fit.gain, fit.offset) == (pytest.approx(-3.0, rel=5e-3), pytest.approx(2.0, abs=5e-3))
    assert fit.correlation < -0.999
    assert fit.overlap == pytest.approx(10 - abs(delay), abs=0.25)


def test_the_other_way_round_the_delay_changes_its_sign() -> None:
    first, second = sampled(100), sampled(60, 0.123)
    there = fit_delay(*first, second[0], 4 * second[1] - 1)
    back = fit_delay(second[0], 4 * second[1] - 1, *first)
    assert back.delay == pytest.approx(-there.delay, abs=1e-5)
    assert back.gain == pytest.approx(1 / there.gain, rel=1e-3)
    assert back.offset == pytest.approx(0.25, abs=1e-3)


def test_unix_time_in_nanoseconds_loses_nothing_and_order_does_not_matter() -> None:
    first, second = sampled(100), sampled(90, 0.0371)
    epoch = 1_436_828_708_309_848_898
    shuffled = np.random.default_rng(0).permutation(len(second[0]))
    plain = fit_delay(*first, *second)
    late = fit_delay(first[0] + epoch, first[1], second[0][shuffled] + epoch, second[1][shuffled])
    assert late.delay == pytest.approx(plain.delay, abs=1e-7)


@pytest.mark.parametrize("rates", [(100, 100), (10, 100)], ids=str)
def test_the_sigma_is_that_of_repeated_recordings(rates: tuple[int, int]) -> None:
    delay, scores, errors = 0.0031, [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        (ta, a), (tb, b) = sampled(rates[0]), sampled(rates[1], delay)
        a, b = a + 0.1 * rng.standard_normal(a.size), -3 * b + 0.3 * rng.standard_normal(b.size)
        fit = fit_delay(ta, a, tb, b, max_delay=0.3)
        errors.append(fit.delay - delay)
        scores.append((fit.delay - delay) / fit.sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.35  # of 25: 1 ± 0.14
    assert abs(np.mean(errors)) < 3 * np.std(errors) / np.sqrt(25)
    # the Cramér–Rao bound: both noises, as one of 0.3 √(1 + r), over the speed that gain and offset leave
    n = 10 * min(rates)
    speed = 3 * np.sqrt((2 * np.pi) ** 2 * (0.7**2 + 0.5**2 * 1.9**2) / 2)
    assert np.std(errors) < 1.35 * 0.3 * np.sqrt(1 + min(rates) / max(rates)) / (speed * np.sqrt(n))


def test_what_repeats_between_renewals_is_not_new() -> None:
    stamps = np.arange(10)
    values = np.array([1, 1, 2, 2, 3, 3, 3, 3, 3, 4.0])
    kept_stamps, kept = fresh(stamps, values)
    assert kept_stamps.tolist() == [0, 2, 4, 8, 9]
    assert kept.tolist() == [1, 2, 3, 3, 4]


def test_a_stair_looks_late_by_half_a_step_until_its_repeats_are_dropped() -> None:
    t, y = sampled(100)
    held = np.repeat(y[::4], 4)[: len(y)]  # renewed at 25 Hz, polled at 100
    other = sampled(90, 0.05)
    assert fit_delay(t, held, *other).delay == pytest.approx(0.05 - 0.015, abs=1e-3)
    assert fit_delay(*fresh(t, held), *other).delay == pytest.approx(0.05, abs=1e-4)


# -- what cannot be answered -------------------------------------------------------------------------------------------


def still(noise: float) -> Stream:
    t = np.arange(0, 10, 0.01)
    return np.round(t * 1e9).astype(np.int64), 5.0 + noise * np.random.default_rng(1).standard_normal(t.size)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_stream_without_motion_is_told(noise: float) -> None:
    with pytest.raises(FitError, match="second: nothing beyond its noise"):
        fit_delay(*sampled(100), *still(noise))


def test_streams_that_do_not_overlap_are_told() -> None:
    with pytest.raises(FitError, match=r"overlap.*second from 20 to 25 s"):
        fit_delay(*sampled(100), *sampled(100, begin=20, end=25))


def test_motions_that_have_nothing_in_common_are_told() -> None:
    stamps, _ = sampled(100)
    walk = np.cumsum(np.random.default_rng(3).standard_normal(len(stamps)))
    with pytest.raises(FitError, match="the same motion"):
        fit_delay(*sampled(100), stamps, walk, max_delay=0.3)


def test_a_motion_of_constant_speed_is_told() -> None:
    t = np.arange(0, 5, 0.01)
    stamps = np.round(t * 1e9).astype(np.int64)
    with pytest.raises(FitError, match="constant speed"):
        fit_delay(stamps, 0.2 * t, stamps, 3 * (t - 0.04))


def test_a_periodic_motion_is_told_unless_the_delay_is_known_to_be_short() -> None:
    t = np.arange(0, 20, 0.01)
    stamps = np.round(t * 1e9).astype(np.int64)
    a, b = np.sin(2 * np.pi * t), np.sin(2 * np.pi * (t - 0.1))
    with pytest.raises(FitError, match="periodic"):
        fit_delay(stamps, a, stamps, b)
    with pytest.raises(FitError, match="periodic"):  # as the gain may be negative, half a period is one as well
        fit_delay(stamps, a, stamps, b, max_delay=0.45)
    assert fit_delay(stamps, a, stamps, b, max_delay=0.45, gain_sign=1).delay == pytest.approx(0.1, abs=1e-4)
    assert fit_delay(stamps, a, stamps, b, max_delay=0.3).delay == pytest.approx(0.1, abs=1e-4)


def test_what_is_no_number_too_short_or_of_two_lengths_is_told() -> None:
    stamps, values = sampled(100)
    with pytest.raises(FitError, match="first: 1 values that are not"):
        fit_delay(stamps, np.where(stamps == stamps[7], np.nan, values), stamps, values)
    with pytest.raises(FitError, match="second: 5"):
        fit_delay(stamps, values, stamps[:5], values[:5])
    with pytest.raises(FitError, match="a stamp for each value"):
        fit_delay(stamps, values, stamps, values[:-1])


# -- a real robot, its force sensor and a motion capture system --------------------------------------------------------


def recorded(name: str, columns: int) -> Stream:
    words = recording(f"pushing/time_delay/{name}").read_text().split()
    return np.array([int(w) for w in words[::columns]]), np.array([float(w) for w in words[1::columns]])


def between(stream: Stream, origin: int, begin: float, end: float) -> Stream:
    inside = (stream[0] >= origin + begin * 1e9) & (stream[0] < origin + end * 1e9)
    return stream[0][inside], stream[1][inside]


def test_robot_and_motion_capture_are_apart_by_the_same_delay_in_every_segment() -> None:
    tip, seen = recorded("Output_tip_tcpvicon.txt", 2), recorded("Output_vicon_tcpvicon.txt", 2)
    origin = tip[0][0]
    for prepared in (tip, fresh(*tip)):
        fits = [
            fit_delay(*between(prepared, origin, begin, begin + 6), *between(seen, origin, begin, begin + 6))
            for begin in range(3, 33, 6)
        ]
        delays = np.array([fit.delay for fit in fits])
        assert np.ptp(delays) < 0.003
        assert np.ptp(delays) < 10 * max(fit.sigma for fit in fits) < 0.004
        assert min(fit.correlation for fit in fits) > 0.9999
        assert np.mean([fit.gain for fit in fits]) == pytest.approx(1000, rel=1e-3)  # metres there, millimetres here


def test_robot_and_force_are_apart_by_the_same_delay_in_every_segment() -> None:
    tip, force = recorded("Output_tcp_fttcp.txt", 2), recorded("Output_ft_fttcp.txt", 3)
    origin = tip[0][0]
    presses = 3 * 1.16  # s; three presses on something soft
    delays = [
        fit_delay(
            *between(tip, origin, begin, begin + presses),
            *between(force, origin, begin, begin + presses),
            max_delay=0.3,
        ).delay
        for begin in 7.6 + presses * np.arange(3)
    ]
    assert np.ptp(delays) < 0.003
