"""An object that is in no catalogue is tipped from YAML alone: an L, which is not convex, and a right trapezoid."""

from __future__ import annotations

import pytest

from experiments.check import check
from experiments.files import load

OWN = {
    "my_l": "vertices_mm: [[0, 0], [60, 0], [60, 30], [30, 30], [30, 90], [0, 90]], mass: 0.1",
    "my_trapezoid": "vertices_mm: [[0, 0], [70, 0], [45, 70], [0, 70]], mass: 0.06",
}
EXPERIMENT = """
name: {name}
sensor: soft_bubble
grasped_object: tall_box
extrinsic_object: {{name: {name}, {shape}, tag: {{id: 17, size_mm: 22, height_mm: 10}}}}
grasp: {{centre_mm: [0, 45], angle_deg: 0}}
friction: {{eo-ground: 0.5}}
stages:
  - {{stage: plan, name: tip, skill: extrinsic_pivoting, parameters: {{pivot: left}}, weights: {{track: 0.01}}}}
  - {{stage: execute, plan: tip, controllers: [closed_loop_pi], trials: 1}}
"""


def write(folder, name):
    (folder / f"{name}.yaml").write_text(EXPERIMENT.format(name=name, shape=OWN[name]))


@pytest.mark.parametrize("name", OWN)
def test_it_is_found_where_and_how_to_tip_it(tmp_path, monkeypatch, name):
    write(tmp_path, name)
    monkeypatch.chdir(tmp_path)
    assert "stage 1: plan tip: extrinsic_pivoting, 40 steps, lm on fused, closed form" in check(load(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", OWN)
def test_it_is_tipped_in_a_lab_as_well_as_the_paper_s_objects_are(command, name):
    write(command.folder, name)
    finished = command.run(name, "--set", "world.profile=lab", "--set", "seed=3")
    assert finished.code == 0, finished.err
    trial = finished.trial("closed_loop_pi")
    assert trial["status"] == "completed"
    # the best summaries of the paper's table of extrinsic pivoting
    assert trial["measured"]["eo_pose_mm"]["mean"] <= 0.8
    assert trial["measured"]["wrench_N"]["mean"] <= 0.75
