"""A law that re-plans gets what its plan was made of, and is refused in time where there is only a file."""

import pytest

from experiments.check import check
from experiments.files import load
from experiments.schema import ExecuteStage
from mechanics.yaml_input import InputError


def test_a_plan_from_a_file_is_not_enough_for_it():
    stages = "stages=[{stage: execute, plan: some/plan.npz, controllers: [open_loop, mpc]}]"
    with pytest.raises(InputError) as e:
        check(load("static_in_contact", None, [stages]))
    [problem] = e.value.problems
    assert problem.wrong == "mpc re-plans: it needs a plan stage in this experiment, not a plan from a file"
    assert "plan stage" in problem.expected


def test_its_figures_stand_in_the_experiment_file():
    resolved = load("grasped_static", None, ["stages.1.controllers=[mpc]", "stages.1.settings.mpc.horizon=3"])
    stage = resolved.experiment.stages[1]
    assert isinstance(stage, ExecuteStage) and stage.law("mpc").horizon == 3
    with pytest.raises(InputError):
        load("grasped_static", None, ["stages.1.controllers=[mpc]", "stages.1.settings.mpc.horizons=3"])


@pytest.fixture(scope="module")
def pressed(shared_command):
    """Grasped static with the law, six steps."""
    few = ("--set", "stages.0.parameters.steps=6", "--set", "stages.1.controllers=[mpc]")
    return shared_command.run("grasped_static", *few, out="planning")


def test_a_trial_runs_from_the_command_and_its_row_counts_the_replans(pressed):
    assert pressed.code == 0, pressed.err
    trial = pressed.trial("mpc")
    assert trial["status"] == "completed"
    assert trial["law"]["replans"] == 7 and trial["law"]["failed"] == 0  # one at each waypoint, and one before them
    assert trial["truth"]["wrench_N"]["mean"] <= 0.05
    assert trial["truth"]["go_pose_mm"]["mean"] <= 0.05
