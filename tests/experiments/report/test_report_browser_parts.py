"""In a browser: pictures in step with the scene, traces that lead it, friction cones, the theme, keys, figures."""

import math

import numpy as np
import pytest

from tests.experiments.report.pages import draw_figures, draw_traces, expect_pose, seek, wait_until

LIGHT, DARK = "#ffffff", "#14171a"


@pytest.fixture(scope="module")
def page(show, extrinsic):
    return show(extrinsic)


def pixel(page, number):
    """[r, g, b] in the middle of a picture, once it is drawn."""
    return page.evaluate(
        """async (number) => {
          const canvas = document.querySelectorAll("#pictures canvas")[number];
          const seen = () => [...canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data];
          while (seen()[3] === 0) await new Promise(requestAnimationFrame);
          return seen().slice(0, 3);
        }""",
        number,
    )


def wait_for_pixel(page, number, wanted):
    wait_until(
        page,
        f"""(() => {{
          const canvas = document.querySelectorAll("#pictures canvas")[{number}];
          const seen = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data;
          return {wanted}.every((value, i) => Math.abs(value - seen[i]) <= 8);
        }})()""",
    )


def test_pictures_are_those_of_the_newest_waypoint(page, extrinsic):
    times = extrinsic["trials"][0]["waypoints"]["t"]
    captions = page.locator("#pictures figcaption")
    assert [text.split()[0] for text in captions.all_inner_texts()] == ["finger_left", "finger_right", "camera"]
    seek(page, times[7] + 0.2)
    assert "waypoint 8," in captions.nth(0).inner_text()
    assert "waypoint 7," in captions.nth(2).inner_text()  # the camera has one at every other waypoint
    assert not page.locator("#pictures .ahead").count()
    seek(page, 1.0)
    assert page.locator("#pictures .ahead").count() == 3  # none has been taken yet
    assert page.heard == []


def test_a_deformation_has_the_colours_of_its_scale(page, extrinsic):
    times = extrinsic["trials"][0]["waypoints"]["t"]
    seek(page, times[0])
    wait_for_pixel(page, 0, [68, 1, 84])  # viridis begins
    seek(page, times[-1])
    wait_for_pixel(page, 0, [253, 231, 37])  # viridis ends: 19 mm of 19.0
    assert "19.0 mm" in page.locator(".colour-scale").inner_text()
    assert "untouched finger" in page.locator(".colour-scale").inner_text()


def test_a_camera_keeps_its_colours(page, extrinsic):
    seek(page, extrinsic["trials"][0]["waypoints"]["t"][4])
    wait_for_pixel(page, 2, [90, 90, 90])


def test_a_trial_without_pictures_says_why(show, extrinsic):
    page = show(extrinsic)
    assert not page.locator("#no-pictures").is_visible()
    page.locator("#trial").select_option("1")
    assert "no picture of finger_left, finger_right, camera in this trial" in page.locator("#no-pictures").inner_text()
    assert page.locator("#pictures canvas").count() == 0
    page.locator("#trial").select_option("0")
    assert page.locator("#pictures canvas").count() == 3
    assert page.heard == []


def test_a_damaged_picture_is_told_beside_it(show, extrinsic):
    import copy

    run = copy.deepcopy(extrinsic)
    run["trials"][0]["pictures"][0]["shots"][0][2] = "AAAA"
    page = show(run)
    seek(page, 0.0)
    wait_until(page, "document.querySelector('#pictures figcaption').textContent.includes('cannot be read')")
    assert [text for text in page.heard if not text.startswith("warning")] == []


def cones(page):
    return page.evaluate(
        """() => [...document.querySelectorAll("#scene .cone")].map(
          (node) => node.getAttribute("d").match(/-?[\\d.]+/g).map(Number))"""
    )


