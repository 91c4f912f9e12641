"""What a campaign's report shows: its summary, its trials and their runs' reports, what is missing, what made it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from experiments.campaign import frame
from experiments.campaign.folder import CampaignFolder, JobFolder
from experiments.campaign.frame import Pairing
from experiments.report.summary import leaves, mapping
from experiments.run_folder import RunFolder

#: the column of a trial's link, relative to the campaign's folder; empty where its run has no report
LINK = ".link"


@dataclass(frozen=True)
class Missing:
    """The jobs of a cell that have not ended and were not given up, of all that it has."""

    cell: tuple[str, ...]
    jobs: int
    of: int
    trials: int


@dataclass(frozen=True)
class GivenUp:
    """A job that no more attempt is made of, and the report of its last one, where there is one."""

    id: str
    tags: str
    reason: str
    link: str


@dataclass(frozen=True)
class Collected:
    """A campaign as its report shows it.

    ``trials`` is the table of all trials with the column `LINK`; ``keys`` are the columns that tell the cells of the
    grid apart. ``stations`` with their profiles; ``sets`` are those that all jobs have. ``provenance``: each path with
    the values that its runs have, mostly one.
    """

    summary: Mapping[str, Any]
    trials: pd.DataFrame
    keys: tuple[str, ...]
    pairings: tuple[Pairing, ...]
    grid: Mapping[str, tuple[str, ...]]
    missing: tuple[Missing, ...]
    given_up: tuple[GivenUp, ...]
    started: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()
    provenance: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def collect(campaign: CampaignFolder, summary: Mapping[str, Any], trials: pd.DataFrame) -> Collected:
    """Look at every job's folder. Raises InputError where there is no campaign."""
    jobs = campaign.read()["jobs"]
    folders = {job["id"]: campaign.job(job["id"]) for job in jobs}
    runs = trials["run"].tolist()
    links = {run: link_to(campaign.path / run, campaign.path) for run in dict.fromkeys(runs)}
    trials = trials.assign(**{LINK: [links[run] for run in runs]})
    ended = [found[1] for folder in folders.values() if (found := folder.ended()) is not None]
    return Collected(
        summary,
        trials,
        tuple(frame.cell_keys(campaign.path, trials)),
        tuple(frame.pairings(campaign.path, trials)) if len(trials) else (),
        _grid(jobs),
        tuple(_missing(jobs, folders)),
        tuple(_given_up(jobs, folders, campaign.path)),
        tuple(sorted(str(results["started"]) for results in ended if results.get("started"))),
        tuple(dict.fromkeys(_station(results) for results in ended if results.get("station"))),
        _common(jobs),
        _provenance(ended),
    )


def link_to(run: Path, root: Path) -> str:
    """Where a run's report lies as seen from a page in ``root``; empty where it has none."""
    report = RunFolder(run).report
    return quote(report.relative_to(root).as_posix()) if report.is_file() else ""


def _common(jobs: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """What is set in every job."""
    first = jobs[0].get("sets", ()) if jobs else ()
    return tuple(text for text in first if all(text in job.get("sets", ()) for job in jobs))


def _station(results: Mapping[str, Any]) -> str:
    profile = results.get("profile")
    return str(results["station"]) + (f", profile {profile}" if profile else "")


def _grid(jobs: Iterable[Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """The values that each tag has, in the order in which they come."""
    found: dict[str, dict[str, None]] = {}
    for job in jobs:
        for key, value in job["tags"].items():
            found.setdefault(key, {})[frame.shown(value)] = None
    return {key: tuple(values) for key, values in found.items()}


def _cell(job: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(f"{key} {frame.shown(value)}" for key, value in job["tags"].items() if key != "seed")


def _missing(jobs: Iterable[Mapping[str, Any]], folders: Mapping[str, JobFolder]) -> Iterable[Missing]:
    cells: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for job in jobs:
        cells.setdefault(_cell(job), []).append(job)
    for cell, own in cells.items():
        left = [job for job in own if folders[job["id"]].ended() is None and folders[job["id"]].failure is None]
        if left:
            yield Missing(cell, len(left), len(own), sum(len(job["trials"]) for job in left))


def _given_up(jobs: Iterable[Mapping[str, Any]], folders: Mapping[str, JobFolder], root: Path) -> Iterable[GivenUp]:
    for job in jobs:
        folder = folders[job["id"]]
        if folder.ended() is None and (failure := folder.failure) is not None:
            runs = folder.runs()
            tags = ", ".join(f"{key} {frame.shown(value)}" for key, value in job["tags"].items())
            yield GivenUp(job["id"], tags, failure, link_to(runs[-1], root) if runs else "")


def _provenance(ended: Iterable[Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    found: dict[str, dict[str, None]] = {}
    for results in ended:
        for path, value in leaves(mapping(results.get("provenance"))):
            found.setdefault(path, {})[value] = None
    return {path: tuple(values) for path, values in found.items() if path}
