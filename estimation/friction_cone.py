"""The likelihood of contact forces under a friction cone: a mixture of slip, stick and outliers (`friction_fit`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logsumexp, ndtr, ndtri

from estimation.errors import FitError
from mechanics.readings import Array

#: below this normal force a ratio is noise [N]
LEAST_NORMAL_FORCE = 1.0
#: how far a tared zero may be off from stroke to stroke [N], and by which factor that itself is not known, 1 sigma
STROKE_ERROR, STROKE_FACTOR = 0.02, 2.0
#: how far the forces' axes may be turned against the contact's, 1 sigma [rad]
TURNED = 0.005
#: offsets of a stroke that its likelihood is integrated over: in their sigmas, and about its peak, in the peak's
_COARSE, _FINE = np.linspace(-3.5, 3.5, 29), np.linspace(-5.0, 5.0, 21)
#: steps by which the peak is found from the best of the coarse offsets
_PEAK_STEPS = 3
#: samples that must slip, and by how much slip must raise the log likelihood
_SLIPPING, _EVIDENCE = 8.0, 6.0
#: an atom this wide, over the noise, is no edge
_WIDEST = 6.0
#: no force is told to better than this [N], however well a stroke's agree: what is systematic in one is not modelled
LEAST_WIDTH = 0.002
#: share of outliers at most: with more, a wrong cone explains anything
MOST_OUTLIERS = 0.1
#: parameters of the likelihood without shares: µ, apex (2), log width of the atom
PARAMETERS = 4


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """A coefficient ``mu`` with ``interval``, its 95 % one, from ``samples`` forces above the least normal force.

    ``slipping`` and ``outliers`` are shares of the samples; ``apex`` (2,) [N] = (f_n, f_t) is where the cone's tip
    lies in the readings; ``sides`` are the signs of f_t on which slip was seen. With one side only, apex and µ are told
    apart by the prior and the spread of f_n alone, and the interval is wider for it. ``noise`` [N] is that of a force
    across the edge, as found.
    """

    mu: float
    interval: tuple[float, float]
    samples: int
    slipping: float
    outliers: float
    apex: Array
    noise: float
    sides: tuple[int, ...]

    @property
    def standard_error(self) -> float:
        """1 sigma of ``mu``."""
        return (self.interval[1] - self.interval[0]) / (2 * 1.959964)


class Cone:
    """The mixture's likelihood of f_t given f_n, for checked samples.

    Parameters, in units in which they move alike: µ, apex f_n, apex f_t, log width over the noise, and for each group
    of samples the logits of its shares that slip and that are outliers.
    """

    #: parameters before the shares
    ahead = PARAMETERS

    def __init__(self, force: Array, fast: NDArray[np.bool_], noise: float, zero_error: float):
        self._force, self._noise, self._zero = force, noise, zero_error
        self._groups = [group for group in (~fast, fast) if group.any()]
        self._span = float(np.abs(force[:, 1]).max()) * 1.05
        first = [0.01, 0.3 * zero_error, 0.3 * zero_error, *[0.2] * (self.ahead - 3)]
        self._unit = np.array([*first, *[0.5] * (2 * len(self._groups))])

    def _densities(self, p: Array, offset: Array | float = 0.0) -> Array:
        """Densities (..., n, 3) [1/N] of |f_t| from the apex: slipping, sticking, neither; ``offset`` (..., n) [N]."""
        width = self._width(p)
        edge = self._slope(p) * np.maximum(self._force[:, 0] - p[1], 0.25 * LEAST_NORMAL_FORCE)
        side = np.abs(self._force[:, 1] - p[2]) - offset
        beyond = (side - edge) / width
        atom = np.exp(-0.5 * beyond**2) / (width * np.sqrt(2 * np.pi))
        within = (ndtr(-beyond) - ndtr(-(side + edge) / width)) / edge
        return np.stack([atom, within, np.full_like(side, 1 / self._span)], axis=-1)

    def _width(self, p: Array) -> float:
        """1 sigma of a force across the edge [N]."""
        return float(np.hypot(np.exp(p[3]) * self._noise * np.sqrt(1 + p[0] ** 2), LEAST_WIDTH))

    def _slope(self, p: Array) -> Array | float:
        """That of the edge on the side of each sample."""
        return p[0]

    def _shares(self, p: Array) -> Array:
        """Shares (n, 3) of the three, by the group of each sample."""
        shares = np.empty((len(self._force), 3))
        for k, group in enumerate(self._groups):
            slip, out = expit(p[self.ahead + 2 * k : self.ahead + 2 * k + 2])
            out *= MOST_OUTLIERS
            shares[group] = (1 - out) * slip, (1 - out) * (1 - slip), out
        return shares

    def _joint(self, p: Array) -> Array:
        """Densities times shares (n, 3)."""
        return self._densities(p) * self._shares(p)

    def _log_likelihood(self, p: Array) -> float:
        return float(np.log(np.maximum(self._joint(p).sum(axis=1), 1e-300)).sum())

    def _cost(self, z: Array) -> float:
        p = z * self._unit
        if np.min(self._slope(p)) <= 1e-4 or np.abs(p[3 : self.ahead]).max() > 5:
            return 1e9
        # weak priors keep a share or a width that the samples do not show from running away
        prior = float(np.sum((p[1:3] / self._zero) ** 2) + p[3] ** 2 + np.sum((p[self.ahead :] / 3) ** 2))
        return 0.5 * prior - self._sides(p) - self._log_likelihood(p)

    def _sides(self, p: Array) -> float:
        """Log likelihood of the sides on which the samples lie, each side with its own share.

        Without it an apex that slides along the one edge which a drag to one side shows would cost nothing.
        """
        up = ndtr((self._force[:, 1] - p[2]) / self._noise).sum()
        counts = np.array([up, len(self._force) - up])
        return float(np.sum(counts * np.log(np.maximum(counts, 1e-9) / len(self._force))))

    def starts(self) -> list[Array]:
        """The three best of a grid of coefficients and widths, with the apex at zero, a tenth of a unit apart."""
        ratios = np.abs(self._force[:, 1]) / self._force[:, 0]
        grid = np.unique(np.quantile(ratios, np.linspace(0.2, 1.0, 80)))
        shares = [-0.5, -0.5] * len(self._groups)
        trials = [np.array([mu, 0, 0, wide, *shares]) / self._unit for mu in grid[grid > 1e-3] for wide in (0.0, 1.2)]
        return sorted(trials, key=self._cost)[:3]

    def best(self, starts: list[Array]) -> Array:
        """The parameters with the highest likelihood that the ``starts`` lead to."""
        found = [minimize(self._cost, z, method="L-BFGS-B", options={"maxiter": 200}) for z in starts]
        return min(found, key=lambda one: one.fun).x

    def result(self, z: Array, gain_error: float) -> FrictionFit:
        """The fit at the maximum ``z``, with an interval from the curvature there."""
        p = z * self._unit
        mu = float(p[0])
        of = self._responsibilities(p)
        covariance = np.linalg.pinv(_hessian(self._cost, z, np.full(len(z), 0.05)), hermitian=True)
        variance = covariance[0, 0] * self._unit[0] ** 2 + 2 * (gain_error * mu) ** 2
        half = float(ndtri(0.975)) * float(np.sqrt(max(variance, 0.0)))
        signs = np.sign(self._force[:, 1] - p[2])
        firm = (signs[:, None] == (-1, 1)) & (of[:, :1] > 0.5)
        sides = tuple(side for side, seen in zip((-1, 1), firm.sum(axis=0), strict=True) if seen >= 0.5 * _SLIPPING)
        return FrictionFit(
            mu=mu,
            interval=(mu - half, mu + half),
            samples=len(of),
            slipping=float(of[:, 0].mean()),
            outliers=float(of[:, 2].mean()),
            apex=p[1:3].copy(),
            noise=float(np.exp(p[3])) * self._noise,
            sides=sides,
        )

    def _responsibilities(self, p: Array) -> Array:
        """How likely each sample (n, 3) slips, sticks, or does neither."""
        joint = self._joint(p)
        return joint / np.maximum(joint.sum(axis=1, keepdims=True), 1e-300)

    def check_slip(self, z: Array) -> None:
        """Raise FitError unless the maximum ``z`` shows slip, which explains the samples better than none."""
        p, cost = z * self._unit, self._cost(z)
        of = self._responsibilities(p)
        slipping = float(of[:, 0].sum())
        # the best that sticking and outliers alone can do
        stuck = p.copy()
        stuck[self.ahead :: 2] = -20.0
        fixed = np.zeros(len(p), bool)
        fixed[self.ahead :: 2] = True
        unused = 0.5 * float(np.sum((stuck[fixed] / 3) ** 2))

        def alone(free: Array) -> float:
            z = stuck / self._unit
            z[~fixed] = free
            return self._cost(z) - unused

        ratios = np.abs(self._force[:, 1] - p[2]) / self._force[:, 0]
        starts = [np.array([mu, *stuck[1:]]) for mu in np.quantile(ratios, [0.9, 0.95, 0.99, 1.0])] + [stuck]
        costs = [
            minimize(alone, (start / self._unit)[~fixed], method="L-BFGS-B", options={"maxiter": 60}).fun
            for start in starts
        ]
        if slipping >= _SLIPPING and min(costs) - cost > _EVIDENCE and np.exp(p[3]) < _WIDEST:
            return
        raise FitError(
            "contact forces",
            f"slip: at least {_SLIPPING:g} samples that gather on the cone's edge",
            f"{slipping:.0f} of {len(of)} that could: no slip seen along the tangential axis, µ is at least {p[0]:.3g}",
            "Drag further or faster, or press less, until the contact slides.",
        )


class StrokeCone(Cone):
    """The same, with an offset for every stroke that is integrated out, and axes that are turned.

    The parameters before the shares end with the log of the offsets' size, and the angle [rad]. All strokes share the
    apex. Each has a tare of its own, so what they share of the tares' errors is their mean.
    """

    ahead = PARAMETERS + 2

    def __init__(
        self, force: Array, fast: NDArray[np.bool_], stroke: NDArray[np.intp], noise: float, zero_error: float
    ):
        order = np.argsort(stroke, kind="stable")
        self._stroke = stroke[order]
        self._begins = np.flatnonzero(np.diff(self._stroke, prepend=-1))
        super().__init__(force[order], fast[order], noise, zero_error / np.sqrt(len(self._begins)))
        self._unit[PARAMETERS + 1] = 0.3 * TURNED
        self._side = np.sign(self._force[:, 1])

    def start(self, plain: Cone, found: Array) -> Array:
        """From where the fit without offsets, ``plain``, ended."""
        p = np.insert(found * plain._unit, PARAMETERS, [0.0, 0.0])
        return p / self._unit

    def _slope(self, p: Array) -> Array:
        # the tangent of an angle that is turned changes by 1 + µ² of it
        return p[0] + self._side * (1 + p[0] ** 2) * p[PARAMETERS + 1]

    def _by_offset(self, p: Array, offsets: Array) -> Array:
        """Log density (o, strokes) [1/N] of each stroke and each of its ``offsets`` (o, strokes) [N]."""
        size = STROKE_ERROR * np.exp(p[PARAMETERS])
        joint = np.einsum("osc,sc->os", self._densities(p, offsets[:, self._stroke]), self._shares(p))
        samples = np.add.reduceat(np.log(np.maximum(joint, 1e-300)), self._begins, axis=1)
        return samples - (offsets / size) ** 2 / 2 - np.log(np.sqrt(2 * np.pi)) - np.log(size)

    def _peaks(self, p: Array) -> tuple[Array, Array]:
        """The likeliest offset (strokes,) of each stroke [N], and how wide its peak is, 1 sigma.

        What slips lies on the edge, but for the offset and a sample's own noise: the peak is as narrow as that of their
        mean, which is far narrower than the offsets themselves.
        """
        size = STROKE_ERROR * np.exp(p[PARAMETERS])
        coarse = np.repeat(size * _COARSE[:, None], len(self._begins), axis=1)
        peak = np.take_along_axis(coarse, self._by_offset(p, coarse).argmax(axis=0)[None], axis=0)[0]
        width = self._width(p)
        beyond = np.abs(self._force[:, 1] - p[2]) - self._slope(p) * np.maximum(self._force[:, 0] - p[1], 0.0)
        precision = np.full(len(peak), size**-2)
        for _ in range(_PEAK_STEPS):
            joint = self._densities(p, peak[self._stroke]) * self._shares(p)
            slips = joint[:, 0] / np.maximum(joint.sum(axis=1), 1e-300)
            precision = size**-2 + np.add.reduceat(slips, self._begins) / width**2
            peak = np.add.reduceat(slips * beyond, self._begins) / width**2 / precision
        return peak, precision**-0.5

    def _log_likelihood(self, p: Array) -> float:
        peak, width = self._peaks(p)
        size = STROKE_ERROR * np.exp(p[PARAMETERS])
        coarse = np.repeat(size * _COARSE[:, None], len(peak), axis=1)
        offsets = np.sort(np.concatenate([coarse, peak + width * _FINE[:, None]]), axis=0)
        apart = np.diff(offsets, axis=0, prepend=offsets[:1], append=offsets[-1:])
        weights = 0.5 * (apart[1:] + apart[:-1])  # trapezoids
        marginal = np.asarray(logsumexp(self._by_offset(p, offsets), axis=0, b=weights), float)
        prior = (p[PARAMETERS] / np.log(STROKE_FACTOR)) ** 2 + (p[PARAMETERS + 1] / TURNED) ** 2
        return float(marginal.sum()) - 0.5 * prior

    def _joint(self, p: Array) -> Array:
        return self._densities(p, self._peaks(p)[0][self._stroke]) * self._shares(p)


def _hessian(cost, p: Array, steps: Array) -> Array:
    n = len(p)
    H = np.zeros((n, n))
    e = np.diag(steps)
    for i in range(n):
        for j in range(i, n):
            corners = cost(p + e[i] + e[j]) - cost(p + e[i] - e[j]) - cost(p - e[i] + e[j]) + cost(p - e[i] - e[j])
            H[i, j] = H[j, i] = corners / (4 * steps[i] * steps[j])
    return H
