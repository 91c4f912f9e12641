"""By how much one sensor's stream lags behind another's, from a motion that both saw.

Both streams are scalars with stamps and rates of their own, and show one motion through an unknown gain and offset:
second(t) = gain · first(t − delay) + offset + noise. Clock offset and transport delay come as their sum: one motion
cannot tell them apart. The maximum of the correlation over all delays starts a maximum-likelihood fit of delay, gain
and offset; its uncertainty is taken from the residuals as they are, correlated in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from estimation.errors import FitError
from mechanics.readings import Array

MIN_SAMPLES = 12  # in the overlap
_WHAT = "delay between two streams"
_LEAST_CORRELATION = 0.7
_CUTOFFS = (0.5, 0.25, 0.12, 0.06, 0.03)
_CURVED = 0.05  # share of a speed that gain and offset must leave; less, and the motion was one of constant speed
_EXACT = 1e-6  # share of a stream's variance below which a misfit is rounding and the smoothing's
_RIVAL = 1.5  # a delay elsewhere whose squared misfit is within this factor explains the motion as well


@dataclass(frozen=True, slots=True)
class DelayFit:
    """``delay`` [s] of the second stream behind the first, 1 ``sigma`` [s], ``gain`` and ``offset`` of second by first.

    Add ``delay`` to a stamp of the first to have the stamp that the second gives the same instant. ``correlation`` at
    that delay is over ``n`` samples and ``overlap`` [s].
    """

    delay: float
    sigma: float
    gain: float
    offset: float
    correlation: float
    n: int
    overlap: float


def fresh(stamps_ns: ArrayLike, values: ArrayLike) -> tuple[NDArray[np.int64], Array]:
    """Samples whose value differs from the one before, and the last of each rest.

    A stream that is polled faster than its source renews itself repeats each value: a stair that looks late by half a
    step. Its first sample of each value is the one that was new. A rest is more than twice the usual repeats.
    """
    stamps, y = np.asarray(stamps_ns, np.int64), np.asarray(values, float)
    new = np.concatenate(([True], y[1:] != y[:-1]))
    starts = np.flatnonzero(new)
    repeats = np.diff(starts, append=len(y))
    rests = repeats > 2 * np.median(repeats)
    keep = new.copy()
    keep[(starts + repeats - 1)[rests]] = True
    return stamps[keep], y[keep]


def fit_delay(
    first_ns: ArrayLike,
    first: ArrayLike,
    second_ns: ArrayLike,
    second: ArrayLike,
    *,
    max_delay: float = 1.0,
    gain_sign: int = 0,
) -> DelayFit:
    """Delay of the second stream behind the first, looked for within ±``max_delay`` [s].

    Stamps (n,) [ns] with values (n,), in any order. ``gain_sign``: second rises where first does (1), or falls (−1), or
    nobody knows (0). Raises FitError for numbers that are not finite, streams that do not overlap, a stream without
    motion, motions that have nothing in common, one of constant speed, and a periodic one that fits at several delays.
    """
    a, b = _stream("first", first_ns, first), _stream("second", second_ns, second)
    origin = min(int(a[0][0]), int(b[0][0]))
    (ta, ya), (tb, yb) = ((np.asarray((t - origin) * 1e-9, np.float64), y) for t, y in (a, b))
    # the denser stream is made a curve, the other's samples are compared with it
    swapped = float(np.median(np.diff(tb))) < float(np.median(np.diff(ta)))
    curve_t, curve_y, t, y = (tb, yb, ta, ya) if swapped else (ta, ya, tb, yb)
    comparison = _Comparison(curve_t, curve_y, t, y)
    side = -1.0 if swapped else 1.0

    step = float(min(np.median(np.diff(t)), max_delay / 20)) / 2
    delays = np.arange(-max_delay, max_delay + step / 2, step)
    score = np.array([comparison.score(side * d, gain_sign) for d in delays])
    if not np.isfinite(score).any():
        raise FitError(
            _WHAT,
            f"streams that overlap by {MIN_SAMPLES} samples or more within ±{max_delay:g} s",
            f"first from 0 to {ta[-1] - ta[0]:.3g} s, second from {tb[0] - ta[0]:.3g} to {tb[-1] - ta[0]:.3g} s",
            "Record both while the same motion runs.",
        )
    score = np.where(np.isfinite(score), score, -1.0)
    best = float(delays[int(np.argmax(score))])
    comparison = _smoothed(comparison, (curve_t, curve_y, t, y), side * best)
    found, spread, gain, offset, misfit = comparison.refined(side * best)
    rho = comparison.correlation(found)
    if abs(rho) < _LEAST_CORRELATION or (gain_sign and np.sign(rho) != gain_sign):
        raise FitError(
            _WHAT,
            "streams that show the same motion",
            f"a correlation of {rho:.2f} at best, at {side * found * 1e3:.0f} ms",
            "Choose signals that follow one another, and move more.",
        )
    _alone(comparison, delays, score, side, (found, misfit), gain_sign)
    if not spread < max_delay / 3 or abs(found) > max_delay + 2 * step:
        raise FitError(
            _WHAT,
            f"a motion that fixes it within ±{max_delay:g} s",
            f"{side * found:.3g} ± {spread:.2g} s",
            "Move faster, to and fro.",
        )
    inside = comparison.inside(found)
    if swapped:  # y = gain · curve + offset holds with first and second exchanged
        gain, offset = 1 / gain, -offset / gain
    return DelayFit(side * found, spread, gain, offset, rho, int(inside.sum()), float(np.ptp(t[inside])))


def _stream(name: str, stamps_ns: ArrayLike, values: ArrayLike) -> tuple[NDArray[np.int64], Array]:
    stamps, y = np.asarray(stamps_ns), np.asarray(values, float)
    if stamps.shape != y.shape or stamps.ndim != 1:
        raise FitError(_WHAT, "a stamp for each value", f"{name}: {stamps.shape} and {y.shape}", "Correct the stream.")
    if not (np.isfinite(stamps).all() and np.isfinite(y).all()):
        bad = int(np.sum(~np.isfinite(y)))
        raise FitError(_WHAT, "finite numbers", f"{name}: {bad} values that are not", "Leave those readings out.")
    stamps, order = np.unique(stamps.astype(np.int64), return_index=True)
    y = y[order]
    if len(y) < MIN_SAMPLES:
        raise FitError(_WHAT, f"{MIN_SAMPLES} samples or more", f"{name}: {len(y)}", "Record for longer.")
    # the noise is in second differences; what is larger than it is motion
    noise = float(np.median(np.abs(np.diff(y, 2)))) / (0.6745 * np.sqrt(6))
    if not float(np.std(y)) > max(1.5 * noise, 1e-12 * float(np.abs(y).max())):
        raise FitError(_WHAT, "motion in both streams", f"{name}: nothing beyond its noise", "Move while recording.")
    return stamps, y


class _Comparison:
    """Samples (t, y) against a curve through the other stream: y(t) ≈ gain · curve(t − delay) + offset.

    The curve is smoothed to ``cutoff`` of half its Nyquist frequency: through the samples themselves it would be
    quieter between them than at them, which draws the delay to half a sample, and its slope would be noise.
    """

    def __init__(self, curve_t: Array, curve_y: Array, t: Array, y: Array, cutoff: float = 1.0):
        scale = float(np.std(curve_y))
        # The spline is the filter 1 / (1 + λ h ω⁴), which has no phase.
        h = float(np.median(np.diff(curve_t)))
        lam = (2 * h / np.pi / cutoff) ** 4 / h
        self.curve: BSpline = make_smoothing_spline(curve_t, (curve_y - curve_y.mean()) / scale, lam=lam)
        self.slope = self.curve.derivative()
        self.scale, self.mean = scale, float(curve_y.mean())
        self.begin, self.end = float(curve_t[0]), float(curve_t[-1])
        self.knots, self.at_knots = curve_t, self.curve(curve_t)
        self.t, self.y = t, y

    def inside(self, delay: float) -> NDArray[np.bool_]:
        return (self.t - delay >= self.begin) & (self.t - delay <= self.end)

    def correlation(self, delay: float) -> float:
        inside = self.inside(delay)
        if inside.sum() < MIN_SAMPLES:
            return float("nan")
        x, y = np.interp(self.t[inside] - delay, self.knots, self.at_knots), self.y[inside]
        x, y = x - x.mean(), y - y.mean()
        size = float(np.sqrt((x @ x) * (y @ y)))
        return float(x @ y) / size if size > 0 else 0.0

    def score(self, delay: float, gain_sign: int) -> float:
        rho = self.correlation(delay)
        return rho * gain_sign if gain_sign else abs(rho)

    def refined(self, delay: float) -> tuple[float, float, float, float, float]:
        """Delay, its sigma, gain, offset and the mean squared misfit, by Gauss–Newton."""
        for _ in range(30):
            x, residual, beyond, gain = self._linear(delay)
            size = float(beyond @ beyond)
            if size < (_CURVED * gain) ** 2 * float(np.sum(self.slope(self.t[self.inside(delay)] - delay) ** 2)):
                raise FitError(
                    _WHAT,
                    "a motion that speeds up, slows down or turns",
                    "one of constant speed, of which a delay is an offset",
                    "Move to and fro.",
                )
            step = float(beyond @ residual) / size
            delay += step
            if abs(step) < 1e-9 or self.inside(delay).sum() < MIN_SAMPLES:
                break
        if self.inside(delay).sum() < MIN_SAMPLES:
            return delay, np.inf, np.nan, np.nan, np.inf
        x, residual, beyond, gain = self._linear(delay)
        sigma = np.sqrt(_long_run(residual * beyond)) / float(beyond @ beyond)
        offset = float(np.mean(self.y[self.inside(delay)] - gain * x))
        gain_si = gain / self.scale
        return delay, float(sigma), gain_si, offset - gain_si * self.mean, float(np.mean(residual**2))

    def _linear(self, delay: float) -> tuple[Array, Array, Array, float]:
        """Curve values, residuals after gain and offset, the delay's own column beyond those two, and the gain."""
        inside = self.inside(delay)
        at = self.t[inside] - delay
        x, y = self.curve(at), self.y[inside]
        A = np.column_stack((x, np.ones_like(x)))
        (gain, offset), *_ = np.linalg.lstsq(A, y, rcond=None)
        column = -gain * self.slope(at)
        beyond = column - A @ np.linalg.lstsq(A, column, rcond=None)[0]
        return x, y - gain * x - offset, beyond, float(gain)


