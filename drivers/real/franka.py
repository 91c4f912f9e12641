"""A Franka arm in the task plane, through its control interface (FCI) and `franky`.

The robot runs its own 1 kHz controller; a thread of libfranka feeds it from the motion that the newest set-point asked
for. Each motion ends at rest by itself, so an arm whose commander falls silent brakes, whatever this process does; and
a robot that hears nothing from this process brakes by its own rules. The state comes by the robot's clock.
"""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from time import monotonic, time_ns
from typing import Any

import numpy as np

from drivers.errors import CommandRefused, DeviceFault, DriverError, NotConnected
from drivers.interfaces import Arm, ArmTarget, Description, freshness
from drivers.real.arm_frames import ArmFrames
from drivers.real.franka_config import FrankaConfig
from drivers.real.franka_link import ARM_PORT, SILENCE, FrankaLink, RobotTime, import_franky
from drivers.real.franka_motion import LEG, Joints, Way, motion, to_rest
from drivers.real.franka_settings import errors, mode, settings
from drivers.registry import Driver
from drivers.streaming import POLL, StreamingSensor
from mechanics.readings import Array, PoseReading, Stamp, Status

_COMMAND = "command a set-point"
#: what the robot may take for a command [s], and for getting over an error
_ANSWER, _RECOVERY = 1.0, 4.0
#: libfranka itself waits so long for a state [s]
_STATE = 1.2
#: libfranka's low-pass filter is off from this cut-off on [Hz]
_UNFILTERED = 1000.0
#: how libfranka says that it cannot plan a motion, and how often another one is tried
_NO_PLAN, _PLANS = "Motion planner failed", 1.0
#: two frames are the same within these [m, 1]
_SAME = 1e-5


