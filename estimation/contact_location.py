"""Where the grasped object is touched, from the environment's wrench on it.

*Tactile State-Estimation*, the contact program: enumerate points of the outline, solve the friction-cone QP at each
(`cone_projection`, closed form), refine the best of every face continuously. A single wrench can have several
explanations on an outline that is not convex, or near a corner: all of them are answered, with their weights, and the
status says that they are several. `contact_filter` chooses among them over time.

Everything is in the go's frame; the force is of the environment on the go.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from estimation.cone_projection import fit_sites, square_root
from estimation.contact_sites import Sites, Surface, sites
from estimation.contact_wrench import EnvironmentWrench
from mechanics.polygon import Polygon
from mechanics.readings import Array


class ContactStatus(StrEnum):
    """Whether the contact's place is known, and if not, why not."""

    OK = "ok"
    #: the force is too small to say where it acts, or there is none
    NO_WRENCH = "no_wrench"
    #: several places, or a long stretch of a face, explain the wrench
    AMBIGUOUS = "ambiguous"
    #: no point contact on this outline explains the wrench: several contacts, a bias, a wrong friction or outline
    UNEXPLAINED = "unexplained"
    #: nothing of the surroundings is near enough to touch
    OUT_OF_REACH = "out_of_reach"
    #: the wrench or its information is no number
    INVALID = "invalid"


@dataclass(frozen=True, eq=False)
class ContactHypothesis:
    """One explanation of a wrench: a ``point`` (2,) [m] on a ``face`` or at a ``vertex`` (the other is None).

    ``force`` (2,) [N] on the go; ``chi2`` of the wrench alone; ``weight`` among the hypotheses kept, the prior
    included. ``deviation`` [m] is the standard deviation along the face, whose direction is ``along`` (2,); at a
    vertex it is zero, and the doubt whether it is this vertex is in the weights.
    """

    point: Array
    face: int | None
    vertex: int | None
    force: Array
    chi2: float
    weight: float
    deviation: float
    along: Array

    @property
    def covariance(self) -> Array:
        """Of the point's error (2, 2) [m²]: it lies on the outline, so there is none across the face."""
        return self.deviation**2 * np.outer(self.along, self.along)


@dataclass(frozen=True, eq=False)
class ContactEstimate:
    """``hypotheses`` that explain the wrench, the most likely first, and whether they can be acted on.

    There are none with a status other than OK and AMBIGUOUS. ``reason`` says what was expected and what came.
    """

    status: ContactStatus
    reason: str = ""
    hypotheses: tuple[ContactHypothesis, ...] = ()

    @property
    def contact(self) -> ContactHypothesis | None:
        """The contact, where it is known; None with any status but OK."""
        return self.hypotheses[0] if self.status is ContactStatus.OK else None


@dataclass(frozen=True, eq=False)
class ContactPrior:
    """Where the contact is believed to be: ``point`` (2,) [m] in go, ``deviation`` [m] in either direction."""

    point: Array
    deviation: float


@dataclass(frozen=True, eq=False)
class Gates:
    """What a wrench and its explanations must be to be believed."""

    #: a wrench with less force says nothing [N]
    force: float = 1.0
    #: χ² beyond which a point contact does not explain it: 99 % of three degrees of freedom
    chi2: float = 11.3
    #: hypotheses farther apart than this are different answers, and a stretch longer than this (1 σ) is none [m]
    apart: float = 0.005
    #: weight below which a rival is no rival
    rival: float = 0.01


