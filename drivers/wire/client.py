"""Devices that live in another process, behind the interfaces of `drivers.interfaces`.

What arrives is kept as bytes and decoded when it is read: at ten times real time most wrenches are only logged.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.interfaces import (
    Arm,
    ArmTarget,
    Description,
    ForceTorqueSensor,
    Gripper,
    R,
    Sensor,
    TactileSensor,
    TagCamera,
    freshness,
)
from drivers.wire import messages, topics
from drivers.wire.arm_server import holder_id
from drivers.wire.bus import Bus
from drivers.wire.codec import decode_reading
from drivers.wire.lease import RENEWAL, TIME_TO_LIVE
from drivers.wire.link import Link
from drivers.wire.streams import Sample, Subscription
from drivers.wire.watch import Watch
from mechanics.readings import GripperReading, ImageReading, PoseReading, TagReading, WrenchReading


class RemoteSensor(Sensor[R]):
    """The half that all remote devices share: the stream, the description, and the news of the server's death."""

    kind: ClassVar[str]

    def __init__(self, name: str, link: Link, lockstep: bool, buffer: int = 4096):
        super().__init__(name, buffer)
        self._link, self._lockstep = link, lockstep
        self._stream, self._type = next(iter(topics.STREAMS[self.kind].items()))
        self._kept: deque[Sample] = deque(maxlen=buffer)
        self._decoded: dict[int, R] = {}
        self._watch: Watch | None = None
        self._subscription: Subscription | None = None
        self._stop_listening: Callable[[], None] = lambda: None
        self._newest_capture = 0
        self._still = lockstep

    def describe(self) -> Description:
        """What the device says of itself; asks its server. Raises DeviceTimeout, DeviceFault, ProtocolError."""
        try:
            said: dict[str, Any] = json.loads(self._ask("describe", asked="describe itself").text)
            said.update(range=tuple(said["range"]), resolution=tuple(said["resolution"]))
            return Description(**said)
        except (ValueError, TypeError, KeyError) as error:
            raise ProtocolError(self.name, "describe itself", str(error), "Server and client must match") from error

    @property
    def corrupt(self) -> int:
        """Messages that arrived since connecting and could not be read; what nobody has read yet is read for it."""
        with self._arrived:
            unread = [sample for sample in self._kept if sample.reading is None]
        for _ in self._readable(unread):
            pass
        return self._corrupt

    def _open(self, timeout: float) -> None:
        bus = self._link.bus
        self._forget()
        try:
            self._join(bus, timeout)
        except BaseException:
            self._shut()
            raise

    def _join(self, bus: Bus, timeout: float) -> None:
        self._watch = bus.watch(topics.alive(self._link.station, self.name))
        if not self._watch.seen(timeout):
            raise NotConnected(
                self.name, "connect", f"no server within {timeout:g} s", "Check `extrinsic status STATION`"
            )
        self._subscription = bus.subscribe(topics.key(self._link.station, self.name, self._stream))
        self._stop_listening = self._subscription.listen(self._receive)
        said = self.describe()  # the answer also says that the subscription has reached the server
        if said.kind != self.kind:
            raise NotConnected(
                self.name, "connect", f"it is a {said.kind}, not a {self.kind}", "Check the station file"
            )
        self._type = topics.streams_of(said.kind, said.extra.get("sensor", ""))[self._stream]
        self.max_age = freshness(said.rate)

    def _shut(self) -> None:
        self._stop_listening()
        self._stop_listening = lambda: None
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    def _ask(self, verb: str, payload: bytes = b"", asked: str = "", timeout: float | None = None) -> Any:
        return self._link.ask(self.name, verb, payload, asked=asked, timeout=timeout, watch=self._watch)

    def _command(self, verb: str, payload: bytes = b"", asked: str = "", timeout: float | None = None) -> Any:
        self._need_connection(asked or verb)
        return self._ask(verb, payload, asked, timeout)

    # -- the stream ----------------------------------------------------------------------------------------------

    def _receive(self, sample: Sample) -> None:
        if self._lockstep:
            sample.receive_ns = sample.capture_ns  # the world stands still while a message travels
        with self._arrived:
            last = self._last_sequence
            if last is not None and (sample.sequence <= last or sample.capture_ns < self._newest_capture):
                self._kept.clear()  # the world was reset: what came before is of another time
                last = None
                self._link.now_ns = min(self._link.now_ns, sample.capture_ns)
            if last is not None:
                self._gaps += sample.sequence - last - 1
            self._last_sequence, self._newest_capture = sample.sequence, sample.capture_ns
            self._kept.append(sample)
            self._arrived.notify_all()
            listeners = self._listeners
        if listeners:
            for reading in self._readable([sample]):
                for listener in listeners:
                    listener(reading)

    def _decode(self, sample: Sample) -> R:
        if sample.reading is None:
            try:
                sample.reading = decode_reading(
                    self._type, sample.payload, sample.sequence, sample.status, sample.receive_ns
                )
            except ProtocolError as error:
                sample.reading = ProtocolError(self.name, error.asked, error.got, error.remedy)
                self._corrupt += 1
        if isinstance(sample.reading, ProtocolError):
            raise sample.reading.with_traceback(None)
        return cast("R", sample.reading)

    def _readable(self, samples: Iterable[Sample]) -> Iterator[R]:
        for sample in samples:
            with suppress(ProtocolError):  # counted
                yield self._decode(sample)

    def _station_ns(self) -> int:
        return self._link.now_ns if self._lockstep else time.time_ns()

    def forget(self) -> None:
        """Drop what was received: the world is about to be reset."""
        self._forget()

    def _forget(self) -> None:
        with self._arrived:
            self._kept.clear()
        super()._forget()

    def latest(self, timeout: float = 1.0) -> R:
        """As `Sensor.latest`; raises DeviceFault when the server has died."""
        self._need_connection("read")
        with self._holding("read"):
            self._await(
                lambda: self._kept[-1].capture_ns if self._kept else None, timeout, lambda: self._need_life("read")
            )
            sample = self._kept[-1]
        return self._decode(sample)

    def since(self, capture_ns: int) -> list[R]:
        """As `Sensor.since`; raises DeviceFault when the server has died."""
        self._need_connection("read")
        self._need_life("read")
        found: list[Sample] = []
        with self._arrived:
            for sample in reversed(self._kept):
                if sample.capture_ns <= capture_ns:
                    break
                found.append(sample)
        return list(self._readable(reversed(found)))

    def arrivals(self, since_ns: int) -> list[int]:
        """When the kept readings arrived, after ``since_ns`` [ns, Unix time; capture times in lockstep]."""
        with self._arrived:
            return [sample.receive_ns for sample in self._kept if sample.receive_ns > since_ns]

    def lease_holders(self) -> list[str]:
        """Who commands the device by now; nobody does where there is no lease."""
        return []

    @contextmanager
    def _holding(self, asked: str) -> Iterator[None]:
        """Hold `_arrived`; the server's death wakes who waits on it."""
        withdraw = self._need_life(asked).once_gone(self._wake)
        try:
            with self._arrived:
                yield
        finally:
            withdraw()

    def _wake(self) -> None:
        with self._arrived:
            self._arrived.notify_all()

    def _need_life(self, asked: str) -> Watch:
        if self._watch is None or self._watch.gone:
            raise DeviceFault(self.name, asked, "the device's server has died", "Start the station again")
        return self._watch


