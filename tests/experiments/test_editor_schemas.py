"""The JSON Schemas of the files that people write: they are up to date, and agree with what the loader takes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from jsonschema import Draft7Validator

from drivers.config import StationConfig
from drivers.sim.mismatch import FOLDER as PROFILES
from drivers.sim.mismatch import Mismatch
from experiments import shipped
from experiments.editors import KINDS, MODELINE, SCHEMAS, schema_text
from experiments.files import PACKAGE, dump_resolved, load
from experiments.schema import Experiment
from experiments.table.schema import Table
from mechanics.catalogue import CATALOGUE, SENSORS, ObjectModel, SensorModel
from mechanics.yaml_input import InputError, parse, read_text, read_yaml

MODELS = {
    "experiment": Experiment,
    "station": StationConfig,
    "object": ObjectModel,
    "sensor": SensorModel,
    "profile": Mismatch,
    "table": Table,
}
SHIPPED = {
    "experiment": sorted(shipped.FOLDER / f"{name}.yaml" for name in shipped.experiments()),
    "station": sorted(shipped.STATIONS / f"{name}.yaml" for name in shipped.stations()),
    "object": sorted(CATALOGUE.glob("*.yaml")),
    "sensor": sorted(SENSORS.glob("*.yaml")),
    "profile": sorted(PROFILES.glob("*.yaml")),
    "table": sorted(PACKAGE.glob("table_*.yaml")),
}
FILES = [pytest.param(kind, file, id=f"{kind}-{file.stem}") for kind, files in SHIPPED.items() for file in files]
#: files with every kind of stage, device and key between them: each is tried hundreds of times
TRIED = [
    pytest.param(kind, next(file for file in SHIPPED[kind] if file.stem == name), id=name)
    for kind, name in (
        ("experiment", "demo"),
        ("experiment", "calibrate"),
        ("station", "sim"),
        ("station", "example_lab"),
        ("object", "pentagon"),
        ("sensor", "gelslim"),
        ("profile", "hard"),
    )
]
TEXTS = {kind: json.loads((SCHEMAS / f"{kind}.json").read_text("utf-8")) for kind in KINDS}
VALIDATORS = {kind: Draft7Validator(schema) for kind, schema in TEXTS.items()}


def accepted(kind, data):
    return VALIDATORS[kind].is_valid(data)


def loaded(kind, data):
    try:
        parse(MODELS[kind], read_text(json.dumps(data), "file.yaml"))
    except InputError:
        return False
    return True


def test_the_shipped_schemas_are_those_that_the_command_makes(tmp_path):
    # in a process of its own: the tests of skills and laws register more of them
    command = [sys.executable, "-m", "experiments.cli", "schema", "--out", str(tmp_path)]
    subprocess.run(command, check=True, timeout=100)
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in SCHEMAS.iterdir()}
    for file in SCHEMAS.iterdir():
        made = (tmp_path / file.name).read_bytes()
        assert made == file.read_bytes(), f"{file} is not up to date: extrinsic schema --out experiments/schemas"


@pytest.mark.parametrize("kind", KINDS)
def test_each_is_a_schema_of_draft_7_with_a_title_and_a_description(kind):
    schema = TEXTS[kind]
    assert schema["$schema"] == "http://json-schema.org/draft-07/schema#"
    Draft7Validator.check_schema(schema)
    named = [name for name, one in schema["definitions"].items() if not one.get("title")]
    assert schema["title"]
    assert not named


def test_every_key_of_an_experiment_and_of_a_station_is_described():
    definitions = TEXTS["experiment"]["definitions"]
    for name in ("Experiment", "StationConfig", "GraspConfig", "WorldConfig", "TrialSettings"):
        for key, one in definitions[name]["properties"].items():
            target = one["allOf"][0].get("$ref") if "allOf" in one else one.get("$ref")
            described = definitions[target.rpartition("/")[2]] if target else one
            assert described.get("description"), f"{name}.{key}"


@pytest.mark.parametrize(("kind", "file"), FILES)
def test_a_shipped_file_fits_its_schema_and_names_it_in_its_first_line(kind, file):
    assert not [error.message for error in VALIDATORS[kind].iter_errors(read_yaml(file).data)]
    first = file.read_text("utf-8").splitlines()[0]
    assert first.startswith(MODELINE)
    assert (file.parent / first.removeprefix(MODELINE)).resolve() == (SCHEMAS / f"{kind}.json").resolve()


def misspelt(data):
    """``data`` with each of its keys misspelt in turn, and the path of that key."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield (key,), {(f"{name}x" if name == key else name): one for name, one in data.items()}
            for path, other in misspelt(value):
                yield (key, *path), {**data, key: other}
    elif isinstance(data, list):
        for i, value in enumerate(data):
            for path, other in misspelt(value):
                yield (i, *path), [*data[:i], other, *data[i + 1 :]]


