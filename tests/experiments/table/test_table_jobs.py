"""From a table to jobs: in which order, what each is told, and what is refused before anything runs."""

from typing import Any

import pandas as pd
import pytest

from experiments.files import load
from experiments.table import aggregate, jobs
from experiments.table.aggregate import Data
from experiments.table.jobs import Options
from mechanics.yaml_input import InputError
from planning.errors import InfeasiblePlan
from tests.experiments.table.table_cases import SMALL


@pytest.fixture
def table(small):
    return jobs.load_table(str(small))[0]


def of(table, run, **options):
    entry = next(entry for entry in table.runs if entry.name == run)
    return jobs.run_jobs_of(table, entry, Options(**options), None)


def loaded(job) -> Any:
    return load(job.experiment, job.station, job.all_sets)


def executed(job) -> Any:
    resolved = loaded(job)
    return resolved, resolved.experiment.stages[-1]


def test_every_trial_is_a_job_with_all_controllers_so_that_they_are_compared_in_pairs(table):
    made = of(table, "static", seed=3)
    assert [job.id for job in made] == ["static-a-0", "static-a-1"]
    resolved, stage = executed(made[1])
    assert (stage.controllers, stage.trials, stage.first) == (("open_loop", "closed_loop"), 1, 1)
    assert resolved.experiment.seed == 3
    assert resolved.station.world.profile == "lab"
    assert resolved.experiment.stages[0].parameters["steps"] == 3


def test_every_trajectory_grasps_anew_and_sets_its_own(table):
    made = of(table, "slow")
    assert [(job.tags["trajectory"], job.trial) for job in made] == [("a", 0), ("a", 1), ("b", 2), ("b", 3)]
    angles = [executed(job)[0].experiment.stages[0].parameters["angle_deg"] for job in made]
    assert angles == [15.0, 15.0, 20.0, 20.0]


def test_a_part_has_the_first_trials_of_each_trajectory(table):
    assert [job.trial for job in of(table, "slow", trials=1)] == [0, 2]


def test_what_the_command_line_sets_counts_more_than_the_table_but_not_the_seed(table):
    sets = ("stages.0.parameters.steps=5", "seed=9", "world.profile=ideal")
    resolved, _ = executed(of(table, "slow", sets=sets, seed=2)[0])
    assert resolved.experiment.stages[0].parameters["steps"] == 5
    assert (resolved.experiment.seed, resolved.station.world.profile) == (2, "ideal")


def test_a_job_of_some_controllers_keeps_only_their_settings(small):
    small.write_text(SMALL.replace("open_loop, closed_loop", "closed_loop, closed_loop_pi"))
    table = jobs.load_table(str(small))[0]
    one = of(table, "slow", sets=("stages.1.settings.closed_loop_pi.k_i=0.1",))[0]
    assert executed(one)[1].settings == {"closed_loop_pi": {"k_i": 0.1}}
    less = one.of(["closed_loop"])
    assert less.id != one.id
    assert executed(less)[1].controllers == ("closed_loop",)


def test_tags_tell_what_the_experiment_says_of_friction_and_size(table):
    tags = of(table, "static")[0].tags
    assert (tags["skill"], tags["sensor"], tags["mu_ground"], tags["mu_object"]) == (
        "static",
        "soft_bubble",
        0.33,
        None,
    )
    assert tags["rho_mm"] == pytest.approx(44.8, abs=0.05)  # of a box 50 by 146.9 mm: √((a² + b²) / 12)


def test_a_saved_plan_is_executed_without_planning_and_taken_to_the_fingers(table, tmp_path):
    one = of(table, "static")[0].executing(tmp_path / "p.npz")
    (stage,) = loaded(one).experiment.stages
    assert (stage.plan, stage.restiffen) == (str(tmp_path / "p.npz"), True)


def test_calibrations_come_in_the_order_in_which_they_need_each_other(table):
    phases = jobs.calibration_phases(table, table.runs)
    assert [[entry.name for entry in phase] for phase in phases] == [["hand"], ["rough"]]
    assert jobs.calibration_phases(table, [run for run in table.runs if run.calibration is None]) == []


