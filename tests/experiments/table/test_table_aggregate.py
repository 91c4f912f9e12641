"""From trials to cells, comparisons and counts: against figures worked out from single waypoints."""

import numpy as np
import pandas as pd
import pytest

from experiments.table import aggregate
from experiments.table.aggregate import Data
from experiments.table.jobs import load_table
from experiments.table.schema import Comparison, Count, Single
from mechanics.yaml_input import InputError
from tests.experiments.table.table_cases import row

#: Student's t, two-sided 95 %, for 3 trials
T_2 = 4.303
#: errors at the waypoints of three trials
WAYPOINTS = np.array([[0.1, 0.2, 0.3, 0.4], [0.2, 0.2, 0.2, 0.6], [0.5, 0.4, 0.6, 0.7]])


def trials(controller="open_loop", values=WAYPOINTS, **tags):
    rows = []
    for number, waypoints in enumerate(values):
        one = row(
            "j", controller, number, wrench=waypoints.mean(), trajectory="a", run="static", skill="static", **tags
        )
        rows.append(one | {"measured.wrench_N.std": waypoints.std()})
    return rows


def figure(data, where, name, witness):
    found = aggregate.figure(data, where, name, witness)
    assert found is not None
    return found


def data(*rows):
    return Data(pd.DataFrame([one for some in rows for one in some]), pd.DataFrame())


def compared(entry, data, table="grasped"):
    return list(aggregate._compared(load_table(table)[0], entry, data))


def test_a_cell_is_the_mean_over_all_waypoints_with_their_deviation():
    found = figure(data(trials()), {"controller": "open_loop"}, "wrench_N", "measured")
    assert found["mean"] == pytest.approx(WAYPOINTS.mean())
    assert found["std"] == pytest.approx(WAYPOINTS.std())


def test_its_interval_is_over_trials():
    means = WAYPOINTS.mean(axis=1)
    found = figure(data(trials()), {}, "wrench_N", "measured")
    half = T_2 * means.std(ddof=1) / np.sqrt(3)
    assert (found["low"], found["high"]) == pytest.approx((means.mean() - half, means.mean() + half), abs=1e-3 * half)
    assert found["n"] == 3


def test_a_trial_that_never_came_to_a_waypoint_counts_as_a_trial_and_not_in_the_mean():
    lost = [row("j", "open_loop", 3, status="device_failed", ran=False, trajectory="a", run="static", skill="static")]
    table = load_table("grasped")[0].model_copy(update={"panels": ()})
    cell = aggregate._cell(table, data(trials(), lost), {"controller": "open_loop"}, "wrench_N")
    assert (cell["completed"], cell["trials"]) == (3, 4)
    assert cell["measured"]["mean"] == pytest.approx(WAYPOINTS.mean())


def test_tags_pick_trials_and_one_that_was_not_given_picks_none_of_the_others():
    frame = data(trials(start="flat"), trials("closed_loop", start=None)).trials
    assert set(aggregate.picked(frame, {"start": "flat"})["controller"]) == {"open_loop"}
    assert set(aggregate.picked(frame, {"start": None})["controller"]) == {"closed_loop"}
    assert set(aggregate.picked(frame, {"controller": ["open_loop", "closed_loop"]})["start"].dropna()) == {"flat"}
    assert not len(aggregate.picked(frame, {"nothing": 1}))
    assert aggregate.combinations(frame, ["start"]) == [{"start": "flat"}, {"start": None}]


def test_a_summary_is_the_papers_own_arithmetic():
    """The components of the paper's Table 3, tall_box, give its summaries."""
    components = {"fx_N": 0.63, "fy_N": 0.77, "tau_Nmm": 86.9, "x_mm": 0.36, "y_mm": 0.72}
    rows = trials(rho_mm=44.8)
    for change, one in zip((-0.1, 0.0, 0.1), rows, strict=True):  # of different trials: their means count
        one |= {f"measured.{key}.mean": value * (1 + change) for key, value in components.items()}
        one |= {f"measured.{key}.std": 0.1 for key in components}
    wrench, pose = (figure(data(rows), {}, name, "measured") for name in aggregate.SUMMARIES)
    assert wrench["mean"] == pytest.approx(2.18, abs=0.006)
    assert pose["mean"] == pytest.approx(0.805, abs=0.001)
    assert (wrench["std"], wrench["low"]) == (None, None)


