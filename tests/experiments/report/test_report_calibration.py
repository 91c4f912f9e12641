"""Calibrations in the report: the paper's two figures, a table of all that was known, and what a bad file does."""

import json
import math
import re

import numpy as np
import pytest
from plotly.graph_objects import Figure

from experiments.calibrate.models import ElasticityCalibration, FrictionCalibration
from experiments.report import calibration, calibration_table, payload, render
from experiments.report.build import build_report
from experiments.run_folder import RunFolder

ELASTICITY, FRICTION = "elasticity-soft_bubble-tall_box", "friction-tall_box-ground"
HOSTILE = '</script><script>window.harmed = 1</script><img src=x onerror="window.harmed = 1">&amp;'


def model(kind, run, name):
    return kind.model_validate({k: v for k, v in run["results"]["calibration"][name].items() if k != "file"})


def drawn(page):
    """What the page carries of calibration figures."""
    text = re.search(r'<script type="application/json" id="drawings">(.*?)</script>', page, re.DOTALL)
    return json.loads(text.group(1))["figures"] if text else []


def of_role(figure, role, panel=""):
    return next(t for t in figure["data"] if t["meta"]["role"] == role and t["xaxis"] == f"x{panel}")


def columns(*rows) -> dict[str, np.ndarray]:
    names: tuple[str, ...] = ("x", "y", "theta", "fx", "fy", "tau", "fx_fit", "fy_fit", "tau_fit")
    return dict(zip(names, np.array(rows, float).T, strict=True))


def test_displacement_stands_against_wrench_in_the_units_of_the_paper(calibrated):
    found = model(ElasticityCalibration, calibrated, ELASTICITY)
    quarter_turn = math.pi / 180 / 4
    row = [0.001, -0.002, quarter_turn, 2.5, -3.5, 0.045, 2.25, -3.75, 0.041]
    figure = calibration.elasticity_figure(found, columns(row, [0.0] * 9))
    for panel, across, measured, fitted in (("", 1.0, 2.5, 2.25), ("2", -2.0, -3.5, -3.75), ("3", 0.25, 45.0, 41.0)):
        assert of_role(figure, "measured", panel)["x"][0] == pytest.approx(across)
        assert of_role(figure, "measured", panel)["y"][0] == pytest.approx(measured)
        assert of_role(figure, "fitted", panel)["x"][0] == pytest.approx(across)
        assert of_role(figure, "fitted", panel)["y"][0] == pytest.approx(fitted)
    axes = [figure["layout"][f"xaxis{n}"]["title"]["text"] for n in ("", "2", "3")]
    assert axes == ["x [mm]", "y [mm]", "θ [deg]"]
    assert [a["text"] for a in figure["layout"]["annotations"]] == ["fx [N]", "fy [N]", "τ [N·mm]"]


def test_the_line_in_each_panel_has_the_slope_of_the_paper_s_stiffness(calibrated):
    found = model(ElasticityCalibration, calibrated, ELASTICITY)
    figure = calibration.elasticity_figure(found, columns([-0.001] * 3 + [0.0] * 6, [0.002] * 3 + [0.0] * 6))
    # K_bubbles of the paper, its third row and column over a length of 44.8 mm
    slopes = (2.20896, 1.87592, 1608.49 * 0.0448**2 * 1e3 * math.pi / 180)
    for panel, slope in zip(("", "2", "3"), slopes, strict=True):
        line = of_role(figure, "stiffness", panel)
        assert np.diff(line["y"])[0] / np.diff(line["x"])[0] == pytest.approx(slope, rel=2e-3)
        assert line["y"][0] / line["x"][0] == pytest.approx(slope, rel=2e-3)  # through zero


def test_the_caption_tells_how_far_the_fitted_points_lie_from_the_measured(calibrated, make_samples):
    samples = make_samples(noise=0.0)
    for name, shift in (("fx", 0.25), ("fy", -0.5), ("tau", 0.012)):
        samples[name] = samples[f"{name}_fit"] + shift
    calibrated["calibration"]["samples"][ELASTICITY] = samples
    assert "<dd>0.25\u00a0N, 0.5\u00a0N, 12\u00a0N·mm</dd>" in render(calibrated)


def test_the_matrix_is_printed_in_si_with_one_sigma(calibrated):
    page = render(calibrated)
    table = re.search(r'<table class="matrix">(.*?)</table>', page, re.DOTALL)
    assert table is not None
    text = [
        re.sub(r"<[^>]*>", "", cell).strip() for cell in re.findall(r"<t[dh].*?</t[dh]>", table.group(1), re.DOTALL)
    ]
    assert text == [
        *("K ± 1σ", "x [m]", "y [m]", "θ [rad]"),
        *("fx [N]", "2209.0 ± 9.4", "−143.3 ± 6.2", "17.91 ± 0.31"),
        *("fy [N]", "−143.3 ± 6.2", "1875.9 ± 8.8", "−14.05 ± 0.28"),
        *("τ [N·m]", "17.91 ± 0.31", "−14.05 ± 0.28", "3.228 ± 0.021"),
    ]


