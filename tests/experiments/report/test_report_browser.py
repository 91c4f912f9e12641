"""The page in a browser: it is quiet, it asks for nothing, it moves, and what it shows are the numbers it was given."""

import math

import numpy as np
import pytest

from tests.experiments.chromium import assert_quiet_and_within
from tests.experiments.report.pages import (
    draw_calibrations,
    draw_traces,
    expect_pose,
    pose,
    seek,
    wait_until,
)


@pytest.fixture(scope="module")
def page(show, grasped):
    return show(grasped)


@pytest.fixture(scope="module")
def traced(show, grasped):
    """The report of the grasped run with its traces drawn; tests leave trial and view as they choose."""
    page = show(grasped)
    draw_traces(page)
    return page


@pytest.mark.parametrize(
    ("name", "width", "scheme"),
    [
        ("grasped", 1280, "dark"),
        ("extrinsic", 1280, "light"),
        ("extrinsic", 800, "dark"),
        ("aborted", 800, "light"),
        ("empty", 800, "dark"),
    ],
)
def test_the_page_is_quiet_asks_for_nothing_and_fits(request, show, name, width, scheme):
    page = show(request.getfixturevalue(name), width, scheme)
    if name != "empty":
        draw_traces(page)
        page.locator("#play").click()
        wait_until(page, "Player.time > 5.05")
        page.locator("#play").click()
    for i in range(page.locator("details").count()):
        page.locator("details summary").nth(i).click()
    assert_quiet_and_within(page, width)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (800, "dark")])
def test_a_page_that_only_calibrates_is_quiet_and_fits(show, calibrated, width, scheme):
    page = show(calibrated, width, scheme)
    draw_calibrations(page)
    assert page.locator(".calibration-plot").count() == 4
    assert_quiet_and_within(page, width)
    paper = {"light": "#ffffff", "dark": "#14171a"}
    for plot in page.locator(".calibration-plot").all():
        assert plot.evaluate("plot => plot.layout.paper_bgcolor") == paper[scheme]
        names = plot.locator(".legendtext").all_text_contents()
        boxes = [text.bounding_box() for text in plot.locator(".legendtext, .annotation-text").all()]
        assert names
        assert len({round(box["y"]) for box in boxes[: len(names)]}) == 1  # the legend is one line, and no title in it
        assert boxes[0]["y"] + boxes[0]["height"] <= boxes[-1]["y"] + 1
    other = "dark" if scheme == "light" else "light"
    page.emulate_media(color_scheme=other)
    wait_until(page, f"document.querySelector('.calibration-plot').layout.paper_bgcolor === '{paper[other]}'")


def test_forces_on_screen_stand_at_the_angle_of_their_cone(show, calibrated):
    page = show(calibrated)
    draw_calibrations(page)
    for plot, mu in zip(page.locator("figure.friction").all(), (0.33, 0.52, 0.21), strict=True):
        path = plot.locator(".trace path.js-line").last.get_attribute("d")
        (x0, y0), (x1, y1) = [[float(v) for v in point.split(",")] for point in path[1:].split("L")[:2]]
        assert abs((x1 - x0) / (y1 - y0)) == pytest.approx(mu, rel=0.02)


def test_on_paper_calibrations_are_drawn_without_scrolling(show, calibrated):
    page = show(calibrated)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    for plot in page.locator(".calibration-plot").all():
        assert plot.locator(".scatterlayer .trace").count() > 0
        assert plot.evaluate("plot => plot.layout.width") <= 680
    assert page.locator("details:not([open])").count() == 0
    assert page.heard == []


def test_the_slider_moves_the_scene(page, grasped):
    playback = grasped["trials"][0]["playback"]
    for index in (0, 70, 200, len(playback["t"]) - 1):
        seek(page, playback["t"][index])
        expect_pose(page, "go", playback["go"][index])
        expect_pose(page, "ee", playback["ee"][index])


def test_between_two_frames_the_pose_lies_between(page, grasped):
    playback = grasped["trials"][0]["playback"]
    seek(page, (playback["t"][200] + playback["t"][201]) / 2)
    expect_pose(page, "go", (np.array(playback["go"][200]) + np.array(playback["go"][201])) / 2)


