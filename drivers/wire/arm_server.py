"""An arm on the bus: the lease, the checks of every set-point, and a stop that nothing can hold up."""

from __future__ import annotations

import contextlib
import json
import threading
import time

import numpy as np

from drivers.errors import CommandRefused, DriverError
from drivers.interfaces import Arm, ArmTarget
from drivers.wire import messages, topics
from drivers.wire.lease import LeaseTable
from drivers.wire.server import Answer, Desk, DeviceServer

_TICK = 0.05


class ArmServer(DeviceServer):
    """An `Arm` on the bus.

    A commander holds the lease by a liveliness token (lost at once when its process dies) and by renewal (lost after
    a second when it is frozen; later in lockstep, where nothing moves meanwhile). Losing it holds the arm. Stop and
    hold need no lease, have queryables of their own and overtake everything that waits.
    """

    def __init__(self, desk: Desk, arm: Arm):
        super().__init__(desk, arm)
        self.arm = arm
        self._table = LeaseTable(desk.lease)
        self._lock = threading.Lock()
        self._served: str | None = None  # for whom the arm's own lease is held; only the owner's thread touches it
        self._sequence = -1
        self._closing = threading.Event()
        self._watchman = threading.Thread(target=self._watch, name=f"{arm.name} lease", daemon=True)

    def open(self) -> None:
        """As `DeviceServer.open`, and watch over the lease."""
        super().open()
        self._watchman.start()

    def close(self) -> None:
        """Stop watching, hold the arm, withdraw; idempotent."""
        self._closing.set()
        if self._watchman.is_alive():
            self._watchman.join(timeout=2.0)
        if self.arm.connected:
            with contextlib.suppress(DriverError):  # an arm that cannot be held has nothing to hold
                self.arm.hold()
        super().close()

    def foreign_commander(self, session: str) -> str | None:
        """Who has the lease, unless it is the session named."""
        with self._lock:
            holder = self._table.holder(time.monotonic())
        return None if holder is None or belongs_to(holder, session) else nickname(holder)

    def _verbs(self) -> None:
        super()._verbs()
        self._serve("command", self._command)
        self._serve("acquire", self._acquire)
        self._serve("release", self._release)
        self._serve("renew", self._renew, direct=True)
        self._serve("holders", self._holders, direct=True)
        self._serve("hold", lambda _: self.arm.hold(), urgent=True)
        self._serve("stop", lambda _: self.arm.stop(), urgent=True)
        self._serve("recover", lambda _: self.arm.recover(), urgent=True)
        pattern = topics.lease(self.desk.station, self.arm.name, "*")
        self._stops.append(self.desk.bus.watch_all(pattern, self._token_gone))

    def _acquire(self, payload: bytes) -> Answer:
        holder = messages.decode(payload, messages.STRING).data
        with self._lock:
            now = time.monotonic()
            if not self._table.acquire(holder, now):
                other = nickname(self._table.holder(now) or "nobody")
                raise CommandRefused(
                    self.arm.name, "acquire the lease", f"{other} has it", "Wait until it is given back, or stop it"
                )
        try:
            self._give_back()
            self.arm.acquire(holder)
        except BaseException:
            with self._lock:
                self._table.release(holder)
            raise
        self._served, self._sequence = holder, -1
        return Answer()

    def _renew(self, payload: bytes) -> None:
        holder = messages.decode(payload, messages.STRING).data
        with self._lock:
            if not self._table.renew(holder, time.monotonic()):
                raise CommandRefused(self.arm.name, "renew the lease", "it was lost", "Acquire it again")

    def _holders(self, _: bytes) -> Answer:
        with self._lock:
            holder = self._table.holder(time.monotonic())
        return Answer(json.dumps([] if holder is None else [nickname(holder)]))

    def _release(self, payload: bytes) -> None:
        holder = messages.decode(payload, messages.STRING).data
        with self._lock:
            self._table.release(holder)
        if self._served == holder:
            self._give_back()

    def _command(self, payload: bytes) -> None:
        asked = "command a set-point"
        value = messages.decode(payload, messages.TARGET)
        with self._lock:
            now = time.monotonic()
            if not self._table.renew(value.holder, now):
                if self._table.has_lapsed(value.holder, now):
                    silent = f"its lease lapsed: nothing was heard of it for {self._table.time_to_live:g} s"
                    raise CommandRefused(
                        self.arm.name, asked, silent, "See what held it up, and acquire the lease anew"
                    )
                raise CommandRefused(self.arm.name, asked, "no lease", "Acquire the lease: `with arm.lease(name):`")
        numbers = (*value.pose, *value.twist, value.duration)
        if not np.all(np.isfinite(numbers)) or value.duration < 0:
            raise CommandRefused(self.arm.name, asked, "the target is not finite", "Send finite numbers")
        if value.sequence <= self._sequence:
            raise CommandRefused(
                self.arm.name,
                asked,
                f"target {value.sequence} came after {self._sequence}",
                "Count targets up within a lease",
            )
        self.arm.command(ArmTarget(value.pose.copy(), value.twist.copy(), value.duration, value.sequence))
        self._sequence = value.sequence
        stream = self._streams["target"]
        if stream.matched:
            stream.put(payload, stream.newest + 1, self.desk.now_ns())

    def _token_gone(self, token: str) -> None:
        holder = topics.holder_of(token)
        with self._lock:
            lost = self._table.release(holder)
        if lost:
            self.desk.run(lambda: self._lose(holder), True)

    def _watch(self) -> None:
        while not self._closing.wait(_TICK):
            with self._lock:
                lost = self._table.lapse(time.monotonic())
            if lost is not None:
                self.desk.run(lambda holder=lost: self._lose(holder), True)

    def _lose(self, holder: str) -> None:
        if self._served == holder:
            self._give_back()

    def _give_back(self) -> None:
        if self._served is not None:
            self._served = None
            self.arm.release()  # holds the arm


def nickname(holder: str) -> str:
    """The name that a holder gave itself."""
    return holder.split("~", 1)[0]


def belongs_to(holder: str, session: str) -> bool:
    """Whether a holder is of the session with this id."""
    return f"~{session}~" in holder


def holder_id(name: str, session: str, count: int) -> str:
    """A holder that no other commander shares: the name, the session's id and a number, fit for a key."""
    plain = "".join(letter if letter.isalnum() or letter in "-_. " else "_" for letter in name)[:64] or "unnamed"
    return f"{plain}~{session}~{count}"
