"""Every kind of bad input: one clear message with file, line, key, what was expected and the nearest valid key.

Nothing is started and nothing is written; the command's exit code is 2.
"""

from __future__ import annotations

import pytest

from experiments.check import check
from experiments.files import load
from mechanics.yaml_input import InputError

GOOD = """\
name: mine
station: sim
sensor: soft_bubble
grasped_object: tall_box
stages:
  - stage: plan
    name: press
    skill: grasped_static
    parameters:
      steps: 5
  - stage: execute
    plan: press
    controllers: [open_loop]
"""

OBJECT = "name: brick\nvertices_mm:\n  - [0, 0]\n  - [50, 0]\n  - [50, 120]\n  - [0, 120]\nmass: 0.1\n"
SENSOR = "name: gel\nrho_mm: 40\nstiffness_printed: [[9, 0, 0], [0, 9, 0], [0, 0, 9]]\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(GOOD)
    (tmp_path / "brick.yaml").write_text(OBJECT)
    (tmp_path / "gel.yaml").write_text(SENSOR)
    return tmp_path


def edited(path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def refusal(station: str | None = None) -> str:
    with pytest.raises(InputError) as e:
        check(load("mine.yaml", station))
    return str(e.value)


def test_the_good_files_are_good(folder):
    check(load("mine.yaml"))
    edited(folder / "mine.yaml", "soft_bubble", "gel.yaml")
    assert load("mine.yaml").sensor.name == "gel"


# Each line: (what is edited, old, new) → the message, line by line.
CASES = {
    "misspelt key": (
        ("mine.yaml", "sensor: soft", "sensr: soft"),
        "mine.yaml, line 3: sensr: unknown key",
        "one of calibration, extrinsic_object, friction, grasp",
        "sensor",
    ),
    "unknown key": (
        ("mine.yaml", "station: sim", "zodiac: fine"),
        "mine.yaml, line 2: zodiac: unknown key",
        "one of calibration, extrinsic_object",
        None,
    ),
    "a motion faster than the arm may be": (
        ("mine.yaml", "sensor: soft", "trial: {approach_speed: 0.3}\nsensor: soft"),
        "mine.yaml, line 3: trial.approach_speed: 0.3 m/s on the mean is 0.562 m/s in the middle of a motion",
        "at most 0.133 m/s: the arm's limits.speed is 0.25 m/s",
        None,
    ),
    "misspelt key of a stage": (
        ("mine.yaml", "    plan: press", "    plan: press\n    trails: 2"),
        "mine.yaml, line 13: stages.1.trails: unknown key",
        "one of controllers, faults, first, plan, restiffen, settings, stage, trials",
        "trials",
    ),
    "misspelt parameter of a skill": (
        ("mine.yaml", "steps: 5", "step: 5"),
        "mine.yaml, line 10: stages.0.parameters.step: unknown key",
        "steps",
        "steps",
    ),
    "wrong type": (
        ("mine.yaml", "steps: 5", "steps: five"),
        "mine.yaml, line 10: stages.0.parameters.steps: text 'five'",
        "a whole number",
        None,
    ),
    "list for a name": (
        ("mine.yaml", "name: mine", "name: [mine]"),
        "mine.yaml, line 1: name: a list of 1",
        "text",
        None,
    ),
    "one name for a list": (
        ("mine.yaml", "[open_loop]", "open_loop"),
        "mine.yaml, line 13: stages.1.controllers: text 'open_loop'",
        "a list",
        None,
    ),
    "missing key": (
        ("mine.yaml", "grasped_object: tall_box\n", ""),
        "mine.yaml, line 1: grasped_object: missing key",
        "text or a mapping",
        None,
    ),
    "unknown object": (
        ("mine.yaml", "tall_box", "tal_box"),
        "mine.yaml, line 4: grasped_object: there is no such object: tal_box",
        "a path, or one of hbox, heptagon, pentagon, tall_box, triangle, z",
        "tall_box",
    ),
    "unknown skill": (
        ("mine.yaml", "skill: grasped_static", "skill: grasped_statics"),
        "mine.yaml, line 8: stages.0.skill: unknown skill 'grasped_statics'",
        "grasped_pivoting",
        "grasped_static",
    ),
    "unknown controller": (
        ("mine.yaml", "open_loop", "oppen_loop"),
        "mine.yaml, line 13: stages.1.controllers.0: unknown controller 'oppen_loop'",
        "closed_loop",
        "open_loop",
    ),
    "unknown stage": (
        ("mine.yaml", "stage: execute", "stage: exicute"),
        "mine.yaml, line 11: stages.1.stage: unknown value 'exicute'",
        "calibrate_friction, execute, faults, plan",
        "execute",
    ),
    "unknown sensor": (
        ("mine.yaml", "soft_bubble", "soft_buble"),
        "mine.yaml, line 3: sensor: there is no such sensor: soft_buble",
        "one of gelslim, soft_bubble",
        "soft_bubble",
    ),
    "unknown station": (
        ("mine.yaml", "station: sim", "station: simm"),
        "mine.yaml, line 2: station: there is no such station: simm",
        "sim",
        "sim",
    ),
    "unknown plan": (
        ("mine.yaml", "plan: press", "plan: pres"),
        "mine.yaml, line 12: stages.1.plan: no plan named 'pres' comes before this stage",
        "press",
        "press",
    ),
    "key twice": (
        ("mine.yaml", "station: sim", "name: again"),
        "mine.yaml, line 2: the key 'name' stands twice, first on line 1",
        "each key once",
        None,
    ),
    "not YAML": (
        ("mine.yaml", "[open_loop]", "[open_loop"),
        "mine.yaml, line 14: not YAML: while parsing a flow sequence",
        "`key: value` lines",
        None,
    ),
    "no trials": (
        ("mine.yaml", "    plan: press", "    plan: press\n    trials: 0"),
        "mine.yaml, line 13: stages.1.trials: the number 0",
        "greater than or equal to 1",
        None,
    ),
    "impossible motion": (
        (
            "mine.yaml",
            "skill: grasped_static\n    parameters:\n      steps: 5",
            "skill: grasped_pivoting\n    parameters:\n      angle_deg: [0, 20]",
        ),
        "mine.yaml, line 10: stages.0.parameters.angle_deg: step 0",
        "tall_box",
        None,
    ),
}


@pytest.mark.parametrize("case", list(CASES))
def test_bad_input_in_an_experiment(folder, case):
    (file, old, new), first, expected, nearest = CASES[case]
    edited(folder / file, old, new)
    lines = refusal().splitlines()
    assert lines[0].startswith(first)
    assert lines[1].startswith("    expected: ")
    assert expected in lines[1]
    assert lines[2:] == ([f"    nearest:  {nearest}"] if nearest else [])


REFERENCED = {
    "self-intersecting polygon": (
        ("brick.yaml", "- [50, 0]\n  - [50, 120]\n", "- [50, 120]\n  - [50, 0]\n"),
        "brick.yaml, line 3: vertices_mm.0: self-intersecting: edge 0–1 crosses edge 2–3 (vertices counted from 0)",
        "a simple polygon",
    ),
    "negative mass": (
        ("brick.yaml", "mass: 0.1", "mass: -0.1"),
        "brick.yaml, line 7: mass: the number -0.1",
        "greater than 0 (mass [kg])",
    ),
    "stiffness that is not positive definite": (
        ("gel.yaml", "[0, 0, 9]", "[0, 0, -9]"),
        "gel.yaml, line 3: stiffness_printed: not positive definite: its smallest eigenvalue is -9",
        "a symmetric, positive definite 3 × 3 matrix",
    ),
    "misspelt key of an object": (
        ("brick.yaml", "mass", "mas"),
        "brick.yaml, line 1: mass: missing key",
        "a number (mass [kg])",
    ),
}


@pytest.mark.parametrize("case", list(REFERENCED))
def test_bad_input_in_a_file_that_the_experiment_names(folder, case):
    (file, old, new), first, expected = REFERENCED[case]
    edited(folder / "mine.yaml", "tall_box", "brick.yaml")
    edited(folder / "mine.yaml", "soft_bubble", "gel.yaml")
    edited(folder / file, old, new)
    lines = refusal().splitlines()
    assert lines[0].removeprefix(f"{folder}/") == first
    assert expected in lines[1]


def test_bad_input_in_an_object_that_stands_in_the_experiment(folder):
    edited(folder / "mine.yaml", "tall_box", "\n  name: a\n  mass: -1\n  vertices_mm: [[0, 0], [50, 0], [0, 60]]")
    assert refusal().startswith("mine.yaml, line 6: grasped_object.mass: the number -1\n    expected: greater than 0")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the file is empty"),
        (b"# nothing\n", "the file is empty"),
        (b"- a\n- b\n", "line 1: a list of 2"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "line 1: this is no text in UTF-8"),
        (b"hello", "line 1: text 'hello'"),
        (b"a: b: c\n", "line 1: not YAML"),
    ],
)
def test_a_file_that_is_no_mapping_is_refused(folder, content, says):
    (folder / "mine.yaml").write_bytes(content)
    assert refusal().startswith(f"mine.yaml{',' if says.startswith('line') else ':'} {says}")