@dataclass(frozen=True, eq=False)
class ContactLocator:
    """Finds the contact on an ``outline`` (in the go's frame) under Coulomb friction ``mu``.

    ``spacing`` [m] of the candidates: they bracket the answer, which is then refined. A vertex within ``near`` [m]
    of a surface is touched by that surface. ``only_near`` keeps to what the surroundings can reach: for a scene that
    is known in full. A µ that is too small costs millimetres, one that is too large next to nothing: round up.
    """

    outline: Polygon
    mu: float
    spacing: float = 0.001
    near: float = 0.01
    only_near: bool = False
    gates: Gates = Gates()

    def __post_init__(self) -> None:
        for name in ("mu", "spacing", "near"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0 and (value > 0 or name == "mu")):
                raise ValueError(f"ContactLocator: {name}: expected a finite number > 0, received {value}")

    def locate(
        self,
        measured: EnvironmentWrench,
        surroundings: Sequence[Surface] | None = None,
        prior: ContactPrior | None = None,
    ) -> ContactEstimate:
        """The contact behind one wrench (3,). Never raises for what a sensor may say: that is a status."""
        return self.locate_each(measured, surroundings, prior)[0]

    def locate_each(
        self,
        measured: EnvironmentWrench,
        surroundings: Sequence[Surface] | None = None,
        prior: ContactPrior | None = None,
    ) -> list[ContactEstimate]:
        """`locate` for each of the wrenches (n, 3) of ``measured``, whose information is common or (n, 3, 3)."""
        where = self.sites(surroundings)
        wrench = np.atleast_2d(measured.wrench)
        information = np.broadcast_to(measured.information, (len(wrench), 3, 3))
        said = [self.refusal(w, H, where) for w, H in zip(wrench, information, strict=True)]
        fits = np.empty((len(wrench), len(where), 6))
        good = np.array([one is None for one in said])
        if good.any():
            shared = measured.information.ndim == 2
            fits[good] = self.fits(where, wrench[good], information[:1] if shared else information[good],
                                   measured.about, prior)  # fmt: skip
        return [one or self._judged(where, fits[i], prior) for i, one in enumerate(said)]

    def sites(self, surroundings: Sequence[Surface] | None = None) -> Sites:
        """Where the go can be touched in these surroundings (None: nothing is known of them)."""
        if surroundings is None and not self.only_near:
            return self._alone
        return sites(self.outline, self.mu, self.spacing, self.near, surroundings, self.only_near)

    @cached_property
    def _alone(self) -> Sites:
        return sites(self.outline, self.mu, self.spacing, self.near, None, only_near=False)

    def fits(
        self, where: Sites, wrench: Array, information: Array, about: ArrayLike, prior: ContactPrior | None = None
    ) -> Array:
        """The best point of every site for each ``wrench`` (n, 3): (n, S, 6) as `cone_projection.fit_sites` has it."""
        believed = np.zeros(3) if prior is None else np.array([*prior.point, prior.deviation**-2])
        out = np.empty((len(wrench), len(where), 6))
        roots = square_root(information).reshape(-1, 3, 3)
        fit_sites(where.start, where.along, where.length, where.count, where.rays, np.ascontiguousarray(wrench),
                  roots, np.ascontiguousarray(about, float), believed, out)  # fmt: skip
        return out

    def refusal(self, wrench: Array, information: Array, where: Sites) -> ContactEstimate | None:
        """The answer to a wrench (3,) that nothing can be said of; None to any other."""
        if not (np.isfinite(wrench).all() and np.isfinite(information).all()):
            return ContactEstimate(ContactStatus.INVALID, f"the wrench is {wrench.tolist()}; expected finite numbers")
        force = observed_force(wrench, information, self.gates.force)
        if force <= self.gates.force:
            return self.no_wrench(force)
        if not len(where):
            reason = f"a force of {force:.2g} N, and no surface within {self.near * 1e3:g} mm of the object"
            return ContactEstimate(ContactStatus.OUT_OF_REACH, reason)
        return None

    def _judged(self, where: Sites, fit: Array, prior: ContactPrior | None) -> ContactEstimate:
        """The hypotheses behind the fits (S, 6) of one wrench."""
        chi2, cost = fit[:, 1], fit[:, 1] + fit[:, 2]
        explains = np.flatnonzero(chi2 <= self.gates.chi2)
        if not explains.size:
            return self.unexplained(chi2.min())
        least = cost[explains].min()
        kept = explains[cost[explains] <= least + self.gates.chi2]
        kept = kept[np.argsort(cost[kept], kind="stable")]
        kept = kept[np.sort(np.unique(where.group[kept], return_index=True)[1])]  # one hypothesis a face
        weights = np.exp(-(cost[kept] - least) / 2)
        weights /= weights.sum()
        believed = 0.0 if prior is None else prior.deviation**-2
        out = [
            self.hypothesis(
                where, int(k), fit[k, 0], fit[k, 3:5], fit[k, 1], w, spread(where, int(k), fit[k, 5] + believed)
            )
            for k, w in zip(kept, weights, strict=True)
        ]
        return judge(out, self.gates)

    def no_wrench(self, force: float) -> ContactEstimate:
        """The answer to a ``force`` [N] that is too small."""
        reason = f"a force of {force:.2g} N is observed; more than {self.gates.force:g} N is needed"
        return ContactEstimate(ContactStatus.NO_WRENCH, reason)

    def unexplained(self, chi2: float) -> ContactEstimate:
        """The answer where the best contact leaves ``chi2``."""
        reason = f"the best point contact leaves χ² = {chi2:.3g}, more than {self.gates.chi2:g}"
        return ContactEstimate(ContactStatus.UNEXPLAINED, reason)

    def hypothesis(
        self, where: Sites, site: int, s: float, force: Array, chi2: float, weight: float, deviation: float
    ) -> ContactHypothesis:
        """The hypothesis of a contact at distance ``s`` [m] along a site."""
        n, group = len(self.outline), int(where.group[site])
        return ContactHypothesis(
            where.start[site] + s * where.along[site],
            group if group < n else None,
            group - n if group >= n else None,
            force.copy(),
            float(chi2),
            float(weight),
            deviation,
            where.along[site],
        )


