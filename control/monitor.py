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
    """Watches the planned contacts of the go, and those of the extrinsic object with the ground, at the waypoints.

    ``load`` is the fraction of the planned contact force below which a contact counts as lost. ``lies`` (3,) is the
    pose of the go as it was seen before touch-down, in the frame of where the plan has it: a contact that lands
    elsewhere because the go lies otherwise in the fingers has not slipped, it has to stick where it landed. A contact
    of the two objects has to stick where the extrinsic one is seen to carry it.
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
        return self._slip(step, measured)

    def _slip(self, step: int, measured: PlanarState) -> Deviation | None:
        plan = self.plan
        for c, name in enumerate(plan.contact_names):
            if plan.contact_modes[step][c] != "stick":
                continue
            planned = stood = plan.contact_points[step, c]
            body, planned_body = measured.go, plan.go[step]
            if plan.eo is not None and not touches_go(plan, c):
                body, planned_body = measured.eo, plan.eo[step]
            else:
                if plan.eo is not None and measured.eo is not None:
                    stood = _carried(measured.eo, plan.eo[step], planned)
                stood = stood + self._landed(step, c)
            if body is None:
                continue
            moved = float(np.linalg.norm(_carried(body, planned_body, planned) - stood))
            if moved > self.slip_tolerance:
                return Deviation(
                    "slipped", f"waypoint {step}: contact '{name}' is {moved * 1e3:.1f} mm from where it should stick"
                )
        return None

    def _landed(self, step: int, contact: int) -> Array:
        """How far (2,) along the surface, in W, the contact of the go landed from where the plan has it."""
        if self.lies is None:
            return np.zeros(2)
        plan = self.plan
        body_point = se2.transform(se2.inverse(plan.go[step]), plan.contact_points[step, contact])
        off = se2.rotate(plan.go[0, 2], se2.transform(self.lies, body_point) - body_point)
        normal = plan.contact_normals[step, contact]
        return off - (off @ normal) * normal


def touches_go(plan: Plan, contact: int) -> bool:
    """Whether a contact of a plan is one of the go's."""
    return plan.contact_bodies is None or "go" in plan.contact_bodies[contact]


def _carried(body: Array, planned_body: Array, point: Array) -> Array:
    """Where ``point`` (2,) of a body that the plan has at ``planned_body`` (3,) is with the body at ``body`` (3,)."""
    return se2.transform(body, se2.transform(se2.inverse(planned_body), point))
