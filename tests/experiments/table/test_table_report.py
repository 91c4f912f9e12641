"""The report of a table: its panels as printed, its targets, its trials, and what is there of one that was cut off."""

import json

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments.cli import app
from experiments.table import run
from experiments.table.jobs import Options
from experiments.table.run import main
from tests.experiments.campaign.test_report import Page
from tests.experiments.chromium import assert_quiet_and_within


@pytest.fixture
def out(made, small, tmp_path):
    """A table with one trial that slipped, whose runs have left reports."""
    made.status["static-a-1"] = "slipped"
    folder = tmp_path / "out"
    main(str(small), Options(), made.engine(), folder)
    for place in folder.glob("runs-*/jobs/*/run"):
        (place / "report.html").write_text("<!doctype html>")
    return folder


def rebuilt(folder):
    ended = CliRunner().invoke(app, ["report", str(folder)])
    assert ended.exit_code == 0, ended.output
    return Page(folder / "report.html")


def test_a_table_ends_with_its_report(made, small, tmp_path, capsys):
    main(str(small), Options(), made.engine(), tmp_path / "out")
    assert (tmp_path / "out" / "report.html").is_file()
    assert f"report: {tmp_path / 'out' / 'report.html'}" in capsys.readouterr().out


def test_the_panels_figures_are_those_of_table_md(out):
    page = rebuilt(out)
    markdown = (out / "table.md").read_text("utf-8")
    printed = [
        [c.strip() for c in line.strip("| \n").split(" | ")] for line in markdown.splitlines() if "measured |" in line
    ]
    [panel] = [rows for name, rows in page.tables.items() if any("measured" in cells for cells in rows)]
    shown = [cells[cells.index("measured") :] for cells in panel if "measured" in cells]
    assert shown and shown == [cells[cells.index("measured") :] for cells in printed]


def test_trials_are_told_by_the_panels_tags_and_lead_to_their_runs(out):
    page = rebuilt(out)
    trials = pd.read_parquet(out / "trials.parquet")
    rows = page.tables["trials"][1:]
    assert len(rows) == len(trials) == 12
    assert {cells[1] for cells in rows} == {"static", "slow"}  # the panel's columns are runs
    assert "runs-0/jobs/static-a-1/run/report.html" in page.links
    assert all((out / link).is_file() for link in page.links)
    [_, slipped] = page.tables["failures"]
    assert slipped[:2] == ["2", "slipped"]
    told = {cells[0]: cells[1] for cells in page.tables["findings"][1:]}
    assert told["done"] == "10 of 12"


def test_one_that_was_cut_off_says_how_far_it_has_come(out):
    (out / "table.json").unlink()
    text = " ".join(rebuilt(out).text.split())
    assert "A small table" in text and "Unfinished" in text
    assert "The same command with the same --out goes on with what is missing." in text


@pytest.mark.parametrize("name", ["table.json", "trials.parquet"])
def test_a_torn_file_is_refused_by_name(out, name):
    (out / name).write_text("{")
    ended = CliRunner().invoke(app, ["report", str(out)])
    assert ended.exit_code == 2
    assert name in ended.output


def test_a_report_that_cannot_be_made_takes_no_table_with_it(made, small, tmp_path, monkeypatch, capsys):
    def fails(_):
        raise RuntimeError("no ink")

    monkeypatch.setattr(run, "write_report", fails)
    main(str(small), Options(), made.engine(), tmp_path / "out")
    assert json.loads((tmp_path / "out" / "table.json").read_text())["table"] == "small"
    assert "the report could not be made: no ink" in capsys.readouterr().err


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (800, "dark")])
def test_the_page_is_quiet_asks_for_nothing_and_fits(out, open_page, width, scheme):
    rebuilt(out)
    page = open_page(out / "report.html", width, scheme)
    for plot in page.locator(".trials-plot").all():
        plot.scroll_into_view_if_needed()
        plot.locator(".scatterlayer .trace").first.wait_for(state="attached")
    assert page.locator(".trials-plot").count() > 0
    assert_quiet_and_within(page, width)
