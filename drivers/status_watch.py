"""The status of a station while somebody looks on: every device by its view, at the cost of a viewer.

A station that is not there yet, goes, or comes back, and a device of it that does, is told as such; nothing here raises
for it. A view carries the numbers of its stream's readings, so that it tells the rate at which these are made. What was
lost before it reached the bus, the lease and the gates are asked for once a second, by verbs that only tell something
and keep no device waiting.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from drivers.config import StationConfig
from drivers.errors import DriverError
from drivers.health import WORDS
from drivers.interfaces import Description
from drivers.status import Commanding, DeviceStatus, absent, explained, nothing_listens
from drivers.wire import topics
from drivers.wire.bus import Bus
from drivers.wire.link import Link
from drivers.wire.session import listening
from drivers.wire.station_bus import station_bus
from drivers.wire.streams import Sample
from drivers.wire.watch import Watch
from mechanics.readings import Status

NANO = 1e-9

#: how often devices are asked for what their views do not tell, and how long each may take to answer [s]
_ROUND, _ANSWER = 1.0, 1.0
#: a rate is measured over this time [s], and over the last two readings of a device that speaks more seldom
_SPAN = 2.0
#: where no device of a station was seen for so long its bus is opened anew [s]
_BARREN = 5.0

LOOKING = "looking for it"
"""What is said of a station before it was found or missed."""


class StationWatch:
    """Looks on at a station: a context manager with one thread, which it joins; `look` at any time, from any thread."""

    def __init__(self, config: StationConfig):
        # a viewer waits for nobody: what does not answer soon is told as silent
        patient = min(config.bus.timeout, _ANSWER)
        self.config = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": patient})})
        self._seats = {name: _Seat(self.config, name) for name in config.devices}
        self._lock = threading.Lock()
        self._trouble = LOOKING
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"watch {config.name}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and leave the bus; idempotent. Takes no longer than one answer that does not come."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10 * _ANSWER)

    def look(self) -> list[DeviceStatus]:
        """A row for each device, as it is now; asks nobody."""
        with self._lock:
            trouble = self._trouble
        if trouble and not any(seat.was_alive for seat in self._seats.values()):
            return absent(self.config, trouble)
        return explained(self.config, [seat.row(trouble) for seat in self._seats.values()])

    # -- the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closing.is_set():
            trouble = nothing_listens(self.config)
            try:
                if listening(self.config.bus.endpoint):
                    with station_bus(self.config, "viewer") as bus:
                        self._stay(bus)
            except DriverError as error:
                trouble = error.got
            self._say(trouble)
            self._closing.wait(_ROUND)

    def _stay(self, bus: Bus) -> None:
        """Look on until the end, or until there is nobody to look at: a bus may outlive its other end unknowingly."""
        link, seats = Link(bus, self.config.name), self._seats.values()
        seen = time.monotonic()
        try:
            while not self._closing.is_set():
                begun = time.monotonic()
                for seat in seats:
                    seat.attend(link)
                    if self._closing.is_set():
                        return
                if any(seat.alive for seat in seats):
                    seen = begun
                    self._say("")
                elif begun - seen > _ROUND:
                    self._say(f"nobody serves it at {self.config.bus.endpoint}")
                    if begun - seen > _BARREN or not listening(self.config.bus.endpoint):
                        return
                # news of a device that comes shortens the first rounds
                self._closing.wait(_ROUND if all(seat.alive for seat in seats) else 0.2 * _ROUND)
        finally:
            for seat in seats:
                seat.leave()

    def _say(self, trouble: str) -> None:
        with self._lock:
            self._trouble = trouble


class _Seat:
    """Where one device of the station is looked at from. The watch's thread attends to it; anybody takes its row."""

    def __init__(self, config: StationConfig, name: str):
        self._config, self._name, self._known = config, name, config.devices[name]
        self._watch: Watch | None = None
        self._stop: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._came: deque[tuple[int, int]] = deque()  # when, and the reading's number
        self._status = Status.OK
        self._described: Description | None = None
        self._told: dict[str, Any] = {}
        self._arm: Commanding | None = None
        self._trouble = ""
        self._gone_at: float | None = None
        self.was_alive = False

    @property
    def alive(self) -> bool:
        """Whether the device's server is there."""
        return self._watch is not None and self._watch.seen(0) and not self._watch.gone

    def attend(self, link: Link) -> None:
        """Find the device again if it went; ask for what its view does not tell."""
        if self._watch is not None and self._watch.gone:
            self.leave()
        if self._watch is None:
            self._watch = link.bus.watch(topics.alive(self._config.name, self._name))
        if not self._watch.seen(0.05):
            return
        try:
            if self._described is None:
                self._join(link, self._watch)
            self._ask(link, self._watch)
            self._trouble = ""
        except DriverError as error:
            self._trouble = error.got

    def _join(self, link: Link, watch: Watch) -> None:
        with self._lock:
            self._came.clear()
            self._status = Status.OK
        said = json.loads(link.ask(self._name, "describe", timeout=_ANSWER, watch=watch).text)
        said.update(range=tuple(said["range"]), resolution=tuple(said["resolution"]))
        stream = next(iter(topics.STREAMS[self._known.kind]))
        view = topics.view(topics.key(self._config.name, self._name, stream))
        self._stop = link.bus.subscribe(view).listen(self._receive)
        self._described = Description(**said)
        self.was_alive, self._gone_at = True, None

    def _ask(self, link: Link, watch: Watch) -> None:
        def told(verb: str) -> Any:
            return json.loads(link.ask(self._name, verb, timeout=_ANSWER, watch=watch).text)

        if self._known.kind == "arm":
            self._arm = Commanding.of(told("holders"), told("safety"))
        self._told = told("health")

    def leave(self) -> None:
        """The device, or the bus, has gone."""
        self._stop()
        self._stop = lambda: None
        if self._watch is not None:
            self._watch.close()
        self._watch = self._described = None
        if self.was_alive and self._gone_at is None:
            self._gone_at = time.monotonic()

    def _receive(self, sample: Sample) -> None:
        with self._lock:
            if self._came and sample.sequence <= self._came[-1][1]:
                self._came.clear()  # the world was reset, or the device began anew
            self._came.append((sample.receive_ns, sample.sequence))
            self._status = Status(sample.status)
            while len(self._came) > 2 and (sample.receive_ns - self._came[1][0]) * NANO > _SPAN:
                self._came.popleft()

    def row(self, trouble: str) -> DeviceStatus:
        """What is known now; ``trouble`` is the station's, where it has any."""
        name, kind, backend = self._name, self._known.kind, self._known.backend
        described = self._described
        if described is None or not self.alive:
            return DeviceStatus(name, kind, backend, False, trouble=self._absence(trouble))
        with self._lock:
            first, last = (self._came[0], self._came[-1]) if self._came else (None, None)
            status = self._status
        age = None if last is None else (time.time_ns() - last[0]) * NANO
        rate = None
        if first is not None and last is not None and last[0] > first[0]:
            rate = (last[1] - first[1]) / ((last[0] - first[0]) * NANO)
        speaks = described.rate or 1.0
        silent = age is None or age > max(_ROUND, 3.0 / speaks)
        said = self._trouble
        if silent:
            rate = None
        if corrupt := self._told.get("corrupt"):
            said = "; ".join(filter(None, (said, f"{corrupt} readings were damaged")))
        return DeviceStatus(
            name,
            kind,
            backend,
            True,
            rate=rate,
            age=age,
            gaps=self._told.get("gaps"),
            model=described.model,
            condition="" if silent else WORDS.get(status, ""),
            trouble=said,
            arm=self._arm,
        )

    def _absence(self, trouble: str) -> str:
        if self.was_alive:
            now = time.monotonic()
            gone = f"gone for {now - (self._gone_at or now):.0f} s"
            return f"{gone}: {trouble}" if trouble else gone
        return trouble or "no server for it"
