"""The paper's rigid sensor controller: feedback by somebody who takes the fingers for rigid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from control.base import register
from control.closed_loop_pi import ClosedLoopPI, PISettings
from mechanics import se2
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan


@register
class RigidSensor(ClosedLoopPI):
    """The PI law told that the go is where a rigid grasp would have it: ee ⊕ X_ee_go, frozen as felt in free air.

    What comes of it, for a go that the contact blocks and fingers w = K d, d the displacement of the ee from where it
    is at zero wrench: the go seems to move by d, so e = −d + K⁻¹(K d_des − K d) = d_des − 2 d. It vanishes at
    d = d_des/2, which is half the planned wrench (2 N of 4 N; the paper found 1.74 and 1.90 N). Accumulated in full,
    d ← d + e = d_des − d would swing between d and d_des − d for ever; the integral of gain k_i takes d to d_des/2 by
    a factor of 1 − 2 k_i. In free directions it is right, for there the go does follow the ee. Half the normal force
    under the planned tangential one may leave the friction cone, or lose the contact: that is this law's result.
    """

    name = "rigid_sensor"

    def __init__(self, plan: Plan, settings: PISettings | None = None):
        super().__init__(plan, settings)
        self._X_ee_go: Array | None = None

    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Correct as the PI law does, and take in where the go lies in the fingers: the mean over the looks."""
        super().in_air(go_desired, measured)
        if measured.go is None:
            return
        lies = se2.between(measured.ee, measured.go)
        before = lies if self._X_ee_go is None else self._X_ee_go
        self._X_ee_go = se2.interpolate(before, lies, 1.0 / self._looks)

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Correct by what a rigid grasp would mean; without a look in free air, by the wrench alone."""
        go = None if self._X_ee_go is None else se2.compose(measured.ee, self._X_ee_go)
        super().in_contact(step, replace(measured, go=None if go is None else np.asarray(go)))