def test_error_table_on_screen_equals_the_results(page, grasped):
    for row, trial in zip(page.locator("#errors tbody tr").all(), grasped["results"]["trials"], strict=True):
        shown = [cell.inner_text() for cell in row.locator("td.number").all()]
        means = [trial[s][k]["mean"] for k in ("go_pose_mm", "wrench_N") for s in ("measured", "truth")]
        stds = [trial[s][k]["std"] for k in ("go_pose_mm", "wrench_N") for s in ("measured", "truth")]
        assert shown == [f"{mean:.3f} ± {std:.3f}" for mean, std in zip(means, stds, strict=True)]


def test_read_out_gives_the_waypoint_in_the_units_of_the_paper(page, grasped):
    way = grasped["trials"][0]["waypoints"]
    seek(page, way["t"][7])
    rows = {}
    series = ""
    for row in page.locator("#values tbody tr").all():
        heads = [head.inner_text() for head in row.locator("th").all()]
        series = heads[0] or series
        rows[series, heads[1]] = [float(c.inner_text().replace("−", "-")) for c in row.locator("td").all()]
    for column, source in enumerate(("planned", "measured", "truth"), start=1):
        x, y, theta = way[source]["go"][7]
        assert rows["go", "x [mm]"][column] == pytest.approx(x * 1e3, abs=0.006)
        assert rows["go", "y [mm]"][column] == pytest.approx(y * 1e3, abs=0.006)
        assert rows["go", "θ [deg]"][column] == pytest.approx(math.degrees(theta), abs=0.006)
        fx, fy, tau = way[source]["wrench"][7]
        assert rows["wrench", "fx [N]"][column] == pytest.approx(fx, abs=0.0006)
        assert rows["wrench", "fy [N]"][column] == pytest.approx(fy, abs=0.0006)
        assert rows["wrench", "τ [N·mm]"][column] == pytest.approx(tau * 1e3, abs=0.06)


def test_compliance_is_the_pose_of_ee_in_gocf(page, grasped):
    playback, grasp = grasped["trials"][0]["playback"], np.array(grasped["grasp"])
    seek(page, playback["t"][220])
    go, ee = np.array(playback["go"][220]), np.array(playback["ee"][220])
    c, s = math.cos(go[2]), math.sin(go[2])
    R = np.array([[c, -s], [s, c]])
    x, y = R.T @ (ee[:2] - (go[:2] + R @ grasp[:2])) * 1e3
    shown = page.locator("#offset").text_content().replace("−", "-")
    assert shown == f"x {x:.2f} mm · y {y:.2f} mm · θ {math.degrees(ee[2] - go[2]):.2f}°"


def test_the_ghost_is_the_plan_at_the_waypoint_under_way(page, grasped):
    way = grasped["trials"][0]["waypoints"]
    seek(page, way["t"][4] + 0.2)
    shown = page.locator(".ghost-go").get_attribute("transform")
    x, y, _ = way["planned"]["go"][5]
    assert [float(v) for v in shown[len("translate(") : shown.index(")")].split()] == pytest.approx([x, y], abs=1e-6)
    page.locator("#show-plan").uncheck()
    assert not page.locator(".ghost-go").is_visible()
    page.locator("#show-plan").check()
    assert page.locator(".ghost-go").is_visible()


def colour(node):
    return [int(v) for v in node.evaluate("n => getComputedStyle(n).fill").removeprefix("rgb(").rstrip(")").split(",")]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_sticking_is_red_and_round_slipping_green_and_square(show, extrinsic, scheme):
    page = show(extrinsic, scheme=scheme)
    seek(page, 8.0)
    stick, slip = page.locator("#scene .mode-stick"), page.locator("#scene .mode-slip")
    assert (stick.count(), slip.count()) == (1, 2)
    red, green = colour(stick.first), colour(slip.first)
    assert red[0] > 2 * max(red[1:])
    assert green[1] > 1.5 * max(green[0], green[2])
    assert "A" in stick.first.get_attribute("d")
    assert "A" not in slip.first.get_attribute("d")
    assert page.locator("#contacts li").all_inner_texts()[1:] == ["slip+, 3.01 N"] * 2


