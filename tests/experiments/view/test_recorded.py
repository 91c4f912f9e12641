"""A short run in a file for Rerun, read back with Rerun's own reader and held against the run's log."""

import json
import re
import shutil
from collections import defaultdict

import numpy as np
import pytest
from mcap.writer import Writer

from drivers.wire.log_reader import LogReader
from mechanics.readings import TruthReading
from mechanics.records import WaypointRecord

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

STEPS = 3
SHORT = ("--set", "world.profile=ideal", "--set", f"stages.0.parameters.steps={STEPS}")


class Saved:
    """What stands in a file, by path: per timeline the times, and per component the values of each row."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        self.reader = RrdReader(path)
        self._chunks = defaultdict(list)
        for chunk in self.reader.stream():
            self._chunks[chunk.entity_path].append(chunk)

    @property
    def paths(self):
        return set(self._chunks)

    def rows(self, path, component, timeline):
        """{time: values}, of rows that have the component and are on the timeline; times are [ns] or numbers."""
        found = {}
        for chunk in self._chunks[path]:
            batch = chunk.to_record_batch()
            if timeline in chunk.timeline_names and component in batch.schema.names:
                times = batch.column(timeline).cast("int64").to_pylist()
                found |= dict(zip(times, batch.column(component).to_pylist(), strict=True))
        return {time: values for time, values in found.items() if values is not None}

    def scalars(self, path, timeline="waypoint"):
        return self.rows(path, "Scalars:scalars", timeline)

    def text(self, path, component):
        batches = [chunk.to_record_batch() for chunk in self._chunks[path]]
        rows = [row for b in batches if component in b.schema.names for row in b.column(component).to_pylist()]
        return [value for row in rows for value in row]


@pytest.fixture(scope="module")
def run(shared_command):
    finished = shared_command.run("grasped_static", *SHORT, "--set", "stages.1.controllers=[open_loop]")
    assert finished.code == 0, finished.err
    return finished


@pytest.fixture(scope="module")
def view(shared_command):
    """`extrinsic view`, with its settings in the test's own folder: exit code, what it said, what it wrote."""

    def look(*arguments):
        process = shared_command.start("view", *map(str, arguments))
        _, said = process.communicate(timeout=100)
        return process.returncode, said

    return look


@pytest.fixture(scope="module")
def saved(run, view):
    file = run.folder.parent / "run.rrd"
    code, said = view(run.folder, "--save", file)
    assert code == 0, said
    assert "1 trials, 3 waypoints" in said and str(file) in said
    assert "Warning" not in said
    return Saved(file)


@pytest.fixture(scope="module")
def logged(run):
    return [value for _, value in LogReader(run.folder / "log.mcap").values()]


@pytest.fixture(scope="module")
def waypoints(logged):
    return [value for value in logged if isinstance(value, WaypointRecord)]


def test_every_waypoint_has_the_wrenches_of_the_log_in_newtons_and_newton_millimetres(run, saved, waypoints):
    [trial] = run.results["trials"]
    root = f"/trials/{trial['name']}/wrench"
    assert len(waypoints) == STEPS
    for source in ("planned", "measured", "truth"):
        force, torque = saved.scalars(f"{root}/{source}/force"), saved.scalars(f"{root}/{source}/torque")
        assert sorted(force) == sorted(torque) == list(range(STEPS))
        for record in waypoints:
            fx, fy, tau = getattr(record, source).wrench
            assert force[record.step] == [fx, fy] and torque[record.step] == [1e3 * tau]


def test_the_same_stands_on_the_stations_clock(run, saved, waypoints):
    measured = saved.scalars(f"/trials/{run.results['trials'][0]['name']}/wrench/measured/force", "station_time")
    assert measured == {record.capture_ns: list(record.measured.wrench[:2]) for record in waypoints}


def test_the_bodies_are_where_the_plant_says_at_every_instant_it_tells(run, saved, logged):
    name = run.results["trials"][0]["name"]
    places = {}
    for scope in ("station", f"trials/{name}"):
        places |= saved.rows(f"/{scope}/scene/plane/truth/go", "Transform3D:translation", "station_time")
    truths = [value for value in logged if isinstance(value, TruthReading)]
    assert places.keys() == {truth.stamp.capture_ns for truth in truths} and len(places) > 100
    for truth in truths[::50]:
        [shown] = places[truth.stamp.capture_ns]
        assert np.allclose(shown, [*truth.go[:2], 0.0], atol=1e-7)  # float32


