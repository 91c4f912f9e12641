"""The report of a fault campaign: a matrix of faults and moments, what is not as expected, what was not run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from experiments.cli import app
from experiments.files import dump_resolved, load
from tests.experiments.campaign.test_report import Page
from tests.experiments.chromium import assert_quiet_and_within
from tests.experiments.test_faults import campaign

CELLS = [
    {"fault": {"kind": "freeze", "device": "arm"}, "expect": {"approach": "device_failed", "contact": "device_failed"}},
    {"fault": {"kind": "drop", "device": "wrist_ft", "value": 0.5}, "expect": {"contact": "device_failed"}},
]
MOMENTS = (["approach", "contact"], ["contact"])


def row(number: int, kind: dict[str, Any], moment: str, status: str, **more: Any) -> dict[str, Any]:
    name = f"{number:03d}-{kind['kind']}-{kind['device']}-{moment}"
    told = {"name": name, "fault": kind, "moment": moment, "expected": ["device_failed"], "status": status}
    return {**told, "reason": "", "moved_on_s": 0.02, "force_N": 5.0, "short": [], **more}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run of three cells, of which the last did not end as expected; the first has a report."""
    cells = [{**cell, "moments": moments} for cell, moments in zip(CELLS, MOMENTS, strict=True)]
    run = tmp_path / "run"
    run.mkdir()
    (run / "experiment.yaml").write_text(dump_resolved(load(str(campaign(tmp_path, cells)))), "utf-8")
    freeze, drop = (cell["fault"] for cell in CELLS)
    write(
        run,
        [
            row(0, freeze, "approach", "device_failed", moved_on_s=0.03),
            row(1, freeze, "contact", "device_failed", force_N=12.25),
            row(2, drop, "contact", "completed", moved_on_s=9.0, short=["it ended completed, not device_failed"]),
        ],
    )
    own = run / "cells" / "000-freeze-arm-approach"
    own.mkdir(parents=True)
    (own / "report.html").write_text("<!doctype html>")
    return run


def write(run: Path, rows: Any, status: str = "fell_short", reason: str = "") -> None:
    results = {"status": status, "reason": reason, "experiment": "faults", "station": "sim", "seed": 0, "trials": []}
    (run / "results.json").write_text(json.dumps({**results, "provenance": {"git": "abc"}, "faults": rows}))


def made(run: Path) -> Page:
    ended = CliRunner().invoke(app, ["report", str(run)])
    assert ended.exit_code == 0, ended.output
    return Page(run / "report.html")


def test_the_matrix_has_every_fault_and_moment_and_leads_to_the_cells_own_reports(folder: Path) -> None:
    page = made(folder)
    assert page.tables["matrix"] == [
        ["Fault · device", "approach", "contact"],
        ["freeze · arm", "✓ device failed", "✓ device failed"],
        ["drop 0.5 · wrist_ft", "–", "✗ completed expected: device failed"],
    ]
    assert set(page.links) == {"cells/000-freeze-arm-approach/report.html"}  # the others have none
    assert "1 of 3 cells not as expected" in page.text
    assert page.tables["short"][1] == ["002-drop-wrist_ft-contact", "it ended completed, not device_failed"]


def test_the_worst_are_those_that_moved_on_though_it_ended_the_trial_and_those_that_felt_most(folder: Path) -> None:
    moved, force = [rows for name, rows in made(folder).tables.items() if name.startswith("table")]
    assert [cells[0] for cells in moved[1:]] == ["30", "20"]  # whom nothing stopped moves on as it should
    assert [cells[0] for cells in force[1:]] == ["12.2", "5.0", "5.0"]


def test_one_that_was_cut_off_renders_and_says_what_was_not_run(folder: Path) -> None:
    rows = json.loads((folder / "results.json").read_text())["faults"]
    write(folder, rows[:1], "interrupted", "Ctrl-C")
    page = made(folder)
    assert "1 of 3 cells were run: Ctrl-C. So far 1 cell, all as expected." in " ".join(page.text.split())
    assert page.tables["matrix"][1:] == [
        ["freeze · arm", "✓ device failed", "not run"],
        ["drop 0.5 · wrist_ft", "–", "not run"],
    ]
    write(folder, [], "running")
    assert "0 of 3 cells were run" in made(folder).text


def test_rows_that_no_run_has_written_are_refused(folder: Path) -> None:
    write(folder, [{"name": "x"}])
    ended = CliRunner().invoke(app, ["report", str(folder)])
    assert ended.exit_code == 2
    assert "`faults` cannot be read" in ended.output


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (800, "dark")])
def test_the_page_is_quiet_asks_for_nothing_and_fits(folder: Path, open_page: Any, width: int, scheme: str) -> None:
    made(folder)
    page = open_page(folder / "report.html", width, scheme)
    page.locator("#provenance-title").scroll_into_view_if_needed()
    assert_quiet_and_within(page, width)