@pytest.mark.parametrize(("name", "pairs"), [("grasped", 8), ("extrinsic", 3), ("pivoting", 3), ("optimizers", 5)])
def test_the_papers_comparisons_have_a_pair_for_each_trial_of_a_run(name, pairs):
    """8 grasps of a skill; 3 trajectories of a skill or shape; 5 optimisations of an optimiser, on each sensor."""
    table = jobs.load_table(name)[0]
    asked = [job for run in table.runs for job in jobs.run_jobs_of(table, run, Options(), None)]
    rows = [
        {**job.tags, "controller": law, "trial": job.trial, "status": "completed"}
        for job in asked
        for law in job.controllers
    ]
    trials = pd.DataFrame(rows).assign(**{f"measured.{name}.mean": 0.5 for name in ("wrench_N", "eo_pose_mm")})
    aggregate.refuse_doubles(table, trials)
    found = [one for entry in table.comparisons for one in aggregate._compared(table, entry, Data(trials, trials))]
    assert found and {one.told.rpartition(", ")[2] for one in found} == {f"{pairs} of {pairs} pairs"}


def test_the_run_whose_plans_are_executed_runs_too():
    table = jobs.load_table("optimizers")[0]
    assert [run.name for run in jobs.selected(table, ["lm_gelslim"])] == ["lm", "lm_gelslim"]


def test_a_run_that_does_not_exist_is_refused_with_the_nearest(table):
    with pytest.raises(InputError, match=r"--runs: table small has no run 'statik'\n.*\n.*nearest:  static"):
        jobs.selected(table, ["statik"])


def test_a_key_that_does_not_exist_is_refused_with_run_and_trajectory(small):
    small.write_text(SMALL.replace("angle_deg: 20", "angel_deg: 20"))
    table = jobs.load_table(str(small))[0]
    with pytest.raises(
        InputError, match=r"run slow, trajectory b: --set stages.0.parameters.angel_deg.*\n.*\n.*angle_deg"
    ):
        jobs.check_first(table, table.runs, Options())


def test_a_calibration_that_does_not_calibrate_is_refused(small):
    small.write_text(SMALL.replace("name: hand\n", "name: hand\n    experiment: grasped_static\n", 1).replace(
        "    set: {stages: [{stage: calibrate_clock}]}\n", "", 1
    ))  # fmt: skip
    table = jobs.load_table(str(small))[0]
    with pytest.raises(InputError, match=r"calibrations\.hand: grasped_static has no stage that calibrates"):
        jobs.check_first(table, table.runs, Options())


def test_a_run_that_can_use_nothing_of_its_calibration_is_refused(small):
    """The friction of one object tells nothing of another's."""
    small.write_text(
        SMALL.replace("{stage: calibrate_clock}", "{stage: calibrate_friction, pair: go-eo}")
        .replace("pair: go-ground}]}", "pair: eo-ground}]}")
        .replace("tags: {skill: static}\n", "tags: {skill: static}\n    set: {extrinsic_object: pentagon}\n", 1)
    )
    table = jobs.load_table(str(small))[0]
    with pytest.raises(InputError, match=r"runs\.static: nothing that rough finds is of this run's"):
        jobs.check_first(table, table.runs, Options())


def test_more_trials_than_the_table_has_are_refused_with_what_makes_more(table):
    with pytest.raises(InputError, match=r"--trials: 3 are more .*: 2 of each(.|\n)*--set table\.trials=3"):
        jobs.check_first(table, table.runs, Options(trials=3))


def test_a_task_without_a_plan_is_refused_with_run_and_trajectory(small):
    small.write_text(SMALL.replace("angle_deg: 20", "tangential: 3"))
    table = jobs.load_table(str(small))[0]
    with pytest.raises(InfeasiblePlan, match=r"run slow, trajectory b: .*needs µ ≥ "):
        jobs.check_first(table, table.runs, Options())


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("tall_box", "tall_box"),
        ("on", '"on"'),
        ("/a/b-1.npz", "/a/b-1.npz"),
        (0.5, "0.5"),
        ([1, 2], "[1, 2]"),
        ({"a": None}, '{"a": null}'),
        ("a: b", '"a: b"'),
    ],
)
def test_a_value_is_written_so_that_a_set_reads_it_back(value, text):
    assert jobs.written(value) == text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grasped", "extrinsic", "pivoting", "optimizers"])
def test_every_run_of_the_papers_tables_has_a_plan(name):
    table = jobs.load_table(name)[0]
    jobs.check_first(table, table.runs, Options())


@pytest.mark.slow
def test_pivots_keep_their_plan_where_friction_is_off_by_what_a_laboratory_has():
    """3 % (1σ) is how far the laboratories' coefficients are from the nominal ones."""
    table = jobs.load_table("pivoting")[0]
    for run in table.runs:
        mu = {pair: round(0.95 * value, 4) for pair, value in {"go-eo": 0.33, **run.set["friction"]}.items()}
        smaller = run.model_copy(update={"set": {**run.set, "friction": mu}})
        jobs.check_first(table, [smaller], Options())
