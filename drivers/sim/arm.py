"""The simulated arm: a kinematic end-effector that follows its set-points, as well as its world's profile allows."""

from __future__ import annotations

from math import exp, pi, remainder

import numpy as np

from drivers.config import ArmConfig
from drivers.errors import CommandRefused
from drivers.interfaces import Arm, ArmTarget, Description
from drivers.sim.device import DeviceWorld, Simulated
from drivers.sim.faults import Guard, MotionGuard
from drivers.sim.mismatch import Stream
from drivers.sim.plant import ZERO, Pose
from mechanics.readings import PoseReading

#: how long a new error of repeatability takes to build up [s]; the shortest motions take twice as long
BUILD_UP = 0.1
#: what is nearer to its set-point than this is there [m, rad]
ARRIVED = 1e-9
#: faster than this [m/s, m/s, rad/s] no reading changes by itself: a Panda's Cartesian limits
FASTEST = (1.7, 1.7, 2.5)
#: a set-point that goes further than this [m, m, rad] shows in the readings
SEEN = (1e-4, 1e-4, 1e-3)
#: coefficients of 1, t, t², t³
Cubic = tuple[float, float, float, float]


def _position(cubic: Cubic, t: float) -> float:
    a, b, c, d = cubic
    return a + t * (b + t * (c + t * d))


def _speed(cubic: Cubic, t: float) -> float:
    _, b, c, d = cubic
    return b + t * (2 * c + 3 * t * d)


