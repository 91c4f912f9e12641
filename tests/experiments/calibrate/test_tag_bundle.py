"""An object with two tags: each is calibrated, and a run goes by both."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from drivers.sim.host_thread import HostThread
from drivers.sim.mismatch import Lab, load_profile
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.ports import free_endpoint
from experiments.runner import run
from mechanics import se2

PLACES = {10: (0.0, -0.060, 0.0), 19: (0.003, -0.034, np.radians(5.0))}
BUNDLE = """
name: bundle
grasped_object:
  name: twice
  vertices_mm: [[-25, -73.45], [25, -73.45], [25, 73.45], [-25, 73.45]]
  mass: 0.1
  tags:
    - {id: 10, size_mm: 18, position_mm: [0, -60], height_mm: 10}
    - {id: 19, size_mm: 18, position_mm: [3, -34], angle_deg: 5, height_mm: 10}
trial: {approach_speed: 0.12}
stages:
  - {stage: calibrate_camera, views: 9, poses: 6}
  - {stage: plan, name: press, skill: grasped_static, parameters: {steps: 2}}
  - {stage: execute, plan: press, controllers: [closed_loop], trials: 1}
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    folder = tmp_path_factory.mktemp("bundle")
    (folder / "bundle.yaml").write_text(BUNDLE)
    with pytest.MonkeyPatch.context() as patch, (folder / "said.txt").open("w") as said:
        patch.chdir(folder)
        sets = [f"bus.endpoint={free_endpoint()}", "world.profile=lab", "trial.go_pose=tags"]
        outcome = run(load("bundle.yaml", None, sets), Path("run"), Console(file=said), HostThread)
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    return json.loads((folder / "run" / "results.json").read_text())


@pytest.mark.parametrize("number", PLACES)
def test_each_tag_is_found_where_it_is_stuck_on(results: dict, number: int) -> None:
    seat = results["calibration"][f"tag-twice-{number}"]
    true = se2.compose(np.array(PLACES[number]), Lab(load_profile("lab"), 0).tag_bias(number))
    off = np.abs(np.array(seat["pose"]) - true)
    assert (off <= 3 * np.array(seat["deviation"])).all(), off
    assert max(seat["deviation"][:2]) < 3e-4


def test_a_trial_that_goes_by_both_is_completed_and_true(results: dict) -> None:
    [trial] = results["trials"]
    assert trial["status"] == "completed"
    assert trial["truth"]["go_pose_mm"]["mean"] < 0.5
