"""Experiments with skills on an extrinsic object: what is checked before the start, what is run, plans as files."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.check import check
from experiments.files import load
from experiments.planning.files import plan_files
from mechanics.yaml_input import InputError
from planning.errors import InfeasiblePlan
from planning.plan_file import load as read_plan

ON_AN_OBJECT = ["static_in_contact", "relative_pivoting", "relative_sliding", "extrinsic_pushing", "extrinsic_pivoting"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# -- before the start --------------------------------------------------------------------------------------------------


def test_the_dry_run_says_how_a_plan_is_made():
    lines = check(load("extrinsic_pivoting", None, ["stages.0.optimiser=icem", "stages.0.form=paper"]))
    assert "stage 1: plan tip: extrinsic_pivoting, 40 steps, icem on fused, paper form" in lines
    assert "friction go-ground 0.33, go-eo 0.33, eo-ground 0.5" in lines


def test_an_extrinsic_object_beside_a_grasped_skill_stays_off_the_table():
    assert check(load("grasped_static", None, ["extrinsic_object=hbox"]))


def test_a_skill_on_an_object_that_is_not_named_is_refused(elsewhere):
    (elsewhere / "mine.yaml").write_text(
        "name: mine\ngrasped_object: tall_box\nstages:\n- {stage: plan, name: a, skill: extrinsic_pushing}\n"
    )
    with pytest.raises(InputError) as e:
        load("mine")
    assert e.value.problems[0].key == "extrinsic_object"
    assert "extrinsic_pushing moves an extrinsic object" in e.value.problems[0].wrong


@pytest.mark.parametrize(
    ("experiment", "sets", "says"),
    [
        # tasks.md's statics: from flat the pentagon needs 0.37 at the ground, whatever its mass
        ("extrinsic_pivoting", ["friction.eo-ground=0.33"], r"ground right.*needs µ ≥ 0\.3"),
        ("grasped_static", ["stages.0.parameters.tangential=2"], r"needs µ ≥ 0\.667, has 0\.33"),
        # 3 N on hbox's side would need an object of 0.93 kg at 0.33
        ("extrinsic_pushing", ["stages.0.parameters.force=3"], r"object of 0\.9"),
    ],
)
def test_what_no_force_can_do_is_said_before_the_start(experiment, sets, says):
    with pytest.raises(InfeasiblePlan, match=says):
        check(load(experiment, None, sets))


def test_a_parameter_that_the_geometry_does_not_allow_is_refused_where_it_stands():
    with pytest.raises(InputError) as e:
        check(load("relative_sliding", None, ["stages.0.parameters.travel_mm=300"]))
    assert e.value.problems[0].file == "--set stages.0.parameters.travel_mm"
    assert "stay on its face" in e.value.problems[0].wrong


def test_a_workspace_that_the_task_leaves_is_infeasible():
    with pytest.raises(InfeasiblePlan, match="workspace, step 0"):
        check(load("static_in_contact", None, ["stages.0.limits={workspace: {y: [0.5, 0.6]}}"]))


# -- through the station -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pressed(shared_command):
    """Static in contact, open loop, as shipped."""
    return shared_command.run("static_in_contact", "--set", "stages.1.controllers=[open_loop]", out="pressed")


def test_a_trial_on_an_extrinsic_object_lands_where_its_plan_says(pressed):
    assert pressed.code == 0, pressed.err
    for witness in ("truth", "measured"):
        errors = pressed.trial("open_loop")[witness]
        assert errors["eo_pose_mm"]["mean"] <= 0.05
        assert errors["go_pose_mm"]["mean"] <= 0.05
        assert errors["theta_deg"]["mean"] <= 0.05
        assert errors["wrench_N"]["mean"] <= 0.05
    assert pressed.trial("open_loop")["extrinsic_object"] == "hbox"


def test_the_plan_lies_in_the_run_folder_with_where_it_comes_from(pressed):
    [row] = pressed.results["plans"]
    assert (row["file"], row["optimiser"], row["backend"], row["form"]) == ("plans/press.npz", "lm", "fused", "closed")
    plan = read_plan(pressed.folder / row["file"])
    assert (plan.name, plan.skill, plan.steps) == ("press", "static_in_contact", row["steps"])
    assert plan.eo is not None
    np.testing.assert_allclose(plan.eo[0], [0.0, 0.03, 0.0], atol=1e-12)  # half of hbox's 60 mm above the ground
    assert plan.provenance["experiment"] == "static_in_contact"
    assert plan.provenance["versions"] == pressed.results["provenance"]["versions"]


def test_a_plan_of_one_run_is_executed_by_another(pressed, shared_command):
    executed = shared_command.run(
        "static_in_contact",
        *("--set", "stages=[{stage: execute, plan: pressed/plans/press.npz, controllers: [open_loop]}]"),
        out="again",
    )
    assert executed.code == 0, executed.err
    assert executed.trial("open_loop")["truth"] == pressed.trial("open_loop")["truth"]
    [row] = executed.results["plans"]
    assert (row["from"], row["file"]) == ("pressed/plans/press.npz", "plans/press.npz")
    assert (executed.folder / row["file"]).is_file()
    # the folder is whole: its own experiment finds its own plan
    [plan] = plan_files(load(str(executed.folder / "experiment.yaml"))).values()
    assert plan.name == "press"


def test_a_task_without_a_plan_ends_with_5_and_says_so_in_the_results(shared_command):
    finished = shared_command.run("extrinsic_pivoting", "--set", "friction.eo-ground=0.33", out="infeasible")
    assert finished.code == 5
    assert finished.results["status"] == "infeasible"
    assert "needs µ ≥ 0.3" in finished.results["reason"]
    assert (finished.folder / "log.mcap").is_file()
    checked = shared_command.finish(
        shared_command.start("check", "extrinsic_pivoting", "--set", "friction.eo-ground=0.33")
    )
    assert checked.code == 5
    assert "needs µ ≥ 0.3" in checked.err


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["grasped_sliding", *ON_AN_OBJECT])
def test_every_shipped_skill_runs_open_and_closed_loop(command, experiment):
    finished = command.run(experiment)
    assert finished.code == 0, finished.err
    slides = experiment in ("grasped_sliding", "relative_sliding", "extrinsic_pushing")
    truth = finished.trial("open_loop")["truth"]
    assert truth["go_pose_mm"]["mean"] <= (0.3 if slides else 0.05)
    assert truth["wrench_N"]["mean"] <= (0.2 if slides else 0.05)
    if experiment != "grasped_sliding":
        assert truth["eo_pose_mm"]["mean"] <= (0.3 if slides else 0.05)


def test_an_object_that_begins_tilted_is_held_until_the_go_holds_it(shared_command):
    tilted = ["friction.eo-ground=0.33", "stages.0.parameters.angle_deg=[10, 15]", "stages.0.parameters.steps=8"]
    sets = [word for text in [*tilted, "stages.1.controllers=[open_loop]"] for word in ("--set", text)]
    finished = shared_command.run("extrinsic_pivoting", *sets, out="tilted")
    assert finished.code == 0, finished.err
    truth = finished.trial("open_loop")["truth"]
    assert truth["eo_pose_mm"]["mean"] <= 0.05 and truth["wrench_N"]["mean"] <= 0.05


# -- plan files that cannot be taken -----------------------------------------------------------------------------------


def refused_plan(name: str, *sets: str):
    stage = f"stages=[{{stage: execute, plan: {name}, controllers: [open_loop]}}]"
    with pytest.raises(InputError) as e:
        check(load("static_in_contact", None, [stage, *sets]))
    [problem] = e.value.problems
    return problem


def test_a_plan_file_that_is_not_there_or_no_plan_is_refused_where_it_stands(elsewhere):
    found = refused_plan("gone.npz")
    assert found.key == "stages" or found.key.endswith("plan")
    assert "no such file" in found.wrong
    (elsewhere / "torn.npz").write_bytes(b"PK\x03\x04 torn")
    assert "damaged" in refused_plan("torn.npz").wrong


def test_a_plan_for_another_grasp_is_refused(pressed):
    found = refused_plan(str(pressed.folder / "plans/press.npz"), "grasp.centre_mm=[0, 40]")
    assert "made for a grasp at (0, 45) mm" in found.wrong