def test_forces_stand_in_their_cone_at_one_scale(calibrated):
    found = model(FrictionCalibration, calibrated, FRICTION)
    figure = calibration.friction_figure(found, {"f_n": [1.0, 4.0], "f_t": [0.25, -1.5]})
    points = of_role(figure, "measured")
    assert (points["x"], points["y"]) == ([0.25, -1.5], [1.0, 4.0])
    cone = of_role(figure, "cone")
    assert (cone["x"][1], cone["y"][1]) == (0.0, 0.0)
    for end, side in ((0, -1), (2, 1)):
        assert cone["x"][end] / cone["y"][end] == pytest.approx(side * 0.33, abs=1e-4)
        assert cone["y"][end] >= 4.0
    bands = [t for t in figure["data"] if t["meta"]["role"] == "interval"]
    ratios = sorted(x / y for t in bands for x, y in zip(t["x"], t["y"], strict=True) if y)
    assert ratios == pytest.approx([-0.34, -0.32, 0.32, 0.34], abs=1e-4)
    assert figure["layout"]["xaxis"]["scaleanchor"] == "y"


def test_figures_are_figures_to_plotly(calibrated):
    figures = drawn(render(calibrated))
    assert len(figures) == 4
    styles = calibration.styles()
    for figure in figures:
        Figure(data=[{**styles[t["meta"]["role"]], **t} for t in figure["data"]], layout=figure["layout"])


def test_all_points_lie_within_their_axes(calibrated):
    for figure in drawn(render(calibrated)):
        for trace in figure["data"]:
            if trace["meta"]["role"] not in ("measured", "fitted"):
                continue
            for axis in "xy":
                low, high = figure["layout"][trace[f"{axis}axis"].replace(axis, f"{axis}axis")]["range"]
                assert low < min(trace[axis])
                assert max(trace[axis]) < high


def test_of_very_many_samples_some_are_drawn_and_all_are_counted(calibrated):
    many = 50_000
    calibrated["calibration"]["samples"][FRICTION] = {"f_n": np.full(many, 3.0), "f_t": np.linspace(-1, 1, many)}
    calibrated["results"]["calibration"][FRICTION]["samples"] = many
    page = render(calibrated)
    points = of_role(drawn(page)[1], "measured")
    assert len(points["x"]) == 2000
    assert (points["x"][0], points["x"][-1]) == (-1.0, 1.0)
    assert "50,000 (2,000 drawn) samples" in page
    assert len(page.encode()) < 8e6


def test_playback_gives_way_to_the_figures(grasped):
    assert len(payload.build(grasped)["trials"][0]["playback"]["t"]) == len(grasped["trials"][0]["playback"]["t"])
    playback = payload.build(grasped, reserved=payload.BUDGET - 60_000)["trials"][0]["playback"]
    assert len(playback["t"]) < playback["recorded"]


def test_rows_that_hold_no_numbers_are_left_out(calibrated):
    calibrated["calibration"]["samples"][FRICTION] = {
        "f_n": [1.0, math.nan, 3.0, 2.0],
        "f_t": [0.1, 0.2, math.inf, 0.4],
    }
    assert of_role(drawn(render(calibrated))[1], "measured")["y"] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("value", "sigma", "text"),  # two digits of the deviation, as the GUM recommends (7.2.6)
    [
        (2579.168, 12.178, "2579 ± 12"),
        (-158.618, 7.0027, "−158.6 ± 7.0"),
        (3.66258, 0.019062, "3.663 ± 0.019"),
        (0.0512, 0.0816, "0.051 ± 0.082"),
        (1.0, 0.0996, "1.00 ± 0.10"),
        (12345.6, 1234.5, "12346 ± 1234"),
        (0.33, 0.0, "0.33"),
        (1e300, 1e299, "1e+300 ± 1e+299"),
    ],
)
def test_a_figure_is_as_long_as_it_is_known(value, sigma, text):
    assert calibration_table.plus_minus(value, sigma) == text


