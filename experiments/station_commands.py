"""The commands for who stands beside a station: serve it, look at it, stop it, bring its devices up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments import completion
from experiments.command import JsonFile, Sets, StationName, commands
from experiments.json_output import beside
from experiments.terminal import terminal

app = typer.Typer()
command = commands(app)


@command("extrinsic serve sim --set world.clock=realtime")
def serve(
    station: StationName,
    devices: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="DEVICE",
            help="Serve only these devices; all by default.",
            autocompletion=completion.devices,
        ),
    ] = None,
    sets: Sets = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Listen without keys where other machines can reach it.")
    ] = False,
) -> None:
    """Put a station's devices on the bus, until Ctrl-C."""
    from experiments.files import load_station
    from experiments.serve import serve as serve_station

    raise typer.Exit(serve_station(load_station(station, sets or [], devices or None), insecure=insecure))


@command("extrinsic emulate emulated_lab")
def emulate(station: StationName, sets: Sets = None) -> None:
    """Start an emulated lab: a simulated plant behind devices that the real backends speak to, until Ctrl-C."""
    from experiments.files import load_station
    from experiments.serve import emulate as emulate_lab

    raise typer.Exit(emulate_lab(load_station(station, sets or [])))


@command("extrinsic status sim --watch")
def status(
    station: StationName,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on showing it until q or Ctrl-C; a plain line per device in a file.")
    ] = False,
    interval: Annotated[
        float | None,
        typer.Option(
            "--interval", metavar="SECONDS", min=0.1, max=3600, help="How often --watch shows it: 0.5; 10 in a file."
        ),
    ] = None,
    json_file: JsonFile = None,
    sets: Sets = None,
) -> None:
    """Show every device of a station: alive, rate, age, lost readings, who commands it, what stopped it."""
    from experiments import status as telling
    from experiments.files import load_station
    from mechanics.yaml_input import InputError, Problem

    config = load_station(station, sets or [])
    if not watch and interval is not None:
        raise InputError([Problem("status", None, "--interval", "there is one look without --watch", "--watch")])
    raise typer.Exit(telling.watch(config, interval, json_file) if watch else telling.once(config, json_file))


@command("extrinsic stop sim")
def stop(station: StationName, sets: Sets = None) -> None:
    """Stop a station's arm now; it stays stopped until `recover`. Needs no lease, and no run's consent."""
    from drivers.safety import stop as stop_arms
    from experiments.files import load_station

    for arm in stop_arms(load_station(station, sets or [])):
        terminal().print(f"{arm.name} is stopped: {arm.reason}", soft_wrap=True, highlight=False)


@command("extrinsic recover sim")
def recover(station: StationName, sets: Sets = None) -> None:
    """Release a latched stop, once its reason is gone; nothing moves by that."""
    from drivers.safety import recover as recover_arms
    from experiments.files import load_station

    for arm in recover_arms(load_station(station, sets or [])):
        said = f"was stopped: {arm.reason}; it takes set-points again" if arm.reason else "was not stopped"
        terminal().print(f"{arm.name} {said}", soft_wrap=True, highlight=False)


@command("extrinsic check-device lab1.yaml wrist_ft", name="check-device")
def check_device(
    station: StationName,
    device: Annotated[
        str,
        typer.Argument(
            metavar="DEVICE", help="The device's name in the station file.", autocompletion=completion.devices
        ),
    ],
    step: Annotated[
        list[str] | None, typer.Option("--step", metavar="STEP", help="Take this step only; may be repeated.")
    ] = None,
    move: Annotated[bool, typer.Option("--move", help="Let it move: an arm 5 mm, a gripper open and close.")] = False,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="Take a finger's picture, untouched, into FILE (PNG)."),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nobody: agree to what is asked for, leave out what needs a hand.")
    ] = False,
    json_file: JsonFile = None,
    sets: Sets = None,
) -> None:
    """Walk through the bring-up of one device: what to look at, what is measured, what it is worth."""
    from experiments.check_device.checklist import check_device as walk_through
    from experiments.check_device.person import whoever_is_here
    from experiments.files import load_station

    load_station(station, sets or [], [device])  # refuses one that the station has not
    config, console = load_station(station, sets or []), beside(json_file)
    person = whoever_is_here(console, yes=yes)
    steps = tuple(step or ())
    code = walk_through(
        config, device, person, console, move=move, reference=reference, only=steps, json_file=json_file
    )
    raise typer.Exit(code)
