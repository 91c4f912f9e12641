"""The report of a table: its panels beside the paper's, what was held against targets, and every trial as a point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import BaseModel

from experiments import disk
from experiments.campaign.folder import ASKED, CampaignFolder, JobFolder, is_campaign
from experiments.campaign.report import tables
from experiments.campaign.report.collect import LINK, Collected, link_to
from experiments.campaign.report.page import figures_of, filled
from experiments.report.summary import Verdict, leaves
from experiments.results_file import Word, read_json
from experiments.run_folder import write_atomic
from experiments.table import render
from mechanics.yaml_input import InputError, Problem

REPORT, RESULT, TRIALS = "report.html", "table.json", "trials.parquet"
#: what tells the rows and columns of panels apart and is told beside a trial anyway
_METHOD = ("controller",)
_LABELS: dict[str, str] = {"run": "Run", "mu_ground": "µ ground", "mu_object": "µ object", "skill": "Skill"}


class _Panel(BaseModel):
    title: str
    columns: list[dict[str, Any]]
    rows: list[dict[str, Any]]


class _Result(BaseModel):
    table: Word
    title: str
    panels: list[_Panel]
    findings: list[dict[str, Any]]
    shortfalls: list[str]
    incomplete: list[dict[str, Any]]


class _Asked(BaseModel):
    table: dict[str, Any]


def rebuild(folder: Path) -> Path:
    """Write the report of the table in ``folder`` from what lies there; its place.

    One that was cut off has a page, too, which says how far it has come. Raises InputError for what cannot be read, and
    DeviceFault where it cannot be written.
    """
    try:
        return write_report(folder)
    except OSError as error:
        raise disk.not_kept(error, folder, f"extrinsic report {folder}") from None


def write_report(folder: Path) -> Path:
    """As `rebuild`, and raises OSError."""
    folder = folder.absolute()
    result = read_json(folder / RESULT, _Result)
    if result is None and (folder / RESULT).is_file():
        wrong, expected = "no table can be read in it", "the table's own; start it again with the same --out"
        raise InputError([Problem(str(folder / RESULT), None, "", wrong, expected)])
    page = _page(folder, result) if result is not None else _unfinished(folder)
    write_atomic(folder / REPORT, page)
    return folder / REPORT


def _page(folder: Path, result: Mapping[str, Any]) -> str:
    collected = _collected(folder, result)
    figures = figures_of(collected)
    trials = collected.trials
    done = trials["status"].tolist().count("completed")
    return _rendered(
        title=result["title"],
        verdict=verdict(result, done, len(trials)),
        facts=_facts(result),
        panels=[panel_rows(panel) for panel in result["panels"]],
        findings=result["findings"],
        notes=[*render.legend(result), *render.calibrated(result)],
        failures=tables.failure_rows(collected),
        worst=tables.worst(collected),
        trials=tables.trial_rows(collected),
        keys=list(collected.keys),
        campaigns=list(campaigns(folder)),
        figures=figures,
        provenance=list(leaves(result["provenance"])) if result.get("provenance") else [],
    )


def _unfinished(folder: Path) -> str:
    asked = read_json(folder / ASKED, _Asked)
    title = "" if asked is None else str(asked["table"].get("title") or "")
    told = list(campaigns(folder))
    jobs, ended = (sum(one[key] for one in told) for key in ("jobs", "ended"))
    count = f"{ended} of {jobs} jobs begun so far have ended" if told else "Nothing of it was run"
    detail = f"{count}. The same command with the same --out goes on with what is missing."
    return _rendered(
        title=title or "A table",
        verdict=Verdict("aborted", "Unfinished", detail),
        campaigns=told,
    )


def _rendered(**given: Any) -> str:
    empty = dict.fromkeys(("facts", "panels", "findings", "notes", "failures", "worst", "keys", "provenance"), ())
    blank = {**empty, "trials": {"heads": (), "rows": (), "more": 0}, "warnings": ()}
    return filled("table/report.html.j2", given.pop("figures", {}), **{**blank, **given})


def verdict(result: Mapping[str, Any], done: int, trials: int) -> Verdict:
    """Whether the table meets its targets, and how many of its trials completed."""
    count, short = f"{done} of {trials} trials completed", result["shortfalls"]
    held = sum(one.get("holds") is not None for one in result["findings"])
    if short:
        return Verdict(
            "short", "Fell short", f"{len(short)} {'targets are' if len(short) > 1 else 'target is'} missed; {count}."
        )
    targets = f"All {held} targets are met; " if held else ""
    return Verdict("completed", "Completed", f"{targets}{count}.")


def panel_rows(panel: Mapping[str, Any]) -> dict[str, Any]:
    """A panel as `table.md` has it: heads, and for each row its name and lines."""
    heads, rows = render.heads(panel), []
    for row in panel["rows"]:
        first = row["cells"][0]["figure"]
        lines = []
        for line in render.lines(row):
            said = [render.said(line, cell, cell["figure"] == first) for cell in row["cells"]]
            better = [line == "measured" and _better(cell) for cell in row["cells"]]
            lines.append((line, list(zip(said, better, strict=True))))
        rows.append({"name": ", ".join(render.tagged(row["tags"])), "lines": lines})
    return {"title": panel["title"], "heads": heads, "rows": rows}


def _better(cell: Mapping[str, Any]) -> bool:
    ours, theirs = cell["measured"], cell["paper"]
    return ours is not None and theirs is not None and ours["mean"] <= theirs["mean"]


def campaigns(folder: Path) -> Iterator[dict[str, Any]]:
    """The table's campaigns: name, jobs, how many ended, its report where it was made."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and is_campaign(path):
            found = CampaignFolder(path)
            jobs = [found.job(job["id"]) for job in found.read()["jobs"]]
            ended = sum(job.ended() is not None for job in jobs)
            yield {"name": path.name, "jobs": len(jobs), "ended": ended, "link": link_to(path, folder)}


