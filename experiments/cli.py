"""The command `extrinsic`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from experiments.exit_codes import ExitCode

app = typer.Typer(
    name="extrinsic",
    help="Tactile, non-prehensile manipulation: drivers, planning and experiments, from YAML to report.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Experiment = Annotated[str, typer.Argument(metavar="EXPERIMENT", help="An experiment file, or a shipped one's name.")]
StationName = Annotated[str, typer.Argument(metavar="STATION", help="A station file, or a shipped one's name.")]
StationOption = Annotated[
    str | None,
    typer.Option("--station", metavar="STATION", help="Run on this station, not the experiment's own."),
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a key of the experiment or the station; may be repeated."),
]


@app.command(epilog="Example: extrinsic run grasped_pivoting --set world.stiffness_scale=0.8")
def run(
    experiment: Experiment,
    station: StationOption = None,
    sets: Sets = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="The run folder, new or empty.")] = None,
) -> None:
    """Run an experiment: plan, execute, log, measure, report."""
    from experiments import runner
    from experiments.files import load
    from experiments.tables import error_table

    resolved = load(experiment, station, sets or [])
    outcome = runner.run(resolved, out, Console(stderr=True))
    console = Console()
    console.print(error_table(outcome.results))
    if outcome.exit_code is not ExitCode.DONE:
        Console(stderr=True, soft_wrap=True).print(f"[red]{outcome.results['status']}[/]: {outcome.reason}")
    console.print(f"report: {outcome.folder.report}", soft_wrap=True, highlight=False)
    raise typer.Exit(outcome.exit_code)


@app.command(epilog="Example: extrinsic check experiments/grasped_static.yaml --station sim")
def check(experiment: Experiment, station: StationOption = None, sets: Sets = None) -> None:
    """Validate and resolve an experiment and dry-run its sequence; touches no device."""
    from experiments.check import check as dry_run
    from experiments.files import load

    console = Console()
    for line in dry_run(load(experiment, station, sets or [])):
        console.print(line, soft_wrap=True, highlight=False)


@app.command(epilog="Example: extrinsic serve sim --set world.clock=realtime")
def serve(
    station: StationName,
    devices: Annotated[
        list[str] | None, typer.Argument(metavar="[DEVICE]...", help="Serve only these devices; all by default.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Put a station's devices on the bus, until Ctrl-C."""
    from drivers.sim.host import serve as serve_simulated
    from experiments.files import load_station

    config = load_station(station, sets or [], devices or None)
    console = Console(stderr=True)
    console.print(f"serving {', '.join(config.devices)} at {config.bus.endpoint}; Ctrl-C ends it", highlight=False)
    raise typer.Exit(serve_simulated(config))


@app.command(epilog="Example: extrinsic status sim")
def status(station: StationName, sets: Sets = None) -> None:
    """Show every device of a station: alive, rate, age, faults."""
    from drivers.status import station_status
    from experiments.files import load_station
    from experiments.tables import status_table

    rows = station_status(load_station(station, sets or []))
    Console().print(status_table(rows))
    raise typer.Exit(ExitCode.DONE if all(row.alive for row in rows) else ExitCode.DEVICE_FAILED)


@app.command(epilog="Example: extrinsic report runs/grasped_pivoting-20260101T120000.000000")
def report(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
) -> None:
    """Rebuild a run's report from its log."""
    from experiments.report.build import build_report
    from experiments.run_folder import RunFolder

    folder = RunFolder.open(run_folder)
    build_report(folder)
    Console().print(f"report: {folder.report}", soft_wrap=True, highlight=False)


def _check_packages() -> str | None:
    """Why this environment cannot work, or None: another distribution may have put its `control` over ours."""
    here = Path(__file__).resolve().parent.parent
    spec = find_spec("control")
    where = None if spec is None or spec.origin is None else Path(spec.origin).resolve().parent.parent
    if where == here:
        return None
    return (
        f"the package 'control' comes from {where}, not from {here}: another distribution (python-control has the same "
        "name) is installed over this one. Install extrinsic into an environment of its own:\n"
        "  python -m venv .venv && .venv/bin/pip install extrinsic"
    )


def main() -> None:
    """Entry point: bad input ends with 2, a failed device with 3, Ctrl-C with 130, each with one clear message."""
    problem = _check_packages()
    if problem:
        sys.exit(f"extrinsic: {problem}")
    from drivers.errors import DriverError
    from mechanics.yaml_input import InputError

    try:
        app()
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(ExitCode.BAD_INPUT)
    except DriverError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(ExitCode.DEVICE_FAILED)
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)


if __name__ == "__main__":
    main()
