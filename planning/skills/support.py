"""What the ground must do to an extrinsic object that the grasped one pushes: plain statics, no solver.

Skills ask here which force of the go balances the object, and whether the ground can answer it: before anything is
optimised, an infeasible wish is refused with the friction, or the force, that would make it feasible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics import se2
from mechanics.contact import force_in_world
from mechanics.friction import Mode, required_friction
from mechanics.readings import Array
from planning.errors import InfeasiblePlan

#: relative tolerance of cones and balances
TOLERANCE = 1e-6


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@dataclass(frozen=True, eq=False)
class Pushed:
    """An extrinsic object at K poses ``eo`` (K, 3), pushed at ``point`` along ``normal`` (K, 2), both in its frame.

    ``mass`` [kg], ``gravity`` [m/s²]; ``ground`` (P, 2) are the one or two points it stands on, in its frame, left one
    first, ``modes`` theirs, ``mu`` and ``mu_object`` the friction coefficients. ``normal`` is a unit normal into it.
    """

    eo: Array
    mass: float
    gravity: float
    point: Array
    normal: Array
    ground: Array
    modes: tuple[Mode, ...]
    names: tuple[str, ...]
    mu: float
    mu_object: float

    @property
    def weight(self) -> Array:
        """The force (2,) [N] of gravity."""
        return np.array([0.0, -self.mass * self.gravity])

    def _lever(self, p: Array) -> Array:
        """Points (..., 2) of the object relative to its ground point 0, axes of W: (K, 2)."""
        return se2.rotate(self.eo[:, 2], np.broadcast_to(p, (len(self.eo), 2)) - self.ground[0])

    def axes(self) -> tuple[Array, Array]:
        """The contact's normal and tangent (K, 2) in W."""
        n = se2.rotate(self.eo[:, 2], self.normal)
        return n, np.column_stack([n[:, 1], -n[:, 0]])

    def balancing(self, f_n: Array) -> Array:
        """Return the force (K, 2) = (f_n, f_t) of normal part ``f_n`` (K,) that balances the weight about the pivot.

        Raises InfeasiblePlan where the contact's tangent passes through the pivot: only the normal part turns it then.
        """
        f_t = self.tangential(f_n)
        stuck = ~np.isfinite(f_t)
        if stuck.any():
            reason = "its friction passes through the pivot, so nothing balances the weight: choose another contact"
            raise InfeasiblePlan(int(stuck.argmax()), "object", np.nan, np.nan, by="go", reason=reason)
        return np.column_stack([f_n, f_t])

    def tangential(self, f_n: Array) -> Array:
        """Return the tangential force (K,) that balances the weight about the pivot; ∞ where the tangent passes it."""
        n, t = self.axes()
        lever = self._lever(self.point)
        turning = _cross(lever, t)
        moment = f_n * _cross(lever, n) + _cross(self._lever(np.zeros(2)), self.weight)
        stuck = np.abs(turning) < 1e-6 * np.linalg.norm(lever, axis=1)
        return np.where(stuck, np.inf, -moment / np.where(stuck, 1.0, turning))

    def pushing(self, f_t: Array) -> Array:
        """Return the normal force (K,) that keeps the eo slipping on the ground, with the tangential part ``f_t`` (K,).

        Raises InfeasiblePlan where a push, however strong, only wedges the object against the ground.
        """
        n, t = self.axes()
        slope = self.modes[0].slip_sign * self.mu
        along = n[:, 0] - slope * n[:, 1]
        f_n = (-slope * self.mass * self.gravity - f_t * (t[:, 0] - slope * t[:, 1])) / np.where(along == 0, 1, along)
        stuck = (np.sign(along) != -self.modes[0].slip_sign) | (f_n < 0)
        if self.mu > 0 and stuck.any():
            reason = "no push of the go makes it slip this way: the contact faces the wrong way, or wedges the object"
            raise InfeasiblePlan(int(stuck.argmax()), self.names[0], np.nan, self.mu, reason=reason)
        return f_n

    def reaction(self, force: Array) -> Array:
        """Return the ground's force (K, 2) [N] in W that balances the go's ``force`` (K, 2) = (f_n, f_t)."""
        return -self.weight - force_in_world(self.axes()[0], force)

    def loads(self, force: Array) -> Array:
        """Return the normal force (K, P) [N] at each ground point."""
        up = self.reaction(force)[:, 1]
        if len(self.ground) == 1:
            return up[:, None]
        push = force_in_world(self.axes()[0], force)
        about_first = _cross(self._lever(self.point), push) + _cross(self._lever(np.zeros(2)), self.weight)
        second = -about_first / self._lever(self.ground[1])[:, 0]
        return np.column_stack([up - second, second])

    def needs(self, force: Array) -> tuple[Array, Array]:
        """Return the least friction (K,) at the object's contact and (K,) at the ground; ∞ where one pulls."""
        return required_friction(force), required_friction(self.reaction(force)[:, ::-1])

    def check(self, force: Array, object_mode: Mode = Mode.STICK) -> None:
        """Raise InfeasiblePlan at the first step where ``force`` (K, 2) is no wish that the modes admit."""
        at_object, at_ground = self.needs(force)
        loads, reaction = self.loads(force), self.reaction(force)
        scale = self.mass * self.gravity + np.linalg.norm(force, axis=1)
        for k in range(len(force)):
            if object_mode is Mode.STICK and not at_object[k] <= self.mu_object * (1 + TOLERANCE):
                raise InfeasiblePlan(k, "object", float(at_object[k]), self.mu_object, by="go")
            light = int(loads[k].argmin())
            if loads[k, light] < -TOLERANCE * scale[k]:
                raise InfeasiblePlan(k, self.names[light], np.nan, self.mu, reason=self._lifted(force[k], loads[k]))
            heavy = self.names[int(loads[k].argmax())]
            if self.modes[0] is Mode.STICK:
                if not at_ground[k] <= self.mu * (1 + TOLERANCE):
                    raise InfeasiblePlan(k, heavy, float(at_ground[k]), self.mu)
            else:
                wanted = self.modes[0].slip_sign * self.mu * reaction[k, 1]
                if abs(reaction[k, 0] - wanted) > TOLERANCE * scale[k]:
                    raise InfeasiblePlan(k, heavy, float(at_ground[k]), self.mu, reason=self._unsteady(reaction[k]))

    def _lifted(self, force: Array, loads: Array) -> str:
        if len(self.ground) == 1:
            return f"is lifted: the go pulls the object up with {-loads.sum():.3g} N more than its weight"
        return (
            f"is lifted with {-loads.min():.3g} N: at f_n = {force[0]:.3g} N, f_t = {force[1]:.3g} N the push tips"
            " the object; ask for less, or touch it elsewhere"
        )

    def _unsteady(self, reaction: Array) -> str:
        need = abs(reaction[0]) / reaction[1] if reaction[1] > 0 else np.inf
        heavier = (abs(reaction[0]) / self.mu - reaction[1]) / self.gravity if self.mu > 0 and self.gravity > 0 else 0.0
        return (
            f"slips, so its friction is {self.mu:.3g} · {reaction[1]:.3g} N = {self.mu * reaction[1]:.3g} N, but the"
            f" push takes {abs(reaction[0]):.3g} N: needs µ = {need:.3g}, or an object of {self.mass + heavier:.3g} kg"
        )
