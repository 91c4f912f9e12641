"""An arm on the bus: the lease, the gates that every set-point has to pass, and a stop that nothing can hold up."""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from drivers.config import ArmLimits
from drivers.errors import CommandRefused, DriverError, ProtocolError
from drivers.gates import Gates
from drivers.interfaces import Arm, ArmTarget, ForceTorqueSensor
from drivers.wire import messages, topics
from drivers.wire.codec import decode_reading
from drivers.wire.lease import LeaseTable
from drivers.wire.server import Answer, Desk, DeviceServer, Lane, Work
from drivers.wire.streams import Sample
from mechanics.readings import Array, PoseReading, Stamp, Status, WrenchReading

log = logging.getLogger(__name__)

_ASKED = "command a set-point"
_TICK = 0.05
#: what a network delays is not lost yet [s]; in lockstep nothing is on its way while time passes
_PATIENCE = 0.02


class ArmServer(DeviceServer):
    """An `Arm` on the bus.

    A commander holds the lease by a liveliness token (lost at once when its process dies) and by renewal (lost after
    a second when it is frozen; later in lockstep, where nothing moves meanwhile). Losing it holds the arm. Stop and
    hold need no lease, have queryables of their own and overtake everything that waits.

    ``sensors`` are the force/torque sensors that the arm carries: by name, the device itself where it is in this
    process, else the rate [Hz] at which it speaks on the bus. They and the estimator's wrench, where somebody
    publishes one, are the witnesses of the arm's `Gates`.
    """

    def __init__(
        self,
        desk: Desk,
        arm: Arm,
        limits: ArmLimits | None = None,
        sensors: Mapping[str, ForceTorqueSensor | float] | None = None,
    ):
        super().__init__(desk, arm)
        self.arm, self._sensors = arm, dict(sensors or {})
        rates = {name: s if isinstance(s, int | float) else s.describe().rate for name, s in self._sensors.items()}
        self.gates = Gates(
            arm.name,
            limits or ArmLimits(),
            {**{name: 1.0 / rate for name, rate in rates.items()}, topics.ESTIMATOR: None},
            0.0 if desk.lockstep else _PATIENCE,
            arm.reachable,
        )
        self._table = LeaseTable(desk.lease)
        self._lock = threading.Lock()
        self._served: str | None = None  # for whom the arm's own lease is held; only the owner's thread touches it
        self._unstopped = False  # a stop did not reach the arm yet
        self._closing = threading.Event()
        self._said = ""  # what went wrong last while nobody asked
        self._errands: queue.SimpleQueue[Work] = queue.SimpleQueue()
        self._watchman = threading.Thread(target=self._watch, name=f"{arm.name} lease", daemon=True)

    def open(self) -> None:
        """As `DeviceServer.open`, and watch over lease, commander and force."""
        super().open()
        self.gates.restart(self.desk.steady_ns(), wall_ns=self.desk.now_ns())
        with contextlib.suppress(DriverError):  # it has told nothing yet, and will
            self._at(self.arm.latest(0.1))
        self._stops.append(self.arm.listen(self._moved))
        for name, sensor in self._sensors.items():
            if isinstance(sensor, int | float):
                self._hear(name)
            else:
                self._stops.append(sensor.listen(partial(self._felt_here, name)))
        self._hear(topics.ESTIMATOR)
        self._watchman.start()

    def restart(self, pose: Array) -> None:
        """A simulated world was reset, with the arm at ``pose``: the gates begin anew."""
        self.gates.restart(self.desk.steady_ns(), pose, self.desk.now_ns())

    def _hear(self, source: str) -> None:
        """Listen to a witness of force on the bus."""

        def receive(sample: Sample) -> None:
            with contextlib.suppress(ProtocolError):  # what cannot be read says nothing
                reading = decode_reading(messages.WRENCH, sample.payload, sample.sequence, sample.status, 0)
                if isinstance(reading, WrenchReading):
                    self._felt(source, reading)

        key = topics.key(self.desk.station, source, next(iter(topics.STREAMS["force_torque"])))
        self._stops.append(self.desk.bus.subscribe(key).listen(receive))

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
        self._serve("hold", lambda _: self._hold(), urgent=True)
        self._serve("stop", lambda payload: self._stop(_reason(payload)), urgent=True)
        self._serve("recover", lambda _: self._recover(), urgent=True)
        self._serve("safety", lambda _: Answer(json.dumps(self.gates.summary())), direct=True)
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
        self._served = holder
        self.gates.begin()
        self._tell()
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
        value = messages.decode(payload, messages.TARGET)
        target = ArmTarget(value.pose.copy(), value.twist.copy(), value.duration, value.sequence)
        try:
            with self.gates.counting("lease"):
                self._need_lease(value.holder)
            with self.gates.counting("stopped"):
                self._need_motion()
            sent_ns = messages.stamp_ns(value.header.stamp)
            self.gates.admit(target, sent_ns, self.desk.steady_ns(), self.desk.now_ns())
            with self.gates.counting("arm"):
                self.arm.command(target)
        except DriverError:
            self._tell()
            raise
        self.gates.accept(target, self.desk.steady_ns())
        stream = self._streams["target"]
        if stream.matched:  # the holder's full name would let others command in it
            told = replace(value, holder=nickname(value.holder))
            stream.put(messages.encode(told), stream.newest + 1, self.desk.now_ns())

    def _need_lease(self, holder: str) -> None:
        with self._lock:
            now = time.monotonic()
            if self._table.renew(holder, now):
                return
            lapsed = self._table.has_lapsed(holder, now)
        if lapsed:
            silent = f"its lease lapsed: nothing was heard of it for {self._table.time_to_live:g} s"
            raise CommandRefused(self.arm.name, _ASKED, silent, "See what held it up, and acquire the lease anew")
        raise CommandRefused(self.arm.name, _ASKED, "no lease", "Acquire the lease: `with arm.lease(name):`")

    def _need_motion(self) -> None:
        if self.gates.stopped:
            why = f"the arm is stopped: {self.gates.stopped}"
            raise CommandRefused(self.arm.name, _ASKED, why, "See why, then recover it: `extrinsic recover STATION`")

    def _token_gone(self, token: str) -> None:
        holder = topics.holder_of(token)
        with self._lock:
            lost = self._table.release(holder)
        if lost:
            self.desk.run(lambda: self._lose(holder), True)

    def _watch(self) -> None:
        while not self._closing.is_set():
            errand = None
            with contextlib.suppress(queue.Empty):
                errand = self._errands.get(timeout=_TICK)
            try:
                if errand is not None:
                    errand()
                else:
                    self._look()
            except Exception as error:  # an arm that cannot be reached now: the watch goes on
                if str(error) != self._said:
                    self._said = str(error)
                    log.warning("%s: %s", self.arm.name, error)

    def _look(self) -> None:
        """What the watchman looks after by himself, whoever speaks."""
        with self._lock:
            lost = self._table.lapse(time.monotonic())
        if lost is not None:
            self.desk.run(lambda: self._lose(lost), True)
        if self.desk.lockstep:  # there every reading of the pose looks, so that time decides and not luck
            return
        if self._unstopped:
            self._soon(lambda: self._stop(self.gates.stopped))
        self._guard()

    def _soon(self, work: Work) -> None:
        """Have urgent ``work`` done by the arm's owner: the watchman, where the owner is whoever brings the work.

        That may be the thread of a sensor, which an arm that does not answer is neither to hold up nor to fail.
        """
        if isinstance(self.desk.run, Lane):
            self._errands.put(work)
        else:
            self.desk.run(work, True)

    def _lose(self, holder: str) -> None:
        if self._served == holder:
            self._give_back()

    def _give_back(self) -> None:
        if self._served is not None:
            self._served = None
            self.arm.release()  # holds the arm
            self.gates.rested()

    # -- safety --------------------------------------------------------------------------------------------------

    def _moved(self, reading: PoseReading) -> None:
        self._at(reading)
        self._guard()

    def _at(self, reading: PoseReading) -> None:
        self.gates.at(reading.pose if reading.stamp.status is Status.OK else None)

    def _felt_here(self, source: str, reading: WrenchReading) -> None:
        """A sensor of this process: its stamps come to the bus's time as those of its stream do."""
        if shift := self.desk.shift_ns():
            old = reading.stamp  # by the thousand, and `replace` takes its time
            stamp = Stamp(old.capture_ns + shift, old.receive_ns, old.sequence, old.frame, old.status)
            reading = WrenchReading(stamp, reading.wrench)
        self._felt(source, reading)

    def _felt(self, source: str, reading: WrenchReading) -> None:
        reason = self.gates.feel(source, reading, self.desk.steady_ns())
        if reason:
            self._soon(lambda: self._stop(reason))

    def _guard(self) -> None:
        """Do what the watchdogs ask for."""
        match self.gates.watch(self.desk.steady_ns()):
            case "hold":
                self._soon(self._halt)
            case "stop":
                self._soon(lambda: self._stop(self.gates.stopped))

    def _halt(self) -> None:
        try:
            self.arm.hold()
        except DriverError:
            self.gates.unheld()
            raise
        self._tell()

    def _hold(self) -> None:
        self.arm.hold()
        self.gates.rested()

    def _stop(self, reason: str) -> None:
        self.gates.stop(reason)
        self._unstopped = True  # until the arm says otherwise; the watchman tries again
        self.arm.stop()
        self._unstopped = False
        self._tell()

    def _recover(self) -> None:
        self.arm.recover()
        self._unstopped = False
        self.gates.recover()
        self._tell()

    def _tell(self) -> None:
        """Publish how the gates stand; in the owner's thread."""
        stream = self._streams["safety"]
        if stream.matched:
            now_ns = self.desk.now_ns()
            stream.put(messages.encode(_diagnostics(self.arm.name, self.gates, now_ns)), stream.newest + 1, now_ns)


def _reason(payload: bytes) -> str:
    """Who asked for a stop, and why, where they say so."""
    said = messages.decode(payload, messages.STRING).data if payload else ""
    return said or "somebody asked for it"


def _diagnostics(name: str, gates: Gates, now_ns: int) -> object:
    """The gates' summary as ROS diagnostics: an error while stopped, a warning while something is refused or held."""
    found = gates.summary()
    level, said = 0, "ok"
    if found["stopped"]:
        level, said = 2, f"stopped: {found['stopped']}"
    elif found["held"] or found["refusal"]:
        level, said = 1, found["held"] or found["refusal"]
    counts = {"accepted": found["accepted"], **{f"refused by {gate}": n for gate, n in found["refused"].items()}}
    values = [messages.message("diagnostic_msgs/msg/KeyValue", key=k, value=str(v)) for k, v in counts.items()]
    status = messages.message(
        "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=said, hardware_id=name, values=values
    )
    return messages.message(messages.DIAGNOSTICS, header=messages.header(now_ns, "world"), status=[status])


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