def test_a_friction_cone_stands_at_its_contact_about_its_normal(show, extrinsic):
    import copy

    run = copy.deepcopy(extrinsic)
    for step in run["trials"][0]["waypoints"]["contacts"]:
        for contact in step:
            contact["mu"] = 0.33
    page = show(run)
    seek(page, 8.0)
    found = cones(page)
    assert len(found) == 3
    marks = page.evaluate(
        """() => [...document.querySelectorAll("#scene .marker")].map(
          (node) => node.getAttribute("transform").match(/-?[\\d.]+/g).map(Number))"""
    )
    for x, y, x1, y1, *_, x2, y2 in found:
        assert min(math.hypot(x - mark[0], y - mark[1]) for mark in marks) < 0.1
        angles = [math.atan2(y - b, a - x) for a, b in ((x1, y1), (x2, y2))]
        assert np.diff(angles) == pytest.approx(2 * math.atan(0.33), abs=0.01)
        assert np.mean(angles) == pytest.approx(math.pi / 2, abs=0.01)
    page.locator("#show-cones").uncheck()
    assert cones(page) == []


def test_pointing_at_a_trace_moves_the_scene_and_a_click_keeps_it_there(show, grasped):
    page = show(grasped)
    draw_traces(page)
    playback, times = grasped["trials"][0]["playback"], grasped["trials"][0]["waypoints"]["t"]
    seek(page, times[2])
    before = page.evaluate("Player.time")
    panel = page.locator("#traces .xy .nsewdrag, #traces .nsewdrag").first.bounding_box()
    layout = page.evaluate("document.getElementById('traces').layout.xaxis.range")
    at = panel["x"] + panel["width"] * (times[12] - layout[0]) / (layout[1] - layout[0])
    page.mouse.move(at, panel["y"] + panel["height"] / 2)
    wait_until(page, f"Math.abs(Player.time - {times[12]}) < 1e-4")
    index = int(np.argmin(np.abs(np.array(playback["t"]) - times[12])))
    expect_pose(page, "go", playback["go"][index])
    page.mouse.move(5, 5)
    wait_until(page, f"Player.time === {before}")
    page.mouse.move(at, panel["y"] + panel["height"] / 2)
    wait_until(page, f"Math.abs(Player.time - {times[12]}) < 1e-4")
    page.mouse.down()
    page.mouse.up()
    page.mouse.move(5, 5)
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.evaluate("Player.time") == pytest.approx(times[12], abs=1e-4)
    assert page.heard == []


def ground(page):
    return page.evaluate("getComputedStyle(document.documentElement).getPropertyValue('--page').trim()")


def test_the_theme_can_be_chosen_reaches_the_plots_and_is_remembered(show, grasped):
    page = show(grasped, scheme="light")
    draw_traces(page)
    assert ground(page) == LIGHT
    page.locator("#theme").select_option("dark")
    assert ground(page) == DARK
    assert page.evaluate("document.getElementById('traces').layout.paper_bgcolor") == DARK
    page.reload()
    assert ground(page) == DARK
    assert page.locator("#theme").input_value() == "dark"
    page.emulate_media(media="print")
    assert ground(page) == LIGHT  # on paper it is light whatever was chosen
    page.emulate_media(media="screen", color_scheme="dark")
    page.locator("#theme").select_option("light")
    assert ground(page) == LIGHT
    page.locator("#theme").select_option("system")
    assert ground(page) == DARK
    assert page.heard == []


def test_every_control_is_reached_by_tab_and_shows_that_it_is(page):
    page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    wanted = {"theme", "trial", "time", "play", "previous", "next", "speed", "show-plan", "show-forces", "show-cones"}
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        focus = page.evaluate(
            """() => {
              const node = document.activeElement, style = getComputedStyle(node);
              return [node.id, style.outlineStyle, style.outlineWidth];
            }"""
        )
        if focus[0] in wanted:
            reached.add(focus[0])
            assert focus[1] != "none" and float(focus[2].removesuffix("px")) >= 2, focus
    assert reached == wanted


