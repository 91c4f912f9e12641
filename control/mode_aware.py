"""A feedback law that knows the contact modes: it undoes errors only by motions that the contacts let through."""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy.linalg import lstsq

from control.base import register
from control.closed_loop_pi import ClosedLoopPI, PISettings
from control.response import response
from mechanics import se2
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan

#: a motion of the ee that changes what is measured by less than this, in standard deviations, is left alone
_TOLD = 0.3


class ModeAwareSettings(PISettings):
    """The PI law's gains and limits, and the standard deviation of all that is measured: its weight is 1/σ²."""

    go_mm: float = Field(default=0.2, gt=0, description="σ of the grasped object's place")
    go_deg: float = Field(default=0.3, gt=0, description="σ of its angle")
    force_N: float = Field(default=0.1, gt=0, description="σ of each component of the force")
    torque_Nmm: float = Field(default=4.5, gt=0, description="σ of the torque about the grasp centre")
    eo_mm: float = Field(default=0.1, gt=0, description="σ of the extrinsic object's place")
    eo_deg: float = Field(default=0.1, gt=0, description="σ of its angle")


@register
class ModeAware(ClosedLoopPI):
    """The PI law on e* = −(JᵀWJ)⁻¹ JᵀW y instead of the paper's e, with the same gains.

    y is what is off: go ⊖ go_des at the grasp centre in gocf, wrench − wrench_des, and eo − eo_des where there is one.
    J is their response to the ee through the contact modes (`control.response`), W = diag(1/σ²). e* is the step of
    the ee that leaves least of y: a bias of the pose in a direction that the contact blocks does not turn into
    wrench, as it does in the paper's sum of both. What was not seen drops out.

    The n-th update in contact undoes 1/n of its error at least: what the free air could not show (a bias of the felt
    pose turns into force) is unknown before the first one, and from then on its mean is the better guess.

    The eo's σ are what its tag shows: 0.08 mm and 0.08° of its seat and 0.05 mm and 0.06° of noise make 0.1 of either.
    """

    name = "mode_aware"
    Settings = ModeAwareSettings

    def __init__(self, plan: Plan, settings: ModeAwareSettings | None = None):
        s = ModeAwareSettings() if settings is None else settings
        super().__init__(plan, s)
        self._go_sigma = np.array([s.go_mm * 1e-3, s.go_mm * 1e-3, np.radians(s.go_deg)])
        self._eo_sigma = np.array([s.eo_mm * 1e-3, s.eo_mm * 1e-3, np.radians(s.eo_deg)])
        self._wrench_sigma = np.array([s.force_N, s.force_N, s.torque_Nmm * 1e-3])
        self._updates = 0

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Correct by the constant part and the limited terms, the first errors more than later ones."""
        self._updates += 1
        self.correction = self.constant + self._terms.update(self._error(step, measured), 1.0 / self._updates)

    def _error(self, step: int, measured: PlanarState) -> Array:
        """e* (3,) at waypoint ``step``."""
        plan = self.plan
        linear = response(plan, step)
        rows = [linear.wrench / self._wrench_sigma[:, None]]
        off = [(measured.wrench - plan.wrench[step]) / self._wrench_sigma]
        if measured.go is not None:
            rows.append(linear.go / self._go_sigma[:, None])
            off.append(-self._pose_error(plan.go[step], measured) / self._go_sigma)
        if measured.eo is not None and plan.eo is not None and linear.eo is not None:
            apart = measured.eo - plan.eo[step]
            apart[2] = se2.wrap(apart[2])
            rows.append(linear.eo / self._eo_sigma[:, None])
            off.append(apart / self._eo_sigma)
        J = np.vstack(rows) * self._go_sigma
        largest = float(np.linalg.norm(J, 2))
        step_of_ee = lstsq(J, -np.concatenate(off), cond=_TOLD / largest)[0]  # pyright: ignore[reportOptionalSubscript]
        return np.asarray(step_of_ee) * self._go_sigma
