"""The paper's figures beside single trials: of what it measured, with the law that it measured it with."""

import pytest

from experiments.paper import beside, paper_figures


def trial(skill, controller, eo=None):
    return {"name": "t", "skill": skill, "controller": controller, "extrinsic_object": eo}


@pytest.mark.parametrize(
    ("row", "expected"),
    [  # as Tables 1, 2 and 3 print them
        (trial("grasped_sliding", "closed_loop_pi"), {"wrench_N": (0.22, 0.10), "go_pose_mm": (0.478, 0.26)}),
        (trial("relative_sliding", "closed_loop_pi", "hbox"), {"go_pose_mm": (1.86, 1.33), "eo_pose_mm": (0.36, 0.47)}),
        (trial("extrinsic_pivoting", "closed_loop_pi", "z"), {"theta_deg": (1.29, 1.11), "tau_Nmm": (63.4, 52.7)}),
    ],
)
def test_a_trial_has_the_papers_figures_beside_it(row, expected):
    found = beside([row])["rows"]["t"]
    assert {name: (found[name]["mean"], found[name]["std"]) for name in expected} == expected


@pytest.mark.parametrize(
    "row",
    [
        trial("grasped_sliding", "mpc"),
        trial("relative_sliding", "open_loop", "hbox"),
        trial("relative_sliding", "closed_loop_pi", "pentagon"),
        trial("extrinsic_pivoting", "closed_loop_pi", "hexagon"),
        trial("static", "closed_loop_pi"),
    ],
)
def test_and_none_where_the_paper_has_none(row):
    assert beside([row])["rows"] == {}


def test_every_table_is_whole():
    shapes = ("tall_box", "z", "heptagon", "pentagon", "triangle")
    assert all(len(paper_figures(["pivoting", shape])) == 8 for shape in shapes)
    optimisers = ("grad_100", "mppi_100", "mppi_1000", "icem_100", "icem_1000")
    for name in optimisers:
        assert set(paper_figures(["optimizers", name])) == {"plan_time_s"}
        assert all(len(paper_figures(["optimizers", name, sensor])) == 2 for sensor in ("soft_bubble", "gelslim"))
    skills = ("static_in_contact", "relative_pivoting", "relative_sliding", "extrinsic_pushing")
    assert all(len(paper_figures(["extrinsic", skill])) == 2 for skill in skills)


def test_the_summaries_of_table_3_have_no_deviation():
    assert paper_figures(["pivoting", "heptagon"])["wrench_summary_N"] == (1.27, None)
    assert "wrench_summary_N" not in beside([trial("extrinsic_pivoting", "closed_loop_pi", "heptagon")])["rows"]["t"]
