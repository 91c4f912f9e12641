"""`extrinsic table`: measure, put our figures beside the paper's, hold them against targets, print and keep them."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from experiments import disk
from experiments.bench.figures import TARGETS, Target, Targets
from experiments.exit_codes import ExitCode
from experiments.json_output import beside, write
from experiments.paper import tables as paper_tables
from experiments.provenance import provenance
from experiments.run_folder import write_atomic, write_json
from experiments.table import aggregate, jobs, render
from experiments.table.jobs import Options
from experiments.table.measure import CalibrationFailed, Engine, measure
from experiments.table.report import write_report
from experiments.table.schema import Table
from experiments.terminal import terminal
from mechanics.yaml_input import parse, read_yaml

#: columns of a table that goes to a file or a pipe
FILE_WIDTH = 100


def main(
    name: str,
    options: Options,
    engine: Engine,
    out: Path | None = None,
    json_file: Path | None = None,
    check: bool = False,
) -> ExitCode:
    """Make a table and show it.

    Raises InputError and InfeasiblePlan before anything is started, and DeviceFault where it cannot be kept.
    """
    disk.require_writable(json_file, "--json")
    table, sets = jobs.load_table(name, options.sets)
    options = Options(options.seed, options.trials, options.runs, sets)
    said = terminal(stderr=True)
    folder = (out or Path("runs") / f"table_{table.name}-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}").absolute()
    try:
        data = measure(table, options, engine, folder, said)
    except CalibrationFailed as error:
        said.print(f"[red]{error}[/]", soft_wrap=True, highlight=False)
        return ExitCode.DEVICE_FAILED if error.status in ("failed", "device_failed") else ExitCode.FELL_SHORT
    result = {**stated(table, options, data), "calibrations": believed(folder)}
    console = beside(json_file, FILE_WIDTH)
    render.show(console, result)
    try:
        keep(folder, result, data, json_file)
    except OSError as error:
        raise disk.not_kept(error, folder) from None
    console.print(f"table: {folder / 'table.md'}", soft_wrap=True, highlight=False)
    try:
        console.print(f"report: {write_report(folder)}", soft_wrap=True, highlight=False)
    except Exception as error:  # the trials are run and the table is kept: say it and go on
        said.print(f"the report could not be made: {error}\n  extrinsic report {folder}", style="yellow", markup=False)
    for line in result["shortfalls"] if check else []:
        said.print(f"short: {line}", style="red", highlight=False, markup=False, soft_wrap=True)
    if any(trial["status"] in ("failed", "device_failed") for trial in result["incomplete"]):
        return ExitCode.DEVICE_FAILED
    fell_short = len(aggregate.fell_short(table, data.trials))
    if result["incomplete"]:
        told = f"{len(result['incomplete'])} of {len(data.trials)} trials were not completed"
        told += f"; {fell_short} of them had to be" if fell_short else ", which no count of the table asks for"
        said.print(told, style="red" if fell_short else None, highlight=False, soft_wrap=True)
    return ExitCode.FELL_SHORT if fell_short or (check and result["shortfalls"]) else ExitCode.DONE


def stated(table: Table, options: Options, data: aggregate.Data) -> dict[str, Any]:
    """What table.json says."""
    shown = aggregate.panels(table, data)
    targets = parse(Targets, read_yaml(TARGETS)).tables.get(table.name, {})
    found = [_judged(one, targets.get(one.name)) for one in aggregate.findings(table, data, shown)]
    named = {one["name"] for one in found}
    short = [f"{name}: not measured, target {target}" for name, target in targets.items() if name not in named]
    short += [f"{o['name']}: {o['told']}; target {o['target']} ({o['why']})" for o in found if o["holds"] is False]
    columns = ["run", "trajectory", "controller", "trial", "status", "reason"]
    ended_early = data.trials.reindex(columns=columns).loc[data.trials["status"] != "completed"]
    return {
        "schema": 1,
        "table": table.name,
        "title": table.title,
        "notes": list(table.notes),
        "source": paper_tables().source if table.paper is not None else "",
        **{key: value for key, value in asdict(options).items() if key != "sets"},
        "set": [f"{key}={jobs.written(value)}" for key, value in table.set.items()] + list(options.sets),
        "part": options.part,
        "provenance": provenance(),
        "panels": shown,
        "findings": found,
        "shortfalls": short,
        "incomplete": [dict(zip(columns, row, strict=True)) for row in ended_early.astype(object).to_numpy().tolist()],
    }


def believed(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """What the calibrations of a table's folder have found: the files' content, by calibration."""
    shelves = sorted(path for path in (folder / "calibrations").glob("*") if path.is_dir())
    files = {shelf.name: sorted(shelf.glob("*.yaml")) for shelf in shelves}
    return {name: [{"file": f.name, **read_yaml(f).data} for f in found] for name, found in files.items() if found}


def _judged(found: aggregate.Finding, target: Target | None) -> dict[str, Any]:
    holds = None if target is None else found.value is not None and target.holds(found.value)
    return {
        "name": found.name,
        "value": found.value,
        "told": found.told,
        "target": None if target is None else str(target),
        "holds": holds,
        "why": None if target is None else target.source,
    }


def keep(folder: Path, result: dict[str, Any], data: aggregate.Data, json_file: Path | None) -> None:
    """Write table.json, table.md, trials.parquet and plans.parquet. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "table.json", result)
    write_atomic(folder / "table.md", render.markdown(result))
    for name, frame in (("trials", data.trials), ("plans", data.plans)):
        aside = folder / f".{name}.parquet"
        _plain(frame).to_parquet(aside, index=False)
        aside.replace(folder / f"{name}.parquet")
    write(json_file, result)


def _plain(frame: pd.DataFrame) -> pd.DataFrame:
    """Columns of one kind each, as a Parquet file has them."""
    mixed = [name for name in frame.columns if frame[name].dtype == object]
    return frame.assign(
        **{name: frame[name].map(lambda value: None if pd.isna(value) else str(value)) for name in mixed}
    )
