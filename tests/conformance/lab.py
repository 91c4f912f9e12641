"""An open station as the device contract sees it, whatever its devices are."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.interfaces import Clock, Device, Simulation

SIMULATED = ("sim in process", "sim over zenoh")
LIVE = (*SIMULATED, "real", "real over zenoh")
REPLAYED = ("replay", "replay over zenoh")

#: what only a world that stands still between two calls can be held to
in_lockstep = pytest.mark.backends(*SIMULATED)
#: what can be commanded
live = pytest.mark.backends(*LIVE)
#: and what only tells what it was told
replayed = pytest.mark.backends(*REPLAYED)


def about(kind: str) -> Callable:
    """Mark a claim as one about a kind, for the table."""

    def mark(test):
        test.kind = kind
        return test

    return mark


#: name in the simulated station of one device per kind
SIM_NAMES = {
    "arm": "arm",
    "gripper": "gripper",
    "force_torque": "wrist_ft",
    "tag_camera": "camera",
    "tactile": "bubble",
}


class WallClock:
    """The time of what is not simulated."""

    lockstep = False

    def now_ns(self) -> int:
        return time.time_ns()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)  # station time, which here is everybody's


@dataclass
class Lab:
    """An open station as its user sees it.

    ``names`` are its devices by kind. ``join`` opens it a second time, for another client; ``losing`` is a context in
    which what a device sends does not arrive. ``accuracy`` (3,) [m, m, rad] is how well its arm reaches a set-point.
    Without a ``simulation`` the devices are real ones, at emulators, or a recording; time passes by itself. ``renew``
    puts it back to its begin before each claim.
    """

    devices: Mapping[str, Device]
    clock: Clock
    simulation: Simulation | None
    join: Callable[[], AbstractContextManager[Lab]]
    losing: Callable[[Device], AbstractContextManager[None]]
    names: Mapping[str, str] = field(default_factory=lambda: SIM_NAMES)
    accuracy: tuple[float, float, float] = (1e-6, 1e-6, 1e-6)
    #: the time [s] that a device of a kind lives by: an emulated robot on a busy machine is slower than the wall
    own_time: Callable[[str], float] = lambda _kind: time.monotonic()
    renew: Callable[[], None] = lambda: None

    def of(self, kind: str) -> Any:
        """The device of a kind; the claim is not for a backend that has none."""
        return self.named(self.names.get(kind, kind))

    def named(self, name: str) -> Any:
        """The device of a name, likewise: a Soft Bubble, say, where its camera's SDK is at hand."""
        if name not in self.devices:
            pytest.skip(f"the backend has no {name}")
        return self.devices[name]

    @property
    def world(self) -> Simulation:
        """The simulation of a backend that has one."""
        assert self.simulation is not None
        return self.simulation


@contextmanager
def losing_readings(device) -> Iterator[None]:
    """What a device of this process gives out does not arrive."""
    device._push = lambda reading: None
    try:
        yield
    finally:
        del device._push


@contextmanager
def losing_samples(device) -> Iterator[None]:
    """What a device sends over the bus does not arrive."""
    # the subscription goes on, since a stream that nobody subscribes to is not produced
    subscription = device._subscription
    handlers, subscription._handlers = subscription._handlers, ()
    try:
        yield
    finally:
        subscription._handlers = handlers
