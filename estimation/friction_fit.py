"""A friction coefficient with its interval from contact forces in random motion (*Friction Model Identification*).

Forces of a contact that slips lie on the cone's edges, |f_t| = µ f_n; those of one that sticks lie anywhere within. The
likelihood of a sample is a mixture of three: an atom on the edge, as wide as the force's noise; a uniform share of the
cone, blurred by the same noise; and a few outliers anywhere. The edge of the mixture is the coefficient, whatever the
share that slips, which neither the largest ratio nor a quantile can say. The cone's apex is a nuisance with a prior: a
zero that is off by 0.1 N is 10 % of the ratio at 1 N. Where forces come in strokes, each after a tare of its own, every
stroke has an offset of its own too, which is integrated out: some readings of one stroke are no independent evidence.
And there the axes may be turned a little: what that adds to the ratio on one side it takes on the other, whatever the
forces of either.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from estimation.errors import FitError, finite_rows
from estimation.friction_cone import LEAST_NORMAL_FORCE, PARAMETERS, Cone, FrictionFit, StrokeCone
from mechanics.readings import Array

#: noise that is assumed of a force [N], averaged over a few readings
FORCE_NOISE = 0.02
#: how far a tared zero may be off, 1 sigma [N]
ZERO_ERROR = 0.1
#: calibration error of each force axis, relative, 1 sigma: it scales the ratio and no sample shows it
GAIN_ERROR = 0.005


def fit_friction(
    force: ArrayLike,
    *,
    force_noise: float = FORCE_NOISE,
    slip_speed: ArrayLike | None = None,
    slip_speed_noise: float = 0.002,
    zero_error: float = ZERO_ERROR,
    gain_error: float = GAIN_ERROR,
    strokes: ArrayLike | None = None,
) -> FrictionFit:
    """The coefficient from ``force`` (n, 2) = (f_n, f_t) [N] of one contact in random motion.

    ``force_noise`` is 1 sigma of one component. Samples should be at least as far apart as the noise is correlated.
    ``slip_speed`` (n,) [m/s], where known, parts the samples at three times its noise, and each part gets shares of its
    own. ``zero_error`` [N] and ``gain_error`` (relative) are 1 sigma of what a tare and the sensor's calibration leave.
    ``strokes`` (n,) numbers the stroke of each sample; each has a tare, and so an offset, of its own.
    Raises FitError for NaN, too few samples, no normal or no tangential force, or when no slip is seen.
    """
    values = finite_rows("contact forces", force, (2,), ("f_n", "f_t"))
    if force_noise <= 0:
        raise FitError("force_noise", "a positive number [N]", f"{force_noise:g}", "Take the sensor's noise.")
    fast = _fast(slip_speed, slip_speed_noise, len(values))
    stroke = _numbered(strokes, len(values))
    pressed = values[:, 0] > LEAST_NORMAL_FORCE
    if not pressed.any():
        raise FitError(
            "contact forces",
            f"a normal force f_n above {LEAST_NORMAL_FORCE:g} N",
            f"at most {values[:, 0].max(initial=0.0):.3g} N: the normal axis is not excited",
            "Press harder, and check the sign: f_n > 0 pushes.",
        )
    least = 3 * PARAMETERS
    if pressed.sum() < least:
        raise FitError(
            "contact forces",
            f"at least {least} above {LEAST_NORMAL_FORCE:g} N",
            f"{int(pressed.sum())} of {len(values)}",
            "Record longer, or press harder.",
        )
    values, fast, stroke = values[pressed], fast[pressed], stroke[pressed]
    if np.percentile(np.abs(values[:, 1]), 95) < 3 * max(force_noise, zero_error / 3):
        raise FitError(
            "contact forces",
            "tangential forces f_t above their noise",
            f"95 % below {np.percentile(np.abs(values[:, 1]), 95):.2g} N: the tangential axis is not excited",
            "Drag the object along the surface, do not only press it.",
        )
    plain = Cone(values, fast, force_noise, zero_error)
    found = plain.best(plain.starts())
    plain.check_slip(found)
    if strokes is None:
        return plain.result(found, gain_error)
    by_stroke = StrokeCone(values, fast, stroke, force_noise, zero_error)
    return by_stroke.result(by_stroke.best([by_stroke.start(plain, found)]), gain_error)


def _fast(slip_speed: ArrayLike | None, noise: float, n: int) -> NDArray[np.bool_]:
    if slip_speed is None:
        return np.zeros(n, bool)
    speed = finite_rows("slip speed", np.asarray(slip_speed, float)[:, None], (1,))[:, 0]
    if len(speed) != n:
        raise FitError(
            "slip speed", f"one for each of {n} forces", f"{len(speed)}", "Resample it to the force's times."
        )
    return np.abs(speed) > 3 * noise


def _numbered(strokes: ArrayLike | None, n: int) -> NDArray[np.intp]:
    if strokes is None:
        return np.zeros(n, np.intp)
    numbers = np.asarray(strokes)
    if numbers.shape != (n,):
        raise FitError("strokes", f"one number for each of {n} forces", f"shape {numbers.shape}", "Number each force.")
    return np.unique(numbers, return_inverse=True)[1]


def baselines(force: ArrayLike) -> dict[str, float]:
    """What simpler methods say, by name: the largest ratio, the steepest edge of the convex hull, the 95 % quantile.

    The hull is the cone through the apex that the hull of the mirrored samples supports.
    """
    values = finite_rows("contact forces", force, (2,), ("f_n", "f_t"))
    values = values[values[:, 0] > LEAST_NORMAL_FORCE]
    ratio = np.abs(values[:, 1]) / values[:, 0]
    return {"maximum": float(ratio.max()), "hull": _hull(values), "quantile": float(np.quantile(ratio, 0.95))}


def _hull(values: Array) -> float:
    """Half the opening of the hull's upper edge: least squares slope of its vertices against f_n."""
    folded = np.column_stack([values[:, 0], np.abs(values[:, 1])])
    try:
        corners = folded[ConvexHull(np.vstack([folded, [0.0, 0.0]])).vertices[:-1] % len(folded)]
    except QhullError:
        corners = folded
    upper = corners[corners[:, 1] / corners[:, 0] >= np.quantile(folded[:, 1] / folded[:, 0], 0.9)]
    return float(upper[:, 0] @ upper[:, 1] / (upper[:, 0] @ upper[:, 0]))


