"""Whether every device of a station is alive, how fast it speaks, and what it says of itself.

Looking disturbs nothing: no process is started, no lease is taken, nothing is commanded. For its second it takes the
streams themselves: a view tells neither a stream's rate nor its gaps, and of a camera that nobody else hears only the
view's own rate. Whoever looks on for longer takes the views (`drivers.wire.topics.view`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from drivers.config import StationConfig
from drivers.errors import DriverError
from drivers.station import listening
from drivers.wire.client import REMOTES, RemoteArm
from drivers.wire.link import Link
from drivers.wire.remote import RemoteSensor
from drivers.wire.station_bus import certificates, station_bus

NANO = 1e-9


@dataclass(frozen=True)
class DeviceStatus:
    """One device as seen from here. ``rate`` [Hz] and ``age`` [s] are None where nothing arrived meanwhile."""

    name: str
    kind: str
    backend: str
    alive: bool
    rate: float | None = None
    age: float | None = None
    gaps: int | None = None
    note: str = ""


def station_status(config: StationConfig, seconds: float = 1.0) -> list[DeviceStatus]:
    """Listen to a station for ``seconds`` and return a row for each of its devices; it need not be running."""
    endpoint = config.bus.endpoint
    if not listening(endpoint):
        note = f"nothing listens at {endpoint}"
        return [DeviceStatus(name, d.kind, d.backend, False, note=note) for name, d in config.devices.items()]
    with station_bus(config, "viewer") as bus:
        link = Link(bus, config.name)
        devices = {name: REMOTES[device.kind](name, link, False) for name, device in config.devices.items()}
        failures: dict[str, str] = {}
        for name, device in devices.items():
            try:
                device.connect(1.0)
            except DriverError as error:
                failures[name] = error.got
        try:
            since = time.time_ns()
            time.sleep(seconds)  # a rate is what comes in a span of time: to end it early would falsify it
            return [
                DeviceStatus(name, d.kind, d.backend, False, note=failures[name])
                if name in failures
                else _row(config, devices[name], since, seconds)
                for name, d in config.devices.items()
            ]
        finally:
            for device in devices.values():
                device.close()


def station_certificates(config: StationConfig) -> list[tuple[str, int]]:
    """Every certificate of the station that lies on this machine, by name, with the days that it has left.

    Empty for a station without keys. Raises NotConnected for a file that is no certificate.
    """
    return [] if config.bus.tls is None else certificates(config.bus.tls)


def _gates(found: dict[str, Any]) -> list[str]:
    """What the gates of an arm have to tell."""
    notes = [f"stopped: {found['stopped']}"] if found["stopped"] else []
    if found["held"]:
        notes.append(f"held: {found['held']}")
    if refused := sum(found["refused"].values()):
        gates = ", ".join(f"{gate} {count}" for gate, count in found["refused"].items())
        said = f"refused {refused} of {refused + found['accepted']} set-points ({gates})"
        notes.append(f"{said}, the last: {found['refusal']}")
    return notes


def _row(config: StationConfig, device: RemoteSensor, since_ns: int, seconds: float) -> DeviceStatus:
    known = config.devices[device.name]
    arrivals = device.arrivals(since_ns)
    try:
        described = device.describe()
        alive, notes = True, [described.model]
    except DriverError as error:
        alive, notes = False, [error.got]
    if isinstance(device, RemoteArm) and alive:
        holders = device.lease_holders()
        notes.append(f"commanded by {', '.join(holders)}" if holders else "nobody commands it")
        notes += _gates(device.safety())
    if alive and not arrivals and config.world is not None and config.world.clock == "lockstep":
        notes.append("silent: lockstep time stands still")
    return DeviceStatus(
        device.name,
        known.kind,
        known.backend,
        alive,
        rate=len(arrivals) / seconds if arrivals else None,
        age=(time.time_ns() - arrivals[-1]) * NANO if arrivals else None,
        gaps=device.gaps,
        note="; ".join(notes),
    )
