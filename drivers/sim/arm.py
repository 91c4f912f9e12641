"""The simulated arm: a kinematic end-effector that follows its set-points exactly."""

from __future__ import annotations

from math import pi, remainder

import numpy as np

from drivers.config import ArmConfig
from drivers.errors import CommandRefused
from drivers.interfaces import Arm, ArmTarget, Description
from drivers.sim.device import DeviceWorld, Simulated
from drivers.sim.plant import ZERO, Pose
from mechanics.readings import PoseReading

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
    """

    def __init__(self, name: str, config: ArmConfig, world: DeviceWorld):
        super().__init__(name, config.rate, world)
        self.frame = "world"
        self._config = config
        self._holder: str | None = None
        self._stopped = False
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

    def place(self, pose: Pose) -> None:
        """Put the arm at rest at ``pose`` (x, y, θ) in W."""
        self.pose: Pose = pose
        self.twist: Pose = ZERO
        self._goal, self._goal_twist = pose, ZERO
        self._cubics: list[Cubic] = []
        self._elapsed = self._duration = 0.0

    def advance(self, dt: float) -> None:
        """Follow the present set-point for ``dt`` seconds; `pose` and `twist` are then those of the new instant."""
        if not self._cubics:
            self.twist = ZERO
            return
        self._elapsed += dt
        t = self._elapsed
        if t >= self._duration - 1e-9:
            # the target's twist holds at its own instant; from the next one on the arm rests there
            self.pose, self.twist, self._cubics = self._goal, self._goal_twist, []
            return
        x, y, theta = self._cubics
        self.pose = (_position(x, t), _position(y, t), _position(theta, t))
        self.twist = (_speed(x, t), _speed(y, t), _speed(theta, t))

    def _follow(self, pose: Pose, twist: Pose, duration: float) -> None:
        """Cubic Hermite from the present pose and twist to the given ones."""
        T = duration
        x, y, angle = self.pose
        # the nearest turn of the target's angle, so that the arm never unwinds
        goal = (pose[0], pose[1], angle + remainder(pose[2] - angle, 2 * pi))
        self._cubics = []
        for p0, v0, p1, v1 in zip((x, y, angle), self.twist, goal, twist, strict=True):
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
        self._follow(tuple(pose.tolist()), tuple(twist.tolist()), float(target.duration))

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

    def _read(self) -> PoseReading:
        return PoseReading(self._stamp(), np.array(self.pose))

    def _shut(self) -> None:
        self._rest()
        self._holder = None
