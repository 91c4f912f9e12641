"""The gates of an arm: what every set-point has to pass, and what stops the arm whoever commands it.

They stand in the arm's server, nearest to the robot, for every backend alike, and know neither bus nor threads: a
server tells them the time, the set-points, and what the witnesses of force say. They protect from mistakes of software
in a laboratory. They are no certified safety function: the robot's own safety controller stays in charge.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.config import ArmLimits
from drivers.cubic import cubic
from drivers.errors import CommandRefused, DeviceTimeout, DriverError
from drivers.interfaces import ArmTarget
from mechanics import se2
from mechanics.readings import Array, Status, WrenchReading

NANO = 1e-9
#: so many readings in a row beyond a limit are no outlier
CONFIRMED = 3
#: a sudden change is that of the force smoothed over the first time against the second [s]
_FAST, _SLOW = 0.005, 0.05
#: no arm does anything within less [s]
SHORTEST = 1e-3
_ROUNDING = 1 + 1e-6  # a motion that was planned at a limit is within it
_ASKED = "command a set-point"


@dataclass(frozen=True)
class _Goal:
    """The last accepted set-point: where the arm is going, how fast it arrives, and when [ns].

    It goes there from ``start`` (pose, twist), where it was at ``since_ns``. ``due_ns`` is when it would arrive if it
    had waited for the set-point before: a commander that is in a hurry gets ahead of the time by that.
    """

    pose: Array
    twist: Array
    at_ns: int
    start: tuple[Array, Array]
    since_ns: int
    due_ns: int

    @property
    def moves(self) -> bool:
        return bool(self.twist.any())

    def planned(self, now_ns: int) -> tuple[Array, Array]:
        """Pose and twist (3,) by ``now_ns``, along the cubic that arms follow from set-point to set-point."""
        T = max((self.at_ns - self.since_ns) * NANO, SHORTEST)
        s = min(max((now_ns - self.since_ns) * NANO / T, 0.0), 1.0)
        step = self.pose - self.start[0]
        step[2] = se2.wrap(step[2])
        return cubic(self.start, (self.start[0] + step, self.twist), T, s)


@dataclass
class _Witness:
    """A source of force readings, one each ``period`` [s]; None: it speaks when it likes."""

    period: float | None
    heard_ns: int = 0
    capture_ns: int = 0
    share: float = 0.0  # of its limits, by its newest reading
    over: int = 0  # readings in a row beyond them
    saturated: bool = False
    forgiven: float = 0.0  # the share at which a stop was released
    fast: tuple[float, ...] | None = None
    slow: tuple[float, ...] = ()


class Gates:
    """The gates of one arm. Every method may be called from any thread; times are in ns.

    ``now_ns`` is of a clock that nobody sets, so that no correction of the time hides a silence; ``wall_ns`` is the
    station's, in which set-points and readings are stamped. In a simulated world they are one and the same.

    ``witnesses`` are the sources of force readings by name, each with its period [s], None where it may be silent.
    ``patience`` [s] is the least that a silence lasts: what a network delays is not lost yet. ``reachable(pose)`` says
    why the arm cannot be at a planar pose (3,), where its joints are known, else "".
    """

    def __init__(
        self,
        name: str,
        limits: ArmLimits,
        witnesses: Mapping[str, float | None] | None = None,
        patience: float = 0.0,
        reachable: Callable[[Array], str] = lambda _pose: "",
    ):
        self.name, self.limits = name, limits
        self._patience, self._reachable = patience, reachable
        self._witnesses = {source: _Witness(period) for source, period in (witnesses or {}).items()}
        self._lock = threading.RLock()
        self._accepted = 0
        self._refused: Counter[str] = Counter()
        self._refusal = ""
        self._stopped = self._held = ""
        self._goal: _Goal | None = None
        self._sequence = -1
        self._at: Array | None = None

    @property
    def stopped(self) -> str:
        """Why the arm is stopped; empty while it is not."""
        return self._stopped

    def summary(self) -> dict[str, Any]:
        """What passed and what did not since the server began, by gate; JSON-able."""
        with self._lock:
            return {
                "stopped": self._stopped,
                "held": self._held,
                "accepted": self._accepted,
                "refused": dict(self._refused),
                "refusal": self._refusal,
                "load": {source: round(witness.share, 3) for source, witness in self._witnesses.items()},
            }

    # -- epochs --------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """A new commander: its set-points count from 0, and the first is measured from where the arm is."""
        with self._lock:
            self._sequence, self._goal = -1, None

    def restart(self, now_ns: int, pose: Array | None = None, wall_ns: int | None = None) -> None:
        """Time and force begin anew, with the arm at ``pose`` if that is known. A latched stop stays."""
        wall_ns = now_ns if wall_ns is None else wall_ns
        with self._lock:
            self._goal = None
            self.at(pose)
            for source, witness in self._witnesses.items():
                self._witnesses[source] = _Witness(witness.period, now_ns, wall_ns)

    def at(self, pose: Array | None) -> None:
        """Where the arm is (3,), by its newest reading; None where that says nothing."""
        self._at = pose if pose is not None and all(map(math.isfinite, pose)) else None

    def rested(self) -> None:
        """The arm was held: the next set-point is measured from where it is."""
        with self._lock:
            self._goal = None

    # -- the commander's set-points --------------------------------------------------------------------------------

    def admit(self, target: ArmTarget, sent_ns: int, now_ns: int, wall_ns: int | None = None) -> None:
        """Let a set-point pass, or raise CommandRefused; DeviceTimeout where a witness of force is silent.

        ``sent_ns`` is when its commander sent it, on the wall. What passes counts as accepted once `accept` is told so.
        """
        wall_ns = now_ns if wall_ns is None else wall_ns
        with self._lock:
            for gate, check in (
                ("finite", lambda: self._finite(target)),
                ("sequence", lambda: self._in_sequence(target)),
                ("age", lambda: self._fresh(sent_ns, wall_ns)),
                ("witness", lambda: self._witnessed(now_ns, wall_ns)),
                ("workspace", lambda: self._within(target.pose)),
                ("motion", lambda: self._gentle(target, now_ns)),
            ):
                with self.counting(gate):
                    check()

    @contextmanager
    def counting(self, gate: str) -> Iterator[None]:
        """Count what the block refuses, a DriverError, as this gate's."""
        try:
            yield
        except DriverError as error:
            with self._lock:
                self._refused[gate] += 1
                self._refusal = str(error)
            raise

    def accept(self, target: ArmTarget, now_ns: int) -> None:
        """The arm has taken a set-point. One that a stop overtook leads nowhere."""
        with self._lock:
            self._accepted += 1
            self._sequence = target.sequence
            if self._stopped:
                return
            goal, lasts, pose = self._goal, round(target.duration / NANO), np.asarray(target.pose, float)
            begins, start = now_ns, (pose if self._at is None else self._at, np.zeros(3))
            if goal is not None:
                start = goal.planned(now_ns)
                begins = max(now_ns, goal.due_ns) if self._follows(goal, target, now_ns) else now_ns
            twist = np.asarray(target.twist, float)
            self._goal = _Goal(pose, twist, now_ns + lasts, start, now_ns, begins + lasts)
            self._held = ""

    def _follows(self, goal: _Goal, target: ArmTarget, now_ns: int) -> bool:
        """Whether a set-point goes on from ``goal``, though it may come a little early, and not in its place.

        Early by its own duration at most, and what a network delays: a commander that was held up for a period makes up
        for it with the next. All that it gets ahead of the time counts.
        """
        return (goal.due_ns - now_ns) * NANO <= target.duration * _ROUNDING + self._patience

    def _refuse(self, reason: str, remedy: str) -> None:
        raise CommandRefused(self.name, _ASKED, reason, remedy)

    def _finite(self, target: ArmTarget) -> None:
        numbers = (*target.pose, *target.twist, target.duration)
        if not all(map(math.isfinite, numbers)) or target.duration < 0:
            self._refuse("the target is not finite", "Send finite numbers")

    def _in_sequence(self, target: ArmTarget) -> None:
        if target.sequence <= self._sequence:
            self._refuse(f"target {target.sequence} came after {self._sequence}", "Count targets up within a lease")

    def _fresh(self, sent_ns: int, wall_ns: int) -> None:
        age = (wall_ns - sent_ns) * NANO
        if abs(age) > self.limits.age:
            when = f"{age:.2f} s ago" if age > 0 else f"{-age:.2f} s in the future"
            self._refuse(
                f"it was sent {when}, the limit is {self.limits.age:g} s",
                "See what holds the commander up, and that the clocks of both machines agree",
            )

    def _witnessed(self, now_ns: int, wall_ns: int) -> None:
        for source, witness in self._witnesses.items():
            if witness.period is None:
                continue
            longest = self.limits.silence or max(CONFIRMED * witness.period, self._patience)
            silent, age = (now_ns - witness.heard_ns) * NANO, (wall_ns - witness.capture_ns) * NANO
            if silent > longest or age > max(self.limits.age, longest):
                raise DeviceTimeout(
                    source,
                    "watch over the arm",
                    f"no reading for {max(silent, age):.3g} s",
                    "The arm moves only while its force is known: see to the sensor and its connection",
                )

    def _within(self, pose: Array) -> None:
        limits, (x, y, angle) = self.limits, map(float, pose)
        for what, value, (low, high), unit in (
            ("x", x, limits.x, "m"),
            ("y", y, limits.y, "m"),
            ("the angle", math.degrees(angle), limits.angle_deg, "deg"),
        ):
            if not low <= value <= high:
                self._refuse(
                    f"{what} = {value:.4g} {unit} is outside the workspace, {low:g} to {high:g} {unit}",
                    "Plan within the workspace, or widen `limits` of the arm in the station file",
                )
        if reason := self._reachable(pose):
            self._refuse(reason, "Plan where the arm's joints can go")

    def _gentle(self, target: ArmTarget, now_ns: int) -> None:
        """Step, speed and acceleration, of the motion that leads from the set-point before to this one.

        One that comes in the place of the set-point before, while the arm is still on its way there, is judged from
        where the arm is by then.
        """
        limits, goal = self.limits, self._goal
        if goal is not None and not self._follows(goal, target, now_ns):
            start, before = goal.planned(now_ns)
        else:
            start = self._at if goal is None else goal.pose
            before = np.zeros(3) if goal is None or self._held else goal.twist
        if start is None:
            self._refuse("the arm has not told where it is", "Wait for a reading of its pose that can be trusted")
            return
        step = np.asarray(target.pose, float) - start
        step[2] = se2.wrap(step[2])
        T, twist = target.duration, np.asarray(target.twist, float)
        if T < SHORTEST:
            self._refuse(f"a duration of {T:.3g} s", f"Give the arm {SHORTEST:g} s at least")
        with np.errstate(over="ignore"):  # what is infinite is beyond every limit
            mean = step / T
            change, reach = (twist - before) / T, 2 * (mean - before) / T
        for what, values, limit, turn, unit in (
            ("step", (step,), limits.step_mm * 1e-3, math.radians(limits.step_deg), ""),
            ("speed", (mean, twist), limits.speed, math.radians(limits.turn_speed_deg), "/s"),
            ("acceleration", (change, reach), limits.acceleration, math.radians(limits.turn_acceleration_deg), "/s²"),
        ):
            far = max(math.hypot(value[0], value[1]) for value in values)
            round_ = max(abs(float(value[2])) for value in values)
            remedy = f"Go there in smaller or slower steps, or raise `limits` of '{self.name}' in the station file"
            if not far <= limit * _ROUNDING:  # what is no number at all passes no gate
                self._refuse(f"{what} of {far:.3g} m{unit}, the limit is {limit:g} m{unit}", remedy)
            if not round_ <= turn * _ROUNDING:
                angles = f"{math.degrees(round_):.3g} deg{unit}, the limit is {math.degrees(turn):g} deg{unit}"
                self._refuse(f"turning {what} of {angles}", remedy)

    # -- what stops the arm --------------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """Latch a stop; the first reason stays."""
        with self._lock:
            self._stopped = self._stopped or reason
            self._goal = None

    def recover(self) -> None:
        """Release a latched stop.

        What is beyond a limit by now stops the arm again only if it grows by a tenth, until it has been within it
        once: the arm must be able to leave what it presses on. Of a sensor that is saturated nobody knows whether it
        grows, so that one stops the arm again.
        """
        with self._lock:
            self._stopped = self._held = ""
            self._goal = None
            for witness in self._witnesses.values():
                leaves = witness.share > 1 and not witness.saturated
                witness.forgiven, witness.over = witness.share if leaves else 0.0, 0

    def unheld(self) -> None:
        """The arm could not be held, as `watch` had asked for: it will ask again."""
        with self._lock:
            self._held = ""

    def watch(self, now_ns: int) -> str:
        """The two watchdogs: "hold" or "stop" where a commander fell silent in the midst of a motion, else ""."""
        with self._lock:
            goal = self._goal
            if goal is None or self._stopped or not goal.moves:
                return ""
            late = (now_ns - goal.at_ns) * NANO
            said = f"no set-point for {late:.2g} s in the midst of a motion"
            if late > self.limits.stop_after:
                self.stop(said)
                return "stop"
            if late > self.limits.hold_after and not self._held:
                self._held = said
                return "hold"
            return ""

    def feel(self, source: str, reading: WrenchReading, now_ns: int) -> str:
        """What a witness of force says, heard at ``now_ns``; returns why the arm has to stop now, or ""."""
        fx, fy, fz, tx, ty, tz = reading.wrench.tolist()
        force, torque = math.hypot(fx, fy, fz), math.hypot(tx, ty, tz)
        with self._lock:
            witness = self._witnesses[source]
            if reading.stamp.status in (Status.INVALID, Status.STALE) or not math.isfinite(force + torque):
                return ""  # it said nothing; silence has a gate of its own
            witness.heard_ns, witness.capture_ns = now_ns, reading.stamp.capture_ns
            witness.share = max(force / self.limits.force, torque / self.limits.torque)
            witness.saturated = reading.stamp.status is Status.SATURATED
            if witness.saturated:
                witness.share = max(witness.share, 1.0 + 1e-9)  # who knows how far
            jumped = self._jump(witness, (fx, fy, fz), now_ns)
            if self._stopped:
                return ""
            if jumped > self.limits.jump:
                return f"{source}: the force changed by {jumped:.1f} N at once: contact was lost, or made, unplanned"
            if witness.share <= 1:
                witness.over, witness.forgiven = 0, 0.0
                return ""
            if witness.share <= 1.1 * witness.forgiven and not witness.saturated:
                return ""
            witness.over += 1
            if witness.over < (1 if witness.period is None else CONFIRMED):
                return ""
            if witness.saturated:
                return f"{source} is saturated"
            return (
                f"{source} measures {force:.1f} N and {torque:.2f} N·m, "
                f"the limits are {self.limits.force:g} N and {self.limits.torque:g} N·m"
            )

    def _jump(self, witness: _Witness, force: tuple[float, ...], now_ns: int) -> float:
        """How much the force has changed at once, in the course of a motion [N]; at rest one may tare."""
        goal = self._goal
        moving = goal is not None and (goal.moves or now_ns < goal.at_ns)
        if witness.fast is None or not moving or witness.period is None:
            witness.fast = witness.slow = force
            return 0.0
        quick, slow = min(witness.period / _FAST, 1.0), min(witness.period / _SLOW, 1.0)
        witness.fast = tuple(old + quick * (new - old) for old, new in zip(witness.fast, force, strict=True))
        witness.slow = tuple(old + slow * (new - old) for old, new in zip(witness.slow, force, strict=True))
        return math.dist(witness.fast, witness.slow)
