"""A camera's times in ours."""

from itertools import pairwise

import numpy as np
import pytest

from drivers.real.frame_clock import FrameClock

MS = 1_000_000
NOW = 1_790_000_000_000 * MS
PERIOD = 33 * MS


def test_unix_time_that_is_plausible_is_believed():
    assert FrameClock().capture_ns(NOW - 21 * MS, NOW, True) == NOW - 21 * MS


def test_a_camera_that_is_a_little_ahead_exposed_no_later_than_it_came():
    assert FrameClock().capture_ns(NOW + 5 * MS, NOW, True) == NOW


@pytest.mark.parametrize("wrong", [-2_000 * MS, 100 * MS, -NOW])
def test_unix_time_that_is_not_plausible_is_a_clock_of_its_own(wrong):
    assert FrameClock(0.004).capture_ns(NOW + wrong, NOW, True) == NOW - 4 * MS


def test_the_cameras_own_distances_are_kept_whatever_the_way_took():
    ways = np.random.default_rng(0).integers(0, 20, 200) * MS
    ways[0] = 0
    clock = FrameClock(0.010)
    captured = [clock.capture_ns(77 + n * PERIOD, NOW + n * PERIOD + int(way), False) for n, way in enumerate(ways)]
    assert captured == [NOW + n * PERIOD - 10 * MS for n in range(200)]


def test_the_soonest_frame_is_found_and_none_is_exposed_after_it_came():
    clock = FrameClock()
    arrivals = [NOW + n * PERIOD + way * MS for n, way in enumerate((9, 6, 14, 2, 8))]
    captured = [clock.capture_ns(n * PERIOD, arrival, False) for n, arrival in enumerate(arrivals)]
    assert [arrival - capture for arrival, capture in zip(arrivals, captured, strict=True)] == [0, 0, 8 * MS, 0, 6 * MS]
    assert all(a < b for a, b in pairwise(captured))


def test_a_clock_that_drifts_is_followed():
    clock = FrameClock()
    slow = 1 - 1e-4  # a hundred times worse than a crystal
    late = [NOW + n * PERIOD - clock.capture_ns(round(n * PERIOD * slow), NOW + n * PERIOD, False) for n in range(3000)]
    assert max(late) < 1.01 * 300 * PERIOD * 1e-4


@pytest.mark.parametrize("step", [-10_000 * MS, 10_000 * MS])
def test_a_clock_that_is_set_anew_is_followed_at_once(step):
    clock = FrameClock()
    for n in range(5):
        clock.capture_ns(n * PERIOD, NOW + n * PERIOD, False)
    assert clock.capture_ns(5 * PERIOD + step, NOW + 5 * PERIOD, False) == NOW + 5 * PERIOD


def test_capture_times_rise_even_where_the_cameras_do_not():
    clock = FrameClock()
    told = [NOW - 20 * MS, NOW - 20 * MS, NOW - 25 * MS]
    captured = [clock.capture_ns(t, NOW + n, True) for n, t in enumerate(told)]
    assert all(a < b for a, b in pairwise(captured))