def test_planned_contacts_and_their_forces_stand_at_the_waypoints(run, saved):
    root = f"/trials/{run.results['trials'][0]['name']}/scene/plane/planned"
    modes = saved.rows(f"{root}/contacts", "Points2D:labels", "waypoint")
    assert modes == {step: ["stick"] for step in range(STEPS)}
    arrows = saved.rows(f"{root}/forces", "Arrows2D:vectors", "waypoint")
    sizes = [float(np.hypot(*arrows[step][0])) for step in range(STEPS)]
    assert sizes == sorted(sizes) and sizes[0] == pytest.approx(0.03, rel=0.05)  # from 3 N at 10 mm/N


def test_an_estimate_stands_within_its_band_and_its_ellipse(run, saved, waypoints):
    root = f"/trials/{run.results['trials'][0]['name']}"
    bands = saved.scalars(f"{root}/wrench/estimated_2sigma/force")
    estimated = saved.scalars(f"{root}/wrench/estimated/force")
    for step in range(STEPS):
        low_x, high_x, low_y, high_y = bands[step]
        fx, fy = estimated[step]
        assert low_x < fx < high_x and low_y < fy < high_y
        assert (low_x + high_x) / 2 == pytest.approx(fx) and (low_y + high_y) / 2 == pytest.approx(fy)
    ellipses = saved.rows(f"{root}/scene/plane/estimated/go_2sigma", "LineStrips2D:strips", "waypoint")
    for record in waypoints:
        [outline] = ellipses[record.step]
        centre = np.mean(outline[:-1], axis=0)
        assert np.hypot(*(centre - record.measured.go[:2])) < 1e-3  # on the ideal station all see the same
        assert 0 < np.ptp(np.array(outline)[:, 0]) < 5e-3


def test_every_reading_of_a_sensor_and_every_picture_is_there(run, saved):
    counts = run.results["log"]["messages"]
    for sensor in ("wrist_ft", "table_ft"):
        rows = saved.scalars(f"/station/sensors/{sensor}/force", "station_time")
        assert len(rows) == counts[f"sim/{sensor}/wrench"]
    name = run.results["trials"][0]["name"]
    pictures = saved.rows(f"/trials/{name}/images/camera", "EncodedImage:blob", "station_time")
    assert len(pictures) == counts["sim/camera/image"]


def test_trials_phases_and_the_overview_are_text(run, saved):
    name = run.results["trials"][0]["name"]
    assert saved.text("/log/trials", "TextLog:text")[-1] == f"{name} completed"
    assert f"{name}: trajectory" in saved.text("/log/phases", "TextLog:text")
    [overview] = saved.text("/overview", "TextDocument:text")
    assert "* experiment: grasped_static" in overview and f"| {name} | completed | {STEPS} | camera |" in overview


def test_the_layout_has_a_tab_for_each_trial(run, saved):
    [store] = saved.reader.blueprints()
    said = " ".join(str(chunk.to_record_batch().to_pydict()) for chunk in saved.reader.stream(store=store))
    for tab in (run.results["trials"][0]["name"], "station", "overview", "force of the fingers on the object [N]"):
        assert tab in said


