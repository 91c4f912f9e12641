"""Whether every device of a station is alive, how fast it speaks, and what it says of itself.

Looking disturbs nothing: no process is started, no lease is taken, nothing is commanded. For its second it takes the
streams themselves: a view tells nothing of what is lost, and of a camera that nobody else hears only the view's own
rate. Whoever looks on for longer takes the views (`drivers.status_watch`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from drivers.config import StationConfig
from drivers.errors import DriverError
from drivers.health import WORDS
from drivers.wire.client import REMOTES, RemoteArm
from drivers.wire.link import Link
from drivers.wire.remote import RemoteSensor
from drivers.wire.session import listening
from drivers.wire.station_bus import certificates, station_bus
from mechanics.readings import Status

NANO = 1e-9


@dataclass(frozen=True)
class Commanding:
    """Who commands an arm, and what its gates have to tell since its server began.

    ``stopped`` and ``held`` are reasons, empty where it is not; ``refused`` counts set-points by the gate that refused
    them, and ``refusal`` is the last of these in words.
    """

    holder: str | None = None
    stopped: str = ""
    held: str = ""
    accepted: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    refusal: str = ""

    @classmethod
    def of(cls, holders: list[str], gates: dict[str, Any]) -> Commanding:
        """From what the arm's server says: `RemoteArm.lease_holders` and `RemoteArm.safety`."""
        return cls(
            ", ".join(holders) or None,
            gates["stopped"],
            gates["held"],
            gates["accepted"],
            dict(gates["refused"]),
            gates["refusal"],
        )

    @property
    def notes(self) -> list[str]:
        """In words, the lease first."""
        notes = [f"commanded by {self.holder}" if self.holder else "nobody commands it"]
        notes += [f"stopped: {self.stopped}"] if self.stopped else []
        notes += [f"held: {self.held}"] if self.held else []
        if count := sum(self.refused.values()):
            gates = ", ".join(f"{gate} {number}" for gate, number in self.refused.items())
            said = f"refused {count} of {count + self.accepted} set-points ({gates})"
            notes.append(f"{said}, the last: {self.refusal}")
        return notes


@dataclass(frozen=True)
class DeviceStatus:
    """One device as seen from here.

    ``rate`` [Hz], ``age`` of the newest reading [s] and ``gaps`` are None where nothing is known of them. ``condition``
    is what its readings say of themselves, empty where they are valid. ``trouble`` says why it is not alive, or what
    else there is to say; ``arm`` is there for arms alone.
    """

    name: str
    kind: str
    backend: str
    alive: bool
    rate: float | None = None
    age: float | None = None
    gaps: int | None = None
    model: str = ""
    condition: str = ""
    trouble: str = ""
    arm: Commanding | None = None

    @property
    def notes(self) -> list[str]:
        """All that a person should know beside the figures, the model left out."""
        notes = [] if self.arm is None else self.arm.notes
        return notes + [text for text in (self.condition, self.trouble) if text]

    @property
    def note(self) -> str:
        """The model and the notes in one line."""
        return "; ".join([self.model, *self.notes] if self.model else self.notes)


def station_status(config: StationConfig, seconds: float = 1.0) -> list[DeviceStatus]:
    """Listen to a station for ``seconds`` and return a row for each of its devices; it need not be running."""
    if not listening(config.bus.endpoint):
        return absent(config, nothing_listens(config))
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
            rows = [
                DeviceStatus(name, d.kind, d.backend, False, trouble=failures[name])
                if name in failures
                else _row(config, devices[name], since, seconds)
                for name, d in config.devices.items()
            ]
            return explained(config, rows)
        finally:
            for device in devices.values():
                device.close()


def absent(config: StationConfig, why: str) -> list[DeviceStatus]:
    """A row for each device of a station that cannot be reached."""
    return [DeviceStatus(name, d.kind, d.backend, False, trouble=why) for name, d in config.devices.items()]


def nothing_listens(config: StationConfig) -> str:
    """What is said of a station at whose endpoint nothing accepts connections."""
    return f"nothing listens at {config.bus.endpoint}"


def how_to_start(config: StationConfig) -> str:
    """The command that brings a station up that cannot be reached."""
    if config.bus.mode == "client":
        return "Start the router with `extrinsic lab router STATION`, the devices with `extrinsic serve STATION`"
    return f"Start it with `extrinsic serve {config.name}`, or with the path of its file"


def station_certificates(config: StationConfig) -> list[tuple[str, int]]:
    """Every certificate of the station that lies on this machine, by name, with the days that it has left.

    Empty for a station without keys. Raises NotConnected for a file that is no certificate.
    """
    return [] if config.bus.tls is None else certificates(config.bus.tls)


def explained(config: StationConfig, rows: Sequence[DeviceStatus]) -> list[DeviceStatus]:
    """The rows, each that is alive and silent with a word on that: whether it may be well all the same.

    In lockstep time stands still while nobody asks for more, and no simulated world moves before a run has set its
    scene.
    """
    speaking = any(row.rate is not None for row in rows)
    well = config.world is not None and (config.world.clock == "lockstep" or not speaking)
    why = "silent: its world stands still until a run moves it" if well else "silent: no reading comes"
    return [replace(row, trouble=row.trouble or why) if row.alive and row.rate is None else row for row in rows]


def _row(config: StationConfig, device: RemoteSensor, since_ns: int, seconds: float) -> DeviceStatus:
    known = config.devices[device.name]
    arrivals = device.arrivals(since_ns)
    model = condition = trouble = ""
    alive, arm = True, None
    try:
        model = device.describe().model
        heard = device.heard(0)
        condition = WORDS.get(heard[-1][1] if heard else Status.OK, "")
        if isinstance(device, RemoteArm):
            arm = Commanding.of(device.lease_holders(), device.safety())
    except DriverError as error:
        alive, trouble = False, error.got
    return DeviceStatus(
        device.name,
        known.kind,
        known.backend,
        alive,
        rate=len(arrivals) / seconds if arrivals else None,
        age=(time.time_ns() - arrivals[-1]) * NANO if arrivals else None,
        gaps=device.gaps,
        model=model,
        condition=condition,
        trouble=trouble,
        arm=arm,
    )
