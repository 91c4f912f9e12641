"""The command `extrinsic`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from experiments import __version__, authoring, kernels
from experiments.command import Sets, StationName, commands
from experiments.exit_codes import ExitCode
from experiments.lab.commands import app as lab

app = typer.Typer(
    name="extrinsic",
    help="Tactile, non-prehensile manipulation: drivers, planning and experiments, from YAML to report.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

command = commands(app)
app.add_typer(lab)
app.add_typer(authoring.app)


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"extrinsic {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


Experiment = Annotated[str, typer.Argument(metavar="EXPERIMENT", help="An experiment file, or a shipped one's name.")]
StationOption = Annotated[
    str | None,
    typer.Option("--station", metavar="STATION", help="Run on this station, not the experiment's own."),
]


@command("extrinsic run grasped_pivoting --set world.stiffness_scale=0.8")
def run(
    experiment: Annotated[
        str | None,
        typer.Argument(
            metavar="[EXPERIMENT]", help="An experiment file, or a shipped one's name; may be left out with --resume."
        ),
    ] = None,
    station: StationOption = None,
    sets: Sets = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="The run folder, new or empty.")] = None,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="The plans' motions in free air, in place of trials; touches nothing.")
    ] = False,
    speed: Annotated[
        float | None, typer.Option("--speed", metavar="SHARE", help="Every motion at this share of its speed: 0.2.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="RUN", help="Go on with the run in this folder where it was cut off."),
    ] = None,
) -> None:
    """Run an experiment: plan, execute, log, measure, report."""
    from experiments import runner
    from experiments.files import load
    from experiments.resume import refuse_besides
    from experiments.resume import resume as go_on
    from experiments.tables import error_table, faults_table
    from mechanics.yaml_input import InputError, Problem

    chosen = [*(sets or []), *(["rehearse=true"] if rehearse else [])]
    chosen += [] if speed is None else [f"trial.speed={speed:g}"]
    if resume is not None:
        refuse_besides({"--set": sets, "--out": out, "--rehearse": rehearse, "--speed": speed})
        outcome = go_on(resume, experiment, station, Console(stderr=True))
    elif experiment is None:
        raise InputError([Problem("run", None, "EXPERIMENT", "it is missing", "an experiment, or --resume RUN")])
    else:
        outcome = runner.run(load(experiment, station, chosen), out, Console(stderr=True))
    console = Console()
    faults = outcome.results.get("faults")
    console.print("", faults_table(faults) if faults else error_table(outcome.results), "", sep="\n")
    if outcome.exit_code is not ExitCode.DONE:
        Console(stderr=True, soft_wrap=True).print(f"[red]{outcome.results['status']}[/]: {outcome.reason}")
    console.print(f"report: {outcome.folder.report}", soft_wrap=True, highlight=False)
    raise typer.Exit(outcome.exit_code)


@command("extrinsic check experiments/grasped_static.yaml --station sim")
def check(experiment: Experiment, station: StationOption = None, sets: Sets = None) -> None:
    """Validate and resolve an experiment and dry-run its sequence; touches no device."""
    from experiments.check import check as dry_run
    from experiments.files import load

    console = Console()
    for line in dry_run(load(experiment, station, sets or [])):
        console.print(line, soft_wrap=True, highlight=False)


@command("extrinsic serve sim --set world.clock=realtime")
def serve(
    station: StationName,
    devices: Annotated[
        list[str] | None, typer.Argument(metavar="[DEVICE]...", help="Serve only these devices; all by default.")
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


@command("extrinsic status sim")
def status(station: StationName, sets: Sets = None) -> None:
    """Show every device of a station: alive, rate, age, faults."""
    from drivers.status import station_certificates, station_status
    from experiments.files import load_station
    from experiments.tables import status_table

    config = load_station(station, sets or [])
    rows = station_status(config)
    Console().print(status_table(rows, station_certificates(config)))
    raise typer.Exit(ExitCode.DONE if all(row.alive for row in rows) else ExitCode.DEVICE_FAILED)


@command("extrinsic stop sim")
def stop(station: StationName, sets: Sets = None) -> None:
    """Stop a station's arm now; it stays stopped until `recover`. Needs no lease, and no run's consent."""
    from drivers.safety import stop as stop_arms
    from experiments.files import load_station

    for arm in stop_arms(load_station(station, sets or [])):
        Console().print(f"{arm.name} is stopped: {arm.reason}", soft_wrap=True, highlight=False)


@command("extrinsic recover sim")
def recover(station: StationName, sets: Sets = None) -> None:
    """Release a latched stop, once its reason is gone; nothing moves by that."""
    from drivers.safety import recover as recover_arms
    from experiments.files import load_station

    for arm in recover_arms(load_station(station, sets or [])):
        said = f"was stopped: {arm.reason}; it takes set-points again" if arm.reason else "was not stopped"
        Console().print(f"{arm.name} {said}", soft_wrap=True, highlight=False)


@command("extrinsic check-device lab1.yaml wrist_ft", name="check-device")
def check_device(
    station: StationName,
    device: Annotated[str, typer.Argument(metavar="DEVICE", help="The device's name in the station file.")],
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
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the findings as JSON.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Walk through the bring-up of one device: what to look at, what is measured, what it is worth."""
    from experiments.check_device.checklist import check_device as walk_through
    from experiments.check_device.person import whoever_is_here
    from experiments.files import load_station

    load_station(station, sets or [], [device])  # refuses one that the station has not
    config, console = load_station(station, sets or []), Console()
    person = whoever_is_here(console, yes=yes)
    steps = tuple(step or ())
    code = walk_through(
        config, device, person, console, move=move, reference=reference, only=steps, json_file=json_file
    )
    raise typer.Exit(code)


