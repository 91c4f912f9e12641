"""The rehearsal of a plan: the arm's whole motion, lifted clear of everything, before the first contact.

The arm, its gates and the person beside it see every pose, speed and turn that the trial will ask for. Nothing may be
touched: a force on the grasped object ends it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control.approach import UP
from control.motion import Mover
from control.observe import Observer
from control.settings import TrialSettings
from control.trial import Watch
from drivers.errors import CommandRefused, DriverError, SimulationDiverged
from drivers.interfaces import Clock
from estimation.force_torque import FreeAirLoad
from mechanics.readings import Array
from planning.plan import Plan


@dataclass(frozen=True)
class RehearsalResult:
    """How a rehearsal ended (statuses of design §6), and the greatest force on the go beside its weight [N]."""

    status: str
    reason: str
    force: float
    lift: float
    seconds: float


class _Touched(Exception):
    pass


class Rehearsal:
    """Rehearses a plan ``lift`` metres above where it is to be executed. The arm's lease is held by the caller."""

    def __init__(
        self,
        plan: Plan,
        lift: float,
        observer: Observer,
        clock: Clock,
        load: FreeAirLoad,
        settings: TrialSettings,
        watch: Watch,
    ):
        self._plan, self._up = plan, np.append(lift * UP, 0.0)
        self._observer, self._clock, self._load = observer, clock, load
        self._settings, self._watch = settings, watch
        self._mover = Mover.of(observer.arm, clock, observer.arm_pose(), settings, watch.tick, watch.event)
        self._force = 0.0

    def run(self) -> RehearsalResult:
        """Go through the whole motion. What ends it early is its status, as of a trial (`control.trial.Trial.run`)."""
        begin = self._clock.now_ns()
        status, reason = "completed", ""
        try:
            self._motion()
        except _Touched as touched:
            status, reason = "stopped", str(touched)
        except CommandRefused as error:
            status, reason = "stopped", str(error)
        except SimulationDiverged as error:
            status, reason = "diverged", str(error)
        except DriverError as error:
            status, reason = "device_failed", str(error)
        if reason:
            self._watch.event("error", f"{status}: {reason}")
        seconds = (self._clock.now_ns() - begin) * 1e-9
        return RehearsalResult(status, reason, self._force, float(self._up[1]), seconds)

    def _motion(self) -> None:
        s, plan, mover = self._settings, self._plan, self._mover
        self._watch.phase("approach", 0.0)
        mover.go_above(plan.free_air_ee(plan.preload_go[0]) + self._up)
        mover.rest(max(s.settle, s.window))
        self._observer.zero(self._load, plan.preload_go[0] + self._up)
        self._watch.phase("preload", 0.0)
        mover.through(plan.preload_ee + self._up, s.preload)
        self._feel("the preload")
        for k, ee in enumerate(plan.ee):
            self._watch.phase("trajectory", k / len(plan.ee))
            mover.ramp(ee + self._up, s.ramp)
            self._feel(f"waypoint {k}")
        self._watch.phase("unload", 0.0)
        mover.through(plan.unload_ee + self._up, s.preload)
        self._feel("the unloading")
        self._watch.phase("done", 1.0)

    def _feel(self, where: str) -> None:
        """The force on the go beside its weight; as it moves slowly, nothing else should act on it."""
        ee: Array = self._observer.arm_pose()
        on_go = self._observer.wrist_sensor.wrench_on_go(self._observer.mean_reading(), ee, ee[:2])
        force = float(np.hypot(on_go[0], on_go[1] - self._load.mass * self._load.gravity))
        self._force = max(self._force, force)
        if force > self._settings.rehearsal_force:
            raise _Touched(
                f"{where}: {force:.1f} N act on the grasped object, where it should touch nothing: see what is in its "
                f"way, {self._up[1] * 1e3:.0f} mm above where the trial is to run"
            )
