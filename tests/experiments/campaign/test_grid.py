"""Grids and seeds from the command line: every combination, every seed, every trial, and what is refused."""

import json
from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.campaign.grid import parse_grid, parse_seeds, sweep_jobs
from experiments.files import load
from mechanics.yaml_input import InputError, read_text

words = st.text("abcdefghij_", min_size=1, max_size=6).filter(lambda word: word not in ("on", "off"))
figures = st.floats(-1e3, 1e3, allow_nan=False).map(lambda value: round(value, 3)) | st.integers(-9, 9)
figures = figures.filter(lambda value: isinstance(value, int) or not value.is_integer())  # 1 and 1.0 are one value
values = st.recursive(
    words | figures | st.booleans(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


@given(st.lists(values, min_size=1, max_size=5, unique_by=json.dumps), st.sampled_from([",", ", ", " , "]))
def test_each_value_comes_out_as_it_went_in(wanted, comma):
    [texts] = parse_grid(["key=" + comma.join(map(json.dumps, wanted))]).values()
    assert [read_text(f"value: {text}", "test").data["value"] for text in texts] == wanted


@pytest.mark.parametrize(
    ("option", "texts"),
    [
        ("a.b=0.3,0.5", ("0.3", "0.5")),
        ("a=one, two", ("one", "two")),
        ("a=[1, 2],[3, 4]", ("[1, 2]", "[3, 4]")),
        ("a=[1, 2]", ("[1, 2]",)),
        ("a={go-ground: 0.3, eo-ground: 0.2}", ("{go-ground: 0.3, eo-ground: 0.2}",)),
        ("a='x, y',z", ("'x, y'", "z")),
        ("a=tcp://host:1", ("tcp://host:1",)),
    ],
)
def test_what_stands_in_brackets_or_quotes_is_one_value(option, texts):
    assert parse_grid([option]) == {option.partition("=")[0]: texts}


@pytest.mark.parametrize("option", ["a", "=1", "a=", "a=1,,2", "a=1]", "a=[1,2", "a=[1]]", "a=1],[2", "a=1,1", "a='x"])
def test_what_is_no_list_of_values_is_refused(option):
    with pytest.raises(InputError, match=r"--grid"):
        parse_grid([option])


def test_a_key_is_given_once():
    with pytest.raises(InputError, match=r"--grid has this key already"):
        parse_grid(["a=1", "a=2"])
    with pytest.raises(InputError, match=r"--set has this key already"):
        parse_grid(["a=1"], ["a=3"])


@pytest.mark.parametrize(
    ("text", "seeds"), [("0-4", range(5)), ("0,3,7", (0, 3, 7)), ("2-3, 3,9", (2, 3, 9)), (None, ())]
)
def test_seeds_are_figures_and_ranges(text, seeds):
    assert parse_seeds(text) == tuple(seeds)


@pytest.mark.parametrize("text", ["", "a", "1-", "-1", "4-0", "1.5", "0-99999999999"])
def test_what_is_no_seed_is_refused(text):
    with pytest.raises(InputError, match=r"--seeds"):
        parse_seeds(text)


def test_there_is_a_job_for_each_combination_seed_and_trial_with_all_controllers():
    grid = parse_grid(["world.stiffness_scale=0.9,1", "friction.go-ground=0.4,0.5,0.6"])
    sets = ["stages.1.trials=2", "stages.1.first=5"]
    jobs = sweep_jobs("grasped_static", None, sets, grid, (1, 2))
    loaded = [load(job.experiment, job.station, job.sets) for job in jobs]
    executes: list[Any] = [found.experiment.stages[1] for found in loaded]
    seen = [
        (found.station.model_dump()["world"]["stiffness_scale"], found.friction["go-ground"], found.experiment.seed)
        for found in loaded
    ]
    trials = [(execute.first, execute.trials) for execute in executes]
    assert list(zip(seen, trials, strict=True)) == [
        (cell, trial) for cell in product((0.9, 1.0), (0.4, 0.5, 0.6), (1, 2)) for trial in ((5, 1), (6, 1))
    ]
    assert all(execute.controllers == ("open_loop", "closed_loop") for execute in executes)
    assert len({job.id for job in jobs}) == len(jobs)
    assert jobs[-1].tags == {"world.stiffness_scale": 1, "friction.go-ground": 0.6, "seed": 2}


def test_without_a_grid_the_trials_alone_are_shared():
    jobs = sweep_jobs("grasped_static", None, ["stages.1.trials=3", "seed=4"], {}, ())
    assert [job.tags for job in jobs] == [{"seed": 4}] * 3


def test_a_run_that_calibrates_stays_whole():
    jobs = sweep_jobs("calibrate", None, [], {}, (0, 1))
    assert [job.id for job in jobs] == ["c000-s0", "c000-s1"]


def test_a_key_that_does_not_exist_is_refused_once_with_the_combination():
    with pytest.raises(InputError) as refused:
        sweep_jobs("grasped_static", None, [], parse_grid(["trial.rampp=1,1.5"]), (0, 1))
    [problem] = refused.value.problems
    assert "trial.rampp=1, seed=0" in problem.wrong
    assert problem.nearest == "trial.ramp"


def test_a_value_that_does_not_fit_is_refused_with_its_combination():
    with pytest.raises(InputError) as refused:
        sweep_jobs("grasped_static", None, [], parse_grid(["grasped_object=tall_box,tall_bix"]), ())
    [problem] = refused.value.problems
    assert "grasped_object=tall_bix" in problem.wrong


@pytest.mark.parametrize("key", ["seed", "experiment.seed"])
def test_seeds_stand_in_one_place(key):
    with pytest.raises(InputError, match="the seed is set elsewhere, too"):
        sweep_jobs("grasped_static", None, [f"{key}=3"], {}, (0,))
    with pytest.raises(InputError, match="the seed is set elsewhere, too"):
        sweep_jobs("grasped_static", None, [], parse_grid([f"{key}=0,1"]), (0, 1))


@pytest.mark.parametrize("values", ["0.2,0.20", "1,1.0", "[1,2],[1, 2.0]", "{a: 1},{a: 1.0}", "a,'a'"])
def test_a_value_that_is_written_in_two_ways_stands_twice(values):
    with pytest.raises(InputError, match="stands twice"):
        parse_grid([f"trial.ramp={values}"])
    assert parse_grid(["a=1,true,'1'"]) == {"a": ("1", "true", "'1'")}


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("world.profile", "station.world.profile"),
        ("experiment.trial.ramp", "trial.ramp"),
        ("stages.0.name", "stages.00.name"),
        ("world", "station.world.profile"),
    ],
)
def test_a_key_that_is_written_in_two_ways_is_given_twice(one, other):
    for first, second in ((one, other), (other, one)):
        with pytest.raises(InputError, match="--grid has this key already"):
            parse_grid([f"{first}=lab,ideal", f"{second}=ideal,hard"])


def test_a_set_may_give_the_whole_that_a_grid_varies_and_not_a_part_of_it():
    assert parse_grid(["stages.0.parameters.steps=2,3"], ["stages=[]"])
    with pytest.raises(InputError, match="--set has this key already"):
        parse_grid(["world={profile: lab},{profile: ideal}"], ["station.world.profile=hard"])


def test_keys_of_one_name_in_experiment_and_station_are_two():
    assert len(parse_grid(["experiment.name=a,b", "station.name=c,d"])) == 2


def test_two_combinations_that_are_the_same_run_are_refused():
    with pytest.raises(
        InputError, match=r"grasped_object=tall_box.* and grasped_object=tall_box\.yaml.* one and the same"
    ):
        sweep_jobs("grasped_static", None, [], parse_grid(["grasped_object=tall_box,tall_box.yaml"]), ())
