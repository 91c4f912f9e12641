"""Whether the object slips in the fingers, at once or a little with each step: how far it has come to lie elsewhere.

The grasp q = x ∘ X_ee_go ∘ X_go_gocf, x = K⁻¹w (`grasp_filter`), is the same under every wrench but for what elasticity
misses. The grasp filter follows a q that walks, so that an object that creeps through the fingers by a tenth of a
millimetre at a time goes unnoticed. Here q is held against the one that was seen in free air, right before touch-down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.tactile_pose import ANGLE_LENGTH, left_difference
from mechanics import se2, wrench
from mechanics.elasticity import Elasticity
from mechanics.readings import Array
from mechanics.records import PlanarState

#: turns count by a length, so that one figure tells the size of a motion in the plane
_SCALE = np.array([1.0, 1.0, ANGLE_LENGTH])
#: the lever of a sagging object: each time a hundredth of the last
_ROUNDS = 4


@dataclass(frozen=True)
class SlipNoise:
    """What is no slip, 1 sigma. ``look`` [m]: of the difference of two looks, with arm, tags and camera in it.

    ``compliance``: the share of x by which elasticity may be wrong: hysteresis, creep, stiffening, K itself. ``gate``:
    so many sigma are a slip.
    """

    look: float = 1.5e-4
    compliance: float = 0.1
    gate: float = 4.0


@dataclass(frozen=True, eq=False)
class Drift:
    """How the object lies in the fingers otherwise than in free air, beyond what elasticity says.

    ``moved`` (3,) [m, m, rad] about the grasp centre, in ee; ``sigmas``: its size by its uncertainty. ``slipped`` where
    that is too much to be anything else. ``wrench`` (3,) of the sensor on the object about ``centre`` (2,), axes of W,
    is what the fingers tell by their displacement alone, had it not slipped.
    """

    moved: Array
    sigmas: float
    slipped: bool
    wrench: Array
    centre: Array

    @property
    def size_mm(self) -> float:
        """How far the grasp centre has come [mm]."""
        return float(np.hypot(*self.moved[:2])) * 1e3

    @property
    def size_deg(self) -> float:
        """How far the object has turned [deg]."""
        return abs(float(np.degrees(self.moved[2])))


class FingerSlip:
    """Holds one grasp against how it was in free air (`hangs`); ``X_go_gocf`` (3,) is where the grasp should be."""

    def __init__(self, X_go_gocf: Array, elasticity: Elasticity, noise: SlipNoise | None = None):
        self._grasp, self._elasticity = np.asarray(X_go_gocf, float), elasticity
        self._noise = SlipNoise() if noise is None else noise
        self._before: tuple[Array, Array, Array] | None = None

    def hangs(self, state: PlanarState, covariance: Array | None = None) -> None:
        """The object hangs free in a fresh grasp. States as `drift` takes them; without a pose of it nothing is known.

        A second call begins anew.
        """
        self._before = None if state.go is None or not state.is_finite else (*self._seen(state), _or_none(covariance))

    def drift(self, state: PlanarState, covariance: Array | None = None) -> Drift | None:
        """How far it has come since, by a settled ``state`` whose wrench is about the planned grasp centre on the go.

        ``covariance`` (3, 3) of the go's pose in ee [m, m, rad] is what the sensor of it leaves open beyond
        `SlipNoise.look`. None where its pose is not known, or was not in free air.
        """
        if self._before is None or state.go is None or not state.is_finite:
            return None
        noise, (before, x_before, unknown) = self._noise, self._before
        q, x = self._seen(state)
        moved = left_difference(q, before)
        elastic = noise.compliance * float(np.linalg.norm((x - x_before) * _SCALE))
        spread = np.diag((np.hypot(noise.look, elastic) / _SCALE) ** 2) + unknown + _or_none(covariance)
        sigmas = float(np.sqrt(moved @ np.linalg.solve(spread, moved)))
        felt = se2.compose(before, se2.inverse(se2.compose(se2.between(state.ee, state.go), self._grasp)))
        gocf = se2.compose(state.ee, se2.inverse(felt))
        told = wrench.rotated(self._elasticity.wrench(felt), gocf[2])
        return Drift(moved, sigmas, sigmas > noise.gate, told, gocf[:2])

    def _seen(self, state: PlanarState) -> tuple[Array, Array]:
        """q and x (3,) of a state whose go is seen."""
        assert state.go is not None
        planned = se2.compose(state.go, self._grasp)[:2]
        gocf, x = state.ee, np.zeros(3)
        for _ in range(_ROUNDS):
            w = wrench.about(state.wrench, planned, gocf[:2])
            x = self._elasticity.displacement(wrench.rotated(w, -gocf[2]))
            gocf = se2.compose(state.ee, se2.inverse(x))
        return se2.compose(se2.compose(x, se2.between(state.ee, state.go)), self._grasp), x


def _or_none(covariance: Array | None) -> Array:
    return np.zeros((3, 3)) if covariance is None else np.asarray(covariance, float)