def test_contact_markers_and_force_arrows_are_where_the_contacts_are(show, extrinsic):
    page = show(extrinsic)
    seek(page, 8.0)
    found = page.evaluate(
        """() => {
          const numbers = (text) => text.match(/-?[\\d.]+/g).map(Number);
          const all = (selector) => [...document.querySelectorAll(`#scene ${selector}`)];
          return {
            marks: all(".marker").map((node) => numbers(node.getAttribute("transform"))),
            arrows: all(".arrow.contact").map((node) => numbers(node.getAttribute("d"))),
            ground: all(".ground")[0].getBBox().y,
            perMm: all(".scale")[0].getBBox().width / numbers(all(".quiet")[0].textContent)[0],
          };
        }"""
    )
    contacts = extrinsic["trials"][0]["playback"]["contacts"][200]
    marks = np.array(found["marks"])
    points = np.array([c["point"] for c in contacts]) * 1e3
    np.testing.assert_allclose((found["ground"] - marks[:, 1]) / found["perMm"], points[:, 1], atol=0.1)
    np.testing.assert_allclose(np.diff(marks[:, 0]) / found["perMm"], np.diff(points[:, 0]), atol=0.1)
    for contact, mark, outline in zip(contacts, marks, found["arrows"], strict=True):
        tip = np.array(outline[6:8]) - mark
        fx, fy = contact["force"]
        assert math.atan2(-tip[1], tip[0]) == pytest.approx(math.atan2(fy, fx), abs=0.01)
    lengths = [np.hypot(*(np.array(o[6:8]) - m)) for o, m in zip(found["arrows"], marks, strict=True)]
    forces = [np.hypot(*c["force"]) for c in contacts]
    assert lengths[0] / lengths[1] == pytest.approx(forces[0] / forces[1], rel=0.01)


def test_keys_step_through_the_waypoints_and_play(show, grasped):
    page = show(grasped)
    times = grasped["trials"][0]["waypoints"]["t"]
    now = lambda: page.evaluate("Player.time")  # noqa: E731
    assert now() == pytest.approx(times[0])
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert now() == pytest.approx(times[2], abs=1e-5)
    page.keyboard.press("ArrowLeft")
    assert now() == pytest.approx(times[1], abs=1e-5)
    page.keyboard.press(".")
    assert now() == pytest.approx(times[1] + 0.04, abs=0.04)
    page.keyboard.press("End")
    assert now() == pytest.approx(grasped["trials"][0]["playback"]["t"][-1], abs=1e-5)
    page.keyboard.press("Home")
    assert now() == 0
    page.keyboard.press("Space")
    assert page.locator("#play").inner_text() == "Pause"
    wait_until(page, "Player.time > 0.2")
    page.keyboard.press("Space")
    assert page.locator("#play").inner_text() == "Play"
    stopped = now()
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert now() == stopped


def test_playing_ends_at_the_end_and_begins_anew(show, grasped):
    page = show(grasped)
    end = grasped["trials"][0]["playback"]["t"][-1]
    seek(page, end - 0.1)
    page.locator("#play").click()
    wait_until(page, "document.getElementById('play').textContent === 'Play'")
    assert page.evaluate("Player.time") == pytest.approx(end, abs=1e-6)
    page.locator("#play").click()
    wait_until(page, f"Player.time > 0 && Player.time < {end - 1}")


def test_the_trial_selector_changes_scene_and_traces(traced, grasped):
    page = traced
    page.locator("#trial").select_option("0")
    page.get_by_label("values", exact=True).check()
    page.locator("#trial").select_option("1")
    seek(page, 8.0)
    playback = grasped["trials"][1]["playback"]
    expect_pose(page, "go", playback["go"][200])
    assert "closed loop" in page.locator("#trial-facts").inner_text()
    shown = page.evaluate("document.getElementById('traces').data.find(t => t.meta.role === 'measured').y")
    expected = [row[0] * 1e3 for row in grasped["trials"][1]["waypoints"]["measured"]["go"]]
    assert shown == pytest.approx(expected, abs=1e-3)


