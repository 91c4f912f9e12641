"""Reports of runs as they lie on the disk: a whole one, and what is left of one that was cut off."""

import json
import shutil

import pytest

from drivers.wire.log_reader import LogReader
from experiments.report import render
from experiments.report.build import build_report
from experiments.report.collect import collect
from tests.experiments.report.pages import draw_figures, draw_traces, seek


@pytest.fixture(scope="module")
def finished(shared_command):
    """A short run that nothing disturbed."""
    done = shared_command.run("grasped_static", "--set", "stages.1.controllers=[open_loop]")
    assert done.code == 0, done.err
    return done


def cut(run, share):
    data = run.log.read_bytes()
    run.log.write_bytes(data[: int(share * len(data))])


def test_devices_are_told_with_as_many_readings_as_the_log_has(run, find_cells):
    counts = LogReader(run.log).counts()
    page = render(collect(run))
    rows = {row[0].split()[0]: row for row in find_cells(page, "devices") if "image" not in row[0]}
    assert rows["wrist_ft"][1] == f"{counts['sim/wrist_ft/wrench']:,}"
    assert rows["arm"][1] == f"{counts['sim/arm/pose']:,}"
    assert rows["wrist_ft"][2].endswith("declared 1000")
    assert float(rows["wrist_ft"][2].split()[0]) == pytest.approx(1000, rel=0.01)
    assert rows["finger_left"][1:3] == ["0", "on request"]
    assert rows["finger_left"][-1] == "nobody asked it for a reading"
    assert "Every device spoke as it says of itself" in page  # an ideal station loses nothing


def test_the_search_is_told_as_long_as_the_plan_says(run):
    data = collect(run)
    [row] = data["results"]["plans"]
    told = data["plans"][row["name"]]
    assert told["curve_queries"][0] == 1
    assert told["curve_queries"][-1] <= row["queries"]
    assert len(told["curve"]) == len(told["curve_queries"])
    assert min(told["curve"]) == pytest.approx(row["loss"])


def test_every_waypoint_has_the_cameras_picture(run):
    [trial] = collect(run)["trials"]
    [camera] = trial["pictures"]
    assert camera["device"] == "camera"
    assert [step for _, step, _ in camera["shots"]] == list(range(len(trial["waypoints"]["t"])))


def test_a_whole_run_answers_to_hands_and_shows_its_results(show, run):
    page = show(collect(run))
    draw_traces(page)
    draw_figures(page)
    [trial] = json.loads(run.results.read_text())["trials"]
    shown = [" ".join(cell.inner_text().split()) for cell in page.locator("#errors tbody td.number").all()]
    figures = [trial[source][key] for key in ("go_pose_mm", "wrench_N") for source in ("measured", "truth")]
    told = [f"{f['mean']:.3f} ± {f['std']:.3f}" for f in figures]
    assert shown[:2] + shown[3:5] == told  # the third of each three is the paper's
    before = page.locator(".body-go").get_attribute("transform")
    seek(page, page.evaluate("Number(document.getElementById('time').max) / 4"))
    assert page.locator(".body-go").get_attribute("transform") != before
    assert page.heard == []
    assert len(render(collect(run)).encode()) < 8e6


def damaged(run, how):
    """Damage a run, and say which words its report has to have."""
    if how == "torn in a trial":
        cut(run, 0.6)
        return ["The log was not closed in order: torn", "Completed"]
    if how == "torn, and its results with it":
        cut(run, 0.6)
        run.results.unlink()
        return ["not closed in order", "does not say how the run ended", "unfinished"]
    if how == "torn before anything was written":
        run.log.write_bytes(b"")
        return ["There is no log of this run", "No trial was recorded", "The log has no reading of any device"]
    if how == "log of zeros":
        run.log.write_bytes(bytes(4096))
        return ["no MCAP file"]
    if how == "no log":
        run.log.unlink()
        return ["There is no log of this run", "nothing to play back"]
    if how == "no plans":
        shutil.rmtree(run.path / "plans")
        return ["its file cannot be read"]
    results = json.loads(run.results.read_text())
    results.update(status="stopped", reason="somebody asked for it", trials=[])
    run.results.write_text(json.dumps(results))
    return ["Aborted", "no trial was executed; the run ended with status “stopped”: somebody asked for it"]


@pytest.mark.parametrize(
    "how",
    [
        "torn in a trial",
        "torn, and its results with it",
        "torn before anything was written",
        "log of zeros",
        "no log",
        "no plans",
        "aborted",
    ],
)
def test_what_is_left_of_a_run_has_a_report_that_says_so(show, run, how):
    words = damaged(run, how)
    build_report(run)
    assert run.report.read_text().endswith("</html>")
    page = show(collect(run), width=800, scheme="dark")
    text = page.locator("body").text_content()
    text = " ".join(text.split())
    assert [word for word in words if word not in text] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= 800
    assert page.heard == []
