"""`extrinsic run calibrate` on the simulated station, shortened: what it finds is what the plant is made of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.samples import load_samples
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.ports import free_endpoint
from experiments.runner import Outcome, run
from mechanics.catalogue import load_sensor

SHORT = """
name: short
grasped_object: tall_box
extrinsic_object: hbox
friction: {go-ground: 0.3, go-eo: 0.35, eo-ground: 0.4}
trial: {approach_speed: 0.12}
stages:
  - {stage: calibrate_force_torque, orientations: 4, seconds: 0.1}
  - {stage: calibrate_camera, views: 9, poses: 6}
  - {stage: calibrate_clock, seconds: 3}
  - {stage: calibrate_elasticity, samples: 24, dwell: 0.4, long_dwell: 0.4}
  - {stage: calibrate_friction, pair: go-ground, strokes: 2}
  - {stage: calibrate_friction, pair: go-eo, strokes: 2}
  - {stage: calibrate_friction, pair: eo-ground, strokes: 2}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("station")


@pytest.fixture(scope="module")
def outcome(folder: Path) -> Outcome:
    (folder / "short.yaml").write_text(SHORT)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        sets = [f"bus.endpoint={free_endpoint()}"]
        with (folder / "said.txt").open("w") as said:
            return run(load("short.yaml", None, sets), Path("run"), Console(file=said))


@pytest.fixture
def results(outcome: Outcome, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.chdir(folder)
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    return json.loads(Path("run/results.json").read_text())["calibration"]


def test_the_stiffness_is_the_plants(results: dict[str, Any]) -> None:
    nominal = load_sensor("soft_bubble").stiffness
    scale = np.sqrt(np.outer(np.diag(nominal), np.diag(nominal)))
    found = np.array(results["elasticity-soft_bubble-tall_box"]["stiffness"])
    np.testing.assert_allclose(found / scale, nominal / scale, atol=0.005)


@pytest.mark.parametrize(("name", "mu"), [("tall_box-ground", 0.3), ("tall_box-hbox", 0.35), ("hbox-ground", 0.4)])
def test_each_pairs_friction_is_the_plants(results: dict[str, Any], name: str, mu: float) -> None:
    found = results[f"friction-{name}"]
    assert found["mu"] == pytest.approx(mu, rel=0.01)
    assert found["interval"][0] < mu < found["interval"][1]
    forces = load_samples(Path(f"run/calibration/friction-{name}.csv"))
    assert (np.abs(forces["f_t"]) <= 1.02 * mu * forces["f_n"] + 0.02).all()  # all of them lie in the cone


def test_camera_tag_and_clocks_are_what_the_simulation_has(results: dict[str, Any]) -> None:
    camera = np.array(results["camera"]["camera"]["K"])
    assert camera[0, 0] == pytest.approx(1400.0, abs=0.5)
    position = np.array(results["camera"]["camera"]["X_WC"])[:3, 3]
    np.testing.assert_allclose(position, [0.0, -0.55, 0.07], atol=3e-4)
    seat = results["tag-tall_box-10"]
    np.testing.assert_allclose(seat["pose"][:2], [0.0, -0.04], atol=1e-4)
    assert seat["pose"][2] == pytest.approx(0.0, abs=1e-3)
    delays = results["clock"]["delays"]
    assert delays["camera"]["delay"] == pytest.approx(0.0, abs=5e-4)
    assert abs(delays["wrist"]["delay"]) < 3 * delays["wrist"]["deviation"]  # 0.1 kg is all that it feels turning
    assert results["force_torque"]["tool_mass"] == pytest.approx(0.0, abs=1e-6)


def test_later_runs_on_this_station_believe_it(results: dict[str, Any]) -> None:
    later = load("grasped_static", None, [])
    found = store.load(later)
    assert {c.name for c in found} >= {"elasticity-soft_bubble-tall_box", "camera", "clock", "force_torque"}
    believed = setup.believed(later, found)
    np.testing.assert_array_equal(believed.stiffness, results["elasticity-soft_bubble-tall_box"]["stiffness"])
    assert list(store.load(load("grasped_static", None, ["seed=5"]))) == []  # another laboratory


def test_the_arm_is_back_and_free_and_the_report_is_there(results: dict[str, Any], outcome: Outcome) -> None:
    report = Path("run/report.html").read_text()
    assert "8 calibrations were made" in report
    assert outcome.results["log"]["lost"] == 0
