"""The Franka hand, through its own server beside the arm's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from math import isfinite
from time import monotonic, time_ns
from typing import Any, Literal

from pydantic import Field

from drivers.config import GripperConfig, RealDevice
from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, DriverError, NotConnected
from drivers.interfaces import Description, Gripper, freshness
from drivers.real.franka_config import HOST
from drivers.real.franka_link import HAND_PORT, SILENCE, FrankaLink, RobotTime, import_franky
from drivers.registry import Driver
from drivers.streaming import POLL, StreamingSensor
from mechanics.readings import GripperReading, Stamp

#: by its data sheet: widest opening [m], largest continuous force [N], fastest opening or closing [m/s]
OPEN, STRONGEST, FASTEST = 0.08, 70.0, 0.1
#: how long it may take to begin and to be still, beyond the way at its speed [s]
_SETTLE = 3.0
_ANSWER = 1.0
#: fingers that move less between two readings rest [m]
_STILL = 1e-4
_HOMING = 15.0


class FrankaHandConfig(RealDevice, GripperConfig, frozen=True):
    """A Franka hand."""

    driver: Literal["franka_hand"]
    serial: str = Field(default="", description="a label: the interface does not tell the hand's own")
    rate: float = Field(default=10.0, gt=0, le=100)
    host: str = Field(default="172.16.0.2", pattern=HOST, description="the robot's address")
    speed: float = Field(default=0.03, gt=0, le=FASTEST, description="of opening and closing [m/s]")
    home: bool = Field(default=False, description="measure the opening when it is connected: THE FINGERS MOVE")
    nothing: float = Field(default=0.002, ge=0, le=0.02, description="fingers closer than this hold nothing [m]")


class FrankaHand(StreamingSensor[GripperReading], Gripper):
    """A Franka hand. It measures no force: a reading says which one was asked for, while something is held."""

    def __init__(self, name: str, config: FrankaHandConfig):
        super().__init__(name)
        self.config = config
        self.max_age = freshness(config.rate)
        self._link = FrankaLink(name, config.host, HAND_PORT)
        self._clock = RobotTime(config.rate)
        self._hand: Any = None
        self._turn = threading.Lock()
        self._force = 0.0
        self._widest = 0.0

    def describe(self) -> Description:
        """``range`` is the widest opening [m] and the largest force [N]."""
        config = self.config
        return Description(
            name=self.name,
            kind="gripper",
            model="Franka hand",
            backend="real",
            serial=config.serial or "unknown",
            frame=self.name,
            rate=config.rate,
            range=(OPEN, STRONGEST),
            extra={"driver": config.driver, "address": self._link.address},
        )

    def _begin(self, timeout: float) -> None:
        franky = import_franky(self.name)
        hand = self._link.open(lambda: franky.Gripper(self.config.host), timeout)
        try:
            if self.config.home:
                self._run(hand, "measure its opening", hand.homing_async, _HOMING)
            state = self._link.call("read its state", lambda: hand.state, 1.5)
        except DriverError as error:
            self._link.cut(lambda: None)
            raise NotConnected(self.name, f"set up {self._link.address}", str(error), error.remedy) from error
        self._widest = state.max_width
        self._clock.restart(self._last_sequence)
        self._hand = hand

    def _end(self) -> None:
        hand, self._hand = self._hand, None
        if hand is None:
            return
        held = [hand]
        del hand
        self._link.cut(held.clear)

    def _poll(self) -> None:
        if self._closing.wait(min(self._clock.wait, POLL)):
            return
        try:
            state = self._hand.state
            arrival = time_ns()
        except Exception as error:
            raise self._link.fault("read its state", str(error)) from error
        sequence = self._clock.take(state.time.to_msec())
        if sequence is None:
            if self._clock.silent > SILENCE:
                raise self._link.fault("read its state", f"its clock has stood still for {self._clock.silent:.2g} s")
            self._closing.wait(0.001)
            return
        holding = bool(state.is_grasped) and state.width > self.config.nothing
        self._widest = state.max_width
        last = self._readings[-1].stamp.capture_ns if self._readings else 0
        stamp = Stamp(max(arrival, last + 1), arrival, sequence, self.name)
        self._push(GripperReading(stamp, float(state.width), self._force if holding else 0.0, holding))

    def grasp(self, force: float) -> None:
        """Close on what is between the fingers; where nothing is, they close fully and the readings say so."""
        if not (isfinite(force) and 0 < force <= STRONGEST):
            raise CommandRefused(self.name, "grasp", f"the force must be in (0, {STRONGEST:g}] N, it is {force:g}")
        speed = self.config.speed
        # any width will do: from fully closed to fully open
        self._move("grasp", lambda hand: hand.grasp_async(0.0, speed, force, OPEN, OPEN), force)

    def release(self) -> None:
        """Open the fingers as wide as they go."""
        self._need_connection("release")
        widest = self._widest
        if widest <= 0:
            raise CommandRefused(
                self.name, "release", "its opening was never measured", "Set `home: true`, or home it in Desk"
            )
        self._move("release", lambda hand: hand.move_async(widest, self.config.speed), 0.0)

    def _move(self, asked: str, begin: Callable[[Any], Any], force: float) -> None:
        self._need_connection(asked)
        self._raise_trouble()
        with self._turn:
            hand = self._hand
            if hand is None:
                raise self._link.fault(asked, "it has gone")
            self._force = force
            self._run(hand, asked, lambda: begin(hand), OPEN / self.config.speed + _SETTLE)
        since = time_ns()

        def rests() -> bool:
            """What is read is as the fingers were left; the hand says that it is done while they still creep."""
            if self._trouble is not None or len(self._readings) < 2:
                return self._trouble is not None
            before, newest = self._readings[-2], self._readings[-1]
            return before.stamp.capture_ns > since and abs(newest.width - before.width) < _STILL

        with self._arrived:
            self._arrived.wait_for(rests, _ANSWER)
        self._raise_trouble()

    def _run(self, hand: Any, asked: str, begin: Callable[[], Any], timeout: float) -> None:
        """Wait until a motion has ended. Raises DeviceTimeout, DeviceFault; the fingers are stopped then."""
        going = self._link.call(asked, begin)
        deadline = monotonic() + timeout
        while not going.wait(0.1):
            if self._closing.is_set() and self._hand is not None:
                raise DeviceFault(self.name, asked, "it was closed meanwhile", "")
            self._raise_trouble()
            if monotonic() > deadline:
                self._link.call("stop", hand.stop, _ANSWER)
                raise DeviceTimeout(self.name, asked, f"not done within {timeout:g} s", "See what is in its way")
        if not self._link.call(asked, going.get):
            raise DeviceFault(self.name, asked, "the hand says it failed", "See Desk, and home the hand", True)


DRIVER = Driver(FrankaHandConfig, FrankaHand)