def test_every_control_and_picture_has_a_name(page):
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, canvas, svg[role=img]")].filter((node) =>
          !(node.getAttribute("aria-label") || node.textContent.trim() || node.labels?.[0]?.textContent.trim()))
          .map((node) => node.outerHTML)"""
    )
    assert unnamed == []


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (800, "light"), (800, "dark")])
def test_nothing_overlaps_at_any_width_in_either_theme(show, extrinsic, width, scheme):
    page = show(extrinsic, width, scheme)
    draw_traces(page)
    draw_figures(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    overlapping = page.evaluate(
        """() => {
          const blocks = "main > section, .stage > *, .pictures figure, .identified > figure, header > *, .bar > *";
          const boxes = [...document.querySelectorAll(blocks)].filter((node) => node.offsetParent !== null)
            .map((node) => [node, node.getBoundingClientRect()]);
          const over = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
            && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1;
          const found = [];
          boxes.forEach(([a, boxA], i) => boxes.slice(i + 1).forEach(([b, boxB]) => {
            if (a.contains(b) || b.contains(a) || !over(boxA, boxB)) return;
            found.push([a.outerHTML.slice(0, 80), b.outerHTML.slice(0, 80)]);
          }));
          return found;
        }"""
    )
    assert overlapping == []
    paper = {"light": LIGHT, "dark": DARK}[scheme]
    for plot in page.locator("#traces, .convergence-plot").all():
        assert plot.evaluate("plot => plot.layout.paper_bgcolor") == paper
    assert page.heard == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["extrinsic", "calibrated"])
def test_every_text_on_screen_has_the_contrast_of_wcag_aa(request, show, name, scheme):
    page = show(request.getfixturevalue(name), scheme=scheme)
    if name == "extrinsic":
        draw_traces(page)
    draw_figures(page)
    for i in range(page.locator("details").count()):
        page.locator("details summary").nth(i).click()
    found = page.evaluate(
        """() => {
          const channels = (text) => text.match(/[\\d.]+/g).map(Number);
          const linear = (value) => value / 255 <= .04045 ? value / 255 / 12.92 : ((value / 255 + .055) / 1.055) ** 2.4;
          const luminance = ([r, g, b]) => .2126 * linear(r) + .7152 * linear(g) + .0722 * linear(b);
          const behind = (node) => {
            for (let at = node; at; at = at.parentElement) {
              const colour = channels(getComputedStyle(at).backgroundColor);
              if (colour.length === 3 || colour[3] > 0) return colour;
            }
          };
          const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), poor = new Set();
          let count = 0;
          while (walker.nextNode()) {
            const node = walker.currentNode.parentElement, box = node.getBoundingClientRect();
            if (!walker.currentNode.textContent.trim() || node.closest("script") || !box.width || !box.height) continue;
            count += 1;
            const style = getComputedStyle(node), own = channels(node.closest("svg") ? style.fill : style.color);
            const [high, low] = [luminance(own), luminance(behind(node))].sort((a, b) => b - a);
            if ((high + .05) / (low + .05) >= 4.5) continue;
            poor.add(`${node.tagName}.${node.className.baseVal ?? node.className}: ${walker.currentNode.textContent}`);
          }
          return [count, [...poor]];
        }"""
    )
    assert found[0] > 100
    assert found[1] == []


def test_the_page_says_when_it_answers_before_the_plots_are_made(show, extrinsic):
    page = show(extrinsic)
    marks = page.evaluate("performance.getEntriesByName('interactive').map((mark) => mark.startTime)")
    assert len(marks) == 1
    assert page.evaluate("typeof Plotly") == "undefined"
    seek(page, 8.0)
    assert page.evaluate("Player.time") == 8.0


def test_a_plans_search_is_drawn_on_screen_and_on_paper(show, extrinsic):
    page = show(extrinsic)
    draw_figures(page)
    plot = page.locator(".convergence-plot")
    assert plot.count() == 1
    assert plot.evaluate("plot => plot.data[0].x") == list(range(10, 101, 10))
    page = show(extrinsic)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator(".convergence-plot .scatterlayer .trace").count() == 1
    assert page.heard == []
