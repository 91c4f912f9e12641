"""The terminal's tables: ours beside the paper's, whole at 80 columns."""

import pytest
from rich.console import Console

from experiments.paper import beside, tables
from experiments.tables import error_table


def trial(controller, number=0, pose=2.0, skill="grasped_pivoting"):
    figures = {"go_pose_mm": {"mean": pose, "std": 0.1}, "wrench_N": {"mean": 1.5, "std": 0.2}}
    name = f"pivot-{controller}-{number}"
    row = {"name": name, "skill": skill, "controller": controller, "status": "completed", "measured": figures}
    return row | {"truth": figures}


def shown(trials):
    console = Console(width=80, record=True, force_terminal=False)
    console.print(error_table({"experiment": "e", "station": "s", "seed": 0, "status": "done", "trials": trials}))
    return console.export_text()


@pytest.mark.parametrize(
    ("skill", "controller", "wrench", "pose"),
    [  # Table 1 of the paper
        ("static", "open_loop", 0.75, 1.35),
        ("pivoting", "closed_loop_pi", 0.64, 0.48),
        ("sliding", "rigid_sensor", 0.79, 0.78),
    ],
)
def test_the_papers_figures_are_those_it_prints(skill, controller, wrench, pose):
    row = tables().grasped[skill][controller]
    assert (row.wrench_N[0], row.go_pose_mm[0]) == (wrench, pose)


def test_the_paper_stands_beside_what_it_measured_and_nothing_else():
    assert set(beside([trial("open_loop"), trial("mine")])["rows"]) == {"pivot-open_loop-0"}
    assert beside([trial("open_loop", skill="static")])["rows"] == {}


def test_units_and_figures_are_whole_at_80_columns():
    text = shown([trial("open_loop")])
    assert "pose [mm]" in text and "wrench [N]" in text
    assert "2.00 ± 0.10" in text and "1.86 ± 0.23" in text


def test_the_name_of_a_trial_is_whole_at_80_columns_beside_every_figure():
    figures = {key: {"mean": 2.0, "std": 0.1} for key in ("go_pose_mm", "eo_pose_mm", "wrench_N")}
    seen = {"measured": figures, "truth": figures, "extrinsic_object": "hbox", "status": "lost_contact"}
    text = shown([trial("closed_loop_pi", skill="extrinsic_pushing") | seen | {"name": "tip-closed_loop_pi-0"}])
    assert "tip-closed_loop_pi-0 lost_contact measured 2.00 ± 0.10" in text


def test_several_trials_end_with_the_mean_of_their_means_and_its_spread():
    text = shown([trial("open_loop", 0, 1.0), trial("open_loop", 1, 3.0)])
    assert "2 of 2" in text
    assert "2.00 ± 1.00" in text


def test_controllers_of_the_same_trials_end_with_their_difference_and_its_interval():
    """Of −0.1, −0.2 and −0.3 the mean is −0.2, and half the interval 4.303 × 0.1/√3 = 0.248."""
    levels, less = (1.0, 5.0, 9.0), (0.1, 0.2, 0.3)
    trials = [trial("open_loop", n, level) | {"trial": n} for n, level in enumerate(levels)]
    trials += [
        trial("closed_loop", n, level - by) | {"trial": n}
        for n, (level, by) in enumerate(zip(levels, less, strict=True))
    ]
    lines = shown(trials[:-1]).splitlines(), shown(trials).splitlines()
    assert "closed_loop − open_loop" in "".join(lines[0])  # two pairs
    [at] = [i for i, line in enumerate(lines[1]) if "closed_loop − open_loop" in line]
    assert lines[1][at].split()[:6] == ["closed_loop", "−", "open_loop", "3", "pairs", "measured"]
    assert "-0.20" in lines[1][at] and "-0.45…+0.05" in lines[1][at + 1]
    assert "−" not in shown([trials[0], trials[3]])


def test_an_extrinsic_object_has_a_column_where_there_is_one():
    assert "eo pose" not in shown([trial("open_loop")])
    row = trial("open_loop", skill="extrinsic_pushing") | {"extrinsic_object": "hbox"}
    figures = {key: {"mean": 2.0, "std": 0.1} for key in ("go_pose_mm", "wrench_N")}
    text = shown([row | {"measured": figures | {"eo_pose_mm": {"mean": 0.126, "std": 0.25}}, "truth": None}])
    assert "eo pose [mm]" in text and "0.13 ± 0.25" in text and "2.00 ± 0.10" in text


def test_a_run_without_trials_says_so():
    assert "no trial was run" in shown([])


def test_an_object_that_slipped_in_the_fingers_is_told_beside_its_trial_and_no_other():
    slid = trial("open_loop") | {"finger_slip": {"mm": 1.6, "deg": 0.3, "detected": True, "reason": "waypoint 7: …"}}
    held = trial("mine", 1) | {"finger_slip": {"mm": 0.2, "deg": 0.1, "detected": False, "reason": ""}}
    lines = shown([slid, held, trial("other", 2)]).splitlines()
    [told] = [n for n, line in enumerate(lines) if "slipped in the fingers" in line]
    names = [n for n, line in enumerate(lines) if "pivot-" in line]
    assert names[0] < told < names[1]
