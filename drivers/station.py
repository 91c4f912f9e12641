"""Opens a station: joins the one that is running at its endpoint, or starts the simulated one."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

import numpy as np

from drivers.config import StationConfig
from drivers.descriptions import DESCRIPTIONS, LoggedStation
from drivers.errors import DriverError, NotConnected
from drivers.hosting import HostProcess, StationHost
from drivers.interfaces import Description
from drivers.roles import Roles
from drivers.wire import messages, topics
from drivers.wire.bus import Bus
from drivers.wire.client import REMOTES
from drivers.wire.clock import RemoteClock, RemoteSimulation
from drivers.wire.codec import encode_reading
from drivers.wire.link import Link
from drivers.wire.log import LogWriter
from drivers.wire.remote import RemoteSensor
from drivers.wire.session import listening
from drivers.wire.station_bus import refuse_open_door, station_bus
from drivers.wire.streams import Publisher
from drivers.wire.watch import Watch
from mechanics.readings import Array, Stamp, WrenchReading

Hosting = Callable[[StationConfig], StationHost]
"""What makes the host of a simulated station."""

_PROTOCOL = 2


class Devices(Roles[RemoteSensor]):
    """The open devices of a station.

    ``simulation`` is None for a station without a world, ``host`` unless this connection started it.
    """

    def __init__(
        self,
        config: StationConfig,
        bus: Bus,
        devices: dict[str, RemoteSensor],
        clock: RemoteClock,
        simulation: RemoteSimulation | None,
        host: StationHost | None,
        link: Link,
        watch: Watch,
    ):
        super().__init__(config, devices)
        self.bus, self.clock, self.simulation, self.host = bus, clock, simulation, host
        self._link, self._watch = link, watch
        self._estimates: Publisher | None = None

    def attach(self, writer: LogWriter) -> None:
        """Log every stream of the station but those that its file omits. When it returns, nothing more is missed."""
        prefix = f"{self.config.name}/"
        omit = self.config.log.omit
        wanted = {
            topic: type_name
            for topic, type_name in topics.streams(self.config).items()
            if topic not in omit and topic.removeprefix(prefix) not in omit
        }
        writer.attach(self.bus, wanted, lockstep=self.clock.lockstep)
        # the answer comes after who serves has heard of the subscriptions
        for server in [topics.WORLD] if self.config.world is not None else self._devices:
            self._link.ask(server, "describe", watch=self._watch)
        self.tell_descriptions(writer)

    def tell_descriptions(self, writer: LogWriter) -> None:
        """Put what each device says of itself into the log, so that it can be played back (`drivers.replay`).

        A simulated world says some of it only once it was reset. A device that does not answer is left out.
        """
        said: dict[str, Description] = {}
        for name, device in self.items():
            with suppress(DriverError):
                said[name] = device.describe()
        told = LoggedStation(self.config.name, self.clock.lockstep, said)
        writer.add_attachment(DESCRIPTIONS, "application/json", told.as_json())

    def tell_wrench(self, wrench: Array) -> None:
        """Publish the wrench (fx, fy, τ) that the fingers tell, axes of W: a second witness of the arm's gates."""
        if self._estimates is None:
            topic = topics.key(self.config.name, topics.ESTIMATOR, next(iter(topics.STREAMS["force_torque"])))
            self._estimates = self.bus.publisher(topic, messages.WRENCH)
        fx, fy, tau = map(float, wrench)
        stamp = Stamp(self.clock.now_ns(), self.clock.now_ns(), self._estimates.newest + 1, "world")
        reading = WrenchReading(stamp, np.array([fx, 0.0, fy, 0.0, -tau, 0.0]))
        self._estimates.put(encode_reading(reading), stamp.sequence, stamp.capture_ns)

    def log(self, path: Path | str) -> LogWriter:
        """A new log with the station attached; close it."""
        writer = LogWriter(path, flush=self.config.log.flush)
        try:
            self.attach(writer)
        except BaseException:
            writer.close()
            raise
        return writer


class Station:
    """A station by its file. `connect` opens it as a context; a station can be opened again after it was closed."""

    def __init__(self, config: StationConfig):
        self.config = config

    def connect(self, host: Hosting = HostProcess) -> Connection:
        """The way in: ``with Station(config).connect() as devices:``.

        ``host`` serves a simulated station that does not run yet: in a process of its own, or in a thread of this one
        (`drivers.sim.host_thread.HostThread`).
        """
        return Connection(self.config, host)


