"""Where the object really lies in the fingers: what every tactile image, tag and prior says of it, joined over time.

The fingers' elasticity says how the object moves in them under a wrench, so what has to be estimated is constant but
for what the elasticity misses: the *grasp* q = x ∘ X_ee_go ∘ X_go_gocf (3,), x = K⁻¹w in gocf, which is the identity
where the object lies as planned. Every measurement of X_ee_go is one of q, whatever wrench acted then:

    X_ee_go = x⁻¹ ∘ q ∘ X_go_gocf⁻¹.

Errors of X_ee_go are left perturbations Δ about ee's origin (`tactile_pose`); those of q are the same to first order,
x being small. A Kalman filter in the information form: what an image does not show stays as the others have it.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri

from estimation.tactile_pose import GraspPrior, left_difference, left_moved
from mechanics import se2
from mechanics.readings import Array


@dataclass(frozen=True)
class GraspNoise:
    """What the filter believes of its grasp.

    ``prior`` (3,) 1 sigma of how the object lies in a fresh grasp [m, m, rad]. ``compliance`` is the share of x by
    which elasticity may be wrong (hysteresis, creep, K itself). ``walk`` (3,) 1 sigma per √s. ``floor`` (3,): what
    the measurements share and no number of them averages out. ``gate``: the probability at which a measurement that
    disagrees is a slip, and not chance.
    """

    prior: tuple[float, float, float] = (0.003, 0.003, np.radians(4.0))
    compliance: float = 0.1
    walk: tuple[float, float, float] = (2e-5, 2e-5, np.radians(0.02))
    floor: tuple[float, float, float] = (1e-4, 1e-4, np.radians(0.1))
    gate: float = 1e-5


@dataclass(frozen=True, eq=False)
class _Measured:
    """One measurement of q: mean ``d`` (3,) as Δ from the identity, ``information`` (3, 3), under a displacement."""

    capture_ns: int
    d: Array
    information: Array
    x: Array


@dataclass(frozen=True, eq=False)
class _Belief:
    """Mean Δ (3,) of q from the identity and its covariance, at an instant and a displacement."""

    capture_ns: int
    mean: Array
    covariance: Array
    x: Array
    suspicion: int = 0
    slips: int = 0


@dataclass
class GraspFilter:
    """The belief about one grasp. ``X_go_gocf`` (3,) is where it should be, ``noise`` what may differ.

    Measurements may come late and in any order: those of the last ``memory`` [s] are kept and gone through again, so
    that the belief does not hang on the order of arrival. Older ones are refused by `measure`.
    """

    X_go_gocf: Array
    noise: GraspNoise = field(default_factory=GraspNoise)
    memory: float = 1.0
    _before: _Belief | None = None  # the belief before the oldest kept measurement
    _kept: list[_Measured] = field(default_factory=list)
    _beliefs: list[_Belief] = field(default_factory=list)  # after each of them

    def predicted(self, capture_ns: int, x: Array) -> GraspPrior:
        """X_ee_go at an instant under the displacement ``x`` (3,), before an image of it is read."""
        belief = self._at(capture_ns, x)
        return GraspPrior(self._pose(belief.mean, x), belief.covariance + np.diag(self.noise.floor) ** 2)

    def measure(self, capture_ns: int, x: Array, pose: Array, information: Array) -> bool:
        """Take in X_ee_go = ``pose`` (3,), of ``information`` (3, 3) about Δ, measured under the displacement ``x``.

        Directions without information are not looked at. False: it is older than what is remembered.
        """
        if self._before is not None and capture_ns < self._before.capture_ns:
            return False
        q = se2.compose(se2.compose(x, pose), self.X_go_gocf)
        measured = _Measured(capture_ns, left_difference(q, np.zeros(3)), information, np.asarray(x, float))
        at = bisect_right([m.capture_ns for m in self._kept], capture_ns)
        self._kept.insert(at, measured)
        del self._beliefs[at:]
        for later in self._kept[at:]:
            self._beliefs.append(self._updated(later))
        self._forget()
        return True

    def measured_through(self, capture_ns: int, x: Array, prior: GraspPrior, pose: Array, information: Array) -> bool:
        """`measure` with a ``pose`` that is a posterior: of an image of ``information`` under this ``prior``."""
        posterior = left_difference(pose, prior.pose)
        values, vectors = np.linalg.eigh(_scaled(information))
        kept = values > 1e-9 * max(values.max(), 1.0)
        if not kept.any():
            return True
        inverse = _unscaled((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)
        alone = inverse @ (prior.information + information) @ posterior
        return self.measure(capture_ns, x, left_moved(prior.pose, alone), information)

    @property
    def slips(self) -> int:
        """How often the object has moved in the fingers by what no elasticity explains, since the fresh grasp."""
        last = self._beliefs[-1] if self._beliefs else self._before
        return 0 if last is None else last.slips

    def reset(self) -> None:
        """A fresh grasp."""
        self._before, self._kept, self._beliefs = None, [], []

    # -- the filter --------------------------------------------------------------------------------------------------

    def _pose(self, mean: Array, x: Array) -> Array:
        q = left_moved(np.zeros(3), mean)
        return se2.compose(se2.compose(se2.inverse(x), q), se2.inverse(self.X_go_gocf))

    def _start(self, capture_ns: int, x: Array) -> _Belief:
        return _Belief(capture_ns, np.zeros(3), np.diag(self.noise.prior) ** 2, np.asarray(x, float))

    def _at(self, capture_ns: int, x: Array) -> _Belief:
        """The belief at an instant: after the measurements before it, grown by time and displacement since."""
        at = bisect_right([m.capture_ns for m in self._kept], capture_ns)
        last = self._beliefs[at - 1] if at else self._before
        return self._start(capture_ns, x) if last is None else self._grown(last, capture_ns, x)

    def _grown(self, last: _Belief, capture_ns: int, x: Array) -> _Belief:
        seconds = max(0.0, (capture_ns - last.capture_ns) * 1e-9)
        moved = np.abs(np.asarray(x, float) - last.x) * self.noise.compliance
        growth = np.diag(np.square(self.noise.walk) * seconds + np.square(moved))
        return replace(last, capture_ns=capture_ns, covariance=last.covariance + growth, x=np.asarray(x, float))

    def _updated(self, measured: _Measured) -> _Belief:
        """One Kalman step from the belief after the measurement before (the list's last)."""
        last = self._beliefs[-1] if self._beliefs else self._before
        start = self._start(measured.capture_ns, measured.x)
        before = start if last is None else self._grown(last, measured.capture_ns, measured.x)
        suspicion = before.suspicion + 1 if last is not None and self._disagrees(before, measured) else 0
        if suspicion == 1:  # once may be chance: wait for the next to say it again
            return replace(before, suspicion=1)
        if suspicion > 1:
            before = replace(before, covariance=before.covariance + start.covariance, slips=before.slips + 1)
        precision = np.linalg.inv(before.covariance) + measured.information
        covariance = np.linalg.inv(precision)
        mean = before.mean + covariance @ measured.information @ (measured.d - before.mean)
        return replace(before, mean=mean, covariance=0.5 * (covariance + covariance.T), suspicion=0)

    def _disagrees(self, before: _Belief, measured: _Measured) -> bool:
        # (P + I⁻¹)⁻¹ = I − I (P⁻¹ + I)⁻¹ I holds for a singular I too
        off, information = measured.d - before.mean, measured.information
        joint = np.linalg.inv(before.covariance + np.diag(self.noise.floor) ** 2) + information
        weight = information - information @ np.linalg.solve(joint, information)
        seen = int((np.linalg.eigvalsh(_scaled(information)) > 1.0).sum())
        return bool(off @ weight @ off > chdtri(max(seen, 1), self.noise.gate))

    def _forget(self) -> None:
        horizon = self._kept[-1].capture_ns - round(self.memory * 1e9)
        while len(self._kept) > 1 and self._kept[0].capture_ns < horizon:
            self._kept.pop(0)
            self._before = self._beliefs.pop(0)


_SCALE = np.array([1.0, 1.0, 1 / 0.03])


def _scaled(information: Array) -> Array:
    return _SCALE[:, None] * information * _SCALE * 1e-4  # in units of (10 mm)⁻²


def _unscaled(covariance: Array) -> Array:
    return _SCALE[:, None] * covariance * _SCALE * 1e-4
