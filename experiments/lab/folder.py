"""A lab's folder: the authority, the members' folders, and ``router/access.yaml``, which says who they are.

::

    lab/ca/             ca.pem and its key: whoever has the key can make members
    lab/router/         as every member's: ca.pem certificate.pem key.pem zenoh.json5; and access.yaml
    lab/device-bench/   a machine that serves devices
    lab/runner-alice/   who may command
    lab/viewer-wall/    who may look
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.config import StationConfig
from drivers.wire import topics
from drivers.wire.access import Access
from drivers.wire.router import zenoh_file
from drivers.wire.security import (
    CA,
    CERTIFICATE,
    KEY,
    MEMBER_DAYS,
    Identity,
    make_authority,
    make_member,
    read_identity,
    renew_member,
)
from drivers.wire.session import address
from mechanics.yaml_input import Document, InputError, Problem, nearest, one_of, parse, read_yaml

AUTHORITY, ROUTER, REVOKED = "ca", "router", "revoked"
ACCESS, ZENOH = "access.yaml", "zenoh.json5"
DEFAULT = "lab"
_OPTIONS = {"router": "router", "device": "machine", "runner": "runner", "viewer": "viewer"}


@dataclass(frozen=True)
class Wanted:
    """Members to make: machines with their devices, runners and viewers by their names."""

    machines: Mapping[str, tuple[str, ...]]
    runners: tuple[str, ...] = ()
    viewers: tuple[str, ...] = ()


def lab_folder(config: StationConfig) -> Path:
    """Where a station's lab lies: ``bus.tls.folder``, else ``lab``. Raises InputError for keys from elsewhere."""
    tls = config.bus.tls
    if tls is not None and tls.folder is None:
        raise _refused("bus.tls", "this station's keys are no lab's", "bus.tls.folder")
    return Path(DEFAULT if tls is None or tls.folder is None else tls.folder).expanduser()


def init_lab(
    config: StationConfig, folder: Path, wanted: Wanted, hosts: Sequence[str] = (), days: int = MEMBER_DAYS
) -> Access:
    """Make an authority, a router and members in ``folder``, which is new or empty; all of it or nothing.

    Without machines one serves every device; without runners or viewers there is one of each, named after the station.
    The station itself (`topics.WORLD`) goes to the machine of the arm where nobody is named. The router's certificate
    is for the host of the station's endpoint and for ``hosts``. Raises InputError.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        wrong = f"in {folder} there is something already, and an authority is never overwritten"
        raise _refused("--out", wrong, "a new folder, or `extrinsic lab add`")
    access = _joined(
        config,
        Access(station=config.name),
        Wanted(
            wanted.machines or {config.name: tuple(config.devices)},
            wanted.runners or (config.name,),
            wanted.viewers or (config.name,),
        ),
    )
    endpoint_host = address(config.bus.endpoint).hostname or ""
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))  # 0700
    try:
        make_authority(aside / AUTHORITY, f"{config.name} lab")
        make_member(aside / AUTHORITY, aside / ROUTER, ROUTER, list(dict.fromkeys([endpoint_host, *hosts])), days)
        for name in access.members():
            if name != ROUTER:
                make_member(aside / AUTHORITY, aside / name, name, days=days)
        _write_access(config, aside, access)
        (aside / ".gitignore").write_text("*\n")  # keys are nobody's commit
        aside.rename(folder)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    return access


def add_members(config: StationConfig, folder: Path, wanted: Wanted, days: int = MEMBER_DAYS) -> list[str]:
    """Make more members with the lab's own authority; returns their names. Raises InputError, NotConnected."""
    before = read_access(config, folder)
    after = _joined(config, before, wanted)
    new = [name for name in after.members() if name not in before.members()]
    for name in new:
        if (folder / name).exists():
            raise _refused(f"--{_OPTIONS[after.members()[name]]}", f"there is a folder {folder / name}", "another name")
    for name in new:
        make_member(folder / AUTHORITY, folder / name, name, days=days)
    _write_access(config, folder, after)
    return new


def revoke(config: StationConfig, folder: Path, name: str) -> None:
    """Take every right from a member; in force once the router was started again. Raises InputError.

    What lies here of its keys goes to ``revoked/``, where nobody picks it up by mistake.
    """
    access = read_access(config, folder)
    members = [member for member in access.members() if member != ROUTER]
    if name in access.revoked:
        raise _refused("NAME", f"{name} is revoked already", "a member")
    if name not in members:
        raise _refused("NAME", f"the lab has no member {name!r}", one_of(members), nearest(name, members))
    _write_access(config, folder, access.without(name))
    if (folder / name).is_dir():
        (folder / REVOKED).mkdir(mode=0o700, exist_ok=True)
        (folder / name).rename(folder / REVOKED / name)


