"""The command `extrinsic sweep`: a grid of runs, their table, and an exit code."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from drivers.errors import NotConnected
from experiments import disk
from experiments.campaign import frame
from experiments.campaign.engine import run_jobs
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.grid import parse_grid, parse_seeds, sweep_jobs
from experiments.campaign.report.build import write_report
from experiments.campaign.summary import summarise
from experiments.exit_codes import ExitCode
from experiments.json_output import write


def sweep(
    experiment: str,
    station: str | None,
    sets: Sequence[str],
    grid: Sequence[str],
    seeds: str | None,
    *,
    workers: int,
    scheduler: str | None,
    retries: int,
    out: Path | None,
    json_file: Path | None,
    console: Console,
    said: Console,
) -> ExitCode:
    """Run the sweep, print its table on ``console`` and what happens on ``said``.

    Raises InputError and InfeasiblePlan before anything is started. A sweep that is cut off leaves the table of what
    has been run: KeyboardInterrupt, NotConnected.
    """
    disk.require_writable(json_file, "--json")
    jobs = sweep_jobs(experiment, station, sets, parse_grid(grid, sets), parse_seeds(seeds))
    name = Path(experiment).stem
    folder = out or Path("runs") / f"{name}-sweep-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"
    said.print(f"{len(jobs)} jobs in {folder}", highlight=False, soft_wrap=True)
    try:
        outcomes = run_jobs(jobs, folder, workers=workers, scheduler=scheduler, retries=retries, console=said)
    except KeyboardInterrupt:
        _conclude(folder, ExitCode.INTERRUPTED, json_file, console, said)
        raise
    except NotConnected:
        _conclude(folder, ExitCode.DEVICE_FAILED, json_file, console, said)
        raise
    whole = all(outcome.status == "completed" for outcome in outcomes)
    code = ExitCode.DONE if whole else ExitCode.FELL_SHORT
    return code if _conclude(folder, code, json_file, console, said) else ExitCode.DEVICE_FAILED


_STATUS = {
    ExitCode.DONE: "completed",
    ExitCode.FELL_SHORT: "fell_short",
    ExitCode.DEVICE_FAILED: "scheduler_failed",
    ExitCode.INTERRUPTED: "interrupted",
}


def _conclude(folder: Path, code: ExitCode, json_file: Path | None, console: Console, said: Console) -> bool:
    """Show and write the table and the summary of what has been run; whether they could be written."""
    campaign = CampaignFolder(folder)
    if not campaign.campaign.is_file():
        return True  # it was interrupted before anything was started
    summary, trials = summarise(campaign, _STATUS[code])
    console.print(frame.summary_table(f"sweep of {summary['experiment']}", summary["cells"]))
    differences = frame.comparison_table(summary["comparisons"])
    if differences.row_count:
        console.print(differences)
    for job in summary["failed"]:
        said.print(f"{job['id']}: {job['reason']}", style="red", highlight=False, markup=False, soft_wrap=True)
    try:
        frame.save(folder, summary, trials)
        write(json_file, summary)
    except OSError as error:
        said.print(str(disk.not_kept(error, folder)), style="red", highlight=False, markup=False, soft_wrap=True)
        return False
    console.print(f"trials: {folder / frame.TRIALS}", soft_wrap=True, highlight=False)
    try:
        report = write_report(campaign, summary, trials)
    except Exception as error:  # the trials are run and their table is kept: say it and go on
        said.print(f"the report could not be made: {error}\n  extrinsic report {folder}", style="yellow", markup=False)
    else:
        console.print(f"report: {report}", soft_wrap=True, highlight=False)
    return True
