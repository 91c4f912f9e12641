"""Experiment and station files: what is shipped, what ``--set`` reaches, what a resolved file holds."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from drivers.config import TagCameraConfig
from drivers.scene import Body
from experiments.calibrate.store import Calibrations
from experiments.check import check, tasks
from experiments.files import PACKAGE, Resolved, dump_resolved, load, load_station
from experiments.planning.schema import PlanStage
from experiments.schema import ExecuteStage
from experiments.setup import believed
from mechanics import model_paths
from mechanics.camera import CameraModel
from mechanics.yaml_input import InputError

SHIPPED = [
    "grasped_static",
    "grasped_pivoting",
    "grasped_sliding",
    "static_in_contact",
    "relative_pivoting",
    "relative_sliding",
    "extrinsic_pushing",
    "extrinsic_pivoting",
]

TWO_OBJECTS = """
name: pair
grasped_object: tall_box
extrinsic_object:
  {name: wedge, vertices_mm: [[0, 0], [90, 0], [0, 60]], mass: 0.2, friction: 0.5, tag: {id: 40, size_mm: 20}}
stages:
  - {stage: plan, name: press, skill: grasped_static}
"""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Run from an empty folder: what is shipped is found from anywhere."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(experiment: str, *sets: str, station: str | None = None):
    with pytest.raises(InputError) as e:
        load(experiment, station, sets)
    assert len(e.value.problems) == 1, str(e.value)
    return e.value.problems[0]


# -- shipped -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_experiment_passes_the_dry_run(name):
    lines = check(load(name))
    assert lines[0] == f"experiment {name}, seed 0"
    assert any("open_loop, closed_loop" in line for line in lines)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_bare_name_and_the_path_in_the_repository_mean_the_same(name):
    assert load(name).experiment == load(f"experiments/{name}.yaml").experiment
    assert load(name, "sim").station == load(name, "stations/sim.yaml").station == load(name).station


def test_grasped_pivoting_asks_for_the_motion_of_the_notes():
    resolved = load("grasped_pivoting")
    task = tasks(resolved, believed(resolved, Calibrations()))["pivot"]
    np.testing.assert_allclose(np.degrees(task.problem.angle[[0, -1]]), [10, 35])
    assert task.steps == 20


def test_figures_are_si_and_in_the_objects_frame():
    resolved = load("grasped_static")
    np.testing.assert_allclose(resolved.grasp, [0, 0.045, 0])
    assert resolved.friction == {"go-ground": 0.33}
    body = Body.model_validate(resolved.grasped.body("go"))
    assert [tag.id for tag in body.tags] == [10]


def test_the_camera_sees_the_table_tags_and_the_whole_grasped_object():
    station = load("grasped_static").station
    camera = next(d for d in station.devices.values() if isinstance(d, TagCameraConfig))
    model = CameraModel.looking_at(camera.position, camera.look_at, camera.focal, camera.width, camera.height)
    seen = [
        (mount.pose[0] + sx * mount.size * 0.625, -mount.height, mount.pose[1] + sy * mount.size * 0.625)
        for mount in station.table_tags
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    seen += [(x, y, z) for x in (-0.05, 0.15) for y in (-0.01, 0.01) for z in (0.0, 0.2)]
    pixels = model.project(np.array(seen))
    assert (pixels >= 10).all()
    assert (pixels <= [camera.width - 11, camera.height - 11]).all()


def test_the_shipped_station_is_a_whole_one():
    station = load_station("sim")
    assert {d.kind for d in station.devices.values()} == {"arm", "gripper", "force_torque", "tag_camera", "tactile"}
    assert station.devices["wrist_ft"].model_dump()["pose"] == (0.0, 0.2, 0.0)
    assert len({tag.id for tag in station.table_tags}) == 4


def test_only_the_named_devices_are_kept():
    assert set(load_station("sim", only=["arm", "camera"]).devices) == {"arm", "camera"}
    with pytest.raises(InputError) as e:
        load_station("sim", only=["wrist"])
    assert e.value.problems[0].nearest == "wrist_ft"


# -- --set -------------------------------------------------------------------------------------------------------------


def test_set_reaches_keys_that_stand_in_neither_file():
    resolved = load(
        "grasped_pivoting", None, ["trial.ramp=0.3", "world.stiffness_scale=8e-1", "log.omit=[camera/image]"]
    )
    assert resolved.experiment.trial.ramp == 0.3
    assert resolved.station.world is not None
    assert resolved.station.world.stiffness_scale == 0.8
    assert resolved.station.log.omit == ("camera/image",)


def test_every_figure_and_name_of_experiment_and_station_can_be_set():
    """Setting each to the value that it has changes nothing."""
    resolved = load("grasped_pivoting")
    Path("whole.yaml").write_text(dump_resolved(resolved))
    whole = load("whole.yaml")
    sets = []
    for whose, model in (("experiment", whole.experiment), ("station", whole.station)):
        data = model.model_dump(mode="json")
        for path in model_paths.paths(type(model), data):
            value = reduce(model_paths.at, path, data)
            if not isinstance(value, dict | list) and value is not None and path != ("station",):
                sets.append(f"{whose}.{'.'.join(str(key) for key in path)}={value}")
    assert {f"{whose}.name" for whose in ("experiment", "station")} <= {text.split("=")[0] for text in sets}
    assert "experiment.stages.0.parameters.force.0=4.0" in sets
    assert "station.devices.wrist_ft.pose.1=0.2" in sets
    again = load("whole.yaml", None, sets)
    assert again.experiment == whole.experiment
    assert again.station == whole.station


def test_set_reaches_list_items_and_a_skills_parameters():
    stage = load("grasped_pivoting", None, ["stages.0.parameters.force=3", "stages.1.trials=2"]).experiment.stages
    assert isinstance(stage[0], PlanStage)
    assert isinstance(stage[1], ExecuteStage)
    assert stage[0].parameters["force"] == [3.0, 3.0]
    assert stage[1].trials == 2


def test_a_key_of_both_is_refused_naming_both_and_a_prefix_decides():
    found = refused("grasped_pivoting", "name=mine")
    assert "both" in found.wrong
    assert found.expected == "experiment.name=... or station.name=..."
    resolved = load("grasped_pivoting", None, ["experiment.name=mine", "station.name=lab1"])
    assert (resolved.experiment.name, resolved.station.name) == ("mine", "lab1")


@pytest.mark.parametrize(
    ("text", "nearest"),
    [
        ("ramp=1", "trial.ramp"),
        ("trial.rmp=1", "trial.ramp"),
        ("world.profle=ideal", "world.profile"),
        ("stages.0.parameters.forc=3", "stages.0.parameters.force"),
        ("devices.wrist_tf.rate=3", "devices.wrist_ft.rate"),
        ("station.world.clck=lockstep", "station.world.clock"),
        ("experiment.sed=1", "experiment.seed"),
        ("friction.go-gound=1", "friction.go-ground"),
    ],
)
def test_a_key_of_neither_is_refused_with_the_nearest_of_both(text, nearest):
    found = refused("grasped_pivoting", text)
    assert found.file == f"--set {text.split('=')[0]}"
    assert found.nearest == nearest


@pytest.mark.parametrize("text", ["trial.ramp", "=3", "", " = "])
def test_a_set_without_key_or_value_is_refused(text):
    assert "key=value" in refused("grasped_pivoting", text).expected


def test_the_station_can_be_set_and_the_option_wins(elsewhere):
    text = (PACKAGE / "stations" / "sim.yaml").read_text().replace("name: sim", "name: other")
    (elsewhere / "stations").mkdir()
    (elsewhere / "stations" / "other.yaml").write_text(text)
    assert load("grasped_pivoting", None, ["station=other"]).station.name == "other"
    assert load("grasped_pivoting", "other").station.name == "other"
    assert load("grasped_pivoting", "sim", ["station=other"]).station.name == "sim"
    assert refused("grasped_pivoting", "station=othr").nearest == "other"


# -- references --------------------------------------------------------------------------------------------------------


def test_an_object_may_stand_in_the_file_or_beside_it(elsewhere):
    folder = elsewhere / "mine"
    folder.mkdir()
    (folder / "pair.yaml").write_text(TWO_OBJECTS.replace("tall_box", "brick.yaml"))
    (folder / "brick.yaml").write_text(
        "name: brick\nmass: 1\nvertices_mm: [[0, 0], [50, 0], [50, 120], [0, 120]]\nfriction: 0.4\n"
    )
    resolved = load("mine/pair.yaml")
    assert resolved.grasped.name == "brick"
    assert resolved.extrinsic is not None
    assert resolved.extrinsic.name == "wedge"


def test_friction_is_the_objects_own_unless_the_experiment_says(elsewhere):
    (elsewhere / "pair.yaml").write_text(TWO_OBJECTS)
    assert load("pair").friction == {"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 0.5}
    assert load("pair", None, ["friction.go-eo=0.1"]).friction == {"go-ground": 0.33, "go-eo": 0.1, "eo-ground": 0.5}


def test_two_tags_of_one_id_are_refused(elsewhere):
    (elsewhere / "pair.yaml").write_text(TWO_OBJECTS.replace("id: 40", "id: 10"))
    found = refused("pair.yaml")
    assert (found.line, found.key) == (4, "extrinsic_object")
    assert "id 10" in found.wrong
    assert "tag 2 stands twice" in refused("grasped_static", "table_tags.0.id=2").wrong


def test_a_bundle_has_ids_of_its_own_and_no_single_tag_beside_it(elsewhere):
    one = "tag: {id: 40, size_mm: 20}"
    (elsewhere / "pair.yaml").write_text(
        TWO_OBJECTS.replace(one, "tags: [{id: 40, size_mm: 20}, {id: 40, size_mm: 9}]")
    )
    found = refused("pair.yaml")
    assert found.key == "extrinsic_object.tags.1.id"
    assert "tag 40 stands twice" in found.wrong
    (elsewhere / "pair.yaml").write_text(
        TWO_OBJECTS.replace(one, "tags: [{id: 41, size_mm: 20}, {id: 10, size_mm: 9}]")
    )
    assert "id 10" in refused("pair.yaml").wrong
    (elsewhere / "pair.yaml").write_text(TWO_OBJECTS.replace(one, f"{one}, tags: [{{id: 41, size_mm: 20}}]"))
    assert "both `tag` and `tags`" in refused("pair.yaml").wrong


def test_a_grasp_outside_the_object_is_refused_in_millimetres():
    found = refused("grasped_static", "grasp.centre_mm=[0, 83.45]")
    assert "10.0 mm outside tall_box" in found.wrong  # half of 146.9 is 73.45


def test_a_new_skill_and_a_new_controller_are_known_by_registering(monkeypatch):
    from control.base import CONTROLLERS
    from planning.skills.base import SKILLS

    monkeypatch.setitem(SKILLS, "hover", SKILLS["grasped_static"])
    monkeypatch.setitem(CONTROLLERS, "dream", CONTROLLERS["open_loop"])
    load("grasped_static", None, ["stages.0.skill=hover", "stages.1.controllers=[dream]"])


def test_plans_come_before_their_execution_and_have_names_of_their_own(elsewhere):
    (elsewhere / "x.yaml").write_text(
        "name: x\ngrasped_object: tall_box\nstages:\n- {stage: plan, name: a, skill: grasped_static}\n"
        "- {stage: execute, plan: b, controllers: [open_loop]}\n- {stage: plan, name: b, skill: grasped_static}\n"
    )
    found = refused("x.yaml")
    assert (found.line, found.key, found.expected) == (5, "stages.1.plan", "one of a, a plan file (.npz)")
    found = refused("x.yaml", "stages.1.plan=a", "stages.2.name=a")
    assert (found.file, found.key) == ("--set stages.2.name", "stages.2.name")


def test_friction_with_an_object_that_is_not_there_is_refused():
    assert "no extrinsic object" in refused("grasped_static", "friction.eo-ground=0.3").wrong


# -- the resolved file -------------------------------------------------------------------------------------------------


def resolved_parts(resolved: Resolved):
    return (resolved.station, resolved.grasped, resolved.extrinsic, resolved.sensor, resolved.experiment.stages)


@pytest.mark.parametrize("name", [*SHIPPED, "pair"])
def test_a_resolved_file_is_whole_and_loads_again(name, elsewhere):
    (elsewhere / "pair.yaml").write_text(TWO_OBJECTS)
    first = load(name, None, ["seed=7", "world.stiffness_scale=0.8"])
    text = dump_resolved(first)
    assert "air_corrections:" in text
    assert "vertices_mm:" in text
    assert "stiffness_printed:" in text
    Path("experiment.yaml").write_text(text)
    again = load("experiment.yaml")
    assert resolved_parts(again) == resolved_parts(first)
    assert again.experiment.seed == 7
    assert again.friction == first.friction
    assert dump_resolved(again) == text


def test_a_resolved_file_takes_sets_and_another_station(elsewhere):
    Path("experiment.yaml").write_text(dump_resolved(load("grasped_static", None, ["station.name=lab1"])))
    assert load("experiment.yaml").station.name == "lab1"
    assert load("experiment.yaml", "sim").station.name == "sim"
    assert load("experiment.yaml", None, ["grasped_object.mass=0.2"]).grasped.mass == 0.2
    found = refused("experiment.yaml", "grasped_object.mas=0.2")
    assert found.nearest == "grasped_object.mass"


def test_an_error_in_a_resolved_file_names_the_whole_key(elsewhere):
    text = dump_resolved(load("grasped_static")).replace("seed: 0", "seed: x")
    Path("experiment.yaml").write_text(text)
    found = refused("experiment.yaml")
    assert found.key == "experiment.seed"
    assert found.line == text.splitlines().index("  seed: x") + 1