def test_a_torn_log_shows_what_was_whole_and_says_so(run, view, tmp_path):
    folder = tmp_path / "torn"
    shutil.copytree(run.folder, folder)
    whole = (folder / "log.mcap").read_bytes()
    (folder / "log.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    code, said = view(folder, "--save", tmp_path / "torn.rrd")
    assert code == 0
    assert "log.mcap: torn at byte" in said and "what was whole is shown" in said
    assert "/station/sensors/wrist_ft/force" in Saved(tmp_path / "torn.rrd").paths


def test_a_run_without_a_log_and_one_with_an_empty_log_say_so(run, view, tmp_path):
    for name in ("none", "empty"):
        (tmp_path / name).mkdir()
        shutil.copy(run.folder / "experiment.yaml", tmp_path / name)
    (tmp_path / "empty" / "log.mcap").touch()
    code, said = view(tmp_path / "none", "--save", tmp_path / "none.rrd")
    assert code == 0 and "there is no log" in said
    code, said = view(tmp_path / "empty", "--save", tmp_path / "empty.rrd")
    assert code == 0 and "log.mcap: no MCAP file" in said
    assert "0 trials, 0 waypoints" in Saved(tmp_path / "empty.rrd").text("/overview", "TextDocument:text")[0]


def test_a_resumed_run_shows_both_attempts_at_the_trial_it_was_cut_off_in(run, view, tmp_path):
    folder, name = tmp_path / "resumed", run.results["trials"][0]["name"]
    shutil.copytree(run.folder, folder)
    whole = (folder / "log.mcap").read_bytes()
    (folder / "log.1.mcap").write_bytes(whole)
    code, said = view(folder, "--save", tmp_path / "resumed.rrd")
    assert code == 0 and "2 trials, 6 waypoints" in said
    paths = Saved(tmp_path / "resumed.rrd").paths
    assert {f"/trials/{name}/wrench/measured/force", rf"/trials/{name}\ \(2\)/wrench/measured/force"} <= paths


def test_a_log_by_itself_is_shown_with_the_objects_that_it_carries(run, view, tmp_path):
    shutil.copy(run.folder / "log.mcap", tmp_path / "kept.mcap")
    code, said = view(tmp_path / "kept.mcap", "--save", tmp_path / "kept.rrd")
    assert code == 0, said
    name = run.results["trials"][0]["name"]
    assert f"/trials/{name}/scene/plane/truth/go/outline" in Saved(tmp_path / "kept.rrd").paths


@pytest.fixture
def foreign(tmp_path):
    """A log as another program writes it."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", library="rosbag2_storage_mcap 0.26")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0\1\0\0\0\0", 1)
        writer.finish()
    return path


def test_another_programs_log_is_refused_by_its_name(foreign, run, view, tmp_path):
    code, said = view(foreign, "--save", tmp_path / "x.rrd")
    assert code == 2 and "another program's log" in said and "rosbag2_storage_mcap" in said
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(run.folder / "experiment.yaml", folder)
    shutil.copy(foreign, folder / "log.mcap")
    code, said = view(folder, "--save", tmp_path / "x.rrd")
    assert code == 2 and "another program's log" in said
    assert not (tmp_path / "x.rrd").exists()


def test_saving_reports_nothing_and_keeps_no_settings(run, tmp_path, monkeypatch):
    from tests.experiments.conftest import Command

    home = tmp_path / "home"
    home.mkdir()
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(home))
    command = Command(tmp_path)
    try:
        process = command.start("view", str(run.folder), "--save", "run.rrd")
        _, said = process.communicate(timeout=100)
    finally:
        command.stop()
    assert process.returncode == 0, said
    assert not [path for path in home.rglob("*") if "rerun" in path.name]


# -- Foxglove ----------------------------------------------------------------------------------------------------------


def quoted_paths(layout):
    """(topic, fields) of every message path, and (topic, "") of every topic that a picture is taken from."""

    def strings(value):
        if isinstance(value, dict):
            for key, item in value.items():
                yield from ((item,) if key == "imageTopic" else strings(item))
                yield key
        elif isinstance(value, list):
            for item in value:
                yield from strings(item)
        elif isinstance(value, str):
            yield value

    for text in strings(layout):
        if found := re.fullmatch(r'"([^"]+)"((?:\.\w+|\[\d+\])*)', text):
            yield found[1], found[2]
        elif re.fullmatch(r"(?:sim|run)/[\w/]+", text):
            yield text, ""


def test_every_topic_and_field_of_foxgloves_layout_is_in_the_log(run):
    from drivers.wire import messages, topics
    from drivers.wire.records import STREAMS
    from experiments.files import load
    from experiments.view import foxglove

    station = load(str(run.folder / "experiment.yaml")).station
    types = topics.streams(station) | dict(STREAMS.values())
    first = {}
    for message in LogReader(run.folder / "log.mcap").messages():
        first.setdefault(message.topic, message)
    paths = list(quoted_paths(json.loads(foxglove.text())))
    assert len(paths) > 40
    seen = set()
    for topic, fields in paths:
        assert topic in types, topic
        if topic not in first:  # a picture that nobody asked for, an event that did not happen
            assert topic in ("run/event", "sim/finger_left/image", "sim/finger_right/image")
            continue
        assert first[topic].type_name == types[topic]
        value = messages.decode(first[topic].payload, types[topic])
        for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", fields):
            value = getattr(value, name) if name else value[int(index)]
        seen.add(topic)
    assert {"run/waypoint", "run/phase", "run/trial", "sim/wrist_ft/wrench", "sim/camera/image"} <= seen


def test_foxgloves_layout_is_written_for_the_station_of_a_run_and_over_nothing(run, view, tmp_path):
    file = tmp_path / "layout.json"
    code, said = view(run.folder, "--foxglove-layout", file)
    assert code == 0 and str(file) in said
    assert json.loads(file.read_text())["configById"]["Image!camera"]["imageMode"]["imageTopic"] == "sim/camera/image"
    code, said = view("--foxglove-layout", file)
    assert code == 2 and "it is there already" in said
    code, said = view("sim", "--set", "name=lab7", "--foxglove-layout", tmp_path / "other.json")
    assert code == 0, said
    text = (tmp_path / "other.json").read_text()
    assert "lab7/wrist_ft/wrench" in text and "sim/" not in text