def sliding_forces(
    force: ArrayLike, times: ArrayLike, position: ArrayLike, position_times: ArrayLike, faster_than: float = 0.02
) -> Array:
    """The forces (m, k) of ``force`` (n, k) at ``times`` (n,) [s] while a point is faster than ``faster_than`` [m/s].

    ``position`` (m, 2) [m] at ``position_times`` (m,) [s] may have another rate; its speed is taken over 50 ms, so that
    the noise of a position does not count as motion. Raises FitError for NaN, or where the two do not overlap.
    """
    readings = np.asarray(force, float)
    readings = finite_rows("forces", readings, readings.shape[1:])
    at = finite_rows("times of the forces", np.asarray(times, float)[:, None], (1,))[:, 0]
    points = finite_rows("positions", position, (2,), ("x", "y"))
    t = finite_rows("times of the positions", np.asarray(position_times, float)[:, None], (1,))[:, 0]
    half = 0.025
    inside = (at > t[0] + half) & (at < t[-1] - half)
    if not inside.any():
        raise FitError("times", "forces and positions that overlap", "none that do", "Check the clocks.")
    ends = [
        np.stack([np.interp(at[inside] + shift, t, points[:, k]) for k in range(2)], axis=-1) for shift in (-half, half)
    ]
    speed = np.linalg.norm(ends[1] - ends[0], axis=-1) / (2 * half)
    return readings[inside][speed > faster_than]
