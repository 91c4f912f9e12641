"""Compares what a trial measures with what its plan expects, and says when it has failed and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics import se2
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan


@dataclass(frozen=True)
class Deviation:
    """Why a trial cannot go on: ``status`` of design §6, and the reason in words."""

    status: str
    reason: str


@dataclass
class ContactMonitor:
    """Watches the planned contacts of the go at the waypoints.

    ``load`` is the fraction of the planned contact force below which a contact counts as lost. ``lies`` (3,) is the
    pose of the go as it was seen before touch-down, in the frame of where the plan has it: a contact that lands
    elsewhere because the go lies otherwise in the fingers has not slipped, it has to stick where it landed.
    """

    plan: Plan
    slip_tolerance: float
    force_limit: float
    load: float = 0.1
    lies: Array | None = None

    def check(self, step: int, measured: PlanarState, weight: Array) -> Deviation | None:
        """The deviation at waypoint ``step``, or None. ``weight`` (2,) [N] is the force of gravity on the go in W."""
        force = float(np.hypot(*measured.wrench[:2]))
        if not np.isfinite(measured.wrench).all() or not np.isfinite(measured.ee).all():
            return Deviation("diverged", f"waypoint {step}: a measurement is not finite")
        if force > self.force_limit:
            return Deviation("stopped", f"waypoint {step}: {force:.1f} N exceeds the limit of {self.force_limit:g} N")
        # the environment's force on the go is what balance leaves: -(sensor + weight)
        environment = -(measured.wrench[:2] + weight)
        planned = -(self.plan.wrench[step, :2] + weight)
        size = float(np.linalg.norm(planned))
        if size > 0 and float(environment @ planned) / size < self.load * size:
            return Deviation(
                "lost_contact",
                f"waypoint {step}: {float(environment @ planned) / size:.2f} N along the planned contact force "
                f"of {size:.2f} N",
            )
        if measured.go is not None:
            return self._slip(step, measured.go)
        return None

    def _slip(self, step: int, go: Array) -> Deviation | None:
        for c, name in enumerate(self.plan.contact_names):
            if self.plan.contact_modes[step][c] != "stick":
                continue
            planned = self.plan.contact_points[step, c]
            body_point = se2.transform(se2.inverse(self.plan.go[step]), planned)
            stood = planned + self._landed(step, c, body_point)
            moved = float(np.linalg.norm(se2.transform(go, body_point) - stood))
            if moved > self.slip_tolerance:
                return Deviation(
                    "slipped", f"waypoint {step}: contact '{name}' is {moved * 1e3:.1f} mm from where it should stick"
                )
        return None

    def _landed(self, step: int, contact: int, body_point: Array) -> Array:
        """How far (2,) along the surface, in W, the contact landed from where the plan has it."""
        if self.lies is None:
            return np.zeros(2)
        off = se2.rotate(self.plan.go[0, 2], se2.transform(self.lies, body_point) - body_point)
        normal = self.plan.contact_normals[step, contact]
        return off - (off @ normal) * normal
