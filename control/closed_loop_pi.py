"""The paper's closed-loop PI controller: measurements move the plan by a limited proportional and integral term."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from control.base import LawSettings, register
from control.closed_loop import ClosedLoop
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan


class PISettings(LawSettings):
    """Gains of the error and of its sum over the updates, and how far both together may move the end-effector.

    Without k_p by default: as a position, its term lets go as the error goes, and holds nothing off the plan.
    """

    k_p: float = Field(default=0.0, ge=0, lt=2, description="of the newest error")
    k_i: float = Field(default=0.3, ge=0, lt=2, description="of the sum of the errors")
    limit_mm: float = Field(default=4.0, gt=0, le=50, description="largest correction in contact, along each axis")
    limit_deg: float = Field(default=5.0, gt=0, le=45, description="and of the angle")


class LimitedPI:
    """clip(k_p e + k_i Σe), per component of e (3,) = (x, y, θ) [m, m, rad].

    An error is summed only as far as it takes its component to the limit (conditional integration), so the sum never
    winds up, and turns round with the error.
    """

    def __init__(self, settings: PISettings):
        self.settings = settings
        self._limit = np.array([settings.limit_mm * 1e-3, settings.limit_mm * 1e-3, np.radians(settings.limit_deg)])
        self._sum = np.zeros(3)

    def update(self, error: Array, least: float = 0.0) -> Array:
        """Take ``error`` (3,) in and return what both terms ask for, within the limits.

        So much is added to the sum that both terms undo a share of ``least`` of the error, where k_p + k_i is less.
        """
        k_p, k_i = self.settings.k_p, self.settings.k_i
        if k_i > 0:
            added = error * max(1.0, (least - k_p) / k_i)
            wanted = k_p * error + k_i * (self._sum + added)
            beyond = np.where(np.abs(wanted) > self._limit, wanted - np.copysign(self._limit, wanted), 0.0)
            # back from beyond the limit, but not farther than to where the sum was
            self._sum = self._sum + added - np.clip(beyond / k_i, np.minimum(added, 0.0), np.maximum(added, 0.0))
        return np.clip(k_p * error + k_i * self._sum, -self._limit, self._limit)


@register
class ClosedLoopPI(ClosedLoop):
    """The correction is what the free air taught plus clip(k_p e + k_i Σe), e as in `ClosedLoop` (paper V-C).

    It is a position, not a step: where e has settled, only the sum holds the end-effector off its plan. In free air
    the gain of the n-th look is 1/n, so that the correction becomes the mean over the looks; it stays as a constant
    part when contact begins, at which the limited terms start from nothing.
    """

    name = "closed_loop_pi"
    Settings = PISettings
    settings: PISettings

    def __init__(self, plan: Plan, settings: PISettings | None = None):
        super().__init__(plan, settings)
        self.constant = np.zeros(3)
        self._looks = 0
        self._terms = LimitedPI(self.settings)

    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Move the constant part by 1/n of the n-th pose error seen."""
        if measured.go is None:
            return
        self._looks += 1
        self.constant = self.constant + self._pose_error(go_desired, measured) / self._looks
        self.correction = self.constant

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Correct by the constant part and the limited terms."""
        self.correction = self.constant + self._terms.update(self._error(step, measured))