def test_a_missing_file_and_a_folder_are_refused(folder):
    with pytest.raises(InputError, match=r"minee\.yaml: there is no such experiment"):
        load("minee.yaml")
    with pytest.raises(InputError, match="is a folder"):
        load(str(folder))
    with pytest.raises(InputError) as e:
        load("grasped_pivotin")
    assert e.value.problems[0].nearest == "grasped_pivoting"


STATION = """\
name: lab
world: {profile: ideal}
devices:
  arm: {kind: arm}
  wrist: {kind: force_torque, mount: wrist}
  camera: {kind: tag_camera, position: [0, -1, 0], look_at: [0, 0, 0]}
table_tags: [{id: 0, size: 0.04}]
"""


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "ideal",
            "idel",
            "line 2: world.profile: unknown world profile 'idel'\n    expected: one of hard, ideal, lab\n"
            "    nearest:  ideal",
        ),
        ("world: {profile: ideal}\n", "", "line 1: world: missing key: arm, wrist, camera are simulated"),
        ("kind: arm}", "kind: amr}", "line 4: devices.arm.kind: unknown value 'amr'\n    expected: one of arm,"),
        ("mount: wrist", "mount: wirst", "line 5: devices.wrist.mount: unknown value 'wirst'"),
        ("  arm: {kind: arm}\n", "", "line 3: devices: the station has no arm"),
        ("mount: wrist", "mount: table", "line 3: devices: the station has no force_torque on the wrist"),
        ("table_tags: [{id: 0, size: 0.04}]", "", "line 1: table_tags: the table has no tags"),
        ("size: 0.04", "size: 0", "line 7: table_tags.0.size: the number 0\n    expected: greater than 0"),
        (
            "look_at: [0, 0, 0]",
            "look_at: [0, 0]",
            "line 6: devices.camera.look_at: too few values\n    expected: a list of 3",
        ),
        ("name: lab", "name: Lab 1", "line 1: name: text 'Lab 1'\n    expected: text matching"),
    ],
)
def test_bad_input_in_a_station(folder, old, new, says):
    assert old in STATION
    (folder / "lab.yaml").write_text(STATION)
    assert check(load("mine.yaml", "lab.yaml"))
    (folder / "lab.yaml").write_text(STATION.replace(old, new))
    assert refusal("lab.yaml").startswith(f"lab.yaml, {says}")


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("argument", ["missing.yaml", "mine.yaml"])
def test_the_command_exits_with_2_and_writes_nothing(folder, command, argument, monkeypatch, capsys):
    from experiments import cli

    edited(folder / "mine.yaml", "tall_box", "tal_box")
    before = sorted(folder.rglob("*"))
    monkeypatch.setattr("sys.argv", ["extrinsic", command, argument])
    with pytest.raises(SystemExit) as e:
        cli.main()
    assert e.value.code == 2
    shown = capsys.readouterr()
    assert argument in shown.err
    assert "Traceback" not in shown.err
    assert sorted(folder.rglob("*")) == before


