"""The paper's closed-loop controller: the measured pose and wrench compensate the planned trajectory."""

from __future__ import annotations

from control.base import Controller, register
from mechanics import se2, wrench
from mechanics.elasticity import Elasticity
from mechanics.readings import Array
from mechanics.records import PlanarState


@register
class ClosedLoop(Controller):
    """Accumulates e = (go_desired ⊖ go_estimated) + K⁻¹ (w_desired − w_measured), both in gocf (design §9, paper V-C).

    With exact K, go ⊕ K⁻¹ w is the end-effector's pose, so e is the step that the end-effector still has to take in
    whatever direction the contact leaves it. With stiffness error κ = K/K̂ the residual shrinks by 1 − κ per update in
    the blocked directions: stable for κ < 2.
    """

    name = "closed_loop"

    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Remove the constant part of the pose error before touch-down, where the go moves with the end-effector."""
        self.correction = self.correction + self._pose_error(go_desired, measured)

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Add e to the running correction."""
        self.correction = self.correction + self._error(step, measured)

    def _error(self, step: int, measured: PlanarState) -> Array:
        """The paper's e (3,) at waypoint ``step``."""
        go = self.plan.go[step]
        missing = wrench.rotated(self.plan.wrench[step] - measured.wrench, -(go[2] + self.plan.X_go_gocf[2]))
        return self._pose_error(go, measured) + Elasticity(self.plan.stiffness).displacement(missing)

    def _pose_error(self, go_desired: Array, measured: PlanarState) -> Array:
        """go_desired ⊖ go_estimated (3,) at the grasp centre, in gocf; zero where the go was not seen."""
        if measured.go is None:
            return self.correction * 0.0
        grasp = self.plan.X_go_gocf
        return se2.between(se2.compose(measured.go, grasp), se2.compose(go_desired, grasp))
