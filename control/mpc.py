"""Receding horizon: at every waypoint what remains of the plan is made anew, from where things are seen to be."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from control.base import Controller, LawSettings, register
from control.monitor import Deviation
from control.replan import Belief, Gains
from mechanics import se2, wrench
from mechanics.elasticity import Elasticity
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.errors import InfeasiblePlan
from planning.plan import Plan
from planning.problem import Touch
from planning.receding import Receding, Remaining, table_of, tracking
from planning.skills.base import SkillTask


class MpcSettings(LawSettings):
    """The figures of receding-horizon control."""

    horizon: int = Field(default=10, ge=1, le=10_000, description="steps that are planned anew")
    iterations: int = Field(default=20, ge=1, le=1000, description="trials of the optimiser at most: the arm waits")
    track: float = Field(default=10.0, gt=0, description="weight of keeping to the plan's angles and places [1/mm²]")
    pose: float = Field(default=0.4, gt=0, le=1, description="share of a pose's innovation that is believed")
    grasp: float = Field(default=0.4, gt=0, le=1, description="share of the grasp's, which explains force and ee")
    mu: float = Field(default=0.5, ge=0, le=1, description="share of friction's, where a contact slips")
    slip_mm: float = Field(default=3.0, gt=0, le=100, description="motion of a sticking contact that is a slip")
    slips: int = Field(default=3, ge=0, le=1000, description="slips that are taken in before the trial is given up")
    limit_mm: float = Field(default=4.0, gt=0, le=100, description="change of the grasp since free air, at most")
    limit_deg: float = Field(default=5.0, gt=0, le=90, description="and its angle")


@dataclass
class Tally:
    """What a trial's re-plans were: how many, how many failed, how long each took [s], and the last failure."""

    failed: int = 0
    slips: int = 0
    times: list[float] = field(default_factory=list)
    reason: str = ""


