"""Streaming a path to the arm: quintic ramps, holds, and waiting until the readings have settled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import numpy as np

from control.settings import TrialSettings
from drivers.errors import CommandRefused
from drivers.interfaces import Arm, ArmTarget, Clock
from mechanics import se2
from mechanics.readings import Array

#: the greatest speed of a minimum-jerk motion over its mean
PEAK = 15 / 8
#: set-points over which a motion that had to halt in its midst gathers speed again
GATHERING = 10

Path = Callable[[float], tuple[Array, Array]]
"""Pose and twist (3,) after so many periods of a motion, fractions of one among them."""


def quintic(s: float) -> tuple[float, float]:
    """Position and slope of the minimum-jerk ramp from 0 to 1 at ``s`` in [0, 1]: 10 s³ − 15 s⁴ + 6 s⁵."""
    return s**3 * (10 - 15 * s + 6 * s * s), 30 * s * s * (1 - s) ** 2


class Mover:
    """Sends set-points at ``rate`` [Hz]; every motion starts where the last one ended.

    In real time this process may be held up in the midst of a motion, and the arm's server holds the arm (`hold_after`
    in the station file). The motion then goes on along its path from rest, gathering speed, for no gate would let it go
    at its speed at once. What is refused for another reason is raised.
    """

    def __init__(
        self,
        arm: Arm,
        clock: Clock,
        rate: float,
        start: Array,
        speed: float,
        tick: Callable[[], None] = lambda: None,
        pace: float = 1.0,
        event: Callable[[str, str], None] = lambda _level, _text: None,
    ):
        """``start`` (3,) is the present pose of the end-effector, ``speed`` [m/s] the mean speed of free motions.

        ``tick`` is called after each set-point. ``pace`` slows every motion down: 0.2 is a fifth of its speed.
        ``event`` is told, with its level, where a motion had to halt.
        """
        self.pose = np.asarray(start, float)
        self.speed, self.pace = speed, pace
        self._arm, self._clock, self._period = arm, clock, 1.0 / rate
        self._sequence = self._due_ns = 0
        self._tick, self._event = tick, event

    @classmethod
    def of(
        cls,
        arm: Arm,
        clock: Clock,
        start: Array,
        settings: TrialSettings,
        tick: Callable[[], None] = lambda: None,
        event: Callable[[str, str], None] = lambda _level, _text: None,
    ) -> Self:
        """The mover that a trial's ``settings`` ask for."""
        return cls(arm, clock, settings.control_rate, start, settings.approach_speed, tick, settings.speed, event)

    def _send(self, pose: Array, twist: Array) -> None:
        self._wait(self._command(pose, twist))

    def _command(self, pose: Array, twist: Array) -> int:
        """Send a set-point; returns when that was [ns]."""
        self._sequence += 1
        sent_ns = self._clock.now_ns()
        self._arm.command(ArmTarget(pose, twist, self._period, self._sequence))
        self.pose = pose
        return sent_ns

    def _wait(self, sent_ns: int) -> None:
        """Until the set-point after the one sent at ``sent_ns`` is due."""
        self._clock.sleep(self._period if self._clock.lockstep else self._until_due(sent_ns))
        self._tick()

    def _until_due(self, sent_ns: int) -> float:
        """How long until the next set-point is due: what this one took is not to slow the motion down.

        A set-point that was sent more than a period after it was due, late or as the first after a pause, begins the
        time anew: the arm would hurry after it.
        """
        period = round(self._period * 1e9)
        self._due_ns = (self._due_ns if sent_ns - self._due_ns < period else sent_ns) + period
        return max(self._due_ns - self._clock.now_ns(), 0) * 1e-9

    def _late(self) -> float:
        """By how much [s] the set-point that is due is late, more than a period; 0 where it is not."""
        late = 0.0 if self._clock.lockstep or not self._due_ns else (self._clock.now_ns() - self._due_ns) * 1e-9
        return late if late > self._period else 0.0

    def _along(self, path: Path, ticks: int) -> None:
        """Send the set-points of a motion that takes ``ticks`` periods, and more where it has to gather speed."""
        at, share, halted = 0.0, 1.0, ""  # how far it is, what it has of its speed, and why it halted just now
        while at < ticks:
            faster = min(share + 1 / GATHERING, 1.0)
            ahead = min(at + (share + faster) / 2, ticks)
            pose, twist = path(ahead)
            try:
                sent_ns = self._command(pose, faster * twist)
            except CommandRefused as error:
                late = self._late()  # by now: it may have been held up on its way, too
                if halted or not late:
                    raise
                share, halted = 0.0, f"halted in the midst of a motion, {late:.2g} s late: {error.reason}"
                continue
            if halted:
                self._event("warning", f"{halted}; it goes on from rest")
            at, share, halted = ahead, faster, ""
            self._wait(sent_ns)

    def _ticks(self, seconds: float) -> int:
        """Set-points of a motion that is meant to take ``seconds``."""
        return max(1, round(seconds / self.pace / self._period))

    def ramp(self, goal: Array, seconds: float) -> None:
        """Move to ``goal`` (3,) along a straight line in (x, y, θ) with a quintic time law, taking ``seconds``."""
        start = self.pose
        step = np.asarray(goal, float) - start
        step[2] = se2.wrap(step[2])
        ticks = self._ticks(seconds)

        def path(at: float) -> tuple[Array, Array]:
            s, slope = quintic(at / ticks)
            return start + s * step, slope * step / (ticks * self._period)

        self._along(path, ticks)

    def through(self, path: Array, seconds: float) -> None:
        """Move along the polyline ``path`` (M, 3), one minimum-jerk time law over the whole, taking ``seconds``.

        The path is a function of its index (a force level, say), so the speed between its points follows their spacing.
        """
        points = np.concatenate([self.pose[None], np.asarray(path, float)])
        points[:, 2] = np.unwrap(points[:, 2])
        ticks = self._ticks(seconds)

        def polyline(at: float) -> tuple[Array, Array]:
            s, slope = quintic(at / ticks)
            along = s * (len(points) - 1)
            k = min(int(along), len(points) - 2)
            segment = points[k + 1] - points[k]
            twist = segment * slope * (len(points) - 1) / (ticks * self._period)
            return points[k] + (along - k) * segment, twist

        self._along(polyline, ticks)

    def travel(self, goal: Array) -> None:
        """Move to ``goal`` in free air at the mover's speed (60 deg/s for turns), never faster than 0.2 s."""
        step = np.asarray(goal, float) - self.pose
        seconds = max(0.2, float(np.hypot(step[0], step[1])) / self.speed, abs(float(se2.wrap(step[2]))) / np.pi * 3)
        self.ramp(goal, seconds)

    def go_above(self, goal: Array) -> None:
        """Travel to ``goal`` (3,) in free air: up, then across, then down, so that nothing is swept off the table."""
        here = self.pose
        height = max(here[1], goal[1])
        for pose in ([here[0], height, here[2]], [goal[0], height, goal[2]], goal):
            if np.abs(np.asarray(pose) - self.pose).max() > 1e-6:
                self.travel(np.asarray(pose, float))

    def follow(self, pose: Array, twist: Array) -> None:
        """One set-point of a path that the caller makes up: ``pose`` (3,) and ``twist`` (3,), one period from now.

        At a slower pace it is several, along a straight line. One that is refused is raised: the path's time is the
        caller's, and so is what a halt means to it.
        """
        start, goal, ticks = self.pose, np.asarray(pose, float), self._ticks(self._period)
        for i in range(1, ticks):
            self._send(start + i / ticks * (goal - start), np.asarray(twist, float) / ticks)
        self._send(goal, np.asarray(twist, float) / ticks)

    def rest(self, seconds: float) -> None:
        """Stay for ``seconds``, repeating the set-point so that no watchdog mistakes a pause for a dead commander."""
        for _ in range(max(1, round(seconds / self._period))):
            self._send(self.pose, np.zeros(3))
