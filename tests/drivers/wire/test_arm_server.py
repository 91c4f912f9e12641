"""An arm's server beside an arm that does not answer, or a commander whose replies are lost."""

from __future__ import annotations

import threading

import numpy as np

from drivers.config import ArmLimits
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.gates import CONFIRMED
from drivers.interfaces import ArmTarget
from drivers.wire.arm_server import ArmServer
from drivers.wire.bus import Bus
from drivers.wire.client import RemoteArm
from drivers.wire.link import Link
from drivers.wire.server import Desk

from .conftest import FakeArm, FakeForceTorque


class DeafArm(FakeArm):
    """Takes set-points, and can be neither held nor stopped before the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.hears, self.asked = threading.Event(), threading.Event()

    def hold(self) -> None:
        self._need_answer("hold")
        super().hold()

    def stop(self) -> None:
        self._need_answer("stop")
        super().stop()
        self.released.set()

    def _need_answer(self, asked: str) -> None:
        self.asked.set()
        if not self.hears.is_set():
            raise DeviceFault(self.name, asked, "no answer", "See that the robot is on", recoverable=True)


def test_an_arm_that_cannot_be_held_is_tried_again_and_the_watch_goes_on(served: Bus, joined: Bus) -> None:
    arm = DeafArm()
    with ArmServer(Desk(served, "lab"), arm, ArmLimits(hold_after=0.05, stop_after=60)) as server:
        moving = ArmTarget(np.array([0.1001, 0.2, 0.3]), np.array([0.01, 0, 0]), 0.02)
        server.gates.accept(moving, server.desk.steady_ns())
        assert arm.asked.wait(5)
        arm.hears.set()
        assert arm.held.wait(5)


def test_a_stop_by_force_neither_holds_up_nor_fails_the_sensor_that_asked_for_it(
    served: Bus, fake_wrench: FakeForceTorque
) -> None:
    """The arm does not answer: the sensor's own thread goes on, the stop is latched, and tried until it has arrived."""
    arm, said_by = DeafArm(), set()
    arm.stop = lambda stop=arm.stop: (said_by.add(threading.get_ident()), stop())[1]  # type: ignore[method-assign]
    with ArmServer(Desk(served, "lab"), arm, ArmLimits(force=10), {"wrist_ft": fake_wrench}) as server:
        for k in range(CONFIRMED):
            fake_wrench.push(100 + k)  # its forces are as large as its number
        assert "wrist_ft measures" in server.gates.stopped or arm.asked.wait(5)
        assert arm.asked.wait(5)
        assert threading.get_ident() not in said_by
        arm.hears.set()
        assert arm.released.wait(5) and arm.stopped


def test_a_reply_that_is_lost_uses_its_number_up(served: Bus, link: Link) -> None:
    """What the arm has taken counts for its gates, whether or not its commander heard of it."""
    arm = FakeArm()
    with ArmServer(Desk(served, "lab"), arm), RemoteArm("arm", link, lockstep=False) as remote:
        answer = remote._ask

        def deaf(verb: str, *told: object) -> object:
            said = answer(verb, *told)  # type: ignore[arg-type]
            if verb == "command":
                raise DeviceTimeout("arm", "command", "no reply", "Look")
            return said

        with remote.lease("test"):
            remote._ask = deaf  # type: ignore[method-assign, assignment]
            for _ in range(2):
                try:
                    remote.command(ArmTarget(np.array([0.1, 0.2, 0.3]), np.zeros(3), 0.1))
                except DeviceTimeout:
                    remote._ask = answer  # type: ignore[method-assign]
    assert [target.sequence for target in arm.targets] == [0, 1]
