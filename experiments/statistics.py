"""Means, differences and rates with their 95 % intervals, as tables state them.

A value is a trial's: its waypoints hang together and are no sample of their own, so that a trial counts once.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A ``mean`` of ``n`` values and its interval from ``low`` to ``high``; both None where the values tell none."""

    mean: float
    low: float | None
    high: float | None
    n: int

    @property
    def half(self) -> float | None:
        """Half the interval's width."""
        return None if self.low is None or self.high is None else (self.high - self.low) / 2


@dataclass(frozen=True)
class Rate:
    """``successes`` of ``n``, their ``share`` and its Wilson interval; without any trial the share is not known."""

    successes: int
    n: int
    share: float | None
    low: float
    high: float


def mean(values: Sequence[float], level: float = LEVEL) -> Estimate:
    """The mean of ``values`` (n,) and its interval by Student's t. A single value has no interval.

    Raises ValueError where there is no value, or one that is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or not array.size or not np.isfinite(array).all():
        raise ValueError(f"mean: expected one or more finite values, received {list(values)}")
    middle = float(array.mean())
    if array.size == 1:
        return Estimate(middle, None, None, 1)
    error = float(stats.sem(array))
    if error == 0:  # Student's t has no interval of width zero
        return Estimate(middle, middle, middle, array.size)
    low, high = stats.t.interval(level, array.size - 1, loc=middle, scale=error)
    return Estimate(middle, float(low), float(high), array.size)


def paired(values_a: Sequence[float], values_b: Sequence[float], level: float = LEVEL) -> Estimate:
    """The mean of a − b over pairs (n,) and its interval by Student's t of the differences.

    Raises ValueError where the pairs do not match, or there is none.
    """
    a, b = np.asarray(values_a, dtype=np.float64), np.asarray(values_b, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"paired: expected as many values of either, received {a.shape} and {b.shape}")
    return mean((a - b).tolist(), level)


def paired_over(a: Mapping[Hashable, float], b: Mapping[Hashable, float], level: float = LEVEL) -> Estimate | None:
    """`paired` over the keys that both have; None where there is none."""
    common = [key for key in a if key in b]
    return paired([a[key] for key in common], [b[key] for key in common], level) if common else None


def rate(successes: int, n: int, level: float = LEVEL) -> Rate:
    """The share ``successes`` of ``n`` with Wilson's interval. Raises ValueError for more successes than trials."""
    if not 0 <= successes <= n:
        raise ValueError(f"rate: expected 0 to {n} successes, received {successes}")
    if n == 0:
        return Rate(0, 0, None, 0.0, 1.0)
    found = stats.binomtest(successes, n).proportion_ci(level, method="wilson")
    return Rate(successes, n, successes / n, float(found.low), float(found.high))
