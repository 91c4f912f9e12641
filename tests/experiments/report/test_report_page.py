"""The page as text: what it says, what it carries, and that nothing in it reaches out."""

import json
import math
import re
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.report import payload, render, summary, traces

M = {"mean": 1.23456, "std": 0.2}


def carried(page):
    text = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert text is not None
    return json.loads(text.group(1))


class Links(HTMLParser):
    """Every attribute through which a page asks for something else."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [(tag, k, v) for k, v in attrs if k in {"src", "href", "srcset", "data", "action", "poster"}]


def test_nothing_in_the_page_points_outside(grasped):
    page = render(grasped)
    links = Links()
    links.feed(page)
    assert links.found == [("link", "href", "data:,")]
    style = page[page.index("<style>") : page.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style


def test_the_page_forbids_itself_every_request(empty):
    policy = re.search(r'Content-Security-Policy"\s+content="([^"]*)"', render(empty))
    assert policy is not None
    assert "default-src 'none'" in policy.group(1)
    assert "http" not in policy.group(1)


def test_error_table_shows_the_figures_of_the_results(grasped, find_cells):
    cells = find_cells(render(grasped), "errors")
    for row, trial in zip(cells, grasped["results"]["trials"], strict=True):
        expected = [
            f"{trial[source][key]['mean']:.3f} ± {trial[source][key]['std']:.3f}"
            for key in ("go_pose_mm", "wrench_N")
            for source in ("measured", "truth")
        ]
        assert row[-4:] == expected


def test_component_table_shows_measured_above_truth(grasped, find_cells):
    cells = find_cells(render(grasped), "components")
    trial = grasped["results"]["trials"][0]
    for row, source in zip(cells[:2], ("measured", "truth"), strict=True):
        m = trial[source]
        keys = (("fx_N", 3), ("fy_N", 3), ("tau_Nmm", 2), ("x_mm", 3), ("y_mm", 3), ("theta_deg", 3))
        assert row[-6:] == [f"{m[k]['mean']:.{d}f} ± {m[k]['std']:.{d}f}" for k, d in keys]
        assert row[-7] == source


def test_figures_of_the_paper_stand_beside_where_they_are_given(extrinsic, find_cells):
    cells = find_cells(render(extrinsic), "errors")
    assert "1.260 ± 0.980" in cells[0]
    assert "0.310 ± 0.320" in cells[0]
    assert "1.260 ± 0.980" not in cells[1]


def test_extrinsic_column_appears_only_with_an_extrinsic_object(grasped, extrinsic):
    assert "extrinsic object <span" not in render(grasped)
    assert "extrinsic object <span" in render(extrinsic)


@pytest.mark.parametrize(
    ("status", "trials", "level", "words"),
    [
        ("completed", ["completed", "completed"], "completed", "2 of 2 trials completed"),
        ("completed", ["completed", "slipped"], "short", "1 of 2 trials completed"),
        ("completed", ["infeasible"], "short", "0 of 1 trial completed"),
        ("fell_short", ["completed"], "short", "1 of 1 trial completed"),
        ("completed", ["device_failed"], "aborted", "device failed"),
        ("stopped", ["stopped"], "aborted", "stopped"),
        ("interrupted", [], "aborted", "no trial was executed"),
        ("running", ["completed"], "aborted", "cut off while it was running"),
        ("infeasible", [], "aborted", "infeasible"),
        ("completed", [], "completed", "no trial was executed"),
        (None, ["completed"], "aborted", "does not say how the run ended"),
    ],
)
def test_verdict_follows_the_run_and_its_worst_trial(status, trials, level, words):
    found = summary.verdict({"status": status, "trials": [{"status": s} for s in trials]})
    assert found.level == level
    assert words in found.detail


def test_verdict_gives_the_reason_of_an_abort(aborted):
    assert "arm: read: no reading within 1 s" in summary.verdict(aborted["results"]).detail


def test_header_names_seed_station_profile_and_git(grasped):
    assert dict(summary.facts(grasped)) == {
        "Experiment": "grasped_pivoting", "Station": "sim", "Profile": "ideal", "Seed": "7", "Git": "25914cc0a7d2",
        "Created": "2025-11-22T01:40:00Z",
    }  # fmt: skip


def test_seed_zero_is_a_seed_and_local_changes_are_told():
    facts = dict(summary.facts({"results": {"seed": 0, "provenance": {"git": {"commit": "a" * 40, "dirty": True}}}}))
    assert facts["Seed"] == "0"
    assert facts["Git"] == "a" * 12 + " (with local changes)"
    assert facts["Station"] == "not recorded"


@pytest.mark.parametrize(
    "gone", ["results", "trials", "objects", "grasp", "log", "events", "title", "created", "paper"]
)
def test_page_renders_without_any_one_part(editable, gone):
    del editable[gone]
    assert "</html>" in render(editable)
    editable[gone] = None
    assert "</html>" in render(editable)


def test_empty_run_says_what_there_is_not(empty):
    page = render(empty)
    for words in ("No trial was executed", "nothing to play back", "no traces", "no log", "No event"):
        assert words in page
    assert page.count("<script") == 1  # the theme's
    assert len(page) < 100_000


def test_nothing_at_all_is_still_a_report():
    assert "does not say how the run ended" in render({})


def test_something_that_is_no_mapping_is_refused():
    with pytest.raises(TypeError, match=r"expected a mapping with results.*got list"):
        render([])  # pyright: ignore[reportArgumentType]


def test_aborted_run_tells_of_its_torn_log_and_its_losses(aborted, find_cells):
    page = render(aborted)
    assert "not closed in order: torn at byte 4096: no footer." in page
    assert '<dd class="bad">12</dd>' in page
    assert find_cells(page, "errors")[0][-4:] == ["–"] * 4


def test_log_reports_size_per_trial_and_mean_rates():
    log = summary.log_summary({"bytes": 6_000_000, "seconds": 20.0, "messages": {"a": 2000, "b": 100}, "lost": 0}, 3)
    assert log is not None
    assert log["per_trial"] == "2.00 MB"
    assert log["topics"] == [("a", "2,000", "100.0"), ("b", "100", "5.0")]
    assert log["total"] == "2,100"


@pytest.mark.parametrize(
    "log", [None, {}, {"file": "log.mcap", "bytes": 0, "messages": {}, "ending": "there is no log"}]
)
def test_no_log_is_told_as_no_log(log):
    assert summary.log_summary(log, 0) is None


@pytest.mark.parametrize(("log", "torn"), [({}, False), ({"ending": "complete"}, False), ({"torn": True}, True)])
def test_only_a_log_that_broke_off_is_called_so(log, torn):
    found = summary.log_summary({"bytes": 1, "messages": {"a": 1}, **log}, 1)
    assert found is not None
    assert bool(found["torn"]) is torn


HOSTILE = '</script><script>window.harmed = 1</script><img src=x onerror="window.harmed = 1">&amp;'


def test_names_cannot_break_out_of_the_page(editable):
    for trial in (*editable["trials"], *editable["results"]["trials"]):
        trial.update(name=HOSTILE, skill=HOSTILE, controller=HOSTILE, reason=HOSTILE, status=HOSTILE)
    editable["title"] = editable["created"] = HOSTILE
    editable["objects"]["go"]["name"] = editable["log"]["file"] = editable["results"]["station"] = HOSTILE
    editable["events"] = [{"t": 0.0, "level": HOSTILE, "text": HOSTILE}]
    editable["results"]["provenance"] = {HOSTILE: HOSTILE}
    editable["results"]["calibration"] = {HOSTILE: [HOSTILE]}
    editable["log"]["messages"] = {HOSTILE: 3}
    page = render(editable)
    assert "window.harmed = 1</script>" not in page
    assert "<img" not in page
    assert carried(page)["trials"][0]["name"] == HOSTILE


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)
    )
)
def test_encoded_data_is_json_without_markup_or_nan(value):
    text = payload.encode(payload.clean(value))
    assert not set(text) & set("<>&\u2028\u2029")
    assert json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON")) == payload.clean(value)


def test_arrays_and_numpy_numbers_are_taken(editable):
    plain = render(editable)
    for trial in editable["trials"]:
        for part in ("planned", "measured", "truth"):
            series = trial["waypoints"][part]
            trial["waypoints"][part] = {k: None if v is None else np.array(v) for k, v in series.items()}
        trial["playback"]["t"] = np.array(trial["playback"]["t"])
    editable["grasp"] = np.array(editable["grasp"])
    editable["results"]["seed"] = np.int64(editable["results"]["seed"])
    assert render(editable) == plain


def test_not_finite_poses_become_holes(editable):
    editable["trials"][0]["waypoints"]["measured"]["go"][3] = [0.1, math.nan, 0.2]
    editable["trials"][0]["playback"]["ee"][5] = [math.inf, 0.0, 0.0]
    trial = carried(render(editable))["trials"][0]
    assert trial["waypoints"]["measured"]["go"][3] is None
    assert trial["waypoints"]["measured"]["go"][2] is not None
    assert trial["playback"]["ee"][5] is None


def test_waypoints_that_were_not_reached_follow_at_the_usual_step(aborted):
    way = payload.build(aborted)["trials"][0]["waypoints"]
    assert way["reached"] == [True] * 6 + [False] * 14
    np.testing.assert_allclose(way["t"], 5.0 + 0.6 * np.arange(20), atol=1e-6)


def test_without_a_recording_the_waypoints_are_played(editable):
    trial = editable["trials"][0]
    trial["playback"] = None
    playback = payload.build(editable)["trials"][0]["playback"]
    assert playback["source"] == "truth, waypoints only"
    assert playback["t"] == pytest.approx(trial["waypoints"]["t"])
    trial["waypoints"].update(truth=None, measured=None)
    playback = payload.build(editable)["trials"][0]["playback"]
    assert playback["source"] == "planned, waypoints only"
    assert len(playback["contacts"][0]) == 1


def test_frames_are_put_in_the_order_of_time():
    run = {"trials": [{"playback": {"t": [0.2, None, 0.0, 0.1], "go": [[2, 0, 0], [9, 0, 0], [0, 0, 0], [1, 0, 0]],
                                    "phase": ["b", "x", "a", "a"]}}]}  # fmt: skip
    playback = payload.build(run)["trials"][0]["playback"]
    assert playback["t"] == [0.0, 0.1, 0.2]
    assert [pose[0] for pose in playback["go"]] == [0, 1, 2]
    assert playback["phases"] == [["a", 0.0, 0.2], ["b", 0.2, 0.2]]


def test_phases_are_the_runs_of_equal_labels(grasped):
    phases = payload.build(grasped)["trials"][0]["playback"]["phases"]
    assert [name for name, _, _ in phases] == ["approach", "preload", "trajectory", "unload", "retreat"]
    assert [end for _, _, end in phases[:-1]] == [start for _, start, _ in phases[1:]]


def test_a_forty_step_trial_stays_under_8_mb(make_run, make_trial):
    assert len(render(make_run([make_trial(steps=40, eo=True)], eo=True)).encode()) < 8e6


def test_many_long_trials_are_thinned_to_stay_under_8_mb(make_run, make_trial):
    trial = make_trial(steps=40, eo=True)
    count = len(trial["playback"]["t"])
    page = render(make_run([trial] * 40, eo=True))
    playback = carried(page)["trials"][-1]["playback"]
    assert len(page.encode()) < 8e6
    assert playback["recorded"] == count
    assert 100 < len(playback["t"]) < count
    assert playback["t"][0] == trial["playback"]["t"][0]
    assert playback["t"][-1] == trial["playback"]["t"][-1]
    assert len(playback["t"]) == len(playback["ee"]) == len(playback["eo"]) == len(playback["contacts"])


def test_traces_are_labelled_and_scaled_in_the_units_of_the_paper(grasped):
    figure = traces.figure(payload.build(grasped)["trials"][0])
    assert figure is not None
    assert [a["text"] for a in figure["layout"]["annotations"]] == [
        "go x [mm]", "go y [mm]", "go θ [deg]", "ee x [mm]", "ee y [mm]", "ee θ [deg]", "fx [N]", "fy [N]", "τ [N·mm]",
    ]  # fmt: skip
    planned = [t["meta"] for t in figure["data"] if t["meta"]["role"] == "planned"]
    assert [(m["series"], m["component"]) for m in planned] == [
        (s, c) for s in ("go", "ee", "wrench") for c in range(3)
    ]
    assert [m["factor"] for m in planned] == pytest.approx([1e3, 1e3, 57.29578] * 2 + [1, 1, 1e3])
    low, high = figure["layout"]["yaxis3"]["range"]
    assert low < 10.0
    assert high > 35.0


def test_figures_are_figures_to_plotly(grasped, extrinsic):
    from plotly.graph_objects import Figure

    for run in (grasped, extrinsic):
        figure = traces.figure(payload.build(run)["trials"][0])
        assert figure is not None
        data = [{**traces.styles()[trace["meta"]["role"]], **trace} for trace in figure["data"]]
        Figure(data=data, layout=figure["layout"])  # refuses what it does not know


def test_panels_of_a_figure_do_not_overlap(extrinsic):
    layout = traces.figure(payload.build(extrinsic)["trials"][0])["layout"]  # pyright: ignore[reportOptionalSubscript]
    columns = [layout[f"xaxis{n}"]["domain"] for n in ("", "2", "3")]
    rows = [layout[f"yaxis{n}"]["domain"] for n in ("10", "7", "4", "")]
    for domains in (columns, rows):
        edges = [edge for domain in domains for edge in domain]
        assert edges == sorted(edges)
        assert edges[0] == pytest.approx(0, abs=1e-5)
        assert edges[-1] == pytest.approx(1, abs=1e-5)


def test_measured_angles_are_drawn_on_the_turn_of_the_plan():
    planned, measured = [[0, 0, 3.1], [0, 0, 3.2]], [[0, 0, 3.1], [0, 0, -3.08]]
    way = {"t": [0.0, 1.0], "planned": {"go": planned}, "measured": {"go": measured}}
    found = payload.build({"trials": [{"waypoints": way}]})["trials"][0]["waypoints"]["measured"]["go"]
    assert found[0][2] == 3.1
    assert found[1][2] == pytest.approx(2 * math.pi - 3.08, abs=1e-6)


def test_a_flat_trace_keeps_an_axis_wide_enough_to_look_flat():
    way = {"t": [0.0, 1.0], "planned": {"go": [[0, 0, 0], [1e-7, 0, 0]]}}
    figure = traces.figure(payload.build({"trials": [{"waypoints": way}]})["trials"][0])
    assert figure is not None
    low, high = figure["layout"]["yaxis"]["range"]
    assert high - low >= 1.0


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a, b):
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["style.css", "dark.css"], ids=["light", "dark"])
def test_colours_meet_wcag_contrast(scheme):
    css = (files("experiments.report") / scheme).read_text()
    block = re.findall(r":root \{(.*?)\}", css, re.DOTALL)[0]
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block))
    for name in ("ink", "muted", "link", "completed", "short", "aborted"):  # text: AA
        assert contrast(colours[name], colours["page"]) >= 4.5, name  # the page's and, of a control, the panel's ground
        assert contrast(colours[name], colours["panel"]) >= 4.5, name
    for name in ("stick", "slip", "free", "wrench", "planned", "measured", "truth", "finger", "ground"):  # graphics
        assert contrast(colours[name], colours["page"]) >= 3.0, name
    for body in ("go", "eo"):
        assert contrast(colours[f"{body}-edge"], colours["page"]) >= 3.0
        for mark in ("ink", "stick", "slip", "wrench"):
            assert contrast(colours[mark], colours[body]) >= 3.0, (mark, body)


def test_an_object_that_slipped_in_the_fingers_is_told_with_its_trial_and_in_the_verdict():
    slid = {"name": "a", "status": "completed", "finger_slip": {"detected": True, "reason": "waypoint 7: it slipped"}}
    held = {"name": "b", "status": "completed", "finger_slip": {"detected": False, "reason": ""}}
    results = {"status": "done", "trials": [slid, held]}
    assert [row["reason"] for row in summary.error_table(results)["rows"]] == ["waypoint 7: it slipped", ""]
    assert "2 of 2 trials completed, in 1 of them the object slipped in the fingers" in summary.verdict(results).detail
    assert summary.verdict({"status": "done", "trials": [held]}).detail == "1 of 1 trial completed."