@pytest.mark.parametrize(
    ("table", "tags", "figure", "expected"),
    [
        ("grasped", {"run": "sliding", "controller": "rigid_sensor"}, "go_pose_mm", (0.78, 0.93)),
        ("grasped", {"run": "sliding", "controller": "mpc"}, "wrench_N", (0.22, 0.10)),  # the paper's PI stands in
        ("extrinsic", {"run": "extrinsic_pushing", "controller": "mode_aware"}, "eo_pose_mm", (2.38, 1.89)),
        ("pivoting", {"shape": "triangle", "start": "flat"}, "wrench_summary_N", (2.82, None)),
        ("optimizers", {"optimiser": "icem_100", "sensor": "gelslim"}, "eo_pose_mm", (19.5, 17.69)),
        ("optimizers", {"optimiser": "mppi_1000"}, "plan_time_s", (75.6, 5.24)),
        ("optimizers", {"optimiser": "lm", "sensor": "soft_bubble"}, "wrench_N", (0.43, 0.35)),
    ],
)
def test_the_papers_figure_stands_beside_ours(table, tags, figure, expected):
    assert aggregate.printed(load_table(table)[0], tags)[figure] == expected


def test_the_paper_has_nothing_beside_what_it_did_not_measure():
    assert "plan_time_s" not in aggregate.printed(
        load_table("grasped")[0], {"run": "static", "controller": "open_loop"}
    )
    assert aggregate.printed(load_table("pivoting")[0], {"shape": "hexagon"}) == {}


def test_a_comparison_is_over_pairs_alike_in_trajectory_and_trial():
    ours = trials("mpc", WAYPOINTS - [[0.05], [0.1], [0.15]])[:3]
    entry = Comparison(name="ours − theirs", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "open_loop"})
    alone = trials("mpc", np.full((5, 4), 9.0))[4:]  # a trial that the other has not
    (found,) = compared(entry, data(trials(), ours, alone))
    half = T_2 * 0.05 / np.sqrt(3)
    assert found.value == pytest.approx(-0.1 + half, abs=1e-3 * half)
    assert "-0.100" in found.told and found.told.endswith("3 of 4 pairs")
    (mean,) = compared(entry.model_copy(update={"judged": "mean"}), data(trials(), ours))
    assert mean.value == pytest.approx(-0.1)


def test_pairs_of_several_runs_are_all_compared():
    """Of each run the difference is +0.20 on the mean; the n-th trials of two runs are no pair."""
    offsets, rows = np.array([-0.1, 0.0, 0.1, 0.2, 0.2, 0.3, 0.4, 0.5]), []
    for level, run in ((1.0, "static"), (2.0, "pivoting"), (5.0, "sliding")):
        for controller, wrench in (("mpc", level + offsets), ("closed_loop_pi", np.full(8, level))):
            rows += [one | {"run": run} for one in trials(controller, wrench[:, None])]
    entry = Comparison(name="d", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "closed_loop_pi"})
    (found,) = compared(entry, data(rows))
    half = 2.069 * np.tile(offsets, 3).std(ddof=1) / np.sqrt(24)  # Student's t for 24 differences
    assert found.value == pytest.approx(0.2 + half, abs=1e-3 * half)
    assert "+0.200" in found.told and "surely above" in found.told and found.told.endswith("24 of 24 pairs")


def test_what_follows_from_a_and_b_need_not_be_alike():
    """Two optimisers are two runs, and which run it is follows; the sensor does not, and is alike in a pair."""
    rows = []
    for sensor, level in (("soft_bubble", 0.0), ("gelslim", 7.0)):
        for optimiser, more in (("grad_100", 0.0), ("lm", 0.25)):
            told = {"optimiser": optimiser, "sensor": sensor, "mu_object": None}
            rows += [one | {"run": f"{optimiser}_{sensor}"} for one in trials(values=WAYPOINTS + level + more, **told)]
    entry = Comparison(name="d", figure="wrench_N", a={"optimiser": "lm"}, b={"optimiser": "grad_100"}, judged="mean")
    (found,) = compared(entry, data(rows), "optimizers")
    assert found.value == pytest.approx(0.25)
    assert found.told.endswith("6 of 6 pairs")