def test_every_calibration_is_a_row_with_its_file_and_date(calibrated, find_cells):
    cells = find_cells(render(calibrated), "calibrations")
    assert [row[:3] for row in cells] == [
        ["Elasticity soft_bubble on tall_box", "Kxx 2209.0 ± 9.4 N/m Kyy 1875.9 ± 8.8 N/m Kθθ 3.228 ± 0.021 N·m/rad",
         "200 samples, residual 0.08 N, 0.07 N, 3 N·mm"],
        ["Friction tall_box on ground", "µ 0.330 [0.320, 0.340]", "400 samples"],
        ["Friction tall_box on hbox", "µ 0.520 [0.490, 0.550]", "400 samples"],
        ["Friction hbox on ground", "µ 0.2100 [0.2050, 0.2150]", "400 samples"],
        ["Tool on the wrist sensor wrist_ft", "mass 1.2034 ± 0.0021 kg centrex 1.20 ± 0.30 mm centrey 64.10 ± 0.40 mm",
         "9 samples, residual 0.031 N; centre in ee"],
        ["Camera camera", "focal length 1400.5 ± 1.3 px", "24 views, residual 0.21 px"],
        ["Tag on the object tag 3 on tall_box", "x 0.40 ± 0.11 mm y 20.10 ± 0.12 mm θ 0.50 ± 0.10 deg", ""],
        ["Clocks", "camera 12.1 ± 1.1 ms wrist 2.13 ± 0.54 ms", "delay behind the arm's stamps"],
    ]  # fmt: skip
    assert {row[3] for row in cells} == {"2025-11-20 08:15 UTC in this run"}
    assert cells[-1][4] == "calibrations/lab-1/clock.yaml"


def test_a_calibration_that_was_only_used_is_a_row_without_a_figure(grasped, find_cells):
    page = render(grasped)
    assert find_cells(page, "calibrations")[0][3] == "2025-11-20 08:15 UTC run calibrate-20251120T080000"
    assert 'class="calibration-plot"' not in page
    assert "could not be drawn" not in page


def test_what_was_not_calibrated_is_called_nominal(editable, find_cells):
    editable["calibration"] = {
        "nominal": [
            {
                "name": ELASTICITY,
                "kind": "elasticity",
                "of": "soft_bubble on tall_box",
                "figures": [2209.0, 1876.0, 3.2],
            },
            {"name": FRICTION, "kind": "friction", "of": "tall_box on ground", "figures": [0.9]},
            {"name": "camera", "kind": "camera"},
        ]
    }
    elasticity, friction, camera = find_cells(render(editable), "calibrations")
    assert elasticity[1:] == [
        "Kxx 2209 N/m Kyy 1876 N/m Kθθ 3.2 N·m/rad", "nominal: as the sensor's description says", "", "",
    ]  # fmt: skip
    assert friction[2] == "400 samples"  # this one was calibrated
    assert camera[2] == "nominal: as the camera describes itself"


def test_a_page_that_only_calibrates_has_a_verdict_and_no_player(calibrated):
    page = render(calibrated)
    assert "<strong>Completed</strong> 8 calibrations were made." in page
    for words in ("No trial", "playback", "Errors", "no traces", 'id="scene"', 'id="data"'):
        assert words not in page


@pytest.mark.parametrize(("made", "words"), [([], "no calibration was made"), (["clock"], "1 calibration was made")])
def test_a_calibration_that_found_no_answer_falls_short(calibrated, made, words):
    run = calibrated["results"]
    run["calibration"] = {name: run["calibration"][name] for name in made}
    run.update(status="fell_short", reason="the calibration found no answer: friction")
    calibrated["calibration"].update(made=made, samples={})
    assert f"<strong>Fell short</strong> {words}: the calibration found no answer: friction." in render(calibrated)


def test_a_run_that_should_have_had_trials_says_that_it_had_none(calibrated):
    calibrated["calibration"]["only"] = False
    page = render(calibrated)
    assert "no trial was executed" in page
    assert "nothing to play back" in page


def test_what_this_version_cannot_read_is_shown_as_it_is(calibrated, find_cells):
    known = calibrated["results"]["calibration"]
    known["clock"]["delays"]["wrist"]["delay"] = "late"
    known["gravimeter"] = {"kind": "gravimeter", "g": 9.80665}
    known["stiffness"] = [[1.0]]
    known["camera"]["camera"]["width"] = None
    rows = {row[0]: row for row in find_cells(render(calibrated), "calibrations")}
    for name in ("clock", "gravimeter", "stiffness", "camera"):
        assert rows[name][2] == "no calibration that this version can read"
    assert "delays.wrist.delaylate" in rows["clock"][1]
    assert "9.80665" in rows["gravimeter"][1]