def mistyped(data):
    """``data`` with each of its plain values replaced by another kind of value in turn, and where."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            for path, other in mistyped(value):
                if isinstance(data, dict):
                    yield (key, *path), {**data, key: other}
                else:
                    yield (key, *path), [*data[:key], other, *data[key + 1 :]]
    else:
        for other in ({"no": "such"}, True if isinstance(data, int | float) else -1e300):
            yield (), other


@pytest.mark.parametrize(("kind", "file"), FILES)
def test_a_misspelt_key_of_a_shipped_file_does_not_fit_its_schema(kind, file):
    data = read_yaml(file).data
    for key in data:
        assert not accepted(kind, {(f"{name}x" if name == key else name): one for name, one in data.items()})


@pytest.mark.parametrize(("kind", "file"), TRIED)
def test_a_misspelt_key_fails_wherever_the_loader_refuses_it(kind, file):
    outcomes = [(accepted(kind, data), loaded(kind, data), path) for path, data in misspelt(read_yaml(file).data)]
    assert not [path for fits, loads, path in outcomes if fits != loads]
    assert any(not fits for fits, _, _ in outcomes)


@pytest.mark.parametrize(("kind", "file"), TRIED)
def test_a_value_of_another_kind_fails_wherever_the_loader_refuses_it(kind, file):
    for path, data in mistyped(read_yaml(file).data):
        assert accepted(kind, data) == loaded(kind, data), (path, data)


@pytest.mark.parametrize("station", ["sim", "sim_gelslim", "emulated_lab"])
def test_what_a_run_leaves_as_its_experiment_fits_the_schema_too(station):
    resolved = read_text(dump_resolved(load("demo", station)), "experiment.yaml").data
    assert accepted("experiment", resolved)
    assert not accepted("experiment", {**resolved, "more": 1})
    assert not accepted("experiment", {"experiment": resolved["experiment"]})


PIVOT = {"stage": "plan", "name": "p", "skill": "grasped_pivoting"}
BASE = {"name": "mine", "grasped_object": "tall_box", "stages": [PIVOT]}
TRIANGLE = {"name": "wedge", "vertices_mm": [[0, 0], [50, 0], [0, 50]], "mass": 0.1}


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"grasped_object": "objects/mine.yaml"},
        {"grasped_object": TRIANGLE},
        {"grasped_object": {**TRIANGLE, "color": "red"}},
        {"grasped_object": 3},
        {"extrinsic_object": None},
        {"grasp": {"centre_mm": "auto"}},
        {"grasp": {"centre_mm": [0, 45]}},
        {"grasp": {"centre_mm": [0, 45, 0]}},
        {"friction": {"go-ground": 0.4}},
        {"friction": {"ground-go": 0.4}},
        {"stages": [{**PIVOT, "optimiser": "mppi"}]},
        {"stages": [{**PIVOT, "optimiser": "adam"}]},
        {"stages": [{**PIVOT, "optimiser": {"iterations": 3}}]},
        {"stages": [{**PIVOT, "optimiser": {"name": "gradient", "iterations": 3}}]},
        {"stages": [{**PIVOT, "optimiser": {"name": "gradient", "samples": 3}}]},
        {"stages": [{**PIVOT, "parameters": {"angle_degrees": 3}}]},
        {"stages": [{**PIVOT, "parameters": {"steps": 3}}]},
        {"stages": [{**PIVOT, "skill": "juggling"}]},
        {"stages": [{"stage": "play"}]},
        {"stages": []},
        {"stages": [PIVOT, {"stage": "execute", "plan": "p", "controllers": ["mpc"], "settings": {"mpc": {}}}]},
        {"stages": [PIVOT, {"stage": "execute", "plan": "p", "controllers": ["mpc"], "settings": {"mpc": {"x": 1}}}]},
        {"stages": [PIVOT, {"stage": "execute", "plan": "p", "controllers": []}]},
    ],
    ids=str,
)
def test_shorthands_and_what_depends_on_a_name_are_as_the_loader_has_them(change):
    data = {**BASE, **change}
    assert accepted("experiment", data) == loaded("experiment", data)


SENSOR = {"kind": "force_torque", "mount": "wrist"}


@pytest.mark.parametrize(
    "device",
    [
        SENSOR,
        {**SENSOR, "backend": "sim"},
        {**SENSOR, "backend": "replay", "log": "runs/a"},
        {**SENSOR, "backend": "replay"},
        {**SENSOR, "backend": "real"},
        {**SENSOR, "backend": "real", "driver": "ati_netft", "address": "10.0.0.1"},
        {**SENSOR, "backend": "real", "driver": "ati_netft", "adress": "10.0.0.1"},
        {**SENSOR, "backend": "virtual"},
        {**SENSOR, "address": "10.0.0.1"},
        {"mount": "wrist"},
        {"kind": "arm", "mount": "wrist"},
        {"kind": "sonar"},
        "wrist",
    ],
    ids=str,
)
def test_a_device_has_the_keys_of_its_kind_backend_and_driver(device):
    data = {"name": "lab", "devices": {"wrist_ft": device}}
    assert accepted("station", data) == loaded("station", data)


def test_of_a_driver_of_another_package_nothing_is_said():
    device = {**SENSOR, "backend": "real", "driver": "of_another_package", "whatever": 1}
    assert accepted("station", {"name": "lab", "devices": {"wrist_ft": device}})


def test_a_kind_of_file_that_there_is_not_is_refused_with_those_that_there_are():
    with pytest.raises(InputError, match=r"experimant.*\n.*experiment, object, profile, sensor, station, table") as e:
        schema_text("experimant")
    assert e.value.problems[0].nearest == "experiment"


def test_the_schemas_name_no_file_of_this_machine():
    for file in SCHEMAS.iterdir():
        assert str(Path.home()) not in file.read_text("utf-8")
        assert str(PACKAGE.parent) not in file.read_text("utf-8")
