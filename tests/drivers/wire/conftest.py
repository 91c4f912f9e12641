"""Two ends of a bus in one process, and devices that do as they are told."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from drivers.errors import CommandRefused, DeviceFault
from drivers.interfaces import Arm, ArmTarget, Description, ForceTorqueSensor
from drivers.wire.bus import Bus, open_buses
from drivers.wire.link import Link
from drivers.wire.server import Desk
from mechanics.readings import PoseReading, Stamp, WrenchReading


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture(autouse=True)
def no_session_is_abandoned() -> Iterator[None]:
    yield
    left = open_buses()
    for bus in left:
        bus.close()
    assert not left, f"{len(left)} sessions were left open"
    names = {"lease", "log", "host"}
    stray = [t.name for t in threading.enumerate() if names & set(t.name.split())]
    assert not stray, f"threads were left running: {stray}"


@pytest.fixture
def served(endpoint: str) -> Iterator[Bus]:
    with Bus(endpoint, listen=True, shared_memory=False) as bus:
        yield bus


@pytest.fixture
def joined(served: Bus) -> Iterator[Bus]:
    with Bus(served.endpoint, shared_memory=False, timeout=3.0) as bus:
        yield bus


@pytest.fixture
def desk(served: Bus) -> Desk:
    return Desk(served, "lab", now_ns=lambda: 7)


@pytest.fixture
def link(joined: Bus) -> Link:
    return Link(joined, "lab")


@pytest.fixture
def another(served: Bus) -> Iterator[Callable[[], Bus]]:
    with ExitStack() as stack:
        yield lambda: stack.enter_context(Bus(served.endpoint, shared_memory=False, timeout=3.0))


class FakeForceTorque(ForceTorqueSensor):
    """Pushes what the test says; ``tare`` fails as the test says."""

    def __init__(self, name: str = "wrist_ft"):
        super().__init__(name)
        self.tares = 0
        self.failure: Exception | None = None

    def describe(self) -> Description:
        return Description(
            self.name,
            "force_torque",
            "fake",
            "fake",
            "0",
            self.name,
            1000.0,
            (65.0,) * 6,
            (0.1,) * 6,
            {"mount": "wrist"},
        )

    def tare(self) -> None:
        if self.failure is not None:
            raise self.failure
        self.tares += 1

    def push(self, sequence: int, capture_ns: int | None = None) -> None:
        capture = sequence * 1_000_000 if capture_ns is None else capture_ns
        self._push(WrenchReading(Stamp(capture, capture, sequence, self.name), np.arange(6.0) + sequence))

    def _open(self, timeout: float) -> None: ...

    def _shut(self) -> None: ...


class FakeArm(Arm):
    """Remembers what it was told."""

    def __init__(self, name: str = "arm"):
        super().__init__(name)
        self.did: list[str] = []
        self.targets: list[ArmTarget] = []
        self.stopped = False
        self.held = threading.Event()
        self.released = threading.Event()

    def describe(self) -> Description:
        return Description(self.name, "arm", "fake", "fake", "0", "world", 100.0)

    def acquire(self, holder: str) -> None:
        self.released.clear()
        self.did.append("acquire")

    def release(self) -> None:
        self.did.append("release")
        self.released.set()

    def command(self, target: ArmTarget) -> None:
        if self.stopped:
            raise CommandRefused(self.name, "command", "the arm is stopped", "Recover it")
        if target.duration == 13.0:
            raise DeviceFault(self.name, "command", "joint 3 overheated", "Let it cool", recoverable=True)
        self.targets.append(target)

    def hold(self) -> None:
        self.did.append("hold")
        self.held.set()

    def stop(self) -> None:
        self.stopped = True

    def recover(self) -> None:
        self.stopped = False

    def push(self, sequence: int) -> None:
        self._push(PoseReading(Stamp(sequence, sequence, sequence, "world"), np.array([0.1, 0.2, 0.3])))

    def _open(self, timeout: float) -> None:
        self.push(-1)  # an arm knows where it is

    def _shut(self) -> None: ...


@pytest.fixture
def fake_wrench() -> FakeForceTorque:
    return FakeForceTorque()


@pytest.fixture
def fake_arm() -> FakeArm:
    return FakeArm()