@command("extrinsic report runs/grasped_pivoting-20260101T120000.000000")
def report(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
) -> None:
    """Rebuild a run's report from its log."""
    from experiments.report.build import build_report
    from experiments.run_folder import RunFolder

    folder = RunFolder.open(run_folder)
    build_report(folder)
    Console().print(f"report: {folder.report}", soft_wrap=True, highlight=False)


@command("extrinsic repair runs/grasped_pivoting-20260101T120000.000000")
def repair(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
) -> None:
    """Mend a log that was cut off, beside it; rebuild results.json and the report."""
    from experiments import repair as mending

    mending.say(mending.repair(run_folder), Console())


@command("extrinsic replay runs/grasped_pivoting-20260101T120000.000000 --check")
def replay(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the estimates as JSON.")
    ] = None,
    check_same: Annotated[bool, typer.Option("--check", help="Exit with 1 when an estimate differs.")] = False,
) -> None:
    """Estimate a recorded run again, from its log, with the code of today; show what differs."""
    from experiments import replay as replaying
    from experiments.run_folder import RunFolder

    raise typer.Exit(replaying.main(RunFolder.open(run_folder), json_file, check_same, Console()))


@command("extrinsic bench sim --check")
def bench(
    name: Annotated[str, typer.Argument(metavar="BENCHMARK", help="sim, estimation, planning, load or bus.")],
    runs: Annotated[
        int | None,
        typer.Option("--runs", min=1, help="Measurements per figure of sim, estimation, planning; 5."),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures as JSON.")] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write BENCHMARK.json into DIR.")] = None,
    check_targets: Annotated[bool, typer.Option("--check", help="Exit with 1 when a target is missed.")] = False,
    horizons: Annotated[
        str | None, typer.Option("--horizons", metavar="K,...", help="Steps of the problems of `planning`.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", min=0.1, max=10_000, help="How long `load` runs, 20, and `bus` each way, 1."),
    ] = None,
    viewers: Annotated[
        int | None, typer.Option("--viewers", min=1, max=100, help="Who looks on, now and then, in `load`; 4.")
    ] = None,
) -> None:
    """Measure speed, accuracy and steadiness, figure beside target, in one run."""
    from experiments import bench as benchmarks

    options = benchmarks.Options(runs, _horizons(horizons), minutes, viewers)
    raise typer.Exit(benchmarks.main(name, options, json_file, out, check_targets))