SCENES = {
    "fingers too soft for the object": (
        (
            "mine.yaml",
            "sensor: soft_bubble",
            "sensor: {name: a, rho_mm: 9, stiffness_printed: [[9e3, 0, 0], [0, 9e3, 0], [0, 0, 9e3]]}",
        ),
        "mine.yaml, line 3: sensor: the fingers are too soft: a push of ",
        "makes the go spin out of the grasp",
    ),
    "no friction": (
        ("mine.yaml", "station: sim", "station: sim\nfriction: {go-ground: 0}"),
        "mine.yaml, line 3: friction.go-ground: the number 0",
        "greater than 0",
    ),
}


@pytest.mark.parametrize("case", list(SCENES))
def test_a_scene_that_the_plant_would_refuse_is_refused_before_the_start(folder, case):
    (file, old, new), first, says = SCENES[case]
    edited(folder / file, old, new)
    text = refusal()
    assert text.startswith(first)
    assert says in text


FINGERS = "  finger: {kind: tactile, sensor: gelslim, finger: left}\n"


def test_a_sensor_that_the_stations_fingers_are_not_is_refused(folder):
    (folder / "lab.yaml").write_text(STATION.replace("table_tags", FINGERS + "table_tags"))
    assert refusal("lab.yaml") == (
        "mine.yaml, line 3: sensor: soft_bubble is not what the station lab holds with: finger is a gelslim\n"
        "    expected: gelslim, or a station with soft_bubble fingers"
    )
    assert check(load("mine.yaml", "lab.yaml", ["sensor=gelslim"]))
    (folder / "gel.yaml").write_text(
        "name: gel\nrho_mm: 1000\nstiffness_printed: [[5e3, 0, 0], [0, 9e3, 0], [0, 0, 30]]\n"
    )
    assert check(load("mine.yaml", "lab.yaml", ["sensor=gel.yaml"]))  # one's own figures of these fingers
    (folder / "lab.yaml").write_text(STATION)  # without fingers nobody knows better
    assert check(load("mine.yaml", "lab.yaml", ["sensor=gelslim"]))


def test_an_object_cannot_be_held_and_touched_at_once_since_its_tag_would_stand_twice(folder):
    edited(folder / "mine.yaml", "grasped_object: tall_box", "grasped_object: tall_box\nextrinsic_object: tall_box")
    assert refusal() == (
        "mine.yaml, line 5: extrinsic_object: its tag has the id 10, as has grasped_object\n"
        "    expected: an id of its own for each tag"
    )


def test_bad_input_in_a_world_profile_of_ones_own(folder):
    (folder / "mine_profile.yaml").write_text("description: mine\narm: {repeatabilty: {angle_deg: 0.1}}\n")
    with pytest.raises(InputError) as e:
        load("mine.yaml", None, ["world.profile=mine_profile.yaml"])
    [problem] = e.value.problems
    assert (problem.file, problem.line, problem.nearest) == ("mine_profile.yaml", 2, "repeatability")
    (folder / "mine_profile.yaml").write_text("description: mine\n")
    assert load("mine.yaml", None, ["world.profile=mine_profile.yaml"])
