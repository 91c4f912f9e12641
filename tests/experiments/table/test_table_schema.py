"""The table file: what is refused, where, and what would have been right."""

import re

import pytest

from experiments.table.jobs import load_table
from experiments.table.schema import Table
from mechanics.yaml_input import InputError
from tests.experiments.table.table_cases import SMALL

SHIPPED = ("grasped", "extrinsic", "pivoting", "optimizers")


def refused(tmp_path, before, after, count=1):
    file = tmp_path / "t.yaml"
    assert before in SMALL
    file.write_text(SMALL.replace(before, after, count))
    with pytest.raises(InputError) as error:
        load_table(str(file))
    return str(error.value)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_papers_tables_are_shipped_and_found_by_name(name):
    table, sets = load_table(name, ["trial.ramp=0.3"])
    assert (table.name, sets) == (name, ("trial.ramp=0.3",))
    assert table.set["world.profile"] == "lab"
    assert all(run.calibration is not None for run in table.runs)


@pytest.mark.parametrize(
    ("name", "trials"),
    [
        ("grasped", 3 * 6 * 8),  # skills, controllers, octants
        ("extrinsic", 4 * 2 * 3),  # skills, laws, trajectories
        ("pivoting", 7 * 2 * 3),  # shapes, two of them twice
        ("optimizers", 6 * 2 * 2 * 5),  # optimisers, sensors, laws, optimisations
    ],
)
def test_a_table_has_as_many_trials_as_its_protocol(name, trials):
    table: Table = load_table(name)[0]
    counted = (len(table.controllers_of(r)) * table.trials_of(r) * len(table.trajectories_of(r)) for r in table.runs)
    assert sum(counted) == trials


def test_a_table_that_is_not_shipped_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"pivotting: there is no such table\n.*extrinsic.*\n.*nearest:  pivoting"):
        load_table("pivotting")


def test_a_set_may_change_the_table_itself(small):
    table, sets = load_table(str(small), ["table.trials=1", "trial.ramp=0.4"])
    assert (table.trials, sets) == (1, ("trial.ramp=0.4",))


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("after: hand", "after: arm", r"line 8: calibrations.1.after: 'arm' does not stand before.*\n.*expected: hand"),
        (
            "calibration: rough",
            "calibration: roughly",
            r"runs.0.calibration: no calibration .*\n.*hand, rough\n.*rough",
        ),
        (
            "[wrench_N, go_pose_mm]",
            "[wrench, go_pose_mm]",
            r"panels.0.figures.0: unknown figure 'wrench'.*\n.*wrench_N",
        ),
        ("across: [run]", "across: [runs]", r"panels.0.across: no run has the tag 'runs'.*\n.*\n.*nearest:  run"),
        ("[open_loop, closed_loop]", "[open_lop]", r"line 10: controllers.0: unknown controller.*\n.*\n.*open_loop"),
        ("name: slow", "name: static", r"runs.1.name: 'static' stands twice"),
        ("trials: 2", "trails: 2", r"line 11: trails: unknown key\n.*\n.*nearest:  trials"),
        ("{name: below,", "{name: done,", r"'done' stands twice"),
        ("of: trials completed", "of: trials", r"counts.0.of: unknown value 'trials'"),
        (
            "closed − open, figure: wrench_N",
            "d, figure: plan_loss",
            r"comparisons.0.figure: a trial alone has no plan_loss",
        ),
        (
            "closed − open, figure: wrench_N",
            "d, figure: wrench_summary_N",
            r"comparisons.0.figure: a trial alone has no wrench_summary_N.*\n.*\n.*nearest:  wrench_N",
        ),
        ("{skill: static}", "{controller: mine}", r"line \d+: runs.0.tags.controller: every trial has its own"),
        ("{skill: static}", "{status: completed}", r"runs.0.tags.status: every trial has its own"),
    ],
)
def test_what_a_table_cannot_mean_is_refused_where_it_stands(tmp_path, before, after, message):
    assert re.search(message, refused(tmp_path, before, after)), refused(tmp_path, before, after)


@pytest.mark.parametrize(
    ("added", "message"),
    [
        ("{plans_of: again}", r"runs.3.plans_of: again executes plans of static, it makes none\n.*one of slow, static"),
        ("{plans_of: slow, controllers: []}", r"runs.3.plans_of: without controllers nobody"),
        ("{plans_of: slow, trajectories: [{name: c}]}", r"runs.3.plans_of: slow has no trajectory 'c'\n.*one of a, b"),
    ],
)
def test_saved_plans_have_to_be_made_by_somebody(tmp_path, added, message):
    again = "  - {name: again, experiment: grasped_static, plans_of: static}\n"
    last = f"  - {{name: last, experiment: grasped_static, {added.strip('{}')}}}\n"
    said = refused(tmp_path, "paper:\n", f"{again}{last}paper:\n")
    assert re.search(message, said), said
