"""What all devices have in common that live in another process, behind the interfaces of `drivers.interfaces`.

What arrives is kept as bytes and decoded when it is read: at ten times real time most wrenches are only logged.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, cast

from drivers.errors import DeviceFault, NotConnected, ProtocolError
from drivers.interfaces import Description, R, Sensor, freshness
from drivers.wire import topics
from drivers.wire.bus import Bus
from drivers.wire.codec import decode_reading
from drivers.wire.link import Link
from drivers.wire.streams import Sample, Subscription
from drivers.wire.watch import Watch
from mechanics.readings import Status


class RemoteSensor(Sensor[R]):
    """The half that all remote devices share: the stream, the description, and the news of the server's death."""

    kind: ClassVar[str]
    #: how many readings are kept
    keeps: ClassVar[int] = 4096

    def __init__(self, name: str, link: Link, lockstep: bool):
        super().__init__(name, self.keeps)
        self._link, self._lockstep = link, lockstep
        self._stream, self._type = next(iter(topics.STREAMS[self.kind].items()))
        self._kept: deque[Sample] = deque(maxlen=self.keeps)
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

    def heard(self, since_ns: int) -> list[tuple[int, Status]]:
        """Capture time and status of the kept readings after ``since_ns``, oldest first; none is decoded for it.

        Raises DeviceFault when the server has died.
        """
        self._need_life("look at its stream")
        found: list[tuple[int, Status]] = []
        with self._arrived:
            for sample in reversed(self._kept):
                if sample.capture_ns <= since_ns:
                    break
                found.append((sample.capture_ns, Status(sample.status)))
        return found[::-1]

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