def renew(config: StationConfig, folder: Path, names: Sequence[str], days: int = MEMBER_DAYS) -> list[str]:
    """New certificates for the old keys of these members, all by default; returns their names. Raises InputError."""
    members = list(read_access(config, folder).members())
    for name in names:
        if name not in members:
            raise _refused("NAME", f"the lab has no member {name!r}", one_of(members), nearest(name, members))
    chosen = list(names) or members
    for name in chosen:
        renew_member(folder / AUTHORITY, folder / name, days)
    return chosen


def read_access(config: StationConfig, folder: Path) -> Access:
    """Who the members are. Raises InputError where the lab is missing, or another station's."""
    path = folder / ROUTER / ACCESS
    if not path.exists():
        raise _refused("bus.tls.folder", f"there is no {path}", "`extrinsic lab init`, or the folder of a lab")
    return _checked(config, read_yaml(path))


def router_identity(folder: Path) -> Identity:
    """The router's own certificate and key. Raises NotConnected where they are no good."""
    return read_identity(*(folder / ROUTER / file for file in (CA, CERTIFICATE, KEY)))


def unserved(config: StationConfig, access: Access) -> list[str]:
    """The devices that no machine may serve."""
    served = {device for devices in access.machines.values() for device in devices}
    return [name for name in (*config.devices, topics.WORLD) if name not in served]


def _joined(config: StationConfig, access: Access, wanted: Wanted) -> Access:
    """The members there are and those who are wanted. Raises InputError for a name or a device that cannot be."""
    new = Access.model_construct(
        station="", machines=dict(wanted.machines), runners=wanted.runners, viewers=wanted.viewers
    )
    for name, role in new.members().items():
        if name in access.revoked:
            wrong = f"{name} was revoked: whoever has its old key would be let in again"
            raise _refused(f"--{_OPTIONS[role]}", wrong, "another name")
        if name in access.members() and name != ROUTER:
            raise _refused(f"--{_OPTIONS[role]}", f"there is a {name} already", "another name")
    arms = {name for name, device in config.devices.items() if device.kind == "arm"}
    machines = {name: list(devices) for name, devices in {**access.machines, **wanted.machines}.items()}
    if not any(topics.WORLD in devices for devices in machines.values()):
        for devices in machines.values():
            if arms & set(devices):
                devices.append(topics.WORLD)
                break
    data = {
        **access.model_dump(mode="json"),
        "machines": machines,
        "runners": [*access.runners, *dict.fromkeys(wanted.runners)],
        "viewers": [*access.viewers, *dict.fromkeys(wanted.viewers)],
    }
    return _checked(config, Document(data, {}, "lab"))


def _checked(config: StationConfig, document: Document) -> Access:
    """The document as the members of the station's lab. Raises InputError."""
    access, known = parse(Access, document), (*config.devices, topics.WORLD)
    problems: list[Problem] = []
    if access.station != config.name:
        problems.append(document.problem(("station",), f"this is the lab of station {access.station!r}", config.name))
    for machine, devices in access.machines.items():
        for i, device in enumerate(devices):
            if device not in known:
                wrong = f"the station has no device {device!r}"
                place = ("machines", machine, i)
                problems.append(document.problem(place, wrong, one_of(known), nearest(device, known)))
    if problems:
        raise InputError(problems)
    return access


def _write_access(config: StationConfig, folder: Path, access: Access) -> None:
    """The members' list, then what follows from it: zenoh's own configurations."""
    _replace(folder / ROUTER / ACCESS, access.text())
    endpoint = "tls/" + config.bus.endpoint.split("/", 1)[1]
    for name, role in access.members().items():
        if (folder / name / CERTIFICATE).exists():
            rules = access if role == "router" else None
            _replace(folder / name / ZENOH, zenoh_file(endpoint, rules))


def _replace(path: Path, text: str) -> None:
    aside = path.with_name(f".{path.name}.new")
    with aside.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)


def _refused(key: str, wrong: str, expected: str = "", near: str = "") -> InputError:
    return InputError([Problem("lab", None, key, wrong, expected, near)])
