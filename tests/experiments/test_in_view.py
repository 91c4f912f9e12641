"""What the camera cannot see is bad input: before anything runs, with a place from which it would see it."""

import re

import numpy as np
import pytest

from experiments import planned_poses
from experiments.calibrate.store import Calibrations
from experiments.check import check, tasks
from experiments.files import load
from experiments.planning.make import objective
from experiments.setup import believed
from mechanics.yaml_input import InputError
from planning import planner


def box(height, tag="tag: {id: 20, size_mm: 36}"):
    x, y = 40, height / 2
    corners = f"[[{-x}, {-y}], [{x}, {-y}], [{x}, {y}], [{-x}, {y}]]"
    return f"extrinsic_object={{name: box, vertices_mm: {corners}, mass: 0.1{', ' if tag else ''}{tag}}}"


def checked(experiment, *sets):
    return check(load(experiment, None, ["calibration.source=none", *sets]), Calibrations())


def refusal(experiment, *sets):
    with pytest.raises(InputError) as refused:
        checked(experiment, *sets)
    [problem] = refused.value.problems
    return problem


ROUGH = "friction.eo-ground=0.5"


def test_an_object_that_carries_no_tag_is_refused_where_trials_move_it():
    problem = refusal("extrinsic_pivoting", ROUGH, box(140, tag=""))
    assert (problem.key, problem.wrong) == ("extrinsic_object", "box has no tag: the camera could not see it")
    plan = "stages=[{stage: plan, name: tip, skill: extrinsic_pivoting}]"
    assert checked("extrinsic_pivoting", plan, ROUGH, box(140, tag=""))  # nobody looks at it
    assert checked("grasped_static", box(140, tag=""))  # nobody moves it


@pytest.mark.parametrize("height", [145, 200])
def test_an_object_that_lifts_the_held_one_out_of_the_picture_is_refused_with_a_place_for_the_camera(height):
    problem = refusal("extrinsic_pivoting", ROUGH, box(height))
    assert problem.key == "devices.camera.position"
    assert problem.wrong == "no tag of tall_box is in the picture before a trial of plan tip"
    place = re.search(r"position: (\[.*?\]), look_at: (\[.*?\])", problem.expected)
    assert place is not None
    moved = (f"devices.camera.position={place[1]}", f"devices.camera.look_at={place[2]}")
    assert checked("extrinsic_pivoting", ROUGH, box(height), *moved)
    assert checked("extrinsic_pivoting", ROUGH, box(height), "rehearse=true")  # which looks at nothing


def test_an_object_of_the_catalogues_height_is_seen():
    assert checked("extrinsic_pivoting", ROUGH, box(140))


@pytest.mark.parametrize(
    ("distance", "unseen"),
    [  # half the picture, 360 px of 1400, is 0.257 of the distance; the tags are 0.1 m below its middle, 0.03 m nearer
        (0.20, "the table"),
        (0.55, None),
    ],
)
def test_the_tables_own_tags_have_to_be_in_the_picture(distance, unseen):
    sets = [f"devices.camera.position=[0, {-distance}, 0.07]"]
    if unseen is None:
        assert checked("grasped_static", *sets)
    else:
        assert f"no tag of {unseen} is in the picture" in refusal("grasped_static", *sets).wrong


@pytest.mark.parametrize("experiment", ["grasped_pivoting", "extrinsic_pushing", "extrinsic_pivoting"])
def test_the_nominal_trajectory_is_looked_at_as_the_plan_of_it_would_be(experiment):
    resolved = load(experiment, None, ["calibration.source=none"])
    [task] = tasks(resolved, believed(resolved, Calibrations())).values()
    planned = planner.plan(task, "nominal", objective=objective("fused"))
    from_task, from_plan = planned_poses.of_task(task, 0.01), planned_poses.of_plan(planned, 0.01)
    np.testing.assert_allclose(from_task.go, from_plan.go, atol=1e-9)
    assert (from_task.eo is None) == (from_plan.eo is None)
    if from_task.eo is not None and from_plan.eo is not None:
        np.testing.assert_allclose(from_task.eo, from_plan.eo, atol=1e-9)