def _facts(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    part = "a part of the table" if result.get("part") else "the whole table"
    git = str((result.get("provenance") or {}).get("git") or "not recorded")
    pairs = [("Table", str(result["table"])), ("Seed", str(result.get("seed", "not recorded"))), ("Extent", part)]
    return [*pairs, ("Beside ours", str(result.get("source") or "nothing")), ("Git", git)]


def _collected(folder: Path, result: Mapping[str, Any]) -> Collected:
    """The table's trials as a campaign's, its cells told apart by the tags of its panels."""
    trials = _trials(folder)
    tags = [
        str(tag)
        for panel in result["panels"]
        for one in (*panel["rows"], *panel["columns"])
        for tag in one["tags"]
        if tag not in _METHOD and tag in trials
    ]
    keys = {tag: _LABELS.get(tag) or tag for tag in dict.fromkeys(tags)}
    runs = {path.name: path for path in folder.glob("runs-*/jobs/*")}
    places = {job: _run(runs[job]) if job in runs else None for job in dict.fromkeys(trials["job"].tolist())}
    found = [places[job] for job in trials["job"].tolist()]
    columns: dict[str, Any] = {label: trials[tag] for tag, label in keys.items()}
    columns[LINK] = ["" if run is None else link_to(run, folder) for run in found]
    columns["run"] = ["" if run is None else run.name for run in found]
    columns["skill"] = ""  # what a method's skill is, its cell says
    shown = trials.assign(**columns)
    return Collected({}, shown, tuple(keys.values()), (), {}, (), ())


def _trials(folder: Path) -> pd.DataFrame:
    try:
        return pd.read_parquet(folder / TRIALS)
    except (OSError, ValueError):  # pyarrow's errors are ValueErrors
        wrong, expected = "no trials can be read in it", "the table's own; start it again with the same --out"
        raise InputError([Problem(str(folder / TRIALS), None, "", wrong, expected)]) from None


def _run(job: Path) -> Path | None:
    """The run of a job that counts."""
    found = JobFolder(job)
    ended, runs = found.ended(), found.runs()
    return ended[0] if ended is not None else runs[-1] if runs else None
