"""The report of a fault campaign: what every fault came to at every moment, each cell a link to its run's report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from experiments.campaign.report.collect import link_to
from experiments.campaign.report.page import filled
from experiments.faults.schema import MOMENTS, FaultsStage
from experiments.files import Resolved
from experiments.report.summary import Verdict, facts, leaves, words
from experiments.results_file import Word
from experiments.run_folder import RunFolder
from mechanics.yaml_input import InputError, Problem

#: so many cells in which the arm moved on for longest, and in which the force was greatest
WORST = 5


class Row(BaseModel):
    """A cell as results.json has it, as far as the page shows it. Times of the station."""

    name: Word
    fault: dict[str, Any]
    moment: Word
    expected: list[Word]
    status: Word
    reason: str = ""
    moved_on_s: float | None = Field(default=None, allow_inf_nan=False)
    force_N: float | None = Field(default=None, allow_inf_nan=False)
    short: list[str] = []


_ROWS = TypeAdapter(list[Row])


def is_fault_campaign(results: Mapping[str, Any]) -> bool:
    """Whether results are those of a run that made cells of a fault campaign, or began to."""
    return results.get("faults") is not None


def render(folder: RunFolder, resolved: Resolved, data: Mapping[str, Any]) -> str:
    """One self-contained HTML page; ``data`` as `experiments.report.collect` gives it.

    Raises InputError where the results have no cells that can be read.
    """
    results = data["results"]
    try:
        rows = _ROWS.validate_python(results["faults"])
    except ValidationError as error:
        wrong = f"its `faults` cannot be read: {error.errors()[0]['msg']}"
        raise InputError([Problem(str(folder.results), None, "faults", wrong, "cells as the run wrote them")]) from None
    links = {row.name: link_to(folder.path / "cells" / row.name, folder.path) for row in rows}
    planned = list(_planned(resolved))
    moments = [moment for moment in MOMENTS if any(at == moment for _, at in planned)]
    provenance = results.get("provenance")
    return filled(
        "faults/report.html.j2",
        {},
        title=f"Fault campaign “{data['title']}”",
        verdict=verdict(rows, len(planned), results),
        facts=[
            *((label, value) for label, value in facts(data) if label != "Profile"),
            ("Profile of the cells", _profile(resolved)),
            ("Cells", f"{len(rows)} of {len(planned)}"),
        ],
        warnings=[],
        moments=moments,
        matrix=matrix(rows, planned, moments, links),
        missing=[f"{name}, {moment}" for name, moment in planned[len(rows) :]],
        short=[(row.name, links[row.name], row.short) for row in rows if row.short],
        worst=worst(rows, links),
        cells=[_told(row, links) for row in rows],
        provenance=list(leaves(provenance)) if provenance else [],
    )


def verdict(rows: Sequence[Row], planned: int, results: Mapping[str, Any]) -> Verdict:
    """Whether every cell was run and ended as it has to."""
    short = sum(bool(row.short) for row in rows)
    cells = f"{len(rows)} cell{'s' * (len(rows) != 1)}"
    count = f"{short} of {cells} not as expected" if short else f"{cells}, all as expected"
    if len(rows) < planned:
        reason = str(results.get("reason") or "").strip().rstrip(".")
        told = f": {reason}" if reason else ""
        detail = f"{len(rows)} of {planned} cells were run{told}. So far {count}."
        return Verdict("aborted", "Unfinished", detail)
    return Verdict("short", "Fell short", f"{count}.") if short else Verdict("completed", "Completed", f"{count}.")


def matrix(
    rows: Sequence[Row], planned: Sequence[tuple[str, str]], moments: Sequence[str], links: Mapping[str, str]
) -> list[dict[str, Any]]:
    """A row for each fault, in it a cell for each moment: what came of it, None where it was not run or not asked."""
    by = {(fault_told(row.fault), row.moment): _told(row, links) for row in rows}
    asked = set(planned)
    return [
        {"fault": fault, "cells": [(by.get((fault, moment)), (fault, moment) in asked) for moment in moments]}
        for fault in dict.fromkeys(fault for fault, _ in planned)
    ]


def worst(rows: Sequence[Row], links: Mapping[str, str]) -> list[dict[str, Any]]:
    """The cells in which the arm moved on for longest after the fault, and in which the wrist felt most."""
    found = []
    # one that completed has moved on because it was to
    moved = {r.name: r.moved_on_s * 1e3 for r in rows if r.moved_on_s is not None and r.status != "completed"}
    force = {r.name: r.force_N for r in rows if r.force_N is not None}
    for head, unit, known, decimals in (
        ("Moved on after the fault, where it ended the trial", "ms", moved, 0),
        ("Greatest force at the wrist", "N", force, 1),
    ):
        most = sorted((row for row in rows if row.name in known), key=lambda row: -known[row.name])[:WORST]
        told = [{**_told(row, links), "value": f"{known[row.name]:.{decimals}f}"} for row in most]
        if told:
            found.append({"head": head, "unit": unit, "rows": told})
    return found


def fault_told(fault: Mapping[str, Any]) -> str:
    """A fault in words: kind, device and what else is said of it."""
    rest = {key: value for key, value in fault.items() if key not in ("kind", "device", "moment")}
    more = [_figure(rest.pop("value"))] if "value" in rest else []
    more += [f"{words(key)} {_figure(value)}" for key, value in rest.items()]
    return " ".join([words(fault.get("kind")), *more]) + f" · {fault.get('device', 'world')}"


def _figure(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def _profile(resolved: Resolved) -> str:
    world = resolved.station.world
    own = "" if world is None else world.profile
    stages = [stage for stage in resolved.experiment.stages if isinstance(stage, FaultsStage)]
    return ", ".join(dict.fromkeys(stage.profile or own for stage in stages)) or "not recorded"


def _planned(resolved: Resolved) -> Iterator[tuple[str, str]]:
    """Fault and moment of every cell, in the order in which they are run."""
    for stage in resolved.experiment.stages:
        if isinstance(stage, FaultsStage):
            for cell in stage.cells:
                for moment in cell.moments:
                    yield fault_told(cell.fault.model_dump(exclude_defaults=True)), moment


def _told(row: Row, links: Mapping[str, str]) -> dict[str, Any]:
    return {
        "name": row.name,
        "link": links[row.name],
        "fault": fault_told(row.fault),
        "moment": row.moment,
        "expected": " or ".join(map(words, row.expected)),
        "status": words(row.status),
        "as_expected": not row.short,
        "reason": row.reason,
        "moved_on": "–" if row.moved_on_s is None else f"{row.moved_on_s * 1e3:.0f}",
        "force": "–" if row.force_N is None else f"{row.force_N:.1f}",
    }
