"""Maximum likelihood of the finger's law with noise in displacements and wrenches alike.

With r the residual of a sample and J = ∂w/∂x, the likelihood over the unknown true displacements is
Σ rᵀ (Σ_w + J Σ_x Jᵀ)⁻¹ r: errors in variables with known covariances, exact for a linear law. The weights depend on K,
and are differentiated with it: held fixed they would bring back the bias of least squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.special import fdtrc

from estimation.elasticity_methods import Samples
from estimation.errors import FitError
from estimation.finger_law import ENTRIES, Memory, symmetric
from estimation.finger_memory import size
from mechanics.readings import Array

#: a term stays where chance alone would ask for it this often
SIGNIFICANCE = 0.01
#: 1 sigma of the point about which the torque is known [m]: gains off by half a percent, and a lever, at 200 to 400 mm
LEVER_ERROR = 0.002
#: by how much the displacements' variances may differ from what was given
NOISE_RANGE = 100.0
#: parameters without terms: six of K, three of the offset, two of the lever
BASE = 11
#: the law's terms beyond K, in the order in which they are asked for
STIFFENING, HYSTERESIS, CREEP = "stiffening", "hysteresis", "creep"


@dataclass(frozen=True, eq=False)
class Found:
    """The maximum: as in `ElasticityFit`, with ``terms`` that were asked for and the ``residual`` (n, 3) wrenches.

    ``x_covariance`` (3, 3) of a hold's displacement is what the residuals ask for, not what the fit was weighted by.
    """

    stiffness: Array
    stiffening: float
    memory: Memory
    offset: Array
    lever: Array
    covariance: Array
    residual: Array
    chi2: float
    terms: tuple[str, ...]
    x_covariance: Array


def maximum_likelihood(samples: Samples, start: Array, terms: bool | tuple[str, ...] | None) -> Found:
    """The law that makes the samples most likely, from the stiffness ``start`` (3, 3).

    ``terms``: the law's terms as a tuple; or whether it stiffens, where None leaves that to an F test, as hysteresis
    and creep are left to it wherever there is a path.
    """
    likelihood = _Likelihood(samples, start)
    if isinstance(terms, tuple):
        return likelihood.found(*likelihood.maximum(terms))
    kept: tuple[str, ...] = (STIFFENING,) if terms else ()
    candidates = [] if terms is not None else [STIFFENING]
    candidates += [CREEP, HYSTERESIS] if samples.path is not None else []
    p, cost = likelihood.maximum(kept)[1:]
    while candidates:
        tried = {term: likelihood.maximum((*kept, term), p_of=(kept, p)) for term in candidates}
        best = min(tried, key=lambda term: tried[term][2])
        _, q, lower = tried[best]
        added, freedom = len(q) - len(p), samples.w.size - len(q) - 3 * samples.drift.shape[1]
        ratio = (cost - lower) / added / (lower / freedom)
        if ratio <= 0 or fdtrc(added, freedom, ratio) > SIGNIFICANCE:
            break
        kept, p, cost = (*kept, best), q, lower
        candidates.remove(best)
    return likelihood.found(kept, p, cost)


class _Likelihood:
    """The parameters are pure numbers of about one: K over the start's, lengths over the samples' own spread."""

    def __init__(self, samples: Samples, start: Array):
        if np.linalg.eigvalsh(start)[0] <= 0:
            diagonal = np.abs(np.diag(start))
            start = np.diag(np.where(diagonal > 0, diagonal, 1.0))
        self._samples, self._start = samples, start
        self._unit_K = np.sqrt(np.outer(np.diag(start), np.diag(start)))
        self._unit_x = samples.x.std(axis=0)
        self._inverse_w = np.linalg.inv(np.linalg.cholesky(samples.w_covariance))
        self._nuisances = 3 * samples.drift.shape[1]
        self._unit_s = float(np.sqrt(np.mean(size(start, samples.x) ** 2)))
        span = samples.path.times[[0, -1]] if samples.path is not None else np.array([0.0, 1.0])
        self._unit_t = float(span[1] - span[0]) / max(len(samples.x), 1)

    def maximum(
        self, terms: tuple[str, ...], p_of: tuple[tuple[str, ...], Array] | None = None
    ) -> tuple[tuple[str, ...], Array, float]:
        """The terms, the best parameters, and the cost Σ r² there."""
        starts = [self._first(terms, p_of, scale) for scale in ((1.0, 4.0, 20.0) if terms[-1:] == (CREEP,) else (1.0,))]
        best = None
        for first in starts:
            lower, upper = self._bounds(terms, len(first))
            found = least_squares(
                self._whitened, first, bounds=(lower, upper), args=(terms,), x_scale="jac", ftol=1e-6, max_nfev=60
            )
            if best is None or found.cost < best.cost:
                best = found
        assert best is not None
        return terms, best.x, 2 * float(best.cost)

    def _first(self, terms: tuple[str, ...], p_of: tuple[tuple[str, ...], Array] | None, scale: float) -> Array:
        known: dict[str, Array] = {}
        base = np.concatenate([(self._start / self._unit_K)[tuple(np.transpose(ENTRIES))], np.zeros(BASE - 6)])
        if p_of is not None:
            old, p = p_of
            base = p[:BASE]
            known = self._by_term(old, p)
        # hysteresis: force over K s and log yield length over s; creep: share and log time over a sample's
        default = {STIFFENING: (0.05,), HYSTERESIS: (0.05, np.log(0.2)), CREEP: (0.05, np.log(scale))}
        extra = [known[term] if term in known else np.array(default[term]) for term in terms]
        return np.concatenate([base, *extra])

    def _bounds(self, terms: tuple[str, ...], n: int) -> tuple[Array, Array]:
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
        at = BASE
        for term in terms:
            lower[at], upper[at] = 0.0, 2.0
            if term == HYSTERESIS:
                lower[at + 1], upper[at + 1] = np.log(0.03), np.log(1.0)
            if term == CREEP:
                lower[at + 1], upper[at + 1] = np.log(0.1), np.log(0.5 * len(self._samples.x))
            at += _width(term)
        return lower, upper

    @staticmethod
    def _by_term(terms: tuple[str, ...], p: Array) -> dict[str, Array]:
        values, at = {}, BASE
        for term in terms:
            values[term] = p[at : at + _width(term)]
            at += _width(term)
        return values

    def law(self, terms: tuple[str, ...], p: Array) -> tuple[Array, Array, float, Memory]:
        """K, offset, stiffening and memory of parameters."""
        K = symmetric(p[:6]) * self._unit_K
        values = self._by_term(terms, p)
        a = float(values[STIFFENING][0]) / self._unit_s if STIFFENING in values else 0.0
        h = length = c = time = 0.0
        if HYSTERESIS in values:
            length = float(np.exp(values[HYSTERESIS][1])) * self._unit_s
            h = float(values[HYSTERESIS][0]) * self._unit_s / length
        if CREEP in values:
            c, time = float(values[CREEP][0]), float(np.exp(values[CREEP][1])) * self._unit_t
        return K, p[6:9] * self._unit_x, a, Memory(h, length, c, time)

    def residual(self, terms: tuple[str, ...], p: Array) -> tuple[Array, Array]:
        """Wrenches (n, 3) that the law does not explain, and ∂w/∂x (n, 3, 3), or one (1, 3, 3) for all."""
        samples = self._samples
        K, offset, a, memory = self.law(terms, p)
        x = samples.x - offset
        s = size(K, x)
        q = (1 + a * s)[:, None] * x
        if memory.hysteresis or memory.creep:
            assert samples.path is not None and samples.vertices is not None
            zeta, u = samples.path.states(K, memory.yield_length or self._unit_s, memory.creep_time or 1.0)
            q = q + memory.hysteresis * memory.yield_length * zeta[samples.vertices]
            # of the path alone, so that this term takes no sides in what is noise of a sample and what is not
            q = q + memory.creep * (samples.path.x - u)[samples.vertices]
        f = q @ K
        r = samples.w - f
        # K is symmetric: what makes its measured image asymmetric is a torque that is known about another point
        r[:, 2] -= f[:, :2] @ p[9:BASE] * LEVER_ERROR
        J = K[None]
        if a:
            pull = x @ K
            bend = a * 2 / (K[0, 0] + K[1, 1]) / np.maximum(s, 1e-12)
            J = J + (a * s)[:, None, None] * K + bend[:, None, None] * pull[:, :, None] * pull[:, None, :]
        return r, J

    def displacement_noise(self, terms: tuple[str, ...], p: Array) -> Array:
        """The covariance (3, 3) of displacements, diagonal, that makes what the law leaves in the holds most likely.

        r̄ ~ N(0, Σ_w / n + J diag(v) Jᵀ) in each hold, over v within `NOISE_RANGE` of the given variances. A law that is
        a little wrong counts as noise, as it should: its weight falls with it.
        """
        samples = self._samples
        r, J = self.residual(terms, p)
        given = np.diag(samples.x_covariance)

        def unlikely(log_share: Array) -> float:
            white, root = self._white(r, J, np.diag(given * np.exp(log_share)))
            logdet = 2 * np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum() * (len(samples.count) / len(root))
            return float(white @ white + logdet)

        most = np.log(NOISE_RANGE)
        found = minimize(unlikely, np.zeros(3), method="L-BFGS-B", bounds=[(-most, most)] * 3)
        return np.diag(given * np.exp(found.x))

    def _whitened(self, p: Array, terms: tuple[str, ...]) -> Array:
        """Pure numbers (holds · 3 + n · 3 + 2,) whose squares add up to the cost; last, the lever's prior."""
        r, J = self.residual(terms, p)
        return np.concatenate([self._white(r, J, self._samples.x_covariance)[0], p[9:BASE]])

    def _white(self, r: Array, J: Array, x_covariance: Array) -> tuple[Array, Array]:
        """Residuals as pure numbers (holds · 3 + n · 3,), and the Cholesky factors of the holds' covariances.

        The readings of a hold share its displacement and the noise of that: their mean carries it, and what they differ
        by does not. Without this, a creep of a tenth of a newton would be looked for under a pose's noise.
        """
        samples = self._samples
        mean, away = samples.split(r)
        J = J[samples.first] if len(J) > 1 else J
        S = samples.w_covariance / samples.count[:, None, None] + J @ x_covariance @ J.swapaxes(-1, -2)
        root = np.asarray(np.linalg.cholesky(S), float)
        inverse_mean, inverse_w = np.linalg.inv(root), self._inverse_w
        white = np.concatenate([np.einsum("gij,gj->gi", inverse_mean, mean).ravel(), (away @ inverse_w.T).ravel()])
        if samples.drift.shape[1]:
            # the wandering zero is linear: taken out by projection, whatever its size
            mean_of, away_of = samples.split(samples.drift)
            basis = np.concatenate(
                [
                    np.einsum("gij,gk->gikj", inverse_mean, mean_of).reshape(mean.size, -1),
                    np.einsum("ij,nk->nikj", inverse_w, away_of).reshape(away.size, -1),
                ]
            )
            white = white - basis @ np.linalg.solve(basis.T @ basis, basis.T @ white)
        return white, root

    def found(self, terms: tuple[str, ...], p: Array, cost: float) -> Found:
        """The value of a maximum, with a covariance that is right also where the noise is not what was given."""
        K, offset, a, memory = self.law(terms, p)
        samples, m = self._samples, len(p)
        freedom = samples.w.size - m - self._nuisances
        white = self._whitened(p, terms)
        scores = self._scores(terms, p)
        information = scores.T @ scores
        free = np.array([j for j in range(m) if not self._at_bound(terms, p, j)])
        if np.linalg.cond(information[np.ix_(free, free)]) > 1e14:
            raise FitError(
                "displacements",
                "samples that tell the law's terms apart",
                f"a singular information matrix for {', '.join(('K', *terms))}",
                "Vary amplitude and direction, or ask for fewer terms.",
            )
        inverse = np.linalg.inv(information[np.ix_(free, free)])
        per_hold = samples.by_hold((scores * white[:, None])[:-2])[:, free]
        # White's sandwich, hold by hold: what a wrong law leaves in one counts as it is, not as the noise it was given
        spread = inverse @ (per_hold.T @ per_hold) @ inverse * (samples.w.size / freedom)
        whole = np.zeros((m, m))
        whole[np.ix_(free, free)] = spread
        unit = np.array([self._unit_K[i, j] for i, j in ENTRIES])
        keep = [*range(6)]
        scale = np.append(unit, 1.0 / self._unit_s)
        covariance = np.zeros((7, 7))
        if STIFFENING in terms:
            # stiffening stands where its term does
            at = BASE + sum(_width(term) for term in terms[: terms.index(STIFFENING)])
            keep = [*keep, at]
        size_of = len(keep)
        covariance[:size_of, :size_of] = whole[np.ix_(keep, keep)] * np.outer(scale[:size_of], scale[:size_of])
        r, _ = self.residual(terms, p)
        noise = self.displacement_noise(terms, p)
        return Found(K, a, memory, offset, p[9:BASE] * LEVER_ERROR, covariance, r, cost / freedom, terms, noise)

    def _scores(self, terms: tuple[str, ...], p: Array) -> Array:
        step = 1e-6
        lower, upper = self._bounds(terms, len(p))
        columns = []
        for j in range(len(p)):
            up, down = p.copy(), p.copy()
            up[j], down[j] = min(p[j] + step, upper[j]), max(p[j] - step, lower[j])
            columns.append((self._whitened(up, terms) - self._whitened(down, terms)) / (up[j] - down[j]))
        return np.stack(columns, axis=-1)

    def _at_bound(self, terms: tuple[str, ...], p: Array, j: int) -> bool:
        lower, upper = self._bounds(terms, len(p))
        return bool(p[j] - lower[j] < 1e-8 or upper[j] - p[j] < 1e-8)


def _width(term: str) -> int:
    return 1 if term == STIFFENING else 2
