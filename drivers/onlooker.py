"""Looks on at a running station, for as long as one likes: the views of its streams, as they come.

Looking disturbs nothing: no process is started, no lease taken, nothing commanded, and who takes views holds up nobody
(`docs/decisions/0008-views-beside-streams.md`).
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from pydantic import ValidationError

from drivers.config import StationConfig
from drivers.errors import DriverError, NotConnected
from drivers.scene import Scene
from drivers.station import listening
from drivers.wire import topics
from drivers.wire.link import Link
from drivers.wire.log_reader import Logged
from drivers.wire.station_bus import station_bus
from drivers.wire.streams import Sample
from drivers.wire.watch import Watch

KEPT = 4096
"""So many messages wait for who looks on; the oldest go. At the views' rates these are ten seconds and more."""

_ASKING = 1.0


class Onlooker:
    """A viewer's place at a station, as a context manager.

    Entering it raises NotConnected where the station is not there within ``timeout`` seconds (its bus's own where
    None), and InputError or NotConnected where this machine has no certificate to look with. ``dropped`` counts what
    nobody took in time.
    """

    def __init__(self, config: StationConfig, timeout: float | None = None):
        self.config = config
        self.timeout = config.bus.timeout if timeout is None else timeout
        self.dropped = 0
        self._stack = ExitStack()
        self._kept: deque[Logged] = deque(maxlen=KEPT)
        self._arrived = threading.Condition()
        self._types = topics.streams(config)
        self._watch: Watch | None = None
        self._link: Link | None = None

    def __enter__(self) -> Self:
        config, endpoint = self.config, self.config.bus.endpoint
        asked = f"look on at {endpoint}"
        if not listening(endpoint):
            remedy = "Start the station with `extrinsic serve STATION`, or correct bus.endpoint"
            raise NotConnected(config.name, asked, "nothing listens there", remedy)
        with ExitStack() as stack:
            bus = stack.enter_context(station_bus(config, "viewer"))
            # where there is no world, any device will do: the others may come later
            names = [topics.WORLD] if config.world is not None else list(config.devices)
            watches = [bus.watch(topics.alive(config.name, name)) for name in names]
            deadline = time.monotonic() + self.timeout
            self._watch = next((w for w in watches if w.seen(max(deadline - time.monotonic(), 0.0))), None)
            if self._watch is None:
                got = f"whatever listens there does not serve station '{config.name}'"
                remedy = "Start it with `extrinsic serve STATION`; a certificate that was revoked sees nothing either"
                raise NotConnected(config.name, asked, got, remedy)
            self._link = Link(bus, config.name)
            for topic in self._types:
                stack.callback(bus.subscribe(topics.view(topic)).listen(self._receive))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def gone(self) -> bool:
        """Whether the station has ended since."""
        return self._watch is not None and self._watch.gone

    def take(self, timeout: float) -> list[Logged]:
        """What has come since, as a log would have it; waits at most ``timeout`` seconds for the first."""
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self._kept), timeout)
            taken = list(self._kept)
            self._kept.clear()
        return taken

    def scene(self) -> Scene | None:
        """What stands on the table of a simulated station; None where nothing was put there, and of a real one."""
        if self._link is None or self.config.world is None:
            return None
        try:
            said = json.loads(self._link.ask(topics.WORLD, "describe", timeout=_ASKING, watch=self._watch).text)
            return None if said.get("scene") is None else Scene.model_validate(said["scene"])
        except (DriverError, ValidationError, ValueError):
            return None  # it has ended, it is busy, or it is an emulated one, which does not tell

    def _receive(self, sample: Sample) -> None:
        topic = sample.topic.removesuffix("/view")
        logged = Logged(
            topic,
            self._types.get(topic, ""),
            sample.payload,
            sample.sequence,
            sample.capture_ns,
            sample.receive_ns,
            sample.status,
        )
        with self._arrived:
            self.dropped += len(self._kept) == KEPT
            self._kept.append(logged)
            self._arrived.notify_all()
