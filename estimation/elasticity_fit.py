"""The stiffness of a finger from pairs of displacement and wrench (*Tactile Elasticity Characterization*).

Four methods for the linear law stand side by side, and one of them goes beyond it:

* ``torch``: the paper's, K = LᵀL by gradient, normalised and started from the closed form;
* ``least_squares``: the closed form of the same thing; both take displacements as exact and so come out too soft;
* ``inverse_regression``: x = C w in closed form, right where the displacements' noise outweighs the wrenches';
* ``errors_in_variables``: maximum likelihood with noise in both, Σ rᵀ (Σ_w + J Σ_x Jᵀ)⁻¹ r with J = ∂w/∂x. It adds
  stiffening, hysteresis and creep where the residuals ask for them (F test), the last two from the recorded path.

All of them find the frame in which zero wrench is zero displacement, which is what gocf is: an unknown offset of the
object in the fingers, or a constant bias of the wrench, is a nuisance and leaves K as it is.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from estimation.elasticity_methods import Samples, inverse_regression, least_squares, torch_descent
from estimation.errors import FitError, finite_rows
from estimation.finger_law import ElasticityFit, Memory, entries_of
from estimation.finger_likelihood import maximum_likelihood
from estimation.finger_memory import Path, size
from mechanics import se2
from mechanics.readings import Array
from mechanics.wrench import about, rotated

Method = Literal["errors_in_variables", "inverse_regression", "least_squares", "torch"]
METHODS: tuple[Method, ...] = get_args(Method)
AXES = ("x", "y", "θ")
WRENCH_AXES = ("fx", "fy", "τ")

#: noise that is assumed of a displacement [m, m, rad]: a tag seen by a calibrated camera, a few frames averaged
POSE_NOISE = (1.5e-4, 1.5e-4, np.radians(0.15))
#: and of a wrench [N, N, N·m]: an ATI Gamma on a 200 mm lever, averaged over 20 readings, with some drift
WRENCH_NOISE = (0.05, 0.05, 0.005)
#: calibration error of each axis of the sensor, relative, 1 sigma: it scales K, and no sample shows it
GAIN_ERROR = 0.005
#: an axis is excited where samples spread by so many times their noise
EXCITED = 3.0
_FRAMES = 3


def fit_elasticity(
    x: ArrayLike,
    w: ArrayLike,
    *,
    x_covariance: ArrayLike | None = None,
    w_covariance: ArrayLike | None = None,
    method: Method = "errors_in_variables",
    stiffening: bool | None = None,
    times: ArrayLike | None = None,
    path: Path | None = None,
    holds: ArrayLike | None = None,
    drift_order: int = 0,
    gain_error: float = GAIN_ERROR,
    pose_noise_from_residuals: bool = False,
) -> ElasticityFit:
    """Identify the finger from ``x`` (n, 3), the displacement of ee in gocf, and ``w`` (n, 3), its wrench on the go.

    Both in gocf, the wrench about its origin; the zero of x need not be known. Covariances (3, 3) are those of one
    sample. ``stiffening``: True, False, or None to let an F test decide. With the ``path`` from the grasp on and the
    ``times`` (n,) [s] of the samples, hysteresis and creep are tested for and taken out too, and ``drift_order`` > 0
    lets the wrench's zero wander as such a polynomial. Samples with one number in ``holds`` (n,) are readings of the
    wrench at different times of one hold, whose displacement is the mean of theirs and has ``x_covariance``: what they
    differ by is creep, free of the pose's noise. ``gain_error`` (relative) widens the covariance.
    ``pose_noise_from_residuals``: ``x_covariance`` is only where one begins, the maximum-likelihood fit is weighted by
    the variances that its own residuals show. All but the first method are linear.
    Raises FitError for NaN, fewer samples than unknowns, axes that the samples do not excite (it names them), wrenches
    that are zero, or a stiffness that is not positive definite.
    """
    if method not in METHODS:
        raise FitError("method", f"one of {', '.join(METHODS)}", f"'{method}'", "Choose one of these.")
    if method != "errors_in_variables" and (stiffening or path is not None or drift_order):
        raise FitError(
            "method",
            "errors_in_variables with stiffening, path or drift",
            f"'{method}'",
            "Only it goes beyond w = K x.",
        )
    samples = _samples(x, w, x_covariance, w_covariance, times, path, holds, drift_order)
    _check_excited(samples)
    # here already: a wrong sign or frame would lead the rest astray
    _check_definite(least_squares(samples)[0])
    nominal, offset, K = samples, np.zeros(3), np.eye(3)
    for _ in range(_FRAMES):
        K, intercept = _linear(samples, method)
        offset = se2.compose(offset, -np.linalg.solve(K, intercept))
        samples = _seen_from(nominal, offset)
    if method == "errors_in_variables":
        found = maximum_likelihood(samples, K, stiffening)
        # the rest of the offset is below a hundredth of a millimetre: once more settles it, and once more the weights,
        # since the residuals of a fit with wrong ones are too large
        for _ in range(2 if pose_noise_from_residuals else 1):
            offset = se2.compose(offset, found.offset)
            samples = _seen_from(nominal, offset)
            if pose_noise_from_residuals:
                samples = samples.replaced(x_covariance=found.x_covariance)
            found = maximum_likelihood(samples, found.stiffness, found.terms)
        K, a, covariance, memory = found.stiffness, found.stiffening, found.covariance, found.memory
        residual, chi2, lever = found.residual, found.chi2, found.lever
    else:
        K, intercept = _linear(samples, method)
        a, memory, lever = 0.0, Memory(), np.zeros(2)
        covariance = np.zeros((7, 7))
        residual = samples.w - samples.x @ K - intercept
        S = samples.w_covariance + K @ samples.x_covariance @ K
        freedom = residual.size - 9
        chi2 = float(np.einsum("ni,ij,nj->", residual, np.linalg.inv(S), residual)) / freedom
        covariance[:6, :6] = _linear_covariance(samples, K, residual)
    covariance[range(6), range(6)] += (gain_error * entries_of(K)) ** 2
    _check_definite(K)
    return ElasticityFit(
        stiffness=K,
        stiffening=a,
        covariance=covariance,
        offset=offset,
        lever=lever,
        residual_rms=np.sqrt(np.mean(residual**2, axis=0)),
        chi2=chi2,
        samples=len(samples.x),
        reach=float(size(K, samples.x).max()),
        method=method,
        memory=memory,
    )


def _samples(
    x: ArrayLike,
    w: ArrayLike,
    x_covariance: ArrayLike | None,
    w_covariance: ArrayLike | None,
    times: ArrayLike | None,
    path: Path | None,
    holds: ArrayLike | None,
    drift_order: int,
) -> Samples:
    displacements = finite_rows("displacements", x, (3,), AXES)
    wrenches = finite_rows("wrenches", w, (3,), WRENCH_AXES)
    n = len(displacements)
    if len(wrenches) != n:
        raise FitError("wrenches", f"one for each of {n} displacements", f"{len(wrenches)}", "Pair them by time.")
    if (path is not None or drift_order) and times is None:
        raise FitError("times of the samples", "times with a path or a drift", "none", "Pass the samples' times.")
    instants = None
    if times is not None:
        instants = finite_rows("times of the samples", np.asarray(times, float)[:, None], (1,))[:, 0]
        if len(instants) != n:
            raise FitError("times of the samples", f"{n}", f"{len(instants)}", "Pass one per sample.")
    # K, offset, lever, stiffening; hysteresis and creep with a length and a time; three polynomials
    unknowns = 6 + 3 + 2 + 1 + (4 if path is not None else 0) + 3 * drift_order
    if n < unknowns:
        raise FitError(
            "samples", f"at least as many as unknowns ({unknowns})", f"{n}", "Take more; the paper takes 200."
        )
    hold = np.arange(n)
    if holds is not None:
        labels = finite_rows("holds", np.asarray(holds, float)[:, None], (1,))[:, 0]
        if len(labels) != n:
            raise FitError("holds", f"{n}", f"{len(labels)}", "Pass the number of its hold for each sample.")
        hold = np.unique(labels, return_inverse=True)[1]
        count = np.bincount(hold)
        displacements = np.stack([np.bincount(hold, displacements[:, k]) / count for k in range(3)], axis=-1)[hold]
    through, vertices = None, None
    if path is not None:
        assert instants is not None
        through, vertices = path.through(instants)
    return Samples(
        x=displacements,
        w=wrenches,
        x_covariance=_covariance("covariance of the displacements", x_covariance, POSE_NOISE),
        w_covariance=_covariance("covariance of the wrenches", w_covariance, WRENCH_NOISE),
        hold=hold,
        path=through,
        vertices=vertices,
        drift=_polynomials(instants, drift_order, n),
    )


def _polynomials(instants: Array | None, order: int, n: int) -> Array:
    if instants is None or order == 0:
        return np.zeros((n, 0))
    span = np.ptp(instants) or 1.0
    scaled = 2 * (instants - instants.min()) / span - 1
    return np.polynomial.legendre.legvander(scaled, order)[:, 1:]


def _covariance(what: str, given: ArrayLike | None, default: tuple[float, float, float]) -> Array:
    if given is None:
        return np.diag(default) ** 2
    cov = finite_rows(what, np.asarray(given, float)[None], (3, 3))[0]
    if np.linalg.eigvalsh(0.5 * (cov + cov.T))[0] <= 0:
        raise FitError(what, "a positive definite (3, 3)", f"{cov.tolist()}", "Give every axis a noise above zero.")
    return 0.5 * (cov + cov.T)


def _check_excited(samples: Samples) -> None:
    noise = np.sqrt(np.diag(samples.w_covariance))
    spread = np.ptp(samples.w, axis=0)
    if (np.abs(samples.w) <= EXCITED * noise).all() or (spread <= EXCITED * noise).all():
        raise FitError(
            "wrenches",
            f"forces that vary by more than the noise ({noise[0]:.2g} N)",
            f"spreads of {spread[0]:.2g} N, {spread[1]:.2g} N, {spread[2]:.2g} N·m",
            "Check that the fingers hold the object, that it is fixed, and that the sensor streams.",
        )
    centred = samples.x - samples.x.mean(axis=0)
    root = np.linalg.cholesky(samples.x_covariance)
    values, vectors = np.linalg.eigh(np.cov(np.linalg.solve(root, centred.T)))
    flat = np.sqrt(np.maximum(values, 0.0)) < EXCITED
    if not flat.any():
        return
    # a direction of whitened displacements, back in metres and radians over the noise of each axis
    directions = vectors[:, flat]
    share = np.sqrt((directions**2).sum(axis=1))
    still = [AXES[k] for k in range(3) if share[k] > 0.5]
    moved = [AXES[k] for k in range(3) if AXES[k] not in still]
    only = f"motion along {' and '.join(moved)} only" if moved else "no motion that exceeds the noise"
    verb = "is not excited on its own" if len(still) == 1 else "are not excited on their own"
    raise FitError(
        "displacements",
        f"motion along x, y and θ, independent and {EXCITED:g} times the noise",
        f"{only}: {', '.join(still)} {verb}",
        f"Move along {' and '.join(still)} as well: ±3 mm and ±4° are enough.",
    )


def _check_definite(K: Array) -> None:
    values, vectors = np.linalg.eigh(K / np.sqrt(np.outer(np.abs(np.diag(K)), np.abs(np.diag(K)))))
    if values[0] > 0:
        return
    axis = int(np.argmax(np.abs(vectors[:, 0])))
    every = " in every direction: is w the wrench of the sensor on the object, not its negative?"
    raise FitError(
        "stiffness",
        "a positive definite K: fingers push back",
        f"one that pulls, mostly along {AXES[axis]} (diagonal {np.diag(K).round(2).tolist()})",
        "Check the signs" + (every if values[-1] <= 0 else ", the frame of the wrench and the lever of its torque."),
    )


def _linear(samples: Samples, method: Method) -> tuple[Array, Array]:
    if method == "least_squares":
        return least_squares(samples)
    if method == "torch":
        return torch_descent(samples)
    return inverse_regression(samples)


def _linear_covariance(samples: Samples, K: Array, residual: Array) -> Array:
    """Covariance (6, 6) of K's entries by the residuals' own size, for a regression with an intercept."""
    n = len(residual)
    root = np.linalg.cholesky(residual.T @ residual / (n - 3))
    centred = samples.x - samples.x.mean(axis=0)
    design = np.linalg.solve(root, Samples.design(centred))
    return np.linalg.inv(np.einsum("nij,nik->jk", design, design))


def _seen_from(samples: Samples, offset: Array) -> Samples:
    """The samples in the frame at ``offset`` (3,) in theirs: displacements, wrenches about its origin, the path."""
    moved = about(samples.w, np.zeros(2), offset[:2])
    return samples.replaced(
        x=se2.between(np.broadcast_to(offset, samples.x.shape), samples.x),
        w=rotated(moved, -offset[2]),
        path=None if samples.path is None else samples.path.seen_from(offset),
    )