@pytest.mark.parametrize("size", [1e-300, 1e300])
def test_figures_beyond_any_scale_do_not_break_the_page(calibrated, size):
    known = calibrated["results"]["calibration"]
    known[ELASTICITY].update(stiffness=(size * np.eye(3)).tolist(), residual=[size] * 3, stiffening=size, chi2=size)
    known[FRICTION]["interval"] = [-size, size]
    known["force_torque"].update(tool_mass=size, deviation=[size] * 3)
    known["clock"]["origin"]["made"] = "0001-01-01T00:00:00+14:00"
    assert "</html>" in render(calibrated)


def test_names_cannot_break_out_of_the_page(calibrated):
    run, known = calibrated["calibration"], calibrated["results"]["calibration"]
    for entry in known.values():
        entry["file"] = HOSTILE
        entry["origin"].update(run=HOSTILE, objects=dict.fromkeys(("go", "eo"), HOSTILE))
    known[ELASTICITY].update(sensor=HOSTILE, method=HOSTILE)
    known["camera"]["device"] = known["force_torque"]["device"] = HOSTILE
    known["clock"]["delays"] = {HOSTILE: {"delay": 0.0, "deviation": 1.0}}
    known[HOSTILE] = {"kind": HOSTILE, HOSTILE: [HOSTILE]}
    known[HOSTILE + "2"] = {**known[FRICTION]}
    run["samples"][HOSTILE + "2"] = HOSTILE
    run["samples"][FRICTION][HOSTILE] = [HOSTILE]
    run["nominal"] = [{"name": HOSTILE + "3", "kind": HOSTILE, "of": HOSTILE}]
    page = render(calibrated)
    assert "window.harmed = 1</script>" not in page
    assert "<img" not in page
    assert "harmed" not in json.dumps(drawn(page))
    assert "&lt;img" in page


def write(folder, calibrated, files):
    """A run folder that only calibrated, with ``files`` in its ``calibration/``."""
    (folder / "calibration").mkdir()
    stages = "stages: [{stage: calibrate_elasticity}, {stage: calibrate_friction, pair: go-ground}]"
    (folder / "experiment.yaml").write_text(f"name: calibrate\ngrasped_object: tall_box\n{stages}\n")
    results = calibrated["results"]
    results["calibration"] = {name: results["calibration"][name] for name in (ELASTICITY, FRICTION)}
    (folder / "results.json").write_text(json.dumps(results))
    for name, content in files.items():
        (folder / "calibration" / name).write_bytes(content)
    build_report(RunFolder.open(folder))
    return (folder / "report.html").read_text()


def test_a_run_folder_shows_its_samples_and_what_else_it_took_for_true(tmp_path, calibrated, find_cells):
    csv = b"f_n,f_t\n2.0,0.5\n3.0,-0.75\n"
    before = f"{FRICTION}.20251119T091500.yaml"  # made in the same run, and replaced
    page = write(tmp_path, calibrated, {f"{FRICTION}.csv": csv, f"{FRICTION}.yaml": b"", before: b""})
    (figure,) = drawn(page)
    assert of_role(figure, "measured")["x"] == [0.5, -0.75]
    assert "1 calibration was made" in page
    rows = find_cells(page, "calibrations")
    assert [row[3] for row in rows[:2]] == [
        "2025-11-20 08:15 UTC run calibrate-20251120T080000", "2025-11-20 08:15 UTC in this run",
    ]  # fmt: skip
    assert [row[2].split(":")[0] for row in rows[2:]] == ["nominal"] * 4


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "it is missing"),
        (b"", "no table of numbers"),
        (b"\xff\xfe\x00garbage\x00", "no table of numbers"),
        (b"f_n,f_t\n1.0\n2.0,3.0\n", "no table of numbers"),
        (b"f_n,f_t\n1.0,<b>\n", "no table of numbers"),
        (b"f_n,f_t\n", "no row of it holds numbers"),
        (b"f_n,f_t\nnan,nan\n", "no row of it holds numbers"),
        (b"time,f_n\n1.0,2.0\n", "no column f_t"),
    ],
)
def test_a_bad_file_of_samples_is_left_out_and_said(tmp_path, calibrated, make_samples, content, said):
    samples = make_samples()
    good = ",".join(samples) + "\n" + "\n".join(",".join(map(str, row)) for row in zip(*samples.values(), strict=True))
    files = {f"{ELASTICITY}.csv": good.encode(), f"{ELASTICITY}.yaml": b"", f"{FRICTION}.yaml": b""}
    if content is not None:
        files[f"{FRICTION}.csv"] = content
    page = write(tmp_path, calibrated, files)
    assert len(drawn(page)) == 1
    (problem,) = re.findall(r'<p class="warning">(.*?)</p>', page)
    assert problem.startswith(f"{FRICTION}.csv could not be drawn: ")
    assert said in problem
