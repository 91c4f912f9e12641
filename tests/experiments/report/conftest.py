"""Made-up runs, and the pages that are made of them."""

import copy
from html.parser import HTMLParser

import pytest

from experiments.report import render
from tests.experiments.report.runs import (
    build_calibrated,
    build_pictures,
    build_run,
    build_trial,
    elasticity_samples,
)


@pytest.fixture(scope="module")
def show(open_page, tmp_path_factory):
    """Open the report of a run."""

    def show(run, width=1280, scheme="light"):
        path = tmp_path_factory.mktemp("report") / "report.html"
        path.write_text(render(run), encoding="utf-8")
        return open_page(path, width, scheme)

    return show


@pytest.fixture(scope="session")
def grasped():
    """Two completed trials of grasped pivoting, with truth."""
    return build_run([build_trial("open_loop", seed=1, error=3.0), build_trial("closed_loop", seed=2)])


@pytest.fixture(scope="session")
def extrinsic():
    """One completed trial on an extrinsic object, and one that lost its contact; with figures of the paper beside."""
    good, bad = (
        build_trial(eo=True, offset=0.002),
        build_trial("open_loop", eo=True, offset=0.004, status="lost_contact", seed=3, error=4),
    )
    times = good["waypoints"]["t"]
    camera = build_pictures(times, "camera", "picture", size=(64, 36), every=2)
    good["pictures"] = [build_pictures(times), build_pictures(times, "finger_right"), camera]
    run = build_run([good, bad], status="completed", eo=True)
    run["imagers"] = ["finger_left", "finger_right", "camera"]
    figures = {"go_pose_mm": {"mean": 1.26, "std": 0.98}, "eo_pose_mm": {"mean": 0.31, "std": 0.32}}
    run["paper"] = {"source": "Table 2", "rows": {good["name"]: figures}}
    return run


@pytest.fixture(scope="session")
def aborted():
    """A run that a device ended at waypoint 6: no truth, holes in what was measured, a log that was cut off."""
    trial = build_trial(status="device_failed", seed=4)
    way = trial["waypoints"]
    way["t"] = way["t"][:6]
    way["measured"] = {k: None if v is None else v[:5] + [None] * 15 for k, v in way["measured"].items()}
    way["measured"]["wrench"][2] = [float("nan")] * 3
    way["truth"] = None
    cut = 200
    trial["playback"] = {k: v[:cut] if isinstance(v, list) else v for k, v in trial["playback"].items()}
    trial["playback"]["source"] = "estimate"
    trial["playback"]["wrench"][150:160] = [None] * 10
    trial["reason"] = "arm: read: no reading within 1 s"
    run = build_run([build_trial()], status="device_failed")
    row = run["results"]["trials"][0]
    row.update(status="device_failed", reason=trial["reason"], measured=None, truth=None)
    run["trials"] = [trial]
    run["results"]["reason"] = "arm: read: no reading within 1 s. Check `extrinsic status STATION`"
    run["log"].update(lost=12, ending="torn at byte 4096: no footer")
    run["events"].append({"t": 8.0, "level": "error", "text": "arm: read: no reading within 1 s"})
    return run


@pytest.fixture
def empty():
    """What is left of a run that died before its first trial."""
    return {
        "results": {"schema": 1, "status": "stopped", "experiment": "grasped_static", "trials": [], "provenance": {}},
        "title": "Grasped static", "created": "2025-11-22T01:40:00Z", "objects": {"go": None, "eo": None},
        "grasp": [0, 0, 0], "trials": [], "log": None, "events": [], "paper": None,
    }  # fmt: skip


@pytest.fixture
def calibrated():
    """A run that did nothing but calibrate: all kinds, three pairs, samples beside those that have a figure."""
    return build_calibrated()


@pytest.fixture
def editable(grasped):
    """A copy of the grasped run that a test may change."""
    return copy.deepcopy(grasped)


class Cells(HTMLParser):
    """Texts of the body cells, row by row, of the table with the given id."""

    def __init__(self, table):
        super().__init__()
        self.table, self.inside, self.cell, self.rows = table, False, False, []

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.inside = dict(attrs).get("id") == self.table
        elif self.inside and tag == "tr":
            self.rows.append([])
        elif self.inside and tag in ("td", "th"):
            self.cell = True
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.cell = False
        elif tag == "table":
            self.inside = False

    def handle_data(self, data):
        if self.inside and self.cell:
            self.rows[-1][-1] += data


@pytest.fixture(scope="session")
def find_cells():
    """The function (page, table id) → texts of the rows below the head."""

    def find(page, table):
        parser = Cells(table)
        parser.feed(page)
        head = 2 if table == "errors" else 1
        return [[" ".join(cell.split()) for cell in row] for row in parser.rows[head:]]

    return find


@pytest.fixture(scope="session")
def make_samples():
    """The function that makes up the samples of an elasticity."""
    return elasticity_samples


@pytest.fixture(scope="session")
def make_trial():
    """The function that makes up a trial."""
    return build_trial


@pytest.fixture(scope="session")
def make_run():
    """The function that puts trials into a run."""
    return build_run
