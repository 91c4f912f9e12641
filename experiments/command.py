"""How every command of `extrinsic` is registered: with an example, and with one clear end for each way to fail."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from experiments import completion, shipped
from experiments.exit_codes import ExitCode

Command = TypeVar("Command", bound=Callable[..., None])

Experiment = Annotated[
    str,
    typer.Argument(
        metavar="EXPERIMENT", help="An experiment file, or a shipped one's name.", autocompletion=completion.experiments
    ),
]
StationName = Annotated[
    str,
    typer.Argument(
        metavar="STATION", help="A station file, or a shipped one's name.", autocompletion=completion.stations
    ),
]
StationOption = Annotated[
    str | None,
    typer.Option(
        "--station",
        metavar="STATION",
        help="Run on this station, not the experiment's own.",
        autocompletion=completion.stations,
    ),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", autocompletion=completion.runs)]
RunOrSweep = Annotated[
    Path,
    typer.Argument(
        metavar="RUN", help="The folder of a run, a sweep or a table.", autocompletion=completion.runs_and_sweeps
    ),
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a key of the experiment or the station; may be repeated."),
]
Benchmark = Annotated[
    str,
    typer.Argument(metavar="BENCHMARK", help=f"{', '.join(shipped.BENCHMARKS)}.", autocompletion=completion.benchmarks),
]
TableName = Annotated[
    str,
    typer.Argument(
        metavar="TABLE", help=f"{', '.join(shipped.tables())}, or a table file.", autocompletion=completion.tables
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="Use the workers of a Dask scheduler."),
]
CheckTargets = Annotated[bool, typer.Option("--check", help="Exit with 1 when a target is missed.")]
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write what it found as JSON, too; - is standard output."),
]


def commands(app: typer.Typer) -> Callable[..., Callable[[Command], Command]]:
    """What registers a command of ``app``: ``command = commands(app)``, then ``@command("extrinsic run ...")``.

    ``name`` is the command's where that is not the function's. Each way to fail ends with its exit code and one clear
    message.
    """

    def command(example: str, name: str | None = None) -> Callable[[Command], Command]:
        def register(function: Command) -> Command:
            @wraps(function)
            def orderly(*arguments: Any, **options: Any) -> None:
                from drivers.errors import DriverError
                from mechanics.yaml_input import InputError
                from planning.errors import InfeasiblePlan

                try:
                    function(*arguments, **options)
                except InputError as error:
                    raise _ended(error, ExitCode.BAD_INPUT) from None
                except InfeasiblePlan as error:
                    raise _ended(error, ExitCode.INFEASIBLE) from None
                except DriverError as error:
                    raise _ended(error, ExitCode.DEVICE_FAILED) from None
                except KeyboardInterrupt:
                    raise typer.Exit(ExitCode.INTERRUPTED) from None

            app.command(name, epilog=f"Example: {example}")(orderly)
            return function

        return register

    return command


def _ended(error: Exception, code: ExitCode) -> typer.Exit:
    sys.stderr.write(f"{error}\n")
    return typer.Exit(code)
