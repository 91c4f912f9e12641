"""The Python interface: what the command does, from Python."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from nbclient import NotebookClient

from experiments import Run, RunFailed, run
from experiments.campaign.frame import trials_frame
from experiments.interface import settings
from mechanics.yaml_input import InputError
from tests.experiments.conftest import free_port

NOTEBOOKS = sorted(Path("docs/notebooks").resolve().glob("*.ipynb"))
SHORT = {"stages.0.parameters.steps": 4, "world.stiffness_scale": 0.8}


def endpoint():
    return {"bus.endpoint": f"tcp/127.0.0.1:{free_port()}"}


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("interface") / "run"
    return run("grasped_static", "sim", set={**SHORT, **endpoint()}, out=folder, quiet=True)


def test_importing_the_package_imports_nothing_else():
    heavy = ("numpy", "pandas", "torch", "rich", "pydantic", "zenoh")
    asked = f"import sys, experiments; sys.exit(' '.join(set({heavy}) & set(sys.modules)) or None)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_run_leaves_the_folder_that_the_command_leaves(pressed):
    assert pressed.status == "completed"
    assert {file.name for file in pressed.folder.iterdir()} >= {"experiment.yaml", "log.mcap", "results.json"}
    assert pressed.report.is_file()
    assert pressed.results == json.loads((pressed.folder / "results.json").read_text("utf-8"))
    assert repr(pressed) == f"Run({pressed.folder}: completed, 2 trials)"


def test_trials_are_a_frame_with_the_columns_of_a_sweeps_table(pressed, tmp_path):
    job = {"id": "one", "tags": {"mu": 0.3}, "trials": pressed.results["trials"]}
    (tmp_path / "campaign.json").write_text(json.dumps({"jobs": [job]}))
    shutil.copytree(pressed.folder, tmp_path / "jobs" / "one" / "run")
    swept = trials_frame(tmp_path)
    assert [*swept.columns] == ["job", "run", "mu", *pressed.trials.columns]
    pd.testing.assert_frame_equal(swept.drop(columns=["job", "run", "mu"]), pressed.trials)
    assert pressed.trials["measured.wrench_N.mean"].tolist() == [
        trial["measured"]["wrench_N"]["mean"] for trial in pressed.results["trials"]
    ]


def test_plans_are_those_of_the_trials(pressed):
    assert [*pressed.plans] == ["press"]
    assert pressed.plans["press"].steps == 4


def test_a_stream_is_what_another_reader_finds_in_the_log(pressed):
    with (pressed.folder / "log.mcap").open("rb") as file:
        found = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["sim/wrist_ft/wrench"])
        read = [
            (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, m.wrench.force.x, m.wrench.force.z, m.wrench.torque.y)
            for _, _, _, m in found
        ]
    series = pressed.log["wrist_ft/wrench"]
    assert series.columns == ("fx", "fy", "fz", "tx", "ty", "tz")
    assert series.times_ns.tolist() == [row[0] for row in read]
    np.testing.assert_array_equal(series.values[:, [0, 2, 4]], [row[1:] for row in read])
    np.testing.assert_array_equal(series["fz"], series.values[:, 2])
    np.testing.assert_allclose(series.times, series.times_ns / 1e9)
    assert not series.status.any()
    assert pressed.log["sim/wrist_ft/wrench"] is series


def test_waypoints_give_the_errors_of_the_results(pressed):
    waypoints = pressed.log["run/waypoint"].frame()
    assert len(waypoints) == 2 * 4
    for trial in pressed.results["trials"]:
        rows = waypoints[waypoints.trial == trial["name"]]
        error = (rows.measured_fx - rows.planned_fx).abs().mean()
        assert error == pytest.approx(trial["measured"]["fx_N"]["mean"])


def test_every_topic_of_a_log_is_an_array_with_a_name_for_each_column(pressed):
    assert [*pressed.log] == [*pressed.log.counts]
    for topic, series in pressed.log.items():
        assert series.values.shape[0] == len(series), topic
        if series.values.ndim == 2:
            assert series.values.shape[1] == len(series.columns), topic
            assert series.frame().shape == (len(series), len(series.columns) + len(series.texts))
            assert all(len(words) == len(series) for words in series.texts.values())
    assert len(pressed.log["arm/pose"]) == pressed.log.counts["arm/pose"]


def test_pictures_are_an_array_of_pictures_and_come_one_by_one_too(pressed):
    pictures = pressed.log["camera/image"]
    assert pictures.values.shape[1:] == (720, 1280)
    assert pictures.values.dtype == np.uint8
    first = next(iter(pressed.log.readings("camera/image")))
    np.testing.assert_array_equal(first.image, pictures.values[0])
    with pytest.raises(ValueError, match="no table"):
        pictures.frame()


def test_what_is_not_there_is_answered_with_what_is(pressed):
    with pytest.raises(KeyError, match="nearest: wrist_ft/wrench"):
        pressed.log["wrist_ft/wrensh"]
    with pytest.raises(KeyError, match="fx, fy, fz, tx, ty, tz"):
        pressed.log["wrist_ft/wrench"]["force"]


def test_a_notebook_shows_the_commands_table(pressed):
    shown = pressed._repr_html_()
    assert "press-closed_loop-0" in shown
    assert str(pressed.report) in shown


def test_an_old_run_is_opened_with_all_that_it_has(pressed):
    again = Run.open(str(pressed.folder))
    pd.testing.assert_frame_equal(again.trials, pressed.trials)
    assert again.log.counts == pressed.log.counts


def test_a_folder_without_a_run_or_without_results_is_refused(pressed, tmp_path):
    with pytest.raises(InputError, match=r"no experiment\.yaml in it"):
        Run.open(tmp_path)
    shutil.copy(pressed.folder / "experiment.yaml", tmp_path)
    with pytest.raises(InputError, match="extrinsic repair"):
        Run.open(tmp_path)


def test_bad_input_is_refused_in_the_commands_words_and_nothing_is_started(command, monkeypatch):
    monkeypatch.chdir(command.folder)
    with pytest.raises(InputError) as refused:
        run("grasped_static", set={"trial.rampe": 0.3})
    said = command.finish(command.start("run", "grasped_static", "--set", "trial.rampe=0.3"))
    assert (said.code, said.err) == (2, f"{refused.value}\n")
    assert not [*command.folder.iterdir()]


def test_a_run_that_cannot_be_carried_out_raises_and_says_what_is_left(tmp_path):
    with pytest.raises(RunFailed, match=r"infeasible: (.|\n)*Run\.open") as failed:
        slippery = {"friction": {"go-ground": 0.1}, "stages.0.parameters.tangential": [1, 1]}
        run("grasped_static", set={**slippery, **endpoint()}, out=tmp_path / "run", quiet=True)
    assert failed.value.run.status == "infeasible"
    assert Run.open(tmp_path / "run").trials.empty


def test_settings_are_python_values_or_the_commands_text():
    given = {"seed": np.int64(3), "name": "1", "world.profile": Path("p.yaml"), "grasp.centre_mm": np.array([0.0, 4.5])}
    assert settings(given) == ["seed=3", 'name="1"', 'world.profile="p.yaml"', "grasp.centre_mm=[0.0, 4.5]"]
    assert settings({"rehearse": True, "extrinsic_object": None}) == ["rehearse=true", "extrinsic_object=null"]
    assert settings(["trial.ramp=0.3"]) == ["trial.ramp=0.3"]
    for wrong in ({"seed": object()}, {"trial.ramp": float("nan")}, "trial.ramp=0.3"):
        with pytest.raises(InputError):
            settings(wrong)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_has_no_outputs_stored_and_runs(file, tmp_path):
    notebook = nbformat.read(file, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not [cell for cell in cells if cell.outputs or cell.execution_count]
    [given] = [cell for cell in cells if "parameters" in cell.metadata.get("tags", ())]
    given.source += f"\nsettings |= { ({'stages.0.parameters.steps': 4} | endpoint())!r}"  # a free port, and soon done
    told = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(Path.cwd()), told)))
    try:
        NotebookClient(notebook, timeout=100, resources={"metadata": {"path": str(tmp_path)}}).execute()
    finally:
        os.environ.pop("PYTHONPATH") if told is None else os.environ.update(PYTHONPATH=told)
    table = next(cell for cell in cells if "pivoting.trials" in cell.source)
    assert "closed_loop" in table.outputs[0].data["text/plain"]
    assert len([*(tmp_path / "runs").iterdir()]) == 1
