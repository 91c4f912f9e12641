"""The trial protocol: approach, preload at fixed pose, the trajectory waypoint by waypoint, unload, retreat.

Every trial of every skill and controller runs through here, on the simulated station as on a real one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from control.approach import anchored, resting_eo, retreat
from control.base import Controller
from control.monitor import ContactMonitor, Deviation, slips
from control.motion import Mover
from control.observe import Observer
from control.settings import TrialSettings
from drivers.errors import CommandRefused, DriverError, SimulationDiverged
from drivers.interfaces import Clock
from estimation.finger_slip import Drift
from estimation.force_torque import FreeAirLoad
from estimation.tag_pose import TagPose
from estimation.tool_identification import Agreement
from mechanics import se2
from mechanics.readings import Array
from mechanics.records import ContactBelief, PlanarState, WaypointRecord
from planning.plan import Plan


@dataclass
class TrialResult:
    """How a trial ended (statuses of design §6) and what it recorded. ``plan`` is the plan as anchored.

    ``device`` is the one that failed. ``witness`` is what the sensor under the table said of the wrist's force, at the
    waypoints where it said anything. ``drifts`` tell how the object lay in the fingers at the waypoints, by number,
    where that was seen, and ``finger_slip`` what was said of it when it had slipped there. ``deviation`` is the first
    that the law did not take in.
    """

    status: str
    reason: str
    plan: Plan
    waypoints: list[WaypointRecord] = field(default_factory=list)
    witness: list[Agreement] = field(default_factory=list)
    drifts: dict[int, Drift] = field(default_factory=dict)
    finger_slip: str = ""
    deviation: Deviation | None = None
    device: str = ""


@dataclass
class Watch:
    """Who looks on while a trial runs. Each is called in the control thread and must not block."""

    waypoint: Callable[[WaypointRecord], None] = lambda _waypoint: None
    phase: Callable[[str, float], None] = lambda _name, _fraction: None
    event: Callable[[str, str], None] = lambda _level, _text: None
    #: the wrench (3,) on the grasped object that its place in the fingers tells, axes of W, each time it is seen
    felt: Callable[[Array], None] = lambda _wrench: None
    #: once per set-point; whatever it raises ends the trial
    tick: Callable[[], None] = lambda: None
    #: asks a person to reset the scene and says whether they did; a station without a person answers False
    reset_scene: Callable[[str], bool] = lambda _what: False


class _Ended(Exception):
    def __init__(self, status: str, reason: str):
        self.status, self.reason = status, reason
        super().__init__(reason)


class Trial:
    """One execution of ``plan`` under ``controller``. The arm's lease must be held by the caller."""

    def __init__(
        self,
        name: str,
        plan: Plan,
        controller: Callable[[Plan], Controller],
        observer: Observer,
        clock: Clock,
        load: FreeAirLoad,
        settings: TrialSettings,
        watch: Watch,
    ):
        self._name, self._nominal, self._make_controller = name, plan, controller
        self._observer, self._clock, self._load = observer, clock, load
        self._settings, self._watch = settings, watch
        self._result = TrialResult("completed", "", plan)
        self._witness_told = False
        self._mover = Mover.of(observer.arm, clock, observer.arm_pose(), settings, watch.tick, watch.event)

    def run(self) -> TrialResult:
        """Run the whole protocol. Returns how it ended; where anything failed, the arm is held.

        A device failure ends it ``device_failed``, a refusal or a limit ``stopped``, and a simulation whose state has
        become nonsense ``diverged``.
        """
        result = self._result
        try:
            try:
                self._protocol()
            except _Ended as end:
                result.status, result.reason = end.status, end.reason
                self._leave()
        except CommandRefused as error:
            self._fails("stopped", error)
        except SimulationDiverged as error:
            self._fails("diverged", error)
        except DriverError as error:
            self._fails("device_failed", error)
        if result.status in ("stopped", "diverged", "device_failed"):
            with suppress(DriverError):  # one that does not answer is held by its server
                self._observer.arm.hold()
        if result.status != "completed":
            self._watch.event("error", f"{result.status}: {result.reason}")
        return result

    def _fails(self, status: str, error: DriverError) -> None:
        """End ``status``; what had ended the trial before, where it failed only on the way out, is told with it."""
        result = self._result
        before = f"{result.status}: {result.reason}; then " if result.reason else ""
        result.status, result.reason, result.device = status, f"{before}{error}", error.device

    # -- the phases ----------------------------------------------------------------------------------------------

    def _protocol(self) -> None:
        s, mover = self._settings, self._mover
        self._watch.phase("approach", 0.0)
        go_air = self._lifted(self._nominal)
        mover.go_above(self._nominal.free_air_ee(go_air))
        self._settle()
        plan, X_W_eo = self._anchored(go_air)
        self._result.plan = plan
        controller = self._make_controller(plan)
        monitor = ContactMonitor(plan, s.slip_tolerance_mm * 1e-3, s.force_limit)
        if X_W_eo is not None:
            monitor.before_touch(X_W_eo)

        go_air = self._lifted(plan)
        ee_air = plan.free_air_ee(go_air)
        mover.travel(controller.command(go_air, ee_air))
        self._settle()
        if controller.feedback:
            self._converge_in_air(controller, go_air, ee_air)
        self._zero(self._observer.see(("go",))["go"], go_air)

        self._watch.phase("preload", 0.0)
        touch = controller.command(plan.preload_go[0], plan.preload_ee[0])
        mover.ramp(touch, s.clearance_mm * 1e-3 / s.touch_speed)
        mover.rest(max(s.settle, 0.1))  # without a rest after touch-down the corner walks by 10 µm
        path = [controller.command(go, ee) for go, ee in zip(plan.preload_go, plan.preload_ee, strict=True)]
        mover.through(np.array(path), s.preload)

        weight = np.array([0.0, -self._load.mass * self._load.gravity])
        steps = len(plan.ee)
        for k in range(steps):
            self._watch.phase("trajectory", k / steps)
            measured, told, commanded, contact = self._visit(controller, plan, monitor, k)
            planned = PlanarState(plan.ee[k], plan.go[k], None if plan.eo is None else plan.eo[k], plan.wrench[k])
            record = WaypointRecord(
                self._clock.now_ns(),
                self._name,
                k,
                planned,
                commanded,
                measured,
                None,
                self._observer.estimated,
                contact,
            )
            self._result.waypoints.append(record)
            self._watch.waypoint(record)
            deviation = monitor.check(k, measured, weight)
            if deviation is not None:
                if self._taken_in(deviation, controller, told):
                    monitor.restart(k, measured)
                else:
                    self._deviates(deviation)

        self._watch.phase("unload", 0.0)
        path = [controller.command(go, ee) for go, ee in zip(plan.unload_go, plan.unload_ee, strict=True)]
        mover.through(np.array(path), s.preload + s.ramp * max(0, len(path) - len(plan.preload_go)))
        self._leave()
        self._watch.phase("done", 1.0)

    def _visit(
        self, controller: Controller, plan: Plan, monitor: ContactMonitor, k: int
    ) -> tuple[PlanarState, PlanarState, Array, ContactBelief | None]:
        """Go to waypoint ``k``, let the controller correct it, and measure once settled.

        What is measured, what a law is told there, the pose commanded, and where the go is believed to be touched.

        What has slipped is not corrected before the law was asked about it: it would be followed wherever it has gone.

        What slips is moved on, never about: there an update acts in the motion to the next waypoint. A small motion
        back would leave the contact stuck with less friction than it slips with, and several times as stiff.
        """
        s, mover = self._settings, self._mover
        mover.ramp(controller.waypoint(k), s.ramp)
        self._settle()
        updates = s.corrections if controller.feedback else 0
        later = slips(plan)
        for _ in range(0 if later else updates):
            told = self._estimate()
            # the monitor goes by tags: a go that is felt lies elsewhere by what fingers and tags disagree in
            if self._slid(monitor, k, replace(told, go=None) if self._observer.fingers else told):
                break
            controller.in_contact(k, told)
            mover.ramp(controller.waypoint(k), s.ramp)
            self._settle()
        estimated = self._estimate() if self._observer.fingers else None
        measured = self._observer.measure()
        told = measured if estimated is None else estimated
        if later and updates and not self._slid(monitor, k, measured):
            controller.in_contact(k, told)
        agreed = self._hear_witness(k, measured)
        self._hear_grasp(k, agreed)
        return measured, told, mover.pose, self._observer.contact()

    def _slid(self, monitor: ContactMonitor, k: int, seen: PlanarState) -> bool:
        """Whether a contact is ``seen`` to have slipped, and nobody has decided about it yet."""
        return self._result.deviation is None and monitor.has_slipped(k, seen)

    def _taken_in(self, found: Deviation, controller: Controller, told: PlanarState) -> bool:
        """Whether the law, asked with what it is ``told`` of this instant, goes on. After a refusal nobody asks."""
        asks = self._result.deviation is None and found.status not in ("stopped", "diverged")
        if not asks or not controller.replan(found.step, told, found):
            return False
        self._watch.event("warning", f"{found.reason}; {controller.name} has taken it in and goes on")
        return True

    def _deviates(self, found: Deviation) -> None:
        """End the trial for a deviation, or record the first one where the settings say so."""
        result = self._result
        first = result.deviation is None
        if first:
            result.deviation = found
        if found.status in ("stopped", "diverged") or self._settings.on_deviation == "end":
            raise _Ended(found.status, found.reason)
        if first:
            result.status, result.reason = found.status, found.reason
            self._watch.event("warning", f"{found.reason}; the trial goes on")

    def _hear_witness(self, k: int, measured: PlanarState) -> bool:
        """Whether the sensor under the table has nothing against the wrist's force. The first that it has is told."""
        found = self._observer.second_opinion(measured)
        if found is None:
            return True
        self._result.witness.append(found)
        if not found.agrees and not self._witness_told:
            self._witness_told = True
            dx, dy = found.difference
            self._watch.event(
                "warning",
                f"waypoint {k}: the wrist's force and the one under the table differ by ({dx:+.2f}, {dy:+.2f}) N, more "
                f"than their errors allow: check both sensors, and what touches the table besides the objects",
            )
        return found.agrees

    def _estimate(self) -> PlanarState:
        state = self._observer.estimate()
        self._tell_felt()
        return state

    def _tell_felt(self) -> None:
        if self._observer.drift is not None:
            self._watch.felt(self._observer.drift.wrench)

    def _hear_grasp(self, k: int, trusted: bool) -> None:
        """Keep how the object lies in the fingers at a settled waypoint; the first slip there is told.

        Without a wrist that is ``trusted`` a slip is not told from a force that nobody has measured.
        """
        self._tell_felt()
        drift, result, said = self._observer.drift, self._result, self._observer.slip
        if drift is not None:
            result.drifts[k] = drift
            if drift.slipped and trusted:
                said = f"the object has slipped in the fingers by {drift.size_mm:.1f} mm and {drift.size_deg:.1f} deg"
        if said and not result.finger_slip:
            result.finger_slip = f"waypoint {k}: {said}"
            advice = "grip it harder, or press less; where it has not moved, check the wrist's sensor"
            self._watch.event("warning", f"{result.finger_slip}: {advice}")

    def _converge_in_air(self, controller: Controller, go: Array, ee: Array) -> None:
        for _ in range(self._settings.air_corrections):
            before = controller.correction
            controller.in_air(go, self._estimate())
            self._mover.travel(controller.command(go, ee))
            self._settle()
            if np.hypot(*(controller.correction - before)[:2]) < 2e-5:
                break

    def _anchored(self, go_expected: Array) -> tuple[Plan, Array | None]:
        """Verify the start by tags, zero the wrist sensor under the go's weight, and anchor the plan.

        It is anchored to the table and, along it, to the extrinsic object, whose pose in W (3,) is told with it.
        """
        bodies = ("table", "go") if self._nominal.eo is None else ("table", "go", "eo")
        if not self._observer.tags.get("go"):
            bodies = tuple(body for body in bodies if body != "go")
            self._watch.event(
                "warning", "the grasped object carries no tag: how it lies in the fingers is not verified"
            )
        seen = self._observer.see(bodies)
        problem = self._start_problem(seen, go_expected)
        if problem is not None and self._watch.reset_scene(problem):
            seen = self._observer.see(bodies)
            problem = self._start_problem(seen, go_expected)
        if problem is not None:
            raise _Ended("stopped", f"the start could not be verified: {problem}")
        table, go, eo = (seen.get(body) for body in ("table", "go", "eo"))
        assert table is not None  # _start_problem saw it
        self._zero(go, go_expected)
        X_W_eo = None if eo is None else eo.pose
        return anchored(self._nominal, table.pose, X_W_eo), X_W_eo

    def _zero(self, seen: TagPose | None, go_expected: Array) -> None:
        """Zero the force sensors in free air, under the weight of a go where its tag was seen, else where it should be.

        Once for what is estimated in air, and again just before touch-down: a sensor's zero walks meanwhile.
        """
        self._observer.zero(self._load, go_expected if seen is None else seen.pose, seen=seen is not None)

    def _start_problem(self, seen: dict, go_expected: Array) -> str | None:
        for body, pose in seen.items():
            if pose is None:
                return f"no tag of '{body}' is in view"
        problem = None
        if "go" in seen:
            problem = self._astray("the grasped object", "the grasp should have it", seen["go"].pose, go_expected)
        lies = resting_eo(self._nominal)
        if problem is None and lies is not None:
            on_table = se2.between(seen["table"].pose, seen["eo"].pose)
            problem = self._astray("the extrinsic object", "the plan begins", on_table, lies)
        return problem

    def _astray(self, what: str, where: str, seen: Array, expected: Array) -> str | None:
        s = self._settings
        off = se2.between(expected, seen)
        distance, angle = float(np.hypot(off[0], off[1])) * 1e3, abs(float(np.degrees(off[2])))
        if distance > s.start_tolerance_mm or angle > s.start_tolerance_deg:
            return (
                f"{what} is {distance:.1f} mm and {angle:.1f} deg from where {where} "
                f"(tolerance {s.start_tolerance_mm:g} mm, {s.start_tolerance_deg:g} deg)"
            )
        return None

    # -- motions -------------------------------------------------------------------------------------------------

    def _lifted(self, plan: Plan) -> Array:
        """X_W_go (3,) a clearance off what the go touches first."""
        return plan.preload_go[0] + self._settings.clearance_mm * 1e-3 * np.append(retreat(plan), 0.0)

    def _settle(self) -> None:
        """Hold until the mean wrench of two windows in a row agrees, or the time-out, which is reported."""
        s = self._settings
        self._mover.rest(max(s.settle, s.window))
        waited = s.settle
        before = self._observer.mean_reading()
        while True:
            self._mover.rest(s.window)
            waited += s.window
            now = self._observer.mean_reading()
            if np.abs(now - before)[:3].max() < s.settle_force:
                return
            if waited > s.settle_timeout:
                self._watch.event(
                    "warning",
                    f"not settled after {waited:.1f} s: force still moves {np.abs(now - before)[:3].max():.3f} N",
                )
                return
            before = now

    def _leave(self) -> None:
        """Take the go off what it touches from wherever the trial ended."""
        self._watch.phase("retreat", 0.0)
        off = 2 * self._settings.clearance_mm * 1e-3 * np.append(retreat(self._result.plan), 0.0)
        self._mover.travel(self._mover.pose + off)
