"""What Franka's arm and hand share: how they are reached through libfranka, and let go of, within a time-out.

libfranka (1) waits for ever for a robot that serves somebody else, (2) waits for ever for the answer to a command,
(3) waits a second for a state. Calls of the kinds 1 and 2 are therefore made in threads that are given up when they
are late; their sockets are shut down then, which ends them.
"""

from __future__ import annotations

import os
import socket
import threading
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from math import floor
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from drivers.errors import CommandRefused, DeviceFault, NotConnected
from drivers.real.guarded import guarded

T = TypeVar("T")

ARM_PORT, HAND_PORT = 1337, 1338
#: so long may the robot's own clock stand still while its state is read [s]
SILENCE = 0.8
#: what one look at a clock that stands still counts for at most [s]
_LOOK = 0.25

_opening: defaultdict[tuple[str, int], threading.Lock] = defaultdict(threading.Lock)


def import_franky(device: str) -> Any:
    """The package `franky`. Raises NotConnected where it is not installed."""
    try:
        import franky
    except ImportError as error:
        raise NotConnected(
            device, "load franky", f"{type(error).__name__}: {error}", "Run: pip install 'extrinsic[franka]'"
        ) from error
    return franky


class FrankaLink:
    """The way to one server of a Franka at ``host``: ``port`` is that of the arm or of the hand, fixed by libfranka."""

    def __init__(self, device: str, host: str, port: int):
        self.device, self.host, self.port = device, host, port
        self._sockets: set[str] = set()

    @property
    def address(self) -> str:
        """Where it is."""
        return f"{self.host}:{self.port}"

    def open(self, make: Callable[[], T], timeout: float) -> T:
        """What ``make`` returns, a `franky.Robot` or `franky.Gripper`, within ``timeout`` [s]. Raises NotConnected."""
        asked = f"connect to {self.address}"
        deadline = monotonic() + timeout
        lock = _opening[self.host, self.port]
        if not lock.acquire(timeout=max(timeout, 0.0)):
            raise NotConnected(self.device, asked, "somebody in this process is connecting to it", "Open it once")
        try:
            before = _connections(self.port)
            try:
                made = guarded(make, deadline - monotonic())
                self._sockets = _connections(self.port) - before
                return made
            except TimeoutError as error:
                _shut_down(_connections(self.port) - before)
                got = f"no answer within {timeout:g} s"
                remedy = "The robot serves one client at a time: close the other one, and see that the robot is on"
                raise NotConnected(self.device, asked, got, remedy) from error
            except Exception as error:
                raise NotConnected(self.device, asked, _said(error), _remedy(error)) from error
        finally:
            lock.release()

    def call(self, asked: str, ask: Callable[[], T], timeout: float = 1.0) -> T:
        """What a command returns that the robot answers. Raises CommandRefused, DeviceFault within ``timeout`` [s]."""
        try:
            return guarded(ask, timeout)
        except TimeoutError as error:
            raise self.fault(asked, f"no answer within {timeout:g} s") from error
        except Exception as error:
            if type(error).__name__ == "CommandException":
                raise CommandRefused(self.device, asked, _said(error), "See the robot's own page (Desk)") from error
            raise self.fault(asked, _said(error)) from error

    def fault(self, asked: str, got: str) -> DeviceFault:
        """The robot does not answer."""
        remedy = "See that the robot is on, its brakes open and FCI active, and see to its cable"
        return DeviceFault(self.device, f"{asked} at {self.address}", got, remedy)

    def cut(self, last: Callable[[], object], timeout: float = 2.0) -> None:
        """Let go of the robot: ``last`` drops it, which may take what a command takes; then nothing is left open."""
        with suppress(Exception):
            guarded(last, timeout)
        _shut_down(self._sockets)
        self._sockets = set()


class RobotTime:
    """Readings at a rate by the robot's own clock: which are due, their numbers, and whether the clock stands still.

    Reading k is the first state at or after k periods from the first, so a skip in the numbers is what was lost.
    """

    def __init__(self, rate: float):
        self.rate = rate
        self._begun = False
        self._first = self._base = self._slot = self._newest = 0
        self._advanced = self._looked = self._stood = 0.0

    @property
    def now(self) -> float:
        """The newest instant [s], by the robot's clock."""
        return self._newest * 1e-3

    def restart(self, last: int | None) -> None:
        """The robot was reached. ``last`` is the number of the newest reading before it had gone, if it had."""
        missed = 0 if last is None else floor((monotonic() - self._advanced) * self.rate)
        self._base = 0 if last is None else last + 1 + missed
        self._begun = False
        self._advanced = self._looked = monotonic()
        self._stood = 0.0

    def take(self, time_ms: int) -> int | None:
        """The number of the reading that a state of ``time_ms`` is; None where none is due yet."""
        if not self._begun:
            self._begun, self._first, self._slot, self._newest = True, time_ms, -1, time_ms - 1
        now = monotonic()
        if time_ms > self._newest:
            self._newest, self._advanced, self._stood = time_ms, now, 0.0
        else:  # a computer that stood still for a while itself has looked once in it
            self._stood += min(now - self._looked, _LOOK)
        self._looked = now
        slot = floor((self._newest - self._first) * 1e-3 * self.rate + 1e-9)
        if slot <= self._slot:
            return None
        self._slot = slot
        return self._base + slot

    @property
    def wait(self) -> float:
        """How long until the next reading is due [s], by the robot's clock."""
        due = self._first + (self._slot + 1) * 1e3 / self.rate
        return max((due - self._newest) * 1e-3, 0.0)

    @property
    def silent(self) -> float:
        """How long the robot's clock has been seen to stand still, with the time since the last look [s]."""
        return self._stood + monotonic() - self._looked


def _said(error: Exception) -> str:
    return str(error).removeprefix("libfranka: ").strip() or type(error).__name__


def _remedy(error: Exception) -> str:
    match type(error).__name__:
        case "IncompatibleVersionException":
            return "Install the franky-control that was built for this robot's version (its README has the table)"
        case "RealtimeException":
            return "Run a PREEMPT_RT kernel as a user who may use real-time priority, or set `realtime: ignore`"
        case _:
            return "Check `host`, the network, and that FCI is active on the robot's own page (Desk)"


def _connections(port: int) -> set[str]:
    """The inodes of this process's TCP sockets that lead to ``port`` somewhere, or try to; empty where unknown."""
    found: set[str] = set()
    with suppress(OSError):
        for line in Path("/proc/self/net/tcp").read_text().splitlines()[1:]:
            fields = line.split()
            if int(fields[2].rpartition(":")[2], 16) == port:
                found.add(fields[9])
    return found & set(_descriptors())


def _descriptors() -> dict[str, int]:
    """This process's sockets by inode."""
    sockets: dict[str, int] = {}
    with suppress(OSError):
        for entry in Path("/proc/self/fd").iterdir():
            with suppress(OSError):
                target = str(entry.readlink())
                if target.startswith("socket:["):
                    sockets[target[len("socket:[") : -1]] = int(entry.name)
    return sockets


def _shut_down(inodes: set[str]) -> None:
    """End what waits on these sockets; who opened them closes them."""
    for inode, descriptor in _descriptors().items():
        if inode in inodes:
            with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as theirs:
                theirs.shutdown(socket.SHUT_RDWR)