@register
class Mpc(Controller):
    """Plans the next steps anew at every waypoint, warm, by ``lm``, and commands the first of them (design §9).

    ``task`` is what the plan was made of. What the model leaves over is a grasp that is estimated (`control.replan`),
    so there is no offset left where nothing changes. A re-plan that fails leaves the plan with the grasp as estimated.
    Raises ValueError without a task, or with that of another plan.
    """

    name = "mpc"
    needs_task: ClassVar[bool] = True
    Settings = MpcSettings
    settings: MpcSettings

    def __init__(self, plan: Plan, settings: LawSettings | None = None, task: SkillTask | None = None):
        super().__init__(plan, settings)
        if task is None:
            raise ValueError("mpc re-plans: it needs the task that its plan was made of, a plan alone is not enough")
        s = self.settings
        self._table = table_of(task.problem, plan)
        self._problem = tracking(task.problem, plan, s.track)
        reach = np.array([s.limit_mm * 1e-3, s.limit_mm * 1e-3, np.radians(s.limit_deg)])
        self._belief = Belief(self._problem, Gains(s.pose, s.grasp, s.mu, s.slip_mm * 1e-3, reach))
        self._receding = Receding(self._problem, s.horizon, s.iterations)
        self._remaining: Remaining | None = None
        self._failed_at: int | None = None
        self._touched = False
        self.tally = Tally()

    def in_air(self, go_desired: Array, measured: PlanarState) -> None:
        """Learn how the go lies in the fingers, where nothing else bears on it."""
        if not measured.is_finite:
            return
        self._belief.in_air(self._in_table(measured))
        self._correct()

    def in_contact(self, step: int, measured: PlanarState) -> None:
        """Take in what is seen at waypoint ``step``, and plan anew from there. What is no number is not seen."""
        if not measured.is_finite:
            return
        self._touched = True
        self._belief.in_contact(step, self._in_table(measured), self._predicted(step))
        self._correct()
        self._plan_from(step, self._belief.ahead)

    def replan(self, step: int, measured: PlanarState, deviation: Deviation) -> bool:
        """Take in a slip: go on from where things are, with the friction seen, if forces exist that can."""
        if deviation.status != "slipped" or self.tally.slips >= self.settings.slips:
            return False
        after = min(step + 1, self._problem.steps - 1)
        self.tally.slips += 1
        if not self._belief.slipped(after, self._in_table(measured), deviation.contact):
            return False
        return self._plan_from(after)

    def command(self, go: Array, ee: Array) -> Array:
        """The pose (3,) to command where the plan has the go at ``go`` and the end-effector at ``ee``.

        The plan's wrench, in the grasp as estimated. Once there is contact, the go is where its contacts stick.
        """
        plan, grasp = self.plan, self._belief.grasp
        finger, planned = Elasticity(plan.stiffness), se2.compose(go, plan.X_go_gocf)
        w = wrench.rotated(finger.wrench(se2.between(planned, ee)), planned[2])
        moved = go + self._stands(go) if self._touched else go
        centre = se2.transform(go, grasp[:2])
        return finger.ee_pose(moved, grasp, wrench.about(w, planned[:2], centre))

    def waypoint(self, step: int) -> Array:
        """The pose (3,) to command at waypoint ``step``: of the newest re-plan, else of the plan."""
        if not self._covers(step) and self._failed_at != step:
            self._plan_from(step)
        if not self._covers(step):
            return self.command(self.plan.go[step], self.plan.ee[step])
        assert self._remaining is not None
        return se2.compose(self._table, self._remaining.ee[step - self._remaining.begin])

    def told(self) -> dict[str, Any]:
        """What the trial's row says of the re-plans."""
        times = self.tally.times
        return {
            "replans": len(times),
            "failed": self.tally.failed,
            "slips": self.tally.slips,
            "median_ms": float(np.median(times)) * 1e3 if times else None,
            "max_ms": max(times) * 1e3 if times else None,
            "reason": self.tally.reason,
        }

    # -- re-planning -------------------------------------------------------------------------------------------------

    def _plan_from(self, step: int, ahead: tuple[float, float] = (0.0, 0.0)) -> bool:
        began = time.perf_counter()
        try:
            self._remaining = self._receding.solve(step, self._belief.seen(step), ahead)
        except (InfeasiblePlan, ValueError, np.linalg.LinAlgError) as error:
            self._remaining, self._failed_at = None, step
            self.tally.failed += 1
            self.tally.reason = f"waypoint {step}: {error}"
        self.tally.times.append(time.perf_counter() - began)
        return self._remaining is not None

    def _covers(self, step: int) -> bool:
        found = self._remaining
        return found is not None and found.begin <= step < found.begin + len(found.ee)

    def _predicted(self, step: int) -> float:
        """The relative angle [rad] to which the newest command was to bring the go."""
        if not self._covers(step):
            return float(self._problem.angle[step])
        assert self._remaining is not None
        return float(self._remaining.angle[step - self._remaining.begin])

    def _correct(self) -> None:
        self.correction = se2.between(self.plan.X_go_gocf, self._belief.grasp)

    def _in_table(self, measured: PlanarState) -> PlanarState:
        """The same in the frame of the problem."""
        poses = [None if X is None else se2.between(self._table, X) for X in (measured.ee, measured.go, measured.eo)]
        assert poses[0] is not None
        return PlanarState(poses[0], poses[1], poses[2], wrench.rotated(measured.wrench, -self._table[2]))

    def _stands(self, go: Array) -> Array:
        """How far (3,) in W the go stands from where the plan has it, by where its contacts stick."""
        seen = self._belief.seen(self._problem.steps - 1)
        contact = self._problem.contacts[0]
        e = np.array([contact.normal[1], -contact.normal[0]])
        corner = contact.touch is Touch.CORNER_ON_FACE
        theta = go[2] - self._problem.angle[0] if corner else go[2]
        off = (1.0 if corner else -1.0) * se2.rotate(theta, seen.travel * e)
        return np.append(off + se2.rotate(self._table[2], np.array([seen.along, 0.0])), 0.0)