def test_traces_show_values_and_deviations_from_the_plan(traced, grasped):
    page = traced
    page.locator("#trial").select_option("0")
    page.get_by_label("values", exact=True).check()
    way = grasped["trials"][0]["waypoints"]
    find = """(role) => {
        const wanted = (m) => m.role === role && m.series === 'wrench' && m.component === 2;
        const trace = document.getElementById('traces').data.find((t) => wanted(t.meta));
        return [trace.x, trace.y];
    }"""
    for role in ("planned", "measured", "truth"):
        x, y = page.evaluate(find, role)
        assert x == pytest.approx(way["t"], abs=1e-5)
        assert y == pytest.approx([w[2] * 1e3 for w in way[role]["wrench"]], abs=1e-2)
    page.get_by_label("deviation from the plan").check()
    _, y = page.evaluate(find, "measured")
    deviation = [(m[2] - p[2]) * 1e3 for m, p in zip(way["measured"]["wrench"], way["planned"]["wrench"], strict=True)]
    assert y == pytest.approx(deviation, abs=1e-2)
    assert page.heard == []


def test_the_cursor_in_the_traces_follows_the_playback(traced, grasped):
    page = traced
    page.locator("#trial").select_option("0")
    page.get_by_label("values", exact=True).check()
    left = lambda: page.locator("#traces .cursor").first.evaluate("n => parseFloat(n.style.left)")  # noqa: E731
    positions = []
    for t in (6.0, 10.0, 14.0):
        seek(page, t)
        positions.append(left())
    assert positions[2] - positions[1] == pytest.approx(positions[1] - positions[0], rel=0.01)
    assert positions[1] - positions[0] > 20
    seek(page, 0.0)
    assert not page.locator("#traces .cursor").first.is_visible()


def test_dark_scheme_reaches_the_plots(traced, grasped):
    page = traced
    assert page.evaluate("document.getElementById('traces').layout.paper_bgcolor") == "#ffffff"
    page.emulate_media(color_scheme="dark")
    wait_until(page, "document.getElementById('traces').layout.paper_bgcolor === '#14171a'")


def test_on_paper_everything_is_open_light_and_plotted(show, grasped):
    page = show(grasped, scheme="dark")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("details:not([open])").count() == 0
    assert page.locator("#traces .scatterlayer .trace").count() > 0
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert not page.locator("#play").is_visible()
    page.emulate_media(media="screen")
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator("details[open]").count() == 0
    assert page.heard == []


def test_a_trial_without_anything_recorded_says_so(show, editable):
    editable["trials"][0].update(waypoints=None, playback=None)
    page = show(editable)
    assert page.locator("#no-playback").is_visible()
    assert not page.locator("#stage").is_visible()
    page.locator("#trial").select_option("1")
    assert page.locator("#stage").is_visible()
    draw_traces(page)
    page.locator("#trial").select_option("0")
    assert page.locator("#no-traces").is_visible()
    assert page.heard == []


def test_holes_in_a_recording_hide_the_body_instead_of_inventing_a_pose(show, editable):
    playback = editable["trials"][0]["playback"]
    for index in (100, 101):
        playback["go"][index] = None
        playback["ee"][index] = [math.nan, 0.0, 0.0]
    page = show(editable)
    seek(page, playback["t"][100])
    assert pose(page, "go") is None
    assert pose(page, "ee") is None
    assert page.locator("#offset").text_content() == "not recorded"
    seek(page, playback["t"][99])
    assert pose(page, "go") is not None
    assert page.heard == []


def test_hostile_names_are_shown_not_obeyed(show, editable):
    name = "</script><script>window.harmed = 1</script><img src=x onerror='window.harmed = 1'>"
    for trial in (*editable["trials"], *editable["results"]["trials"]):
        trial.update(name=name, reason=name, skill=name)
    editable["trials"][0]["playback"]["phase"] = [name] * len(editable["trials"][0]["playback"]["t"])
    editable["trials"][0]["waypoints"]["contacts"][0][0]["name"] = name
    page = show(editable)
    draw_traces(page)
    page.keyboard.press("ArrowRight")
    assert page.evaluate("window.harmed") is None
    assert name in page.locator("#errors tbody th").first.text_content()
    assert page.heard == []
