"""``extrinsic lab``: keys, members, the router."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from experiments.command import Sets, StationName, commands
from experiments.terminal import terminal

if TYPE_CHECKING:
    from drivers.config import StationConfig
    from drivers.wire.access import Access
    from experiments.lab.folder import Wanted

app = typer.Typer(
    name="lab",
    help="A lab of several machines: keys, who may do what, the router.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
command = commands(app)

Machines = Annotated[
    list[str] | None,
    typer.Option("--machine", metavar="NAME=DEVICE,...", help="A machine and the devices that it may serve."),
]
Runners = Annotated[list[str] | None, typer.Option("--runner", metavar="NAME", help="Who may command.")]
Viewers = Annotated[list[str] | None, typer.Option("--viewer", metavar="NAME", help="Who may only look.")]
Days = Annotated[int, typer.Option("--days", min=1, max=3650, help="How long the certificates are valid.")]


@command("extrinsic lab init lab1.yaml --router-host router.lab --machine bench=arm,gripper --runner alice")
def init(
    station: StationName,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="A new folder; bus.tls.folder, or lab.")
    ] = None,
    router_host: Annotated[
        list[str] | None,
        typer.Option(
            "--router-host", metavar="HOST", help="A name or an address of the router, beside the endpoint's."
        ),
    ] = None,
    machine: Machines = None,
    runner: Runners = None,
    viewer: Viewers = None,
    days: Days = 365,
    sets: Sets = None,
) -> None:
    """Make a certificate authority and a certificate for the router, each machine, each runner, each viewer."""
    from experiments.files import load_station
    from experiments.lab.folder import init_lab, lab_folder, unserved

    config = load_station(station, sets or [])
    folder = out or lab_folder(config)
    access = init_lab(config, folder, _wanted(machine, runner, viewer), router_host or [], days)
    console = terminal(stderr=True, prose=True)
    console.print(f"{folder}: {', '.join(access.members())}; valid for {days} days")
    _warn(unserved(config, access), console)
    if config.bus.tls is None:
        host = (router_host or [config.bus.endpoint.split("/", 1)[1].rpartition(":")[0]])[0]
        port = config.bus.endpoint.rpartition(":")[2]
        console.print("\nPut this into the station file, then copy each member's folder to its machine:")
        terminal(prose=True).print(f"bus:\n  endpoint: tls/{host}:{port}\n  tls: {{folder: {folder}}}", markup=False)


@command("extrinsic lab add lab1.yaml --runner bob")
def add(
    station: StationName,
    machine: Machines = None,
    runner: Runners = None,
    viewer: Viewers = None,
    days: Days = 365,
    sets: Sets = None,
) -> None:
    """Make certificates for more machines, runners and viewers with the lab's own authority."""
    from experiments.files import load_station
    from experiments.lab.folder import add_members, lab_folder, read_access, unserved
    from mechanics.yaml_input import InputError, Problem

    if not (machine or runner or viewer):
        raise InputError([Problem("lab add", None, "", "nobody was named", "--machine, --runner or --viewer")])
    config = load_station(station, sets or [])
    folder = lab_folder(config)
    names = add_members(config, folder, _wanted(machine, runner, viewer), days)
    console = terminal(stderr=True, prose=True)
    for name in names:
        console.print(f"{folder / name}: copy it to its machine; valid for {days} days")
    _warn(unserved(config, read_access(config, folder)), console)
    console.print(_RESTART)


@command("extrinsic lab revoke lab1.yaml runner-bob")
def revoke(
    station: StationName,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A member, as runner-bob.")],
    sets: Sets = None,
) -> None:
    """Take every right from a member whose key was lost, or who has left."""
    from experiments.files import load_station
    from experiments.lab import folder as lab

    config = load_station(station, sets or [])
    lab.revoke(config, lab.lab_folder(config), name)
    terminal(stderr=True, prose=True).print(f"{name} is revoked. {_RESTART}")


@command("extrinsic lab renew lab1.yaml runner-alice")
def renew(
    station: StationName,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Members, as runner-alice; all by default.")
    ] = None,
    days: Days = 365,
    sets: Sets = None,
) -> None:
    """Make new certificates for the keys that the members have."""
    from experiments.files import load_station
    from experiments.lab import folder as lab

    config = load_station(station, sets or [])
    folder = lab.lab_folder(config)
    console = terminal(stderr=True, prose=True)
    for name in lab.renew(config, folder, names or [], days):
        console.print(f"{folder / name / lab.CERTIFICATE}: copy it to its machine; valid for {days} days")


@command("extrinsic lab router lab1.yaml")
def router(station: StationName, sets: Sets = None) -> None:
    """Run the lab's router at the station's endpoint, until Ctrl-C."""
    from drivers.wire.router import Router
    from drivers.wire.station_bus import warn_of_end
    from experiments.files import load_station
    from experiments.lab.folder import lab_folder, read_access, router_identity, unserved
    from mechanics.yaml_input import InputError, Problem

    config = load_station(station, sets or [])
    if config.bus.tls is None:
        expected = "tls: {folder: ...} and a tls endpoint; `extrinsic lab init` makes the keys"
        raise InputError([Problem(station, None, "bus.tls", "a router without keys guards nothing", expected)])
    folder = lab_folder(config)
    access = read_access(config, folder)
    console = terminal(stderr=True, prose=True)
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    identity = router_identity(folder)
    warn_of_end(identity)
    with Router(config, access, identity):
        _say_who(config, access, console)
        _warn(unserved(config, access), console)
        console.print(f"routing at {config.bus.endpoint}; Ctrl-C ends it")
        ended.wait()


_RESTART = "In force once the router has been started again."


def _say_who(config: StationConfig, access: Access, console: Console) -> None:
    console.print(
        f"commanding: {', '.join(access.runners) or 'nobody'}; looking: {', '.join(access.viewers) or 'nobody'}"
    )
    for name, devices in access.machines.items():
        console.print(f"serving: {name}: {', '.join(devices)}")
    if access.revoked:
        console.print(f"revoked: {', '.join(access.revoked)}")


def _warn(devices: list[str], console: Console) -> None:
    if devices:
        console.print(
            f"[yellow]no machine may serve {', '.join(devices)}; `extrinsic lab add --machine` changes that[/]"
        )


def _wanted(machines: list[str] | None, runners: list[str] | None, viewers: list[str] | None) -> Wanted:
    """Members from the options. Raises InputError for a machine without devices."""
    from experiments.lab.folder import Wanted
    from mechanics.yaml_input import InputError, Problem

    named: dict[str, tuple[str, ...]] = {}
    for text in machines or []:
        name, _, devices = text.partition("=")
        listed = tuple(filter(None, (device.strip() for device in devices.split(","))))
        if not listed or name in named:
            wrong = f"{text!r} names no machine with its devices" if not listed else f"{name} stands twice"
            raise InputError([Problem("lab", None, "--machine", wrong, "NAME=DEVICE,..., such as bench=arm,gripper")])
        named[name] = listed
    return Wanted(named, tuple(runners or ()), tuple(viewers or ()))