class RemoteForceTorque(RemoteSensor[WrenchReading], ForceTorqueSensor):
    """A force/torque sensor on the bus."""

    kind = "force_torque"

    def tare(self) -> None:
        """As `ForceTorqueSensor.tare`."""
        self._command("tare")


class RemoteTagCamera(RemoteSensor[TagReading], TagCamera):
    """A tag camera on the bus."""

    kind = "tag_camera"

    def capture(self, timeout: float | None = None) -> TagReading:
        """As `ImagingSensor.capture`; None: as long as the bus waits for any reply."""
        timeout = self._link.bus.timeout if timeout is None else timeout
        self._command("capture", timeout=timeout)
        return self.latest(timeout)  # the frame is here: a reply comes after what was published before it

    def image(self) -> ImageReading | None:
        """The picture behind the newest `capture`, without loss."""
        reply = self._command("image", asked="send its picture")
        return cast("ImageReading", decode_reading(reply.type, reply.data.tobytes(), 0)) if reply.type else None


class RemoteTactile(RemoteSensor[ImageReading], TactileSensor):
    """A tactile finger on the bus."""

    kind = "tactile"

    def capture(self, timeout: float | None = None) -> ImageReading:
        """As `ImagingSensor.capture`; None: as long as the bus waits for any reply.

        A frame that is lost on its way is made up for by the next one of the stream.
        """
        timeout = self._link.bus.timeout if timeout is None else timeout
        deadline = time.monotonic() + timeout
        wanted = json.loads(self._command("capture", timeout=timeout).text)
        with self._holding("capture"):
            while not self._kept or self._kept[-1].sequence < wanted:
                self._need_life("capture")
                if not self._arrived.wait(deadline - time.monotonic()):
                    got = f"its frame did not arrive within {timeout:g} s"
                    raise DeviceTimeout(self.name, "capture", got, "Check the network's load")
            sample = self._kept[-1]
        return self._decode(sample)

    def reference(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """As `TactileSensor.reference`."""
        reply = self._command("reference", asked="send its reference picture")
        return cast("ImageReading", decode_reading(reply.type, reply.data.tobytes(), 0)).image


class RemoteGripper(RemoteSensor[GripperReading], Gripper):
    """A gripper on the bus."""

    kind = "gripper"

    def grasp(self, force: float) -> None:
        """As `Gripper.grasp`."""
        if not math.isfinite(force):
            raise CommandRefused(self.name, "grasp", f"a force of {force} N", "Ask for a finite force")
        self._command("grasp", messages.encode(messages.message(messages.FLOAT, data=float(force))))

    def release(self) -> None:
        """As `Gripper.release`."""
        self._command("release")


class RemoteArm(RemoteSensor[PoseReading], Arm):
    """An arm on the bus. The lease is renewed by a thread that `release` joins."""

    kind = "arm"
    _acquired = 0

    def __init__(self, name: str, link: Link, lockstep: bool, buffer: int = 4096):
        super().__init__(name, link, lockstep, buffer)
        self._holder: str | None = None
        self._withdraw: Callable[[], None] = lambda: None
        self._targets = 0
        self._done = threading.Event()
        self._renewer: threading.Thread | None = None

    def acquire(self, holder: str) -> None:
        """As `Arm.acquire`."""
        self._need_connection("acquire the lease")
        if self._holder is not None:
            raise CommandRefused(self.name, "acquire the lease", "this client has it already", "Release it first")
        self._acquired += 1
        name = holder_id(holder, self._link.bus.zid, self._acquired)
        self._withdraw = self._link.bus.token(topics.lease(self._link.station, self.name, name))
        try:
            self._ask("acquire", _string(name), "acquire the lease")
        except BaseException:
            self._withdraw()
            raise
        self._holder, self._targets = name, 0
        self._done.clear()
        self._renewer = threading.Thread(target=self._renew, args=(name,), name=f"{self.name} lease", daemon=True)
        self._renewer.start()

    def release(self) -> None:
        """As `Arm.release`; a server that has gone is no error, for it held the arm when it lost us."""
        holder, self._holder = self._holder, None
        if holder is None:
            return
        self._done.set()
        if self._renewer is not None:
            self._renewer.join(timeout=2 * TIME_TO_LIVE)
        try:
            self._ask("release", _string(holder), "release the lease")
        except (DeviceFault, DeviceTimeout):
            pass
        finally:
            self._withdraw()

    def command(self, target: ArmTarget) -> None:
        """As `Arm.command`. The sequence number is counted here, whatever the target says."""
        asked = "command a set-point"
        self._need_connection(asked)
        if self._holder is None:
            raise CommandRefused(self.name, asked, "no lease", "Acquire the lease: `with arm.lease(name):`")
        self._ask(
            "command",
            messages.encode(
                messages.message(
                    messages.TARGET,
                    header=messages.header(self._link.now_ns, "world"),
                    holder=self._holder,
                    sequence=self._targets,
                    pose=_three(self.name, target.pose),
                    twist=_three(self.name, target.twist),
                    duration=float(target.duration),
                )
            ),
            asked,
        )
        self._targets += 1

    def hold(self) -> None:
        """As `Arm.hold`."""
        self._command("hold")

    def stop(self) -> None:
        """As `Arm.stop`."""
        self._command("stop")

    def recover(self) -> None:
        """As `Arm.recover`."""
        self._command("recover")

    def lease_holders(self) -> list[str]:
        """Who has the arm's lease; asks the server. Raises DeviceTimeout, DeviceFault."""
        return json.loads(self._ask("holders", asked="name its commander").text)

    def _shut(self) -> None:
        self.release()
        super()._shut()

    def _renew(self, holder: str) -> None:
        payload = _string(holder)
        while not self._done.wait(RENEWAL):
            try:
                self._ask("renew", payload, "renew the lease", TIME_TO_LIVE)
            except DeviceTimeout:
                continue
            except DriverError:
                return  # lost: the next command is refused and says so


REMOTES: dict[str, type[RemoteSensor]] = {
    remote.kind: remote for remote in (RemoteArm, RemoteGripper, RemoteForceTorque, RemoteTagCamera, RemoteTactile)
}
"""The remote device of each kind."""


def _string(text: str) -> bytes:
    return messages.encode(messages.message(messages.STRING, data=text))


def _three(device: str, values: Any) -> np.ndarray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != (3,):
        raise CommandRefused(device, "command a set-point", f"an array of shape {array.shape}", "Send (x, y, θ)")
    return array
