"""The way onto a station's bus: every process that joins one opens it here, as the role that it plays."""

from __future__ import annotations

import ipaddress
import logging
import os
import time
from collections.abc import Sequence
from pathlib import Path

from drivers.config import StationConfig, TlsConfig
from drivers.errors import NotConnected
from drivers.wire import topics
from drivers.wire.bus import Bus
from drivers.wire.security import (
    CA,
    CERTIFICATE,
    KEY,
    WARNING_DAYS,
    Identity,
    Role,
    days_left,
    expiry,
    read_identity,
    role_of,
)
from drivers.wire.session import address
from mechanics.yaml_input import InputError, Problem

CHOICE = "EXTRINSIC_IDENTITY"
"""The environment variable that names the member to be (``runner-alice``), where a machine has several of a role."""

_HEARD = 2.0  # by then the news that a device is alive has come round [s]

_SUITABLE: dict[Role, tuple[Role, ...]] = {
    "router": ("router",),
    "device": ("device",),
    "runner": ("runner",),
    "viewer": ("viewer", "runner", "device"),  # whoever may do more may look, too
}

log = logging.getLogger(__name__)


def station_bus(
    config: StationConfig, role: Role, *, at_once: bool = False, routing: bool = False, joining: bool = False
) -> Bus:
    """Join a station's bus. A ``device`` listens where there is no router; everybody else connects.

    Where several processes of one machine serve a station without a router, one of them is ``routing``, and the others
    are ``joining`` it. Raises NotConnected, and InputError where listening would let strangers in.
    """
    bus, listen = config.bus, role == "device" and config.bus.mode == "peer" and not joining
    if listen:
        refuse_open_door(config)
    identity = None if bus.tls is None else find_identity(bus.tls, role)
    if identity is not None:
        warn_of_end(identity)
    return Bus(
        bus.endpoint,
        listen=listen,
        mode="router" if routing else "client" if joining else bus.mode,
        timeout=bus.timeout,
        shared_memory=False,
        lease=config.lease,
        at_once=at_once,
        identity=identity,
    )


def warn_unheard(config: StationConfig, devices: Sequence[str]) -> None:
    """Warn of devices of this process that nobody hears: a router drops what a machine's certificate is not for."""
    if config.bus.mode == "peer":
        return
    with station_bus(config, "device") as bus:  # to oneself one is always there
        deadline = time.monotonic() + _HEARD
        watches = {name: bus.watch(topics.alive(config.name, name)) for name in devices}
        unheard = [name for name, watch in watches.items() if not watch.seen(max(deadline - time.monotonic(), 0.0))]
        if unheard and bus.identity is not None:
            said = "the router lets nobody hear %s: %s may not serve it; see `machines` in its access.yaml"
            log.warning(said, ", ".join(unheard), bus.identity.name)


def refuse_open_door(config: StationConfig) -> None:
    """Raise InputError where a server would listen for other machines without keys; warn where that is wanted."""
    bus = config.bus
    if bus.mode == "client" or is_loopback(bus.endpoint):
        return
    if not bus.insecure:
        wrong = f"{bus.endpoint} can be reached from other machines, and whoever reaches it may command the arm"
        expected = "an endpoint at 127.0.0.1, keys (`extrinsic lab init`), or --insecure (bus.insecure: true)"
        raise InputError([Problem("station", None, "bus.endpoint", wrong, expected)])
    log.warning("%s: INSECURE: whoever reaches %s may command the arm", config.name, bus.endpoint)


def warn_of_end(identity: Identity) -> None:
    """Say so where a certificate ends soon: with it the connection ends, whatever goes on."""
    days = days_left(identity.expires)
    if days < WARNING_DAYS:
        log.warning("the certificate of %s ends in %d days; `extrinsic lab renew` makes a new one", identity.name, days)


def is_loopback(endpoint: str) -> bool:
    """Whether only this machine can reach an endpoint."""
    host = address(endpoint).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def find_identity(tls: TlsConfig, role: Role) -> Identity:
    """The member that this process is: the one that $EXTRINSIC_IDENTITY names, or the only one of a suitable role.

    Raises NotConnected where there is none, or more than one, or where its files are no good.
    """
    if tls.folder is None:
        ca, certificate, key = (Path(path or "").expanduser() for path in (tls.ca, tls.certificate, tls.key))
        return read_identity(ca, certificate, key)
    folder = Path(tls.folder).expanduser()
    names = member_folders(folder)
    chosen = os.environ.get(CHOICE, "")
    asked = f"find a {role}'s certificate in {folder}"
    if chosen and role_of(chosen) in _SUITABLE[role]:
        if chosen not in names:
            got, remedy = f"{CHOICE} is {chosen}, which is not there", f"There are: {_listed(names)}"
            raise NotConnected("bus", asked, got, remedy)
        return _member(folder / chosen)
    for suitable in _SUITABLE[role]:
        found = [name for name in names if role_of(name) == suitable]
        if len(found) == 1:
            return _member(folder / found[0])
        if found:
            raise NotConnected("bus", asked, f"there are several: {_listed(found)}", f"Set {CHOICE} to one of them")
    remedy = "Make one with `extrinsic lab init` or `lab add`, and copy its folder there"
    raise NotConnected("bus", asked, f"there are: {_listed(names)}" if names else "there is none", remedy)


def member_folders(folder: Path) -> list[str]:
    """The names of the members whose certificates lie in a lab's folder."""
    return sorted(path.parent.name for path in folder.glob(f"*/{CERTIFICATE}") if role_of(path.parent.name))


def certificates(tls: TlsConfig) -> list[tuple[str, int]]:
    """Every certificate that lies here, by its name, with the days that it has left. Raises NotConnected."""
    if tls.folder is None:
        files = [Path(path or "").expanduser() for path in (tls.certificate, tls.ca)]
    else:
        folder = Path(tls.folder).expanduser()
        members = [folder / name for name in member_folders(folder)]
        files = [member / CERTIFICATE for member in members] + [member / CA for member in members[:1]]
    return [(name, days_left(end)) for name, end in map(expiry, files)]


def _member(folder: Path) -> Identity:
    return read_identity(folder / CA, folder / CERTIFICATE, folder / KEY)


def _listed(names: list[str]) -> str:
    return ", ".join(names) or "none"
