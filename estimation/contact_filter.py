"""The Contact Particle Filter: where the contact is, from the wrenches of many instants.

After Manuelli and Tedrake's filter, which the paper uses. Particles live on the outline. They walk along it and now and
then jump anywhere; the wrench weighs each by the residual of its friction-cone program (`cone_projection`). While a
wrench is ambiguous, the particles of all its explanations live on; motion, or a turn of the force, decides.

Both the steps and the jumps are proposed toward where the newest wrench says, and weighed as if they had been drawn
blindly: importance sampling. A contact that does jump is found at once with a few hundred particles, and rivals that
explain every wrench equally well keep their shares, which blind steps would trade at random.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from estimation.cone_projection import chi2_on, project, square_root
from estimation.contact_location import ContactEstimate, ContactHypothesis, ContactLocator, judge
from estimation.contact_sites import Sites, Surface, corners
from estimation.contact_wrench import EnvironmentWrench
from mechanics.readings import Array

#: clusters with less of the weight are not answered
_NEGLIGIBLE = 1e-3
#: and with less than this are given up
_EXTINCT = 1e-9
#: the share of the particles that jump
_JUMPING = 0.1
_GOLDEN = 0.6180339887498949


class ContactFilter:
    """Follows one contact on the outline of ``locator``; the same ``rng`` gives the same answers.

    ``walk`` [m/√s] is how far the contact slides along the outline, ``jumps`` [1/s] how often it is suddenly
    elsewhere. ``memory`` [s] is how long evidence between rival faces lasts: a walk or a noise that is a little off
    favours one of two equal rivals a little at every instant, and must not add up to certainty.
    """

    def __init__(
        self,
        locator: ContactLocator,
        rng: np.random.Generator,
        *,
        particles: int = 500,
        walk: float = 0.003,
        jumps: float = 0.2,
        memory: float = 2.0,
    ) -> None:
        if not (particles >= 20 and walk >= 0 and jumps > 0 and memory > 0):
            raise ValueError(
                "ContactFilter: expected particles ≥ 20, walk ≥ 0, jumps > 0, memory > 0, received "
                f"{particles}, {walk}, {jumps}, {memory}"
            )
        self.locator, self._rng = locator, rng
        self._walk, self._jumps, self._memory = walk, jumps, memory
        outline = locator.outline
        edges = np.linalg.norm(np.roll(outline.vertices, -1, axis=0) - outline.vertices, axis=1)
        self._ends: Array = np.cumsum(edges, dtype=np.float64)  # arc length at the end of every face
        self._begins: Array = self._ends - edges
        self._corners = corners(outline)
        self._stay = particles - max(1, round(_JUMPING * particles))
        self._blank = True  # nothing is known yet
        self._arc = self._ends[-1] * (np.arange(particles) + rng.uniform(size=particles)) / particles
        self._weights = np.full(particles, 1 / particles)

    def update(
        self, dt: float, measured: EnvironmentWrench | None, surroundings: Sequence[Surface] | None = None
    ) -> ContactEstimate:
        """The contact after ``dt`` [s] and one more wrench (3,), or none (None: only time passes).

        A wrench that says nothing, that no contact explains or that is no number moves no weight: the particles
        spread, and the status says why. Raises ValueError for a ``dt`` that is negative or no number.
        """
        if not (np.isfinite(dt) and dt >= 0):
            raise ValueError(f"ContactFilter.update: dt: expected seconds ≥ 0, received {dt}")
        if measured is None:
            self._pass(dt)
            return self.locator.no_wrench(0.0)
        where = self.locator.sites(surroundings)
        refused = self.locator.refusal(measured.wrench, measured.information, where)
        if refused is not None:
            self._pass(dt)
            return refused
        fit = self.locator.fits(where, measured.wrench[None], measured.information, measured.about)[0]
        if fit[:, 1].min() > self.locator.gates.chi2:
            self._pass(dt)
            return self.locator.unexplained(fit[:, 1].min())
        root = square_root(measured.information)
        self._weigh(dt, measured, where, root, fit)
        return judge(self._clusters(measured, where, root), self.locator.gates)

    def _pass(self, dt: float) -> None:
        """Time without a wrench: walk, and jump to anywhere."""
        n = len(self._arc)
        kept, weights = self._resampled(n, dt)
        kept = (kept + self._walk * np.sqrt(dt) * self._rng.standard_normal(n)) % self._ends[-1]
        jump = self._rng.uniform(size=n) < -np.expm1(-self._jumps * dt)
        arc = np.where(jump, self._rng.uniform(size=n) * self._ends[-1], kept)
        order = np.argsort(arc, kind="stable")
        self._arc, self._weights = arc[order], weights[order]

    def _weigh(self, dt: float, measured: EnvironmentWrench, where: Sites, root: Array, fit: Array) -> None:
        """Resample, move, and weigh: most by walking, some by jumping where this wrench points."""
        n, stay = len(self._arc), 0 if self._blank else self._stay
        jump = 1.0 if self._blank else -np.expm1(-self._jumps * dt)
        self._blank = False
        kept, weights = self._resampled(stay, dt)
        walked, log_ratio = self._walked(kept, dt, where, fit)

        site, s, stretch = where.samples()
        group, s = where.group[site], where.offset[site] + s
        stretch = np.where(where.length[site] > 0, stretch, self.locator.spacing)  # what a vertex draws to itself
        at_sample = self._chi2(measured, where, root, group, s)
        # half the exponent of the likelihood: a broader proposal, whose tails cover those of what it stands for
        lowest = at_sample.min()
        density = np.exp(-(at_sample - lowest) / 4)
        total = float(density @ stretch)
        chosen = systematic(density * stretch / total, n - stay, self._rng)
        offset = (self._spread(n - stay) - 0.5) * stretch[chosen]
        is_face = group[chosen] < len(self._ends)
        jumped = self._arc_of(group[chosen], s[chosen] + np.where(is_face, offset, 0.0))

        arc = np.concatenate([walked, jumped])
        chi2 = self._chi2(measured, where, root, *self._place(arc))
        with np.errstate(divide="ignore"):  # no time, no jump
            log_weight = -chi2 / 2 + np.concatenate(
                [
                    np.log((1 - jump) * weights) + log_ratio,
                    np.log(jump / (n - stay) * total / stretch.sum() / density[chosen]),
                ]
            )
        best = log_weight.max()
        if not np.isfinite(best):  # nothing is where this wrench is, and no time has passed to jump there: start anew
            arc, log_weight, best = np.resize(jumped, n), np.zeros(n), 0.0
        weights = np.exp(log_weight - best)
        order = np.argsort(arc, kind="stable")
        self._arc, self._weights = arc[order], weights[order] / weights.sum()

    def _resampled(self, n: int, dt: float) -> tuple[Array, Array]:
        """``n`` particles (arc lengths, in order) and their weights, face by face.

        Every face keeps its weight exactly, and a rival of little weight enough particles to be followed: plain
        resampling would trade shares at random until one rival has it all.
        """
        group, _ = self._place(self._arc)
        of = np.unique(group, return_inverse=True)[1]
        share = np.bincount(of, weights=self._weights)
        alive = np.flatnonzero(share > _EXTINCT)
        share = share ** np.exp(-dt / self._memory)
        share /= share[alive].sum()
        counts = np.floor(n * (share[alive] + 1 / len(alive)) / 2).astype(int)
        counts[share[alive].argmax()] += n - counts.sum()
        arcs, weights = [], []
        for g, count in zip(alive, counts, strict=True):
            own = np.flatnonzero(of == g)
            arcs.append(self._arc[own[systematic(self._weights[own], count, self._rng)]])
            weights.append(np.full(count, share[g] / max(count, 1)))
        arc, weight = np.concatenate(arcs), np.concatenate(weights)
        order = np.argsort(arc, kind="stable")
        return arc[order], weight[order] / weight.sum()

    def _walked(self, arc: Array, dt: float, where: Sites, fit: Array) -> tuple[Array, Array]:
        """A step of every particle, and the logarithm of how much likelier the walk makes it than its proposal.

        On a face the wrench alone says where the contact is, about as a Gaussian does (``fit``): its product with
        the walk's Gaussian, of twice the variance for what is not Gaussian near a corner, is the proposal.
        """
        walk = self._walk**2 * dt
        if walk == 0:
            return arc, np.zeros(len(arc))
        group, s = self._place(arc)
        pull, aim = np.zeros(2 * len(self._ends)), np.zeros(2 * len(self._ends))
        for k in np.argsort(-fit[:, 1], kind="stable"):  # the best site of a group comes last and stays
            if where.length[k] > 0:
                pull[where.group[k]], aim[where.group[k]] = fit[k, 5], where.offset[k] + fit[k, 0]
        pull, toward = pull[group], aim[group] - s
        variance = 1 / (1 / walk + pull)
        middle = variance * pull * toward
        variance = np.where(pull > 0, 2 * variance, walk)
        step = middle + np.sqrt(variance) * np.asarray(ndtri(self._spread(len(arc))), np.float64)
        ratio = ((step - middle) ** 2 / variance - step**2 / walk + np.log(variance / walk)) / 2
        return np.mod(arc + step, self._ends[-1]), ratio

    def _spread(self, n: int) -> Array:
        """``n`` numbers in (0, 1), evenly spread over any run of neighbours: a golden lattice with a random offset.

        The particles stand in the order of the outline, so that equal stretches of it get equal steps (sequential
        quasi-Monte Carlo, Gerber and Chopin 2015): with independent steps rivals would trade their shares at random.
        """
        lattice = np.arange(n, dtype=np.float64) * _GOLDEN
        return np.clip(np.mod(lattice + self._rng.uniform(), 1.0), 1e-12, 1 - 1e-12)

    def _place(self, arc: Array) -> tuple[NDArray[np.int64], Array]:
        """Face or vertex (N,) of arc lengths, and the distance along it; near a corner the contact is the corner."""
        face = np.minimum(np.searchsorted(self._ends, arc, side="right"), len(self._ends) - 1)
        s = arc - self._begins[face]
        snap = self.locator.spacing / 2
        nearest = np.where(self._ends[face] - arc < s, (face + 1) % len(self._ends), face)
        at_corner = (np.minimum(s, self._ends[face] - arc) < snap) & self._corners[nearest]
        return np.where(at_corner, nearest + len(self._ends), face), np.where(at_corner, 0.0, s)

    def _arc_of(self, group: NDArray[np.int64], s: Array) -> Array:
        return (self._begins[group % len(self._ends)] + s) % self._ends[-1]

    @staticmethod
    def _chi2(measured: EnvironmentWrench, where: Sites, root: Array, group: NDArray[np.int64], s: Array) -> Array:
        out = np.empty(len(group))
        wrench, about = np.ascontiguousarray(measured.wrench), np.ascontiguousarray(measured.about)
        chi2_on(where.start, where.along, where.offset, where.length, where.group, where.rays, wrench, root, about,
                group, s, out)  # fmt: skip
        return out

    def _clusters(self, measured: EnvironmentWrench, where: Sites, root: Array) -> list[ContactHypothesis]:
        """One hypothesis a face or vertex that holds weight, the heaviest first."""
        group, s = self._place(self._arc)
        out = []
        for g in np.unique(group):
            of = group == g
            weight = float(self._weights[of].sum())
            if weight < _NEGLIGIBLE:
                continue
            middle = float(self._weights[of] @ s[of]) / weight
            deviation = float(np.sqrt(self._weights[of] @ (s[of] - middle) ** 2 / weight))
            sites = np.flatnonzero(where.group == g)
            beyond = np.maximum(
                np.abs(middle - where.offset[sites] - where.length[sites] / 2) - where.length[sites] / 2, 0
            )
            sites = sites[beyond <= beyond.min() + 1e-9]
            along = np.clip(middle - where.offset[sites], 0.0, where.length[sites])
            points = where.start[sites] + along[:, None] * where.along[sites]
            force, chi2 = project(points, where.rays[sites], measured.wrench, root, measured.about)
            k = int(chi2.argmin())
            out.append(self.locator.hypothesis(where, int(sites[k]), along[k], force[k], chi2[k], weight, deviation))
        return sorted(out, key=lambda hypothesis: -hypothesis.weight)


def systematic(weights: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``n`` indices drawn by systematic resampling from ``weights``: one random offset for all."""
    edges = np.cumsum(weights)
    return np.minimum(np.searchsorted(edges / edges[-1], (np.arange(n) + rng.uniform()) / n), len(weights) - 1)