class SimArm(Simulated[PoseReading], Arm):
    """Goes to each `ArmTarget` along the cubic in time that starts from the present pose and twist.

    It reaches pose and twist of the target after its duration. Without a new target it stays there, its twist zero
    at once: it never overshoots the last accepted target. A latched stop and the lease outlive a reset of the world.

    Three figures of the profile come between the command and the truth. With a lag the arm follows that path as a
    first-order system; the reported `pose` shows it. Bias and repeatability it cannot see: `true_pose` is the reported
    pose plus a constant, plus an error that is drawn anew whenever the arm leaves a rest and stays while it rests.
    """

    def __init__(self, name: str, config: ArmConfig, world: DeviceWorld):
        super().__init__(name, config.rate, world)
        self.frame = "world"
        self._config = config
        self._holder: str | None = None
        self._stopped = False
        self._bias = self._error = self._error_before = self._error_step = ZERO
        self._spread = ZERO
        self._building = BUILD_UP
        self._lag = 0.0
        self.line.on_silence = self._rest
        self.place(ZERO)

    def describe(self) -> Description:
        """A kinematic arm without limits; its resolution is that of the numbers."""
        return Description(
            name=self.name,
            kind="arm",
            model="simulated planar arm",
            backend="sim",
            serial=self._config.serial,
            frame=self.frame,
            rate=self.rate,
            resolution=ZERO,
            extra={"child": "ee"},
        )

    # -- motion, driven by the world -----------------------------------------------------------------------------

    def restart(self, rng: np.random.Generator) -> None:
        """Begin a new epoch: the profile's bias and lag hold from now on; the arm has no other error until it moves."""
        super().restart(rng)
        figures = self._world.profile.arm
        self._lag = figures.lag
        self._bias = self._world.lab.arm_bias
        x, y, theta = figures.repeatability.si.tolist()
        self._spread = (x, y, theta)
        self._error = self._error_before = self._error_step = ZERO
        self._building = BUILD_UP

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Draw the errors of repeatability from ``rng`` from now on."""
        super().begin_trial(rng)
        self._rng = rng

    def place(self, pose: Pose) -> None:
        """Put the arm at rest at ``pose`` (x, y, θ) in W, as the arm reports it."""
        self.pose: Pose = pose
        self.twist: Pose = ZERO
        self._aim = self._aim_before = pose
        self._aim_twist = ZERO
        self._goal, self._goal_twist = pose, ZERO
        self._cubics: list[Cubic] = []
        self._elapsed = self._duration = 0.0
        if self._building < BUILD_UP:
            # what has built up stays
            self._error_before, self._error_step, self._building = self._error, ZERO, BUILD_UP
        self._tell_truth(ZERO)

    def advance(self, dt: float) -> None:
        """Follow the present set-point for ``dt`` seconds; poses and twists are then those of the new instant."""
        self._aim_before = self._aim
        self._advance_aim(dt)
        if self._lag:
            self._lag_behind(dt)
        else:
            self.pose, self.twist = self._aim, self._aim_twist
        drift = ZERO
        if self._building < BUILD_UP:
            drift = self._build_up(dt)
        self._tell_truth(drift)

    def _advance_aim(self, dt: float) -> None:
        """Where the arm would be without a lag."""
        if not self._cubics:
            self._aim_twist = ZERO
            return
        self._elapsed += dt
        t = self._elapsed
        if t >= self._duration - 1e-9:
            # the target's twist holds at its own instant; from the next one on the arm rests there
            self._aim, self._aim_twist, self._cubics = self._goal, self._goal_twist, []
            return
        x, y, theta = self._cubics
        self._aim = (_position(x, t), _position(y, t), _position(theta, t))
        self._aim_twist = (_speed(x, t), _speed(y, t), _speed(theta, t))

    def _lag_behind(self, dt: float) -> None:
        (ax, ay, at), (x, y, t) = self._aim, self.pose
        if not self._cubics and abs(ax - x) + abs(ay - y) + abs(at - t) < ARRIVED:
            self.pose, self.twist = self._aim, ZERO
            return
        # exact for an aim that runs evenly through the step
        lag, rest = self._lag, exp(-dt / self._lag)
        poses, twists = [], []
        for before, aim, pose in zip(self._aim_before, self._aim, self.pose, strict=True):
            behind = (aim - before) / dt * lag
            poses.append(aim - behind + (pose - before + behind) * rest)
            twists.append((aim - poses[-1]) / lag)
        (x, y, t), (vx, vy, w) = poses, twists
        self.pose, self.twist = (x, y, t), (vx, vy, w)

    def _build_up(self, dt: float) -> Pose:
        """Go on toward the present motion's error of repeatability; returns the rate of it."""
        self._building = min(self._building + dt, BUILD_UP)
        s = self._building / BUILD_UP
        share, slope = s * s * (3 - 2 * s), 6 * s * (1 - s) / BUILD_UP
        (bx, by, bt), (dx, dy, dt_) = self._error_before, self._error_step
        self._error = (bx + share * dx, by + share * dy, bt + share * dt_)
        return slope * dx, slope * dy, slope * dt_

    def _tell_truth(self, drift: Pose) -> None:
        (x, y, t), (bx, by, bt), (ex, ey, et) = self.pose, self._bias, self._error
        #: where the ee is in W, and how fast
        self.true_pose: Pose = (x + (bx + ex), y + (by + ey), t + (bt + et))
        if drift is ZERO:
            self.true_twist: Pose = self.twist
        else:
            (vx, vy, w), (dx, dy, dw) = self.twist, drift
            self.true_twist = (vx + dx, vy + dy, w + dw)

    def _leave_rest(self) -> None:
        """A new motion: it will end elsewhere within the arm's repeatability."""
        draws = self._rng.standard_normal(3).tolist()
        x, y, t = self._error
        sx, sy, st = (s * d for s, d in zip(self._spread, draws, strict=True))
        self._error_before, self._error_step, self._building = self._error, (sx - x, sy - y, st - t), 0.0

    def follow(self, pose: Pose, twist: Pose, duration: float, *, sets_out: bool | None = None) -> None:
        """Cubic Hermite from the present aim and its twist to the given ones, ``duration`` seconds from now.

        This is the motion itself, without lease, stop or checks: `command` is for whoever commands the arm. Whether it
        ``sets_out`` on a motion, which has an error of its own, is by default told by its having been at rest.
        """
        T = duration
        x, y, angle = self._aim
        # the nearest turn of the target's angle, so that the arm never unwinds
        goal = (pose[0], pose[1], angle + remainder(pose[2] - angle, 2 * pi))
        if sets_out is None:
            at_rest = not self._cubics and self._aim_twist == ZERO
            sets_out = at_rest and max(abs(a - b) for a, b in zip(goal, self._aim, strict=True)) > ARRIVED
        if sets_out and self._spread != ZERO:
            self._leave_rest()
        self._cubics = []
        for p0, v0, p1, v1 in zip((x, y, angle), self._aim_twist, goal, twist, strict=True):
            slope = (p1 - p0) / T
            self._cubics.append((p0, v0, (3 * slope - 2 * v0 - v1) / T, (v0 + v1 - 2 * slope) / (T * T)))
        self._goal, self._goal_twist = goal, twist
        self._elapsed, self._duration = 0.0, T

    # -- commands ------------------------------------------------------------------------------------------------

    def acquire(self, holder: str) -> None:
        """Take the lease; the holder itself may ask again."""
        self._need_connection("acquire")
        if self._holder not in (None, holder):
            raise CommandRefused(
                self.name, "acquire", f"'{self._holder}' holds the lease", "Wait until it has finished, or stop it"
            )
        self._holder = holder

    def release(self) -> None:
        """Hold the arm and give the lease back; idempotent."""
        if self._holder is not None:
            self._rest()
            self._holder = None

    @property
    def holder(self) -> str | None:
        """Who has the lease."""
        return self._holder

    def command(self, target: ArmTarget) -> None:
        """Accept one set-point, which replaces the one before from its present pose and twist on."""
        self._need_connection("command")
        self._world.plant(self.name, "command")
        if self._holder is None:
            raise CommandRefused(self.name, "command", "no lease", "Command within `with arm.lease(name):`")
        if self._stopped:
            raise CommandRefused(
                self.name, "command", "the arm is stopped", "See why, then recover it: `extrinsic recover STATION`"
            )
        pose, twist = np.asarray(target.pose, float), np.asarray(target.twist, float)
        if pose.shape != (3,) or twist.shape != (3,):
            raise CommandRefused(
                self.name, "command", f"pose and twist must be (3,), they are {pose.shape} and {twist.shape}"
            )
        if not (np.isfinite(pose).all() and np.isfinite(twist).all() and np.isfinite(target.duration)):
            raise CommandRefused(self.name, "command", f"not finite: {target}", "Look for a NaN in what computed it")
        if target.duration <= 0:
            raise CommandRefused(self.name, "command", f"the duration must be positive, it is {target.duration:g} s")
        self.follow(tuple(pose.tolist()), tuple(twist.tolist()), float(target.duration))

    def hold(self) -> None:
        """Stay where the arm is now."""
        self._need_connection("hold")
        self._rest()

    def stop(self) -> None:
        """Stay where the arm is now and refuse set-points until `recover`."""
        self._need_connection("stop")
        self._rest()
        self._stopped = True

    def recover(self) -> None:
        """Accept set-points again."""
        self._need_connection("recover")
        self._stopped = False

    def _rest(self) -> None:
        self.place(self.pose)

    # -- readings ------------------------------------------------------------------------------------------------

    def _figures(self) -> Stream:
        return self._world.profile.arm

    def _make_guard(self) -> Guard:
        return MotionGuard(FASTEST, SEEN, lambda: self._aim)

    def _read(self) -> PoseReading:
        return PoseReading(self._stamp(), np.array(self.pose))

    def _shut(self) -> None:
        self._rest()
        self._holder = None
