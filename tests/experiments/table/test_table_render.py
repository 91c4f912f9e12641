"""What the terminal and the Markdown file show of a table."""

import pytest
from rich.console import Console

from experiments.table import render


def cell(figure, ours, paper=None, completed=8, where=None):
    def stated(mean):
        return {"mean": mean, "std": 0.16, "low": mean - 0.1, "high": mean + 0.1, "n": 8}

    measured = None if ours is None else stated(ours)
    printed = None if paper is None else {"mean": paper, "std": 0.18}
    counts = {"trials": 8, "completed": completed}
    return {"where": where or {}, "figure": figure, **counts, "measured": measured, "truth": measured, "paper": printed}


@pytest.fixture
def result():
    columns = [
        {"tags": {"run": r}, "figure": f} for r in ("static", "pivoting", "sliding") for f in ("wrench_N", "go_pose_mm")
    ]
    cells = [cell(c["figure"], 0.42, 0.45) for c in columns]
    row = {"tags": {"controller": "closed_loop_pi", "mu_ground": 0.33, "mu_object": None}, "cells": cells}
    finding = {"name": "a | b", "value": 4.0, "told": "4 of 6", "target": "≥ 5", "holds": False, "why": "x"}
    lost = {"run": "static", "trajectory": "a", "controller": "rigid_sensor", "status": "lost_contact"}
    found = {"kind": "friction", "pair": "eo-ground", "mu": 0.3218, "interval": [0.315, 0.329]}
    return {
        "title": "Table 1: [brackets] stay",
        "seed": 0,
        "part": True,
        "source": "The paper",
        "notes": ["a note"],
        "panels": [{"title": "Panel", "columns": columns, "rows": [row]}],
        "findings": [finding],
        "incomplete": [{**lost, "trial": n, "reason": f"at waypoint {n + 3}"} for n in range(2)],
        "calibrations": {"bubble": [found]},
    }


def shown(result):
    console = Console(width=100, record=True, force_terminal=False)
    render.show(console, result)
    return console.export_text()


def test_the_papers_widest_table_is_whole_at_100_columns(result):
    text = shown(result)
    assert "…" not in text.replace("0.32…0.52", "").replace("0.315…0.329", "")  # nothing was cut short
    assert text.count("0.42 ±0.16") == 12 and text.count("0.45 ±0.18") == 6
    assert text.count("8 of 8") == 3  # told once for each skill
    assert "closed_loop_pi" in text and "µ ground 0.33" in text and "[brackets] stay" in text


def test_a_row_says_nothing_of_what_it_has_not(result):
    result["panels"][0]["rows"][0]["cells"] = [cell(c["figure"], 0.42) for c in result["panels"][0]["columns"]]
    assert "0.45" not in shown(result)
    result["panels"][0]["rows"][0]["cells"][0] = cell("wrench_N", None)
    assert "–" in shown(result)


def test_trials_that_did_not_end_well_are_told_with_their_reason(result):
    assert "static, rigid_sensor: 2 lost_contact: at waypoint 3" in shown(result)
    assert "a part of the table" in shown(result)


def test_what_was_calibrated_is_told(result):
    assert "calibrated, bubble: µ eo-ground 0.322 (0.315…0.329)" in shown(result)


def test_the_markdown_has_every_row_with_as_many_cells_as_its_head(result):
    lines = [line for line in render.markdown(result).splitlines() if line.startswith("|")]
    widths = [line.replace("\\|", "").count("|") for line in lines]
    assert widths == [9] * 7 + [5] * 3  # a head, a rule and five lines; a head, a rule and one finding
    assert "| a \\| b | 4 of 6 | ≥ 5 | no |" in lines


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.00"),
        (0.012, "0.01"),
        (0.0062, "0.006"),
        (0.42, "0.42"),
        (9.99, "9.99"),
        (12.34, "12.3"),
        (123.4, "123"),
        (-0.5, "-0.50"),
        (2e-5, "2.0e-05"),
    ],
)
def test_a_figure_has_the_places_that_can_be_compared(value, text):
    assert render.number(value) == text
