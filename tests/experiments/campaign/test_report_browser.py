"""A campaign's page in a browser: it is quiet, asks for nothing, and what is drawn are the figures of the Parquet."""

import pandas as pd
import pytest

from experiments.campaign.report.build import rebuild
from tests.experiments.chromium import assert_quiet_and_within
from tests.experiments.report.pages import wait_until

from .campaigns import campaign, row
from .test_report import with_reports

CELLS = ((0.3, "a sensor with a long name, which has to be broken"), (0.5, "gelslim"), (0.7, "<b>&amp;"))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Three cells of two keys, four seeds, two laws; some trials slip, one has no figure."""
    jobs = []
    for n, (mu, sensor) in enumerate(CELLS):
        for seed in range(4):
            error, rows = 1.0 + 0.7 * n + 0.31 * seed, []
            for law, share in (("open_loop", 1.0), ("closed_loop_pi", 0.3 + 0.05 * seed)):
                slipped = law == "open_loop" and seed == n
                figures = {"wrench_N": error * share, "go_pose_mm": 0.4 * error * share}
                one = row(law, 0, "slipped" if slipped else "completed", None)
                one["reason"] = f"slipped by {error:.1f} mm" if slipped else ""
                told = {name: {"mean": value, "std": 0.1} for name, value in figures.items()}
                one["measured"] = None if slipped and n == 2 else told
                one["truth"] = {name: {"mean": 1.1 * value, "std": 0.1} for name, value in figures.items()}
                rows.append(one)
            tags = {"friction.go-ground": mu, "station.devices.finger_left.sensor": sensor, "seed": seed}
            jobs.append((f"c{n:03d}-s{seed}", tags, rows, [("completed", rows)]))
    return with_reports(campaign(tmp_path_factory.mktemp("runs") / "sweep", jobs))


@pytest.fixture(scope="module")
def show(open_page):
    def show(folder, width=1280, scheme="light"):
        page = open_page(rebuild(folder), width, scheme)
        for plot in page.locator(".trials-plot").all():
            plot.scroll_into_view_if_needed()
            plot.locator(".scatterlayer .trace").first.wait_for(state="attached")
        return page

    return show


@pytest.fixture(scope="module")
def page(show, sweep):
    return show(sweep)


def drawn(page, number, axis):
    """What the plot shows in a column: the trials by their run, and the means with their intervals, by row."""
    return page.evaluate(
        """([number, axis]) => {
          const plot = document.querySelectorAll(".trials-plot")[number];
          const here = plot.data.filter((t) => t.xaxis === axis);
          const points = here.filter((t) => t.customdata).flatMap((t) => t.x.map((x, i) => [t.name, t.text[i], x]));
          const means = here.filter((t) => t.error_x).flatMap((t) => t.x.map((x, i) => [t.name, t.y[i], x,
            x - t.error_x.arrayminus[i], x + t.error_x.array[i]]));
          return { points, means };
        }""",
        [number, axis],
    )


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (800, "light"), (800, "dark")])
def test_the_page_is_quiet_asks_for_nothing_and_fits(show, sweep, width, scheme):
    page = show(sweep, width, scheme)
    page.locator("details summary").click()
    assert_quiet_and_within(page, width)
    colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert colour == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 26)"}[scheme]
    for plot in page.locator(".trials-plot").all():
        assert plot.evaluate("plot => plot.layout.paper_bgcolor") == {"light": "#ffffff", "dark": "#14171a"}[scheme]
        box = plot.bounding_box()
        for label in plot.locator(".ytick text, .annotation-text, .legendtext").all():
            inside = label.bounding_box()
            assert inside["x"] >= box["x"] and inside["x"] + inside["width"] <= box["x"] + box["width"]


def test_every_trial_that_has_a_figure_is_a_point_with_the_parquets_value(page, sweep):
    table = pd.read_parquet(sweep / "trials.parquet")
    for axis, name in (("x", "go_pose_mm"), ("x2", "wrench_N")):
        known = table.dropna(subset=[f"measured.{name}.mean"])
        wanted = {
            (row["controller"].replace("_", " "), row["job"]): row[f"measured.{name}.mean"]
            for row in known.to_dict("records")
        }
        points = {(law, text.split(",")[0]): x for law, text, x in drawn(page, 0, axis)["points"]}
        assert points == pytest.approx(wanted, abs=1e-6)
    assert len(wanted) == 23  # of 24 trials one has no figure


def test_means_and_intervals_are_those_of_the_parquets_rows(page, sweep):
    table = pd.read_parquet(sweep / "trials.parquet")
    means = {(law, x): (low, high) for law, _, x, low, high in drawn(page, 0, "x2")["means"]}
    # Student's t of 4 and of 3 values for 95 %
    times = {4: 3.182446, 3: 4.302653}
    wanted = {}
    for _, rows in table.groupby(["friction.go-ground", "controller"]):
        law, known = rows["controller"].iloc[0], rows["measured.wrench_N.mean"].dropna()
        half = times[len(known)] * known.std() / len(known) ** 0.5
        wanted[law.replace("_", " "), known.mean()] = (known.mean() - half, known.mean() + half)
    assert len(means) == len(wanted) == 6
    for (law, mean), interval in wanted.items():
        near = min((key for key in means if key[0] == law), key=lambda key: abs(key[1] - mean))
        assert near[1] == pytest.approx(mean, abs=2e-6)
        assert means[near] == pytest.approx(interval, abs=1e-5)


def test_differences_are_of_pairs(page, sweep):
    table = pd.read_parquet(sweep / "trials.parquet")
    column = table.pivot(index="job", columns="controller", values="measured.wrench_N.mean")
    wanted = (column["closed_loop_pi"] - column["open_loop"]).dropna().to_dict()
    points = {text.split(",")[0]: x for _, text, x in drawn(page, 1, "x2")["points"]}
    assert points == pytest.approx(wanted, abs=2e-6)


def test_the_truth_is_shown_when_it_is_asked_for(show, sweep):
    page = show(sweep)
    before = {(law, text): x for law, text, x in drawn(page, 0, "x2")["points"]}
    page.locator('input[name="source-distributions"][value="truth"]').check()
    after = {(law, text): x for law, text, x in drawn(page, 0, "x2")["points"]}
    assert len(after) == len(before) + 1  # what the sensors have not seen of one trial, the plant knows
    assert all(after[one] == pytest.approx(1.1 * before[one], abs=1e-5) for one in before)
    assert page.heard == []


def test_a_click_on_a_point_and_a_link_of_a_table_open_the_runs_report(show, sweep):
    page = show(sweep)
    page.locator(".worst a").first.click()
    page.wait_for_url("**/jobs/c002-s3/run/report.html")
    page.go_back()
    plot = page.locator(".trials-plot").first
    plot.scroll_into_view_if_needed()
    point = plot.locator(".scatterlayer .trace").first.locator("path.point").first
    point.wait_for(state="attached")
    link = page.evaluate("document.querySelector('.trials-plot').data.find((t) => t.customdata?.length).customdata[0]")
    box = point.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    plot.locator(".hoverlayer text").first.wait_for()
    page.mouse.down()
    page.mouse.up()
    page.wait_for_url(f"**/{link}")


def test_what_a_tag_says_is_text_in_the_figure(page):
    labels = page.locator(".trials-plot").first.locator(".ytick text").all_text_contents()
    assert labels[-1] == "0.7 · <b>&amp;"


def test_on_paper_the_figures_have_its_width(show, sweep):
    page = show(sweep)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    wait_until(page, "[...document.querySelectorAll('.trials-plot')].every((p) => p.layout.width === 680)")
    page.emulate_media(media="print")
    assert page.pdf()[:4] == b"%PDF"
    assert page.heard == []