def judge(hypotheses: Sequence[ContactHypothesis], gates: Gates) -> ContactEstimate:
    """OK where the hypotheses, the most likely first, are one answer; AMBIGUOUS where they are not."""
    best, kept = hypotheses[0], tuple(hypotheses)
    for other in kept[1:]:
        apart = float(np.linalg.norm(other.point - best.point))
        if other.weight > gates.rival and apart > gates.apart:
            reason = f"{place(best)} and {place(other)}, {apart * 1e3:.1f} mm apart, both explain the wrench"
            return ContactEstimate(ContactStatus.AMBIGUOUS, reason, kept)
    if best.deviation > gates.apart:
        reason = f"{place(best)}, and where on it is known to {best.deviation * 1e3:.1f} mm only"
        return ContactEstimate(ContactStatus.AMBIGUOUS, reason, kept)
    return ContactEstimate(ContactStatus.OK, place(best), kept)


def place(hypothesis: ContactHypothesis) -> str:
    """The face or the vertex, as a reason names it."""
    return f"face {hypothesis.face}" if hypothesis.vertex is None else f"vertex {hypothesis.vertex}"


def spread(where: Sites, site: int, information: float) -> float:
    """Standard deviation [m] of a distance along a site from its ``information`` [1/m²].

    A contact that may be anywhere on a stretch has the deviation of a uniform one, and none has more.
    """
    most = float(where.length[site] / np.sqrt(12))
    return min(most, float(information**-0.5)) if information > 0 else most


def observed_force(wrench: Array, information: Array, within: float) -> float:
    """The size [N] of the force along the directions that are known to better than ``within`` [N].

    The torque is marginalised out: what is known of the force is not more than that.
    """
    H = information[:2, :2]
    if information[2, 2] > 0:
        H = H - np.outer(information[:2, 2], information[2, :2]) / information[2, 2]
    values, vectors = np.linalg.eigh(H)
    return float(np.linalg.norm((wrench[:2] @ vectors)[values >= within**-2]))
