"""`extrinsic init`: a folder that runs as it is, or nothing at all."""

import json
import os

import pytest
from jsonschema import Draft7Validator

from experiments import new_folder as module
from experiments import shipped
from experiments.files import load
from experiments.new_folder import new_folder
from mechanics.yaml_input import InputError, read_yaml

MADE = {".gitignore", "README.md", "experiment.yaml", "schemas", "station.yaml"}


def contents(folder):
    return {file.name for file in folder.iterdir()}


def test_what_is_shipped_to_begin_with_are_experiments_and_stations():
    assert {"demo", "grasped_pivoting", "extrinsic_pivoting", "calibrate"} <= set(shipped.experiments())
    assert not {"targets", "paper_tables", "table_grasped"} & set(shipped.experiments())
    assert {"sim", "emulated_lab", "example_lab"} <= set(shipped.stations())


@pytest.mark.parametrize("experiment", shipped.experiments())
def test_the_copy_says_what_the_shipped_one_says_and_names_the_station_beside_it(experiment, tmp_path, monkeypatch):
    new_folder(tmp_path / "demo", experiment, "sim")
    monkeypatch.chdir(tmp_path / "demo")
    made, shipped = load("experiment.yaml"), load(experiment, "sim")
    assert made.experiment.station == "station.yaml"
    assert made.experiment.model_copy(update={"station": "sim"}) == shipped.experiment
    assert made.station == shipped.station
    assert contents(tmp_path / "demo") == MADE


@pytest.mark.parametrize("station", shipped.stations())
def test_its_files_fit_the_schemas_that_they_name(station, tmp_path):
    new_folder(tmp_path / "demo", "grasped_static", station)
    for name in ("experiment", "station"):
        file = tmp_path / "demo" / f"{name}.yaml"
        first, _, _ = file.read_text("utf-8").partition("\n")
        schema = json.loads((file.parent / first.partition("$schema=")[2]).read_text("utf-8"))
        assert Draft7Validator(schema).is_valid(read_yaml(file).data)


def test_an_empty_folder_is_filled_and_stays_the_same_folder(tmp_path):
    before = tmp_path.stat().st_ino
    new_folder(tmp_path, "grasped_static", "sim")
    assert contents(tmp_path) == MADE
    assert tmp_path.stat().st_ino == before


def test_folders_above_are_made(tmp_path):
    new_folder(tmp_path / "a" / "b", "grasped_static", "sim")
    assert contents(tmp_path / "a" / "b") == MADE


def test_a_folder_that_is_not_empty_is_refused_and_nothing_is_written(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(InputError, match="there is something there already"):
        new_folder(tmp_path, "grasped_static", "sim")
    with pytest.raises(InputError, match="there is something there already"):
        new_folder(tmp_path / "mine", "grasped_static", "sim")
    with pytest.raises(InputError, match="cannot be written"):
        new_folder(tmp_path / "mine" / "demo", "grasped_static", "sim")
    with pytest.raises(InputError, match="cannot be written"):
        new_folder(tmp_path / "de\0mo", "grasped_static", "sim")
    assert contents(tmp_path) == {"mine"}


@pytest.mark.parametrize("folder", [".", "demo"])
def test_a_disk_that_fills_up_leaves_nothing(folder, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.shutil, "copyfile", full)
    with pytest.raises(InputError, match="No space left on device"):
        new_folder(tmp_path / folder, "grasped_static", "sim")
    assert not contents(tmp_path)


def test_what_is_not_shipped_is_answered_with_the_nearest_that_is(tmp_path):
    for given, near in (({"experiment": "grasped_statik", "station": "sim"}, "grasped_static"),):
        with pytest.raises(InputError) as refused:
            new_folder(tmp_path / "demo", **given)
        assert refused.value.problems[0].nearest == near
    with pytest.raises(InputError, match=r"--station: 'simm' is not shipped"):
        new_folder(tmp_path / "demo", "grasped_static", "simm")
    assert not contents(tmp_path)


def test_the_command_says_what_to_do_next_and_that_passes_the_dry_run(command):
    made = command.finish(command.start("init", "my demo", "--experiment", "grasped_static"))
    assert (made.code, made.err) == (0, "")
    assert made.out.splitlines()[-1] == "next: cd 'my demo' && extrinsic run experiment.yaml"
    command.folder /= "my demo"
    checked = command.finish(command.start("check", "experiment.yaml"))
    assert checked.code == 0, checked.err
    again = command.finish(command.start("init", "."))
    assert again.code == 2
    assert "a new or an empty folder" in again.err
    assert contents(command.folder) == MADE
    assert os.access(command.folder / "README.md", os.R_OK)