def _smoothed(comparison: _Comparison, streams: tuple[Array, Array, Array, Array], delay: float) -> _Comparison:
    """The comparison with the curve smoothed as the other stream, whose noise is another, asks for."""
    misfit = comparison.refined(delay)[-1]
    for cutoff in _CUTOFFS:
        smoother = _Comparison(*streams, cutoff)
        found = smoother.refined(delay)[-1]
        if not found < misfit:
            break
        comparison, misfit = smoother, found
    return comparison


def _long_run(scores: Array) -> float:
    """Variance of the sum of a series that is correlated in time (Newey–West, over four correlation lengths)."""
    n = len(scores)
    acf = np.correlate(scores, scores, "full")[n - 1 :]
    if acf[0] <= 0:
        return 0.0
    low = np.flatnonzero(acf < 0.2 * acf[0])
    lags = min(4 * int(low[0]) if low.size else n, n // 3)
    weights = 1 - np.arange(1, lags + 1) / (lags + 1)
    return max(float(acf[0] + 2 * weights @ acf[1 : lags + 1]), float(acf[0]))


def _alone(
    comparison: _Comparison, delays: Array, score: Array, side: float, best: tuple[float, float], gain_sign: int
) -> None:
    """Raises FitError where another maximum of the correlation explains the motion as well as the ``best``."""
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:])) + 1
    for peak in peaks[np.argsort(-score[peaks])][:3]:
        if score[peak] < _LEAST_CORRELATION:
            break
        delay, _, _, _, misfit = comparison.refined(side * float(delays[peak]))
        apart = abs(delay - best[0]) > 4 * (delays[1] - delays[0])
        as_good = misfit < _RIVAL * best[1] + _EXACT * float(np.var(comparison.y))
        if apart and as_good and (not gain_sign or comparison.correlation(delay) * gain_sign > 0):
            raise FitError(
                _WHAT,
                "a motion that fits at one delay only",
                f"a periodic one that fits at {side * best[0] * 1e3:.0f} ms and {side * delay * 1e3:.0f} ms",
                "Move without a period, or give max_delay and gain_sign.",
            )