class Connection:
    """An open station: its host if it had to be started, bus, devices; closed in the reverse order."""

    def __init__(self, config: StationConfig, host: Hosting = HostProcess):
        self.config = config
        self.host: StationHost | None = None
        self._made_by = host
        self._stack = ExitStack()

    def __enter__(self) -> Devices:
        with ExitStack() as stack:
            devices = self._open(stack)
            self._stack = stack.pop_all()
        return devices

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _open(self, stack: ExitStack) -> Devices:
        config = self.config
        endpoint = config.bus.endpoint
        routed = config.bus.mode == "client"
        if not listening(endpoint):
            if routed or config.world is None:
                starting = "the router with `extrinsic lab router" if routed else "the station with `extrinsic serve"
                raise NotConnected(
                    config.name,
                    f"connect to {endpoint}",
                    "nothing listens there",
                    f"Start {starting} STATION`, or correct bus.endpoint",
                )
            refuse_open_door(config)
            self.host = stack.enter_context(self._made_by(config))
        bus = None if self.host is None else self.host.bus
        if bus is None:
            bus = stack.enter_context(station_bus(config, "runner"))
        link = Link(bus, config.name)
        # a station without a world has nobody who speaks for all of it: its arm stands for it, or else its first device
        head = next((n for n, d in config.devices.items() if d.kind == "arm"), next(iter(config.devices)))
        watch = bus.watch(topics.alive(config.name, topics.WORLD if config.world is not None else head))
        stack.callback(self._abandon, watch)
        if not watch.seen(config.bus.timeout):
            raise NotConnected(
                config.name,
                f"connect to {endpoint}",
                f"whatever listens there does not serve station '{config.name}'",
                "Start it with `extrinsic serve STATION`; a certificate that was revoked sees nothing either"
                if routed
                else "Another station or program has the port; change bus.endpoint or end it",
            )
        if config.world is not None:
            reply = link.ask(topics.WORLD, "describe", watch=watch)
            _agree(config, json.loads(reply.text))
            link.now_ns = reply.now_ns
        lockstep = config.world is not None and config.world.clock == "lockstep"
        devices = {name: REMOTES[device.kind](name, link, lockstep) for name, device in config.devices.items()}
        failures: list[DriverError] = []
        for device in devices.values():
            try:
                device.connect(config.bus.timeout)
                stack.callback(device.close)
                if config.world is None:
                    _agree_on(config, device.name, link)
            except DriverError as error:
                failures.append(error)
        if failures:
            raise NotConnected(
                config.name,
                "open its devices",
                f"{len(failures)} of {len(devices)} failed",
                "Mend each of these:",
                children=tuple(failures),
            )
        simulation = None if config.world is None else RemoteSimulation(link, watch, list(devices.values()))
        clock = RemoteClock(link, watch, lockstep)
        return Devices(config, bus, devices, clock, simulation, self.host, link, watch)

    def _abandon(self, watch: Watch) -> None:
        """Kill a host that no longer answers, before the bus waits for it to close in order."""
        if watch.gone and self.host is not None:
            self.host.kill()


def _agree_on(config: StationConfig, name: str, link: Link) -> None:
    """Refuse the server of a device that has another idea of it. Raises NotConnected."""
    mine, theirs = config.devices[name].model_dump(mode="json"), json.loads(link.ask(name, "settings").text)
    differing = sorted(key for key in mine.keys() | theirs.keys() if mine.get(key) != theirs.get(key))
    if differing:
        raise NotConnected(
            name,
            f"join its server at {config.bus.endpoint}",
            f"it was started from a station file with another {', '.join(differing)}",
            "Use one station file on every machine, and start the server again",
        )


def _agree(config: StationConfig, said: dict) -> None:
    """Refuse a running host of another version or with another idea of the station. Raises NotConnected."""
    asked = f"join the host at {config.bus.endpoint}"
    if said.get("protocol") != _PROTOCOL:
        raise NotConnected(
            config.name, asked, f"it speaks protocol {said.get('protocol')}, not {_PROTOCOL}", "Restart it"
        )
    mine, theirs = config.model_dump(mode="json"), said["config"]
    differing = [key for key in ("name", "devices", "table_tags") if mine.get(key) != theirs.get(key)]
    # how far the plant is from the model goes with the reset; its time and its step were fixed when the host started
    ours, its = mine.get("world") or {}, theirs.get("world") or {}
    differing += [f"world.{key}" for key in ("clock", "timestep") if ours.get(key) != its.get(key)]
    if differing:
        raise NotConnected(
            config.name,
            asked,
            f"it was started from a station file with another {', '.join(differing)}",
            "End that host, or use its station file",
        )
