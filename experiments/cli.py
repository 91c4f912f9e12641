"""The command `extrinsic`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from experiments import __version__, authoring, completion, kernels, station_commands
from experiments.command import (
    Benchmark,
    CheckTargets,
    Experiment,
    JsonFile,
    Run,
    RunOrSweep,
    Scheduler,
    Sets,
    StationOption,
    TableName,
    commands,
)
from experiments.exit_codes import ExitCode
from experiments.json_output import beside
from experiments.lab.commands import app as lab
from experiments.terminal import prepare, terminal

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
app.add_typer(station_commands.app)
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


@command("extrinsic run grasped_pivoting --set world.stiffness_scale=0.8")
def run(
    experiment: Annotated[
        str | None,
        typer.Argument(
            metavar="EXPERIMENT",
            help="An experiment file, or a shipped one's name; may be left out with --resume.",
            autocompletion=completion.experiments,
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
        typer.Option(
            "--resume",
            metavar="RUN",
            help="Go on with the run in this folder where it was cut off.",
            autocompletion=completion.runs,
        ),
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
        outcome = go_on(resume, experiment, station, terminal(stderr=True))
    elif experiment is None:
        raise InputError([Problem("run", None, "EXPERIMENT", "it is missing", "an experiment, or --resume RUN")])
    else:
        outcome = runner.run(load(experiment, station, chosen), out, terminal(stderr=True))
    console = terminal()
    faults = outcome.results.get("faults")
    console.print("", faults_table(faults) if faults else error_table(outcome.results), "", sep="\n")
    if outcome.exit_code is not ExitCode.DONE:
        said = terminal(stderr=True, prose=True)
        said.print(f"[red]{outcome.results['status']}[/]: {escape(outcome.reason)}")
        for line in runner.what_next(outcome):
            said.print(line, markup=False)
    console.print(f"report: {outcome.folder.report}", soft_wrap=True, highlight=False)
    raise typer.Exit(outcome.exit_code)


@command("extrinsic check experiments/grasped_static.yaml --station sim")
def check(experiment: Experiment, station: StationOption = None, sets: Sets = None, json_file: JsonFile = None) -> None:
    """Validate and resolve an experiment and dry-run its sequence; touches no device."""
    from experiments.check import main as dry_run

    dry_run(experiment, station, sets or [], json_file)


@command("extrinsic report runs/grasped_pivoting-20260101T120000.000000")
def report(
    run_folder: RunOrSweep,
) -> None:
    """Rebuild a run's report from its log; a sweep's or a table's from its jobs."""
    from experiments.campaign.folder import is_campaign, is_table
    from experiments.progress import Progress
    from experiments.report.build import build_report
    from experiments.run_folder import RunFolder

    if is_campaign(run_folder) or is_table(run_folder):
        from experiments.campaign.report import build as of_campaign
        from experiments.table import report as of_table

        with Progress(terminal(stderr=True)).share("make the report"):
            path = (of_campaign if is_campaign(run_folder) else of_table).rebuild(run_folder)
        terminal().print(f"report: {path}", soft_wrap=True, highlight=False)
        return
    folder = RunFolder.open(run_folder)
    with Progress(terminal(stderr=True)).share("make the report") as heard:
        build_report(folder, heard)
    terminal().print(f"report: {folder.report}", soft_wrap=True, highlight=False)


@command("extrinsic repair runs/grasped_pivoting-20260101T120000.000000")
def repair(
    run_folder: Run,
) -> None:
    """Mend a log that was cut off, beside it; rebuild results.json and the report."""
    from experiments import repair as mending
    from experiments.progress import Progress

    mending.say(mending.repair(run_folder, Progress(terminal(stderr=True))), terminal())


@command("extrinsic replay runs/grasped_pivoting-20260101T120000.000000 --check")
def replay(
    run_folder: Run,
    json_file: JsonFile = None,
    check_same: Annotated[bool, typer.Option("--check", help="Exit with 1 when an estimate differs.")] = False,
) -> None:
    """Estimate a recorded run again, from its log, with the code of today; show what differs."""
    from experiments import replay as replaying
    from experiments.run_folder import RunFolder

    raise typer.Exit(replaying.main(RunFolder.open(run_folder), json_file, check_same, beside(json_file)))


@command("extrinsic view runs/grasped_pivoting-20260101T120000.000000 --web")
def view(
    target: Annotated[
        str | None,
        typer.Argument(metavar="RUN|STATION", help="A run folder or its log.mcap, or a station that is being served."),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="In the browser, at 127.0.0.1, in place of a window.")] = False,
    port: Annotated[
        int | None,
        typer.Option("--port", min=1, max=65534, help="The page's port, 9090; its data take the next one."),
    ] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Say the page's address; open no browser.")] = False,
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FILE.rrd", help="Write it to a file for Rerun, and show nothing.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, help="Look at a live station for so long; until Ctrl-C.")
    ] = None,
    foxglove_layout: Annotated[
        Path | None,
        typer.Option("--foxglove-layout", metavar="FILE", help="Write the layout for Foxglove to FILE, and end."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Look at a recorded run, or at a live station, in Rerun: scene, pictures, wrenches, estimates, events."""
    from experiments.view import command as viewing

    options = viewing.Options(web=web, port=port, browser=not no_browser, save=save, seconds=seconds)
    viewing.main(target, sets or [], options, foxglove_layout, terminal(stderr=True))


@command("extrinsic bench sim --check")
def bench(
    name: Benchmark,
    runs: Annotated[
        int | None,
        typer.Option("--runs", min=1, help="Measurements per figure of sim, estimation, planning; 5."),
    ] = None,
    json_file: JsonFile = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write BENCHMARK.json into DIR.")] = None,
    check_targets: CheckTargets = False,
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

    options = benchmarks.Options(runs, benchmarks.horizons_of(horizons), minutes, viewers)
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
    scheduler: Scheduler = None,
    retries: Annotated[
        int, typer.Option("--retries", min=0, help="So often a job runs again whose worker or device failed.")
    ] = 2,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="The sweep's folder; one that was cut off goes on.")
    ] = None,
    json_file: JsonFile = None,
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
        console=beside(json_file),
        said=terminal(stderr=True),
    )
    raise typer.Exit(code)


@command("extrinsic table pivoting --seed 1 --check")
def table(
    name: TableName,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulated laboratory and its trials.")] = 0,
    trials: Annotated[
        int | None, typer.Option("--trials", metavar="N", min=1, help="A part: so many trials of each trajectory.")
    ] = None,
    runs: Annotated[str | None, typer.Option("--runs", metavar="RUN,...", help="A part: these runs only.")] = None,
    sets: Sets = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Jobs at a time on this machine.")] = 2,
    scheduler: Scheduler = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="The table's folder; one begun goes on.")
    ] = None,
    json_file: JsonFile = None,
    check_targets: CheckTargets = False,
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
    prepare(app)
    problem = _check_packages()
    if problem:
        sys.exit(f"extrinsic: {problem}")
    kernels.keep()
    app()


if __name__ == "__main__":
    main()