class FrankaArm(StreamingSensor[PoseReading], Arm):
    """A Franka arm, seen in the task plane. Set-points go to the robot as they are: the gates are the arm's server's.

    Out of the plane it holds the plane: an arm that stands further out of it than the configuration allows is not
    commanded, and its readings are INVALID. A robot that has gone loses its commander: who commanded it acquires it
    anew. A robot in reflex refuses set-points until `recover`.
    """

    def __init__(self, name: str, config: FrankaConfig):
        super().__init__(name)
        self.config = config
        self.frames = ArmFrames(config.plane, config.tool)
        self.max_age = freshness(config.rate)
        self._link = FrankaLink(name, config.host, ARM_PORT)
        self._clock = RobotTime(config.rate)
        self._franky: Any = None
        self._robot: Any = None
        self._joints: Joints | None = None
        self._set_up = False
        self._turn = threading.RLock()  # one command at a time
        self._holder: str | None = None
        self._stopped = False
        self._broken = ""  # why the last motion failed
        self._way: Way | None = None  # what is left to go of a long one
        self._aim: Array | None = None  # the last set-point's pose, unless it was given up
        self._planless: float | None = None  # since when no motion to it can be planned, by the robot's clock [s]
        self._mode, self._errors = "", ""
        self._off: tuple[float, float] = (0.0, 0.0)  # out of the plane [m, rad]

    def describe(self) -> Description:
        """Its serial number is what the station file says: the interface does not tell it."""
        config = self.config
        return Description(
            name=self.name,
            kind="arm",
            model="Franka arm",
            backend="real",
            serial=config.serial or "unknown",
            frame="world",
            rate=config.rate,
            extra={"child": "ee", "driver": config.driver, "address": self._link.address},
        )

    @property
    def robot_time(self) -> float:
        """The robot's clock at its newest state [s]."""
        return self._clock.now

    # -- reaching it, and letting go ---------------------------------------------------------------------------------

    def _begin(self, timeout: float) -> None:
        deadline = monotonic() + timeout
        self._franky = franky = import_franky(self.name)
        config = self.config
        modes = {"joint": "JointImpedance", "cartesian": "CartesianImpedance"}
        real_time = getattr(franky.RealtimeConfig, config.realtime.capitalize())
        robot = self._link.open(
            lambda: franky.Robot(
                config.host,
                controller_mode=getattr(franky.ControllerMode, modes[config.impedance]),
                realtime_config=real_time,
                default_force_threshold=config.collision_force,
                default_torque_threshold=config.collision_torque,
            ),
            timeout,
        )
        try:
            state = self._link.call("read its state", lambda: robot.state, _left(deadline))
            self._joints = Joints(franky, self.name, robot, state.q)
            self._set_up = False
            if mode(state) == "Idle":  # a robot in reflex takes no settings; `recover` makes up for it
                state = self._set(robot, state, deadline)
        except DriverError as error:
            self._link.cut(lambda: None)
            if isinstance(error, CommandRefused | DeviceFault):
                raise NotConnected(self.name, f"set up {self._link.address}", str(error), error.remedy) from error
            raise
        self._clock.restart(self._last_sequence)
        with self._turn:
            self._robot, self._broken = robot, ""
        self._note(state)

    def _set(self, robot: Any, state: Any, deadline: float) -> Any:
        """The settings that the robot takes between two motions; returns its state with them."""
        for what, ask in settings(robot, state, self.config, self.frames):
            self._link.call(what, ask, _left(deadline))
        while not self._is_ours(state := self._link.call("read its state", lambda: robot.state, _left(deadline))):
            if monotonic() > deadline:  # a command to a wrong frame would turn the arm over
                got = f"the robot keeps to {np.round(state.F_T_EE.matrix, 4).tolist()}"
                raise self._link.fault("set its end-effector", got)
        self._set_up = True
        return state

    def _is_ours(self, state: Any) -> bool:
        """Whether the robot's own end-effector frame is ee."""
        return bool(np.abs(state.F_T_EE.matrix - self.frames.X_F_ee).max() < _SAME)

    def _end(self) -> None:
        with self._turn:
            robot, self._robot, self._joints = self._robot, None, None
            self._way = self._aim = None
            self._holder = None  # whoever commanded it no longer knows where it is
        if robot is None:
            return
        held = [robot]
        del robot

        def drop() -> None:
            with suppress(Exception):
                if held[0].is_in_control:
                    held[0].stop()
            held.clear()  # libfranka joins its thread and closes its sockets

        self._link.cut(drop)

    # -- readings ----------------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        if self._closing.wait(min(self._clock.wait, POLL if self._way is None else LEG / 4)):
            return
        robot = self._robot
        try:
            state = robot.state
            arrival = time_ns()
        except Exception as error:
            raise self._link.fault("read its state", str(error)) from error
        self._watch_motion(robot)
        sequence = self._clock.take(state.time.to_msec())
        self._go_on(robot)
        if sequence is None:
            if self._clock.silent > SILENCE:
                raise self._link.fault("read its state", f"its clock has stood still for {self._clock.silent:.2g} s")
            self._closing.wait(0.0005)  # in a motion the newest state is given without waiting for it
            return
        pose = self._note(state)
        distance, tilt = self._off
        status = Status.INVALID if self._out_of_plane(distance, tilt) else Status.OK
        last = self._readings[-1].stamp.capture_ns if self._readings else 0
        self._push(PoseReading(Stamp(max(arrival, last + 1), arrival, sequence, "world", status), pose))

    def _note(self, state: Any) -> Array:
        """What a state says; returns X_W_ee (3,)."""
        X_EE_ee = np.linalg.inv(state.F_T_EE.matrix) @ self.frames.X_F_ee
        pose, distance, tilt = self.frames.planar(state.O_T_EE.matrix @ X_EE_ee)
        with self._arrived:
            self._set_up = self._set_up and self._is_ours(state)
            self._off = (distance, tilt)
            self._mode, self._errors = mode(state), errors(state)
            self._arrived.notify_all()
        return pose

    def _watch_motion(self, robot: Any) -> None:
        """A motion that failed is told once, by whoever asks first: this thread."""
        try:
            robot.poll_motion()
        except Exception as error:
            said = str(error).removeprefix("libfranka: ").splitlines()[0]
            if "preempted" in said or type(error).__name__ == "NetworkException":
                return  # it was stopped; that the robot has gone is told by its state
            with self._turn:
                aim = self._aim
                now = self._clock.now
                self._planless = now if self._planless is None else self._planless
                if not said.startswith(_NO_PLAN) or now - self._planless > _PLANS:
                    self._broken, self._way = said, None
                elif aim is not None and self._way is None and not self._stopped:
                    # rarely a twist cannot be had in the time; the pose can, at the latest once the robot has braked,
                    # as it does by itself where a motion fails: that is all that a hold asks for
                    self._move(robot, to_rest(self._franky, self.frames, aim, self.config.dynamics / 2), "go on")

    def _out_of_plane(self, distance: float, tilt: float) -> bool:
        far = abs(distance) > self.config.out_of_plane_mm * 1e-3
        return far or abs(tilt) > math.radians(self.config.tilt_deg)

    def latest(self, timeout: float = 1.0) -> PoseReading:
        """As `StreamingSensor.latest`; DeviceFault for a robot whose clock stands still."""
        try:
            return super().latest(timeout)
        except DriverError:
            if self._trouble is None and self._robot is not None and self._clock.silent > SILENCE:
                raise self._link.fault("read", f"its clock has stood still for {self._clock.silent:.2g} s") from None
            raise

    # -- commands ----------------------------------------------------------------------------------------------------

    def acquire(self, holder: str) -> None:
        """Take the lease; the holder itself may ask again."""
        self._need_robot("acquire")
        with self._turn:
            if self._holder not in (None, holder):
                raise CommandRefused(
                    self.name, "acquire", f"'{self._holder}' holds the lease", "Wait until it has finished, or stop it"
                )
            self._holder = holder

    def release(self) -> None:
        """Hold the arm and give the lease back; idempotent."""
        with self._turn:
            held, self._holder = self._holder is not None, None
        if held:
            with suppress(DriverError):  # an arm that has gone is held by itself
                self.hold()

    @property
    def holder(self) -> str | None:
        """Who has the lease."""
        return self._holder

    def reachable(self, pose: Array) -> str:
        """By the joints' limits that the robot itself gives out; "" while it is not connected."""
        joints = self._joints
        return "" if joints is None else joints.unreachable(self.frames.flange_in_base(pose))

    def command(self, target: ArmTarget) -> None:
        """Go to one set-point, which replaces the one before from where the arm is by then."""
        self._check(target)
        with self._turn:
            robot = self._need_robot(_COMMAND)
            self._may_move()
            linear, angular = self.frames.twist_in_base(np.asarray(target.twist, float))
            for what, speed, limit, unit in (
                ("speed", np.linalg.norm(linear), robot.translation_velocity_limit, "m/s"),
                ("turning speed", np.linalg.norm(angular), robot.rotation_velocity_limit, "rad/s"),
            ):
                most = limit.get() * self.config.dynamics
                if speed > most:
                    raise CommandRefused(
                        self.name, _COMMAND, f"{what} of {speed:.3g} {unit}, the robot is set to {most:.3g}",
                        "Go slower, or raise `dynamics` of the arm in the station file",
                    )  # fmt: skip
            if target.duration > 1.5 * LEG:
                self._way = Way(self._clock.now, *self._going(robot), target)
                leg, _ = self._way.leg(self._clock.now)
            else:
                leg, self._way = (
                    (np.asarray(target.pose, float), np.asarray(target.twist, float), target.duration),
                    None,
                )
            assert leg is not None  # a way's first one is due at once
            self._aim, self._planless = np.asarray(target.pose, float), None
            self._move(
                robot, motion(self._franky, self.frames, leg, self.config.dynamics, self.config.braking), _COMMAND
            )

    def _go_on(self, robot: Any) -> None:
        """The next leg of the way to the set-point, when it is due."""
        with self._turn:
            if (way := self._way) is None or self._broken:
                return
            leg, last = way.leg(self._clock.now)
            if last:
                self._way = None
            if leg is not None:
                self._move(
                    robot, motion(self._franky, self.frames, leg, self.config.dynamics, self.config.braking), "go on"
                )

    def _going(self, robot: Any) -> tuple[Array, Array]:
        """Planar pose and twist (3,) that the robot was last told to have."""
        try:
            moves, state = robot.is_in_control, robot.state
        except Exception as error:
            raise self._link.fault("read its state", str(error)) from error
        if not moves:
            return self.frames.planar(state.O_T_EE.matrix)[0], np.zeros(3)
        told = state.O_dP_EE_c
        return self.frames.planar(state.O_T_EE_c.matrix)[0], self.frames.planar_twist(told.linear, told.angular)

    def _check(self, target: ArmTarget) -> None:
        pose, twist = np.asarray(target.pose, float), np.asarray(target.twist, float)
        if pose.shape != (3,) or twist.shape != (3,):
            raise CommandRefused(
                self.name, _COMMAND, f"pose and twist must be (3,), they are {pose.shape} and {twist.shape}"
            )
        if not (np.isfinite(pose).all() and np.isfinite(twist).all() and math.isfinite(target.duration)):
            raise CommandRefused(self.name, _COMMAND, f"not finite: {target}", "Look for a NaN in what computed it")
        if target.duration <= 0:
            raise CommandRefused(self.name, _COMMAND, f"the duration must be positive, it is {target.duration:g} s")

    def _may_move(self) -> None:
        remedy = "See why, then recover it: `extrinsic recover STATION`"
        distance, tilt = self._off
        refused = ""
        if self._holder is None:
            refused, remedy = "no lease", "Command within `with arm.lease(name):`"
        elif self._stopped:
            refused = "the arm is stopped"
        elif self._mode not in ("Idle", "Move"):
            refused = f"the robot is in mode {self._mode}" + (f": {self._errors}" if self._errors else "")
        elif self._broken:
            refused = f"the last motion failed: {self._broken}"
        elif not self._set_up:
            refused = "the robot's end-effector frame is not the one that was set"
            remedy = "Recover the arm to set it, or close and connect it again"
        elif self._out_of_plane(distance, tilt):
            refused = (
                f"ee is {distance * 1e3:.1f} mm and {math.degrees(tilt):.1f}° out of the task plane, "
                f"the limits are {self.config.out_of_plane_mm:g} mm and {self.config.tilt_deg:g}°"
            )
            remedy = "Guide it into the plane by hand, or see to `plane` and `tool` in the station file"
        if refused:
            raise CommandRefused(self.name, _COMMAND, refused, remedy)

    def _move(self, robot: Any, goes: Any, asked: str) -> None:
        """Begin a motion, in place of the one that goes on; it takes libfranka's thread as long as a state at most."""
        try:
            try:
                # unfiltered: what is planned is smooth, and after a lost packet the filter's lag would pass for speed
                robot.move(goes, asynchronous=True, cutoff_frequency=_UNFILTERED)
            except Exception as error:
                if _NO_PLAN not in str(error):
                    raise
                # the motion before could not be planned, which franky tells whoever moves next
                robot.move(goes, asynchronous=True, cutoff_frequency=_UNFILTERED)
        except Exception as error:
            if type(error).__name__ == "CommandException":
                raise CommandRefused(self.name, asked, str(error), "See the robot's own page (Desk)") from error
            raise self._link.fault(asked, f"{type(error).__name__}: {error}") from error

    def _need_robot(self, asked: str) -> Any:
        """The robot; raises NotConnected, and DeviceFault where it has gone or its clock stands still."""
        self._need_connection(asked)
        self._raise_trouble()
        robot = self._robot
        if robot is None or self._clock.silent > SILENCE:
            raise self._link.fault(asked, f"its clock has stood still for {self._clock.silent:.2g} s")
        return robot

    def hold(self) -> None:
        """Brake as hard as the robot's own limits allow, and stay there."""
        with self._turn:
            robot = self._need_robot("hold")
            self._way = self._aim = self._planless = None
            if robot.is_in_control:
                self._move(robot, self._franky.CartesianStopMotion(), "hold")

    def stop(self) -> None:
        """Let the robot end its motion at once, and refuse set-points until `recover`."""
        self._need_connection("stop")
        self._stopped = True
        robot = self._need_robot("stop")
        self._way = None
        self._end_motion(robot)
        with self._turn:  # a set-point that was on its way has been sent by now
            self._way = self._aim = None
            self._end_motion(robot)

    def _end_motion(self, robot: Any) -> None:
        try:
            self._link.call("stop", robot.stop, _ANSWER)
        except CommandRefused:
            if robot.is_in_control:  # at rest there is nothing to stop
                raise

    def recover(self) -> None:
        """Get over a reflex, release a latched stop. Raises CommandRefused while the robot's own stop is pressed."""
        robot = self._need_robot("recover")
        if self._mode == "UserStopped":
            raise CommandRefused(self.name, "recover", "the robot's stop is pressed", "Release it, then recover again")
        if self._mode == "Reflex" or self._errors:
            self._link.call("recover", robot.recover_from_errors, _RECOVERY)
            with self._arrived:  # what that returns may be of a state from before
                if not self._arrived.wait_for(lambda: self._mode in ("Idle", "Move") and not self._errors, _STATE):
                    still = f"the robot stays in mode {self._mode}: {self._errors or 'it names no error'}"
                    raise DeviceFault(self.name, "recover", still, "See the robot's own page (Desk)")
        with self._turn:
            if not self._set_up:
                self._set(robot, robot.state, monotonic() + _RECOVERY)
            self._stopped, self._broken = False, ""


def _left(deadline: float) -> float:
    """Until ``deadline`` [s]; a little in any case, since what is asked is usually answered at once."""
    return max(deadline - monotonic(), 0.05)


DRIVER = Driver(FrankaConfig, FrankaArm)
