"""One experiment, from YAML to report, through the simulated station over zenoh."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader


@pytest.fixture(scope="module")
def static(shared_command):
    """The shipped experiment as it is, on the ideal station."""
    return shared_command.run("grasped_static", "--set", "world.profile=ideal", out="grasped_static")


@pytest.fixture(scope="module")
def pivoting(shared_command):
    """The shipped experiment as it is, on the ideal station."""
    return shared_command.run("grasped_pivoting", "--set", "world.profile=ideal", out="grasped_pivoting")


@pytest.fixture(params=("static", "pivoting"))
def ideal(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module", params=("grasped_static", "grasped_pivoting"))
def softer(request, shared_command):
    """The same on a plant a fifth softer than the planner believes."""
    return shared_command.run(request.param, "--set", "world.stiffness_scale=0.8", out=f"{request.param}-softer")


def without_times_and_provenance(results):
    kept = {key: value for key, value in results.items() if key not in ("provenance", "started", "finished", "timing")}
    return kept | {"plans": [{k: v for k, v in plan.items() if k != "time_s"} for plan in results["plans"]]}


def test_the_run_is_done_and_ends_with_the_reports_path(ideal):
    assert ideal.code == 0, ideal.err
    assert ideal.results["status"] == "completed"
    [path] = re.findall(r"report: (\S+)", ideal.out.splitlines()[-1])
    assert (ideal.folder.parent / path).read_text().lower().startswith("<!doctype html>")


def test_open_loop_on_the_ideal_plant_is_true_to_a_fiftieth(ideal):
    truth = ideal.trial("open_loop")["truth"]
    assert truth["go_pose_mm"]["mean"] <= 0.02
    assert truth["wrench_N"]["mean"] <= 0.02


def test_measured_figures_stand_beside_the_truth(ideal):
    for trial in ideal.results["trials"]:
        for figure in ("go_pose_mm", "wrench_N", "fx_N", "fy_N", "tau_Nmm", "x_mm", "y_mm", "theta_deg"):
            assert trial["measured"][figure]["mean"] >= 0 and trial["truth"][figure]["mean"] >= 0


def test_closed_loop_brings_the_wrench_error_of_a_softer_plant_below_a_fifth(softer):
    open_loop, closed_loop = softer.trial("open_loop"), softer.trial("closed_loop")
    assert open_loop["truth"]["wrench_N"]["mean"] > 0.3  # a fifth of several newtons is missing
    assert closed_loop["truth"]["wrench_N"]["mean"] < open_loop["truth"]["wrench_N"]["mean"] / 5


def test_the_run_folder_holds_what_the_contract_says(ideal):
    assert {"experiment.yaml", "log.mcap", "results.json", "report.html"} <= {p.name for p in ideal.folder.iterdir()}
    results = ideal.results
    assert results["schema"] == 1 and results["seed"] == 0 and results["station"] == "sim"
    assert {"git", "versions", "host"} == set(results["provenance"])


def test_every_published_message_was_logged(ideal):
    account = ideal.results["log"]
    assert account["lost"] == 0
    assert account["published"]["sim/wrist_ft/wrench"] > 1000
    with (ideal.folder / "log.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    ids = {channel.topic: channel.id for channel in summary.channels.values()}
    for topic, count in account["published"].items():
        if count == 0:  # a sensor that nobody asked for a frame has no channel
            assert topic not in ids
            continue
        assert summary.statistics.channel_message_counts[ids[topic]] == count, topic


def test_the_log_opens_in_reruns_loader_with_every_topic(static, tmp_path):
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    assert rerun, "rerun-sdk is a development dependency"
    converted = subprocess.run(
        [rerun, "mcap", "convert", "--disable-raw-fallback", "-o", "out.rrd", str(static.folder / "log.mcap")],
        cwd=tmp_path,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},  # its settings stay in the test's folder
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert converted.returncode == 0, converted.stderr
    for topic in static.results["log"]["messages"]:
        assert f"/{topic}" in converted.stderr, topic


def test_the_same_seed_gives_the_same_results(static, shared_command):
    again = shared_command.run("grasped_static", "--set", "world.profile=ideal", out="again")
    assert without_times_and_provenance(again.results) == without_times_and_provenance(static.results)


def test_the_resolved_experiment_runs_again_to_the_same_results(pivoting, shared_command):
    again = shared_command.run(str(pivoting.folder / "experiment.yaml"), out="resolved")
    assert again.code == 0, again.err
    assert without_times_and_provenance(again.results) == without_times_and_provenance(pivoting.results)


def test_a_run_that_joins_a_served_station_sees_the_same_truth(pivoting, command):
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    assert "serving" in host.stderr.readline()
    joined = command.run("grasped_pivoting")
    assert joined.code == 0, joined.err
    assert host.poll() is None  # a joined host outlives the run
    assert [t["truth"] for t in joined.results["trials"]] == [t["truth"] for t in pivoting.results["trials"]]


def test_the_report_is_rebuilt_from_the_log(static, shared_command):
    report = static.folder / "report.html"
    before = report.read_text()
    report.unlink()
    finished = shared_command.finish(shared_command.start("report", str(static.folder)))
    assert finished.code == 0, finished.err
    assert report.read_text() == before


def test_events_are_lines_of_json(softer):
    path = softer.folder / "events.jsonl"
    if path.exists():
        for line in path.read_text().splitlines():
            assert {"t_ns", "level", "text"} == set(json.loads(line))
