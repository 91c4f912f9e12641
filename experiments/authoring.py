"""The commands for who writes files: `extrinsic init`, a folder to begin with, and `extrinsic schema`, for editors."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from experiments import completion
from experiments.command import commands
from experiments.terminal import terminal

app = typer.Typer()
command = commands(app)


@command("extrinsic init demo && cd demo && extrinsic run experiment.yaml")
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder, new or empty.")],
    experiment: Annotated[
        str,
        typer.Option(
            "--experiment",
            metavar="EXPERIMENT",
            help="The shipped experiment to begin with.",
            autocompletion=completion.experiments,
        ),
    ] = "grasped_pivoting",
    station: Annotated[
        str,
        typer.Option(
            "--station",
            metavar="STATION",
            help="The shipped station to begin with.",
            autocompletion=completion.stations,
        ),
    ] = "sim",
) -> None:
    """Make a folder with an experiment, its station, schemas for editors and a README; ready to run."""
    from experiments.new_folder import EXPERIMENT, README, STATION, new_folder

    new_folder(folder, experiment, station)
    console = terminal(prose=True)
    console.print(f"{escape(str(folder))}: {EXPERIMENT} ({experiment}), {STATION} ({station}), {README}, schemas/")
    change = "" if folder.resolve() == Path.cwd() else f"cd {shlex.quote(str(folder))} && "
    console.print(f"next: {escape(change)}extrinsic run {EXPERIMENT}")


@command("extrinsic schema experiment --out schemas/experiment.json")
def schema(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="[KIND]", help="experiment, station, object, sensor, profile or table; all of them by default."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write it there; all of them: into this folder.")
    ] = None,
) -> None:
    """Print the JSON Schema of a kind of file, by which an editor completes and checks it."""
    from experiments.editors import KINDS, schema_text, write_schema
    from mechanics.yaml_input import InputError, Problem, one_of

    if kind is None and out is None:
        raise InputError([Problem("schema", None, "KIND", "it is missing", f"{one_of(KINDS)}; or --out with a folder")])
    if out is None:
        typer.echo(schema_text(str(kind)), nl=False)
    elif kind is not None:
        write_schema(kind, out)
    else:
        for name in KINDS:
            write_schema(name, out / f"{name}.json")
