"""The report of a campaign: what it says of whole, unfinished and empty ones, and where its links lead."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments.campaign.folder import CampaignFolder
from experiments.campaign.report import points, tables
from experiments.campaign.report.build import rebuild
from experiments.campaign.report.collect import collect
from experiments.campaign.summary import status_of, summarise
from experiments.cli import app
from mechanics.yaml_input import InputError

from .campaigns import campaign, row


class Page(HTMLParser):
    """The rows of each table by its id, the text of all else, and the links."""

    def __init__(self, file):
        super().__init__()
        self.tables, self.links, self.text, self._at, self._quiet = {}, [], "", None, 0
        self.feed(file.read_text(encoding="utf-8"))
        for rows in self.tables.values():
            rows[:] = [[cell.strip() for cell in cells] for cells in rows]

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "table":
            self._at = self.tables.setdefault(given.get("id", f"table {len(self.tables)}"), [])
        elif tag == "tr" and self._at is not None:
            self._at.append([])
        elif tag in ("td", "th") and self._at:
            self._at[-1].append("")
        elif tag == "a":
            self.links.append(given["href"])
        elif tag in ("script", "style"):
            self._quiet += 1
        elif tag in ("div", "span"):
            self.handle_data(" ")

    def handle_endtag(self, tag):
        self._quiet -= tag in ("script", "style")
        self._at = None if tag == "table" else self._at

    def handle_data(self, data):
        if self._quiet:
            return
        self.text += data
        if self._at and self._at[-1]:
            self._at[-1][-1] = re.sub(r"\s+", " ", self._at[-1][-1] + data).lstrip()


def fell(controller, trial, wrench, reason):
    return {**row(controller, trial, "slipped", wrench), "reason": reason}


@pytest.fixture
def jobs():
    """Two cells, two seeds: at 0.5 the open loop slips, with another figure in the reason each time."""
    found = []
    for mu, wrenches in ((0.3, (1.0, 3.0)), (0.5, (2.0, 6.0))):
        for seed, wrench in enumerate(wrenches):
            first = (
                row("open_loop", 0, "completed", wrench)
                if mu < 0.4
                else fell("open_loop", 0, wrench, f"slipped by {wrench} mm at waypoint {seed}")
            )
            rows = [first, row("closed_loop", 0, "completed", wrench - 0.5)]
            found.append((f"c{mu}-s{seed}", {"mu": mu, "seed": seed}, rows, [("completed", rows)]))
    return found


def with_reports(folder):
    for results in folder.glob("jobs/*/run*/results.json"):
        (results.parent / "report.html").write_text("<!doctype html><title>a run</title>")
    return folder


@pytest.fixture
def whole(tmp_path, jobs):
    return with_reports(campaign(tmp_path / "sweep", jobs))


def collected(folder):
    found = CampaignFolder(folder)
    return collect(found, *summarise(found, status_of(found)))


def test_the_figures_of_a_cell_are_those_of_its_rows_in_the_parquet_file(whole):
    page = Page(rebuild(whole))
    table = pd.read_parquet(whole / "trials.parquet")
    rows = {(r[0], r[1]): r for r in page.tables["cells"][1:]}
    own = table[(table["mu"] == 0.5) & (table["controller"] == "open_loop")]["measured.wrench_N.mean"]
    told = rows["0.5", "open loop"]
    # the mean of 2 and 6 is 4, their deviation 2; Student's t for 2 is 12.7062, so 4 ± 12.7062 · 2.82843 / √2
    assert told[-1] == "4.000 ± 2.000 -21.412 … 29.412"
    assert float(told[-1].split()[0]) == own.mean()
    assert told[3] == "0/2 0–66 %"  # Wilson's interval of 0 in 2: z² / (n + z²) = 0.658
    assert rows["0.3", "open loop"][3] == "2/2 34–100 %"


def test_controllers_are_compared_by_pairs(whole):
    page = Page(rebuild(whole))
    assert page.tables["pairs"][1] == ["0.3", "closed loop − open loop", "2", "-0.500 -0.500 … -0.500"]


def test_failures_are_told_by_reason_whatever_figures_stand_in_it(whole):
    [_, told] = Page(rebuild(whole)).tables["failures"]
    assert told[:4] == ["2", "slipped", "slipped by … mm at waypoint …", "2 × open loop at 0.5"]
    assert told[4] == "c0.5-s0 c0.5-s1"


def test_worst_trials_come_first_and_every_link_leads_to_a_report(whole):
    page = Page(rebuild(whole))
    [worst] = [rows for name, rows in page.tables.items() if name.startswith("table")]
    assert [r[0] for r in worst[1:]] == ["6.000", "5.500", "3.000", "2.500", "2.000"]
    assert page.links
    assert all((whole / link).is_file() for link in page.links)
    assert not any(re.match(r"[a-z]+:|/", link) for link in page.links)  # they go with the folder


def test_a_run_without_a_report_is_named_and_not_linked(tmp_path, jobs):
    page = Page(rebuild(campaign(tmp_path / "sweep", jobs)))
    assert page.links == []
    assert "c0.5-s1" in page.text


def test_names_from_files_are_no_markup_and_links_are_quoted(tmp_path):
    rows = [{**row("open_loop", 0, "completed", 1.0), "reason": ""}]
    wrong = [fell("open_loop", 0, 2.0, "</script><script>alert(1)</script>")]
    jobs = [
        ("a b#%1", {"k": "<b>bold</b>", "seed": 0}, rows, [("completed", rows)]),
        ("c", {"k": "</script><i>", "seed": 0}, wrong, [("completed", wrong)]),
    ]
    folder = with_reports(campaign(tmp_path / "sweep", jobs))
    file = rebuild(folder)
    assert "jobs/a%20b%23%251/run/report.html" in Page(file).links
    text = file.read_text(encoding="utf-8")
    assert "<b>bold" not in text and "<script>alert" not in text and "</script><i>" not in text


def test_a_campaign_that_was_cut_off_renders_and_says_what_is_missing(tmp_path, jobs):
    folder = campaign(tmp_path / "sweep", [*jobs[:3], (*jobs[3][:3], [("running", [])])])
    page = Page(rebuild(folder))
    assert "Unfinished" in page.text
    assert "3 of 4 jobs have ended, 1 is missing: it was cut off, or still runs. So far 5 of 6 trials completed." in (
        " ".join(page.text.split())
    )
    assert page.tables["unfinished"][1:] == [["mu 0.5", "1", "2", "2"]]
    assert json.loads((folder / "summary.json").read_text())["status"] == "unfinished"


def test_what_the_sweep_has_said_of_its_own_end_stands_until_its_jobs_have_ended(tmp_path, jobs):
    folder = campaign(tmp_path / "sweep", [*jobs[:3], (*jobs[3][:3], [("running", [])])])
    (folder / "summary.json").write_text('{"status": "interrupted"}')
    assert "it was interrupted" in Page(rebuild(folder)).text
    results = {"status": "fell_short", "reason": "", "trials": jobs[3][2]}
    (folder / "jobs" / jobs[3][0] / "run" / "results.json").write_text(json.dumps(results))
    rebuild(folder)
    assert json.loads((folder / "summary.json").read_text())["status"] == "fell_short"


def test_a_job_that_was_given_up_is_told_with_its_reason(tmp_path, jobs):
    folder = campaign(tmp_path / "sweep", [*jobs[:3], (*jobs[3][:3], [("device_failed", [])])])
    CampaignFolder(folder).job(jobs[3][0]).give_up("the camera is off")
    page = Page(rebuild(folder))
    assert page.tables["given-up"][1:] == [["c0.5-s1", "mu 0.5, seed 1", "the camera is off"]]
    assert "1 job was given up" in page.text


def test_a_campaign_of_which_nothing_ran_has_a_report(tmp_path, jobs):
    page = Page(rebuild(campaign(tmp_path / "sweep", [(*job[:3], []) for job in jobs])))
    assert "no trial was run" in page.text
    assert [r[1:] for r in page.tables["unfinished"][1:]] == [["2", "2", "4"]] * 2


def test_trials_without_any_figure_have_rows_and_no_points(tmp_path):
    rows = [row("open_loop", 0, "lost_contact", None)]
    folder = campaign(tmp_path / "sweep", [("a", {}, rows, [("fell_short", rows)])])
    page = Page(rebuild(folder))
    assert "No trial reached a waypoint" in page.text
    assert page.tables["cells"][1][0] == "open loop"


def test_a_large_campaign_is_drawn_in_parts_and_thinned_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS", 50)
    jobs = []
    for n in range(60):
        rows = [row("open_loop", t, "completed", float(n + t)) for t in range(2)]
        jobs.append((f"j{n}", {"k": n, "seed": 0}, rows, [("completed", rows)]))
    folder = campaign(tmp_path / "sweep", jobs)
    figure = points.distributions(collected(folder))
    assert figure is not None
    assert [len(page["groups"]) for page in figure["pages"]] == [48, 12]
    shown = [group["values"]["measured"]["wrench_N"] for page in figure["pages"] for group in page["groups"]]
    assert sum(map(len, shown)) == 60  # every second, third … of each row, never none
    assert figure["pages"][0]["groups"][7]["means"]["measured"]["wrench_N"][0] == 7.5  # over all
    assert f"every {figure['step']}. trial is drawn" in Page(rebuild(folder)).text


def test_runs_of_several_revisions_are_a_warning(tmp_path, jobs):
    folder = campaign(tmp_path / "sweep", jobs)
    for n, file in enumerate(sorted(folder.glob("jobs/*/run/results.json"))):
        results = json.loads(file.read_text())
        results |= {"started": f"2026-01-0{n + 1}T00:00:00+00:00", "provenance": {"git": "abc" if n else "def"}}
        file.write_text(json.dumps(results))
    found = collected(folder)
    assert tables.warnings(found) == ["The runs were not all made by the same: they differ in git."]
    facts = dict(tables.facts(found))
    assert (facts["Seeds"], facts["mu"], facts["Git"]) == ("0-1", "0.3, 0.5", "def, abc")
    assert facts["Begun"] == "2026-01-01 00:00:00 UTC"


def test_the_command_rebuilds_a_sweeps_report(whole):
    ended = CliRunner().invoke(app, ["report", str(whole)])
    assert ended.exit_code == 0, ended.output
    assert (whole / "report.html").is_file() and (whole / "trials.parquet").is_file()
    assert "report.html" in ended.output


def test_a_torn_campaign_is_refused_by_name(tmp_path):
    (tmp_path / "campaign.json").write_text('{"jobs": [')
    with pytest.raises(InputError, match=r"campaign\.json.*no campaign can be read"):
        rebuild(tmp_path)
    ended = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert ended.exit_code == 2


def test_a_folder_that_cannot_be_written_is_said(whole):
    (whole / "report.html").mkdir()
    ended = CliRunner().invoke(app, ["report", str(whole)])
    assert ended.exit_code == 3
    assert f"then extrinsic report {whole}" in ended.output
    assert not list(Path(whole).glob(".report*"))
