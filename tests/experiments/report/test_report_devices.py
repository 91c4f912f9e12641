"""The table of devices: worst values, when they were, and what is marked."""

import pytest

from experiments.report import device_health, render
from experiments.report.convergence import figures
from tests.experiments.report.runs import build_health, build_plans, stream


def test_every_device_has_a_row_with_its_worst_values_and_when(grasped, find_cells):
    cells = find_cells(render(grasped), "devices")
    assert [row[0] for row in cells] == [
        "arm arm, pose", "camera tag camera, detections", "wrist force torque, wrench", "gripper gripper",
    ]  # fmt: skip
    assert cells[2][1:4] == ["41,600", "999.9 declared 1000", "12.3 ms at 7.25 s"]
    assert cells[2][4:6] == ["3.1 ms at 9.50 s", "3 at most 2 at 7.25 s"]
    assert cells[2][6] == "it is saturated: 12 readings, the first at 20.50 s"
    assert cells[1][2] == "on request"
    assert cells[3][6] == "the log has no reading of it"


def test_the_arm_is_told_with_what_its_gates_refused(grasped, find_cells):
    arm = find_cells(render(grasped), "devices")[0][6]
    assert "its gates refused set-points: 2 by speed" in arm
    assert "0.3 m/s is more than 0.25 m/s, at 12.50 s" in arm


def told(**known):
    found = device_health.section({"streams": [stream("ft", "force_torque", "wrench", 1000, **known)]}, [])
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("known", "marked"),
    [
        ({"declared": 1000.0, "rate": 950.0}, None),
        ({"declared": 1000.0, "rate": 850.0}, "rate"),
        ({"declared": 1000.0, "silence": {"value": 0.09, "t": 1.0}}, None),
        ({"declared": 1000.0, "silence": {"value": 0.2, "t": 1.0}}, "silence"),
        ({"age": {"value": 0.2, "t": 1.0}}, "age"),
        ({"lost": 1, "gaps": 1, "gap": {"value": 1, "t": 1.0}}, "gaps"),
    ],
)
def test_what_is_not_as_it_should_be_is_marked_and_named_before_the_table(known, marked):
    found = told(**known)
    [row] = found["rows"]
    assert [key for key in ("rate", "silence", "age", "gaps") if row[key][2]] == ([marked] if marked else [])
    assert found["troubled"].startswith("Not all was well with ft" if marked else "Every device spoke")


def test_a_log_without_ages_has_no_column_of_them(editable):
    assert "Oldest on arrival" in render(editable)
    for one in editable["health"]["streams"]:
        one["age"] = None
    assert "Oldest on arrival" not in render(editable)


def test_an_event_that_speaks_of_a_device_further_on_is_told_whole():
    events = [{"t": 3.0, "level": "warning", "text": "paused, for 30 s at most: wrist: no reading for 0.2 s"}]
    found = device_health.section(build_health(), [*events, {"t": 4.0, "level": "info", "text": "the other wrists: 3"}])
    assert found is not None
    wrist = next(row for row in found["rows"] if row["device"] == "wrist")
    assert wrist["notes"][1:] == ["paused, for 30 s at most: wrist: no reading for 0.2 s, at 3.00 s"]


def test_events_that_name_a_device_stand_in_its_row_the_first_few():
    events = [{"t": float(i), "level": "warning", "text": f"arm: paused {i}"} for i in range(5)]
    found = device_health.section(build_health(), events)
    assert found is not None
    assert found["rows"][0]["notes"][-4:] == [
        "paused 0, at 0.00 s", "paused 1, at 1.00 s", "paused 2, at 2.00 s", "and 2 more of its kind",
    ]  # fmt: skip


@pytest.mark.parametrize("health", [None, {}, {"streams": [], "silent": []}])
def test_a_run_whose_log_has_no_reading_says_so(editable, health):
    editable["health"] = health
    assert "The log has no reading of any device" in render(editable)


def rows(**known):
    return [{"name": "pivot", "skill": "s", "planner": "icem", "queries": 100, **known}]


def test_a_plan_is_drawn_as_loss_against_queries_on_a_logarithmic_scale():
    [figure] = figures(build_plans(), rows())
    [trace] = figure["data"]
    assert trace["x"] == list(range(10, 101, 10))
    assert (trace["y"][0], trace["y"][-1]) == pytest.approx((10.0, 0.01))
    assert figure["layout"]["yaxis"]["type"] == "log"
    assert figure["layout"]["xaxis"]["title"]["text"] == "queries"
    assert figure["text"] == "Loss from 10 to 0.01 in 100 queries and 250 ms; its budget was spent."
    assert figure["terms"] == [("cone", "0.007"), ("smooth", "0.003")]


def test_a_plan_of_an_older_file_is_drawn_by_its_iterations():
    plans = build_plans()
    del plans["pivot"]["curve_queries"]
    [figure] = figures(plans, rows())
    assert figure["data"][0]["x"] == list(range(1, 11))
    assert figure["layout"]["xaxis"]["title"]["text"] == "iterations"


def test_a_loss_that_was_infinite_is_a_point_less_and_one_that_reaches_zero_has_a_linear_scale():
    plans = build_plans()
    plans["pivot"]["curve"][0], plans["pivot"]["curve"][-1] = None, 0.0
    [figure] = figures(plans, rows())
    assert figure["data"][0]["x"] == list(range(20, 101, 10))
    assert "type" not in figure["layout"]["yaxis"]


def test_a_nominal_plan_has_no_figure_and_one_that_cannot_be_read_says_why():
    assert figures({"pivot": {"curve": [0.5], "curve_queries": [1]}}, rows()) == []
    [figure] = figures({"pivot": "it is damaged"}, rows())
    assert (figure["data"], figure["problem"]) == ([], "its file cannot be read: it is damaged")
    assert figures(None, rows()) == figures({}, None) == []
