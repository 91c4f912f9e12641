"""What two fingers can hold before the object slips between them: an ellipsoidal limit surface."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from mechanics.readings import Array

Three = tuple[float, float, float]
_ITERATIONS = 50


class LimitSurface:
    """The wrenches w of a pair of fingers with (fx² + fy²)/F² + τ²/T² ≤ 1, about the grasp centre.

    Beyond it the object slips along the surface's normal (maximum dissipation; Goyal, Ruina, Papadopoulos 1991).
    """

    def __init__(self, force: float, torque: float, stiffness: Array):
        """Limits ``force`` F [N] and ``torque`` T [N·m], either may be infinite; ``stiffness`` (3, 3) in gocf.

        Raises ValueError for a limit that is not positive.
        """
        if not (force > 0 and torque > 0):
            raise ValueError(
                f"scene.finger_limit: expected a force [N] and a torque [N·m] above 0, got ({force:g}, {torque:g})"
            )
        self.force, self.torque = force, torque
        self._per_force, self._per_torque = 1.0 / force**2, 1.0 / torque**2
        inverse = np.array([1.0 / force, 1.0 / force, 1.0 / torque])
        values, vectors = np.linalg.eigh(inverse[:, None] * np.asarray(stiffness, float) * inverse)
        self._values = tuple(np.maximum(values, 0.0).tolist())
        #: from a wrench to its coordinates along the principal axes of the scaled stiffness, and from there to a slip
        self._into = tuple((vectors.T * inverse).ravel().tolist())
        self._out = tuple((inverse[:, None] * vectors).ravel().tolist())

    @property
    def is_infinite(self) -> bool:
        """Whether nothing ever slips."""
        return self.force == inf and self.torque == inf

    def load(self, fx: float, fy: float, tau: float) -> float:
        """How much of the limit a wrench takes: 1 on the surface, growing with the square of the wrench."""
        return (fx * fx + fy * fy) * self._per_force + tau * tau * self._per_torque

    def slip(self, fx: float, fy: float, tau: float, steepness: float = 1.0) -> Three:
        """How far gocf slips on the object, in gocf, to unload fingers of ``steepness`` · K from w to the surface.

        Closest-point projection in the metric of K⁻¹; zero for a wrench within the surface.
        """
        m, (a, b, c) = self._into, self._values
        p = m[0] * fx + m[1] * fy + m[2] * tau
        q = m[3] * fx + m[4] * fy + m[5] * tau
        r = m[6] * fx + m[7] * fy + m[8] * tau
        u = v = w = 1.0
        multiplier = 0.0
        for _ in range(_ITERATIONS):
            u, v, w = p / (1 + multiplier * a), q / (1 + multiplier * b), r / (1 + multiplier * c)
            square = u * u + v * v + w * w
            if square <= 1 + 1e-12:
                break
            # Newton on 1/‖·‖, which is nearly linear in the multiplier and never overshoots
            slope = (
                u * u * a / (1 + multiplier * a) + v * v * b / (1 + multiplier * b) + w * w * c / (1 + multiplier * c)
            )
            multiplier += (square * sqrt(square) - square) / slope
        n, reach = self._out, multiplier / steepness
        return (
            reach * (n[0] * u + n[1] * v + n[2] * w),
            reach * (n[3] * u + n[4] * v + n[5] * w),
            reach * (n[6] * u + n[7] * v + n[8] * w),
        )