@command("extrinsic sweep grasped_static --grid world.stiffness_scale=0.8,1,1.2 --seeds 0-4 --set world.profile=lab")
def sweep(
    experiment: Experiment,
    grid: Annotated[
        list[str] | None,
        typer.Option("--grid", metavar="KEY=A,B,...", help="Run with each of these values of a key."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seeds", metavar="0-4", help="Run with each of these seeds: 0-4, or 0,3,7.")
    ] = None,
    station: StationOption = None,
    sets: Sets = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes on this machine; 2.")] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="Use the workers of a Dask scheduler.")
    ] = None,
    retries: Annotated[
        int, typer.Option("--retries", min=0, help="So often a job runs again whose worker or device failed.")
    ] = 2,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="The sweep's folder; one that was cut off goes on.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the summary as JSON.")] = None,
) -> None:
    """Run every combination of a grid, every seed and trial, on workers; one table of all trials."""
    from experiments.campaign.sweep import sweep as run_sweep
    from mechanics.yaml_input import InputError, Problem

    if workers is not None and scheduler is not None:
        wrong, expected = "the scheduler has workers of its own", "--workers or --scheduler"
        raise InputError([Problem("sweep", None, "--workers", wrong, expected)])
    code = run_sweep(
        experiment,
        station,
        sets or [],
        grid or [],
        seeds,
        workers=workers or 2,
        scheduler=scheduler,
        retries=retries,
        out=out,
        json_file=json_file,
        console=Console(),
        said=Console(stderr=True),
    )
    raise typer.Exit(code)


def _horizons(text: str | None) -> tuple[int, ...] | None:
    """Numbers of steps. Raises InputError for anything else."""
    from mechanics.yaml_input import InputError, Problem

    if text is None:
        return None
    words = text.split(",")
    if not all(word.strip().isdecimal() and 1 <= int(word) <= 100_000 for word in words):
        wrong, expected = f"{text!r} are no horizons", "whole numbers of steps, such as 40,200,1000"
        raise InputError([Problem("bench", None, "--horizons", wrong, expected)])
    return tuple(dict.fromkeys(int(word) for word in words))


@command("extrinsic table pivoting --seed 1 --check")
def table(
    name: Annotated[
        str, typer.Argument(metavar="TABLE", help="grasped, extrinsic, pivoting, optimizers, or a table file.")
    ],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulated laboratory and its trials.")] = 0,
    trials: Annotated[
        int | None, typer.Option("--trials", metavar="N", min=1, help="A part: so many trials of each trajectory.")
    ] = None,
    runs: Annotated[str | None, typer.Option("--runs", metavar="RUN,...", help="A part: these runs only.")] = None,
    sets: Sets = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Jobs at a time on this machine.")] = 2,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler, tcp://host:port.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="The table's folder; one begun goes on.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write table.json there, too.")
    ] = None,
    check_targets: Annotated[bool, typer.Option("--check", help="Exit with 1 when a target is missed.")] = False,
) -> None:
    """Run a table of the paper: calibrate, run its trials, print our figures beside the paper's."""
    from experiments.table import run as tables
    from experiments.table.jobs import Options

    chosen = () if runs is None else tuple(word.strip() for word in runs.split(","))
    options = Options(seed, trials, chosen, tuple(sets or ()))
    engine = tables.Engine(workers=workers, scheduler=scheduler)
    raise typer.Exit(tables.main(name, options, engine, out, json_file, check_targets))


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
    """Entry point."""
    problem = _check_packages()
    if problem:
        sys.exit(f"extrinsic: {problem}")
    kernels.keep()
    app()


if __name__ == "__main__":
    main()
