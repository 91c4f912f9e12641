"""Whether every device of a station is alive, how fast it speaks, and what it says of itself.

Looking disturbs nothing: no process is started, no lease is taken, nothing is commanded.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from drivers.config import StationConfig
from drivers.errors import DriverError
from drivers.station import listening
from drivers.wire.bus import Bus
from drivers.wire.client import REMOTES, RemoteSensor
from drivers.wire.link import Link

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
    with Bus(endpoint, timeout=config.bus.timeout, shared_memory=False, lease=config.lease) as bus:
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


def _row(config: StationConfig, device: RemoteSensor, since_ns: int, seconds: float) -> DeviceStatus:
    known = config.devices[device.name]
    arrivals = device.arrivals(since_ns)
    try:
        described = device.describe()
        alive, notes = True, [described.model]
    except DriverError as error:
        alive, notes = False, [error.got]
    if known.kind == "arm":
        holders = device.lease_holders()
        notes.append(f"commanded by {', '.join(holders)}" if holders else "nobody commands it")
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
