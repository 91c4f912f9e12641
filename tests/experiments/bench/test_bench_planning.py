"""What `extrinsic bench planning` measures on, and how its figures become a table."""

from __future__ import annotations

from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from experiments.bench import Options, main
from experiments.bench.figures import Figure, targets_of
from experiments.bench.planning_problem import described, pivoting_pentagon, regrasped
from experiments.bench.planning_table import side_by_side
from experiments.bench.planning_timing import Watched, apart, repeated
from mechanics.yaml_input import InputError
from planning.problem import Form


@pytest.mark.parametrize("form", list(Form))
@pytest.mark.parametrize("steps", [10, 40])
def test_the_pentagon_is_turned_by_25_degrees_at_every_horizon(steps, form):
    problem = pivoting_pentagon(steps, form)
    assert problem.steps == steps and problem.form is form
    np.testing.assert_allclose(np.degrees(problem.eo[[0, -1], 2]), [-0.3, -25.0])
    assert f"{form.value} form" in described(problem)


def test_a_grasp_that_is_estimated_anew_is_near_the_old_one():
    problem = pivoting_pentagon(3, Form.CLOSED)
    moved = np.array([regrasped(problem, np.random.default_rng(i)).grasp for i in range(50)]) - problem.grasp
    np.testing.assert_allclose(moved.std(axis=0), [2e-4, 2e-4, np.radians(0.2)], rtol=0.4)


def test_work_is_warmed_up_and_then_repeated_at_least_as_often_as_asked():
    calls = []
    times = repeated(lambda: calls.append(1), least=3, budget=0.0)
    assert len(times) == 3 and len(calls) == 4
    assert (times >= 0).all()


def test_arrays_are_compared_by_the_largest_of_the_reference():
    assert apart([1.0, 2.2], [1.0, 2.0]) == pytest.approx(0.1)
    assert apart([0.0, 1e-3], [0.0, 0.0]) == pytest.approx(1e-3)


def test_a_watched_objective_offers_no_adam_and_times_each_gradient():
    inner = SimpleNamespace(gradient=lambda z: (1.0, z), adam=None)
    watched = Watched(inner)  # type: ignore[arg-type]
    assert not hasattr(watched, "adam")
    for _ in range(3):
        assert watched.gradient(np.ones(2))[0] == 1.0
    assert len(watched.times) == 3


def figure(name: str, median: float, what: str = "") -> Figure:
    return Figure(name, median, median, median, "ms", 1, what)


def test_the_side_by_side_table_has_a_row_for_each_method_and_all_horizons_in_a_cell():
    shown = side_by_side(
        [
            figure("slow, paper form, 40 steps: iteration", 100.0, "the worst of 4; a box, paper form, from 1 mm off"),
            figure("fast, paper form, 40 steps: iteration", 0.0421),
            figure("fast, paper form, 200 steps: iteration", 0.2),
            figure("fast, paper form, 40 steps: loss", 0.0271),
            figure("something else", 3.0),
        ]
    )
    console = Console(width=200, file=StringIO())
    console.print(shown)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    rows = {line.split()[0]: line for line in text.splitlines() if line.strip().startswith(("slow", "fast"))}
    assert set(rows) == {"slow", "fast"}
    assert "0.0421 / 0.2" in rows["fast"] and "0.0271" in rows["fast"]
    assert "100 / –" in rows["slow"]
    assert "a box, paper form, from 1 mm off" in text


def test_targets_are_those_of_the_issue():
    targets = targets_of("planning")
    for form in Form:
        fused = f"fused, Grad 100, {form.value} form, 40 steps: "
        assert targets[fused + "plans per cvxpylayers plan"].at_least == 1000
        assert targets[fused + "loss curve off cvxpylayers accurate"].at_most == 1e-5
    assert targets["fused, lm, paper form, 40 steps: loss over Grad 100's"].at_most == 0.25
    assert targets["fused, lm warm, paper form, 40 steps: re-plans per cvxpylayers iteration"].at_least == 50


def test_horizons_belong_to_the_benchmark_of_plans():
    with pytest.raises(InputError, match="sim has no horizons"):
        main("sim", Options(1, horizons=(40,)), None, None, False)
