"""Where the end-effector must be, by pencil and paper: the balance of each body and K⁻¹, no solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def turn(angle: float) -> np.ndarray:
    """Rotation (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def moment(lever, force):
    """Moment of a force (2,) at a lever (2,)."""
    return lever[0] * force[1] - lever[1] * force[0]


@dataclass(frozen=True)
class Held:
    """The go in compliant fingers: mass [kg], corner (2,) in contact and grasp (2,) in its frame, K (3, 3) in gocf."""

    mass: float
    corner: np.ndarray
    grasp: np.ndarray
    stiffness: np.ndarray
    gravity: float = 9.81

    def go(self, angle: float, contact) -> np.ndarray:
        """X_W_go (3,) with its corner at ``contact`` (2,) in W."""
        return np.append(contact - turn(angle) @ self.corner, angle)

    def wrench(self, angle: float, push) -> np.ndarray:
        """Wrench (3,) of the fingers on the go about the grasp centre, axes of W; ``push`` (2,) acts at the corner."""
        weight = np.array([0.0, -self.mass * self.gravity])
        to_grasp = turn(angle) @ self.grasp
        to_corner = turn(angle) @ (self.corner - self.grasp)
        return np.append(-weight - push, -moment(-to_grasp, weight) - moment(to_corner, push))

    def ee(self, angle: float, contact, push) -> np.ndarray:
        """X_W_ee (3,) that holds the go in balance there: go ∘ grasp ∘ K⁻¹ w."""
        w = self.wrench(angle, push)
        R = turn(angle)
        x = np.linalg.solve(self.stiffness, np.append(R.T @ w[:2], w[2]))
        return np.append(self.go(angle, contact)[:2] + R @ (self.grasp + x[:2]), angle + x[2])


@dataclass(frozen=True)
class Pivot:
    """An eo of mass [kg] that turns about its vertex ``pivot``, which stands at W's origin.

    ``contact`` is where the go's corner touches it and ``normal`` the unit normal into it; all (2,) in its frame.
    """

    mass: float
    pivot: np.ndarray
    contact: np.ndarray
    normal: np.ndarray
    gravity: float = 9.81

    def eo(self, angle: float) -> np.ndarray:
        """X_W_eo (3,)."""
        return np.append(-turn(angle) @ self.pivot, angle)

    def at(self, angle: float) -> np.ndarray:
        """Where (2,) the go touches, in W."""
        return turn(angle) @ (self.contact - self.pivot)

    def push(self, angle: float, force: float) -> np.ndarray:
        """The go's force (2,) on the eo in W, of normal part ``force``, that balances the weight about the pivot."""
        R = turn(angle)
        n = R @ self.normal
        t = np.array([n[1], -n[0]])
        lever = self.at(angle)
        weight = np.array([0.0, -self.mass * self.gravity])
        along = -(moment(lever, n) * force + moment(-R @ self.pivot, weight)) / moment(lever, t)
        return force * n + along * t

    def needs(self, angle: float, force: float) -> tuple[float, float]:
        """|f_t| / f_n at the go's contact and at the pivot."""
        push = self.push(angle, force)
        ground = np.array([0.0, self.mass * self.gravity]) - push
        n = turn(angle) @ self.normal
        return float(abs(moment(n, push)) / (n @ push)), float(abs(ground[0]) / ground[1])