def test_two_trials_of_one_pair_are_refused_with_the_comparison():
    rows = [
        one | {"run": run} for run, law in zip("abc", ("mpc", "mpc", "open_loop"), strict=True) for one in trials(law)
    ]
    entry = Comparison(name="d", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "open_loop"})
    table = load_table("grasped")[0].model_copy(update={"comparisons": (entry,)})
    with pytest.raises(InputError, match=r"comparisons\.0: there are 2 trials with trajectory a, trial 0, of a, b"):
        aggregate.refuse_doubles(table, data(rows).trials)
    aggregate.refuse_doubles(table, data(rows[3:]).trials)


@pytest.mark.parametrize(
    ("shift", "verdict"),
    [  # half the interval of differences that are 0.05 apart is 4.303 × 0.05/√3 = 0.124
        ([-0.20, -0.15, -0.10], "95 % -0.274 to -0.026, surely below"),
        ([-0.10, -0.05, 0.0], "95 % -0.174 to +0.074, undecided"),
        ([0.10, 0.15, 0.20], "95 % +0.026 to +0.274, surely above"),
    ],
)
def test_a_comparison_prints_both_ends_and_what_they_say(shift, verdict):
    ours = trials("mpc", WAYPOINTS + np.array(shift)[:, None])
    entry = Comparison(name="d", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "open_loop"})
    (found,) = compared(entry, data(trials(), ours))
    assert verdict in found.told
    assert found.value is not None and (found.value <= 0) == verdict.endswith("below")


def test_a_comparison_says_how_many_of_its_pairs_ended_early():
    ours = trials("mpc")
    ours[1]["status"] = "slipped"
    entry = Comparison(name="d", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "open_loop"})
    (found,) = compared(entry, data(trials(), ours))
    assert found.told.endswith("3 of 3 pairs, 1 not completed")


def test_a_comparison_without_pairs_says_so():
    entry = Comparison(name="x", figure="wrench_N", a={"controller": "mpc"}, b={"controller": "open_loop"})
    (found,) = compared(entry, data(trials()))
    assert (found.value, found.told) == (None, "no pair of trials has both")


def counted(cells, of="cells at or below the paper", **where):
    shown = [{"rows": [{"cells": cells}]}]
    return aggregate._counted(Count.model_validate({"name": "n", "of": of, "where": where}), data(trials()), shown)


def cell(ours, paper, **where):
    measured = None if ours is None else {"mean": ours}
    return {"where": where, "figure": "wrench_N", "measured": measured, "paper": paper and {"mean": paper}}


def test_cells_are_counted_by_their_side_of_the_papers_figure():
    cells = [cell(0.4, 0.5, run="a"), cell(0.5, 0.5, run="b"), cell(0.6, 0.5, run="c"), cell(0.1, None, run="d")]
    below = counted(cells)
    assert (below.value, below.told) == (2.0, "2 of 3; not c wrench_N 0.6 (0.5)")
    assert counted(cells, "cells at or above the paper").value == 2.0


def test_a_cell_that_was_not_measured_is_on_neither_side():
    assert counted([cell(None, 0.5, run="a")]).told == "0 of 1; not a wrench_N none (0.5)"
    assert counted([cell(None, 0.5, run="a")], "cells at or above the paper").value == 0.0


def test_completed_trials_are_counted_among_those_asked_for():
    assert counted([], "trials completed", controller="open_loop").told == "3 of 3"
    assert counted([], "trials completed", controller="mpc").told == "0 of 0"


def test_a_single_figure_that_nobody_has_is_not_measured():
    entry = Single(name="s", figure="wrench_N", where={"controller": "mpc"})
    assert aggregate._single(entry, data(trials())).told == "not measured"
    known = aggregate._single(entry.model_copy(update={"where": {"controller": "open_loop"}}), data(trials()))
    assert known.value == pytest.approx(WAYPOINTS.mean())
