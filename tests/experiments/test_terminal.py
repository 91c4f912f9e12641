"""Tables and texts on any terminal: too narrow, without UTF-8."""

from __future__ import annotations

import io

import pytest
from rich.box import SIMPLE_HEAD
from rich.table import Table

from experiments.tables import error_table, faults_table
from experiments.terminal import Terminal, plain


def shown(what: object, width: int, encoding: str = "utf-8") -> str:
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    Terminal(file=stream, width=width).print(what)
    stream.flush()
    return stream.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "encoding", "expected"),
    [
        ("1.40 ± 0.05 µm", "ascii", "1.40 +- 0.05 um"),
        ("at most 3° and 2 m/s², N·m", "ascii", "at most 3 deg and 2 m/s2, N.m"),
        ("≥ 3, θ → Müller…", "ascii", ">= 3, theta -> Muller..."),
        ("1.40 ± 0.05", "latin-1", "1.40 ± 0.05"),
        ("\ud800 and 漢", "ascii", "? and ?"),
    ],
)
def test_what_an_encoding_has_not_is_said_in_ascii(text: str, encoding: str, expected: str) -> None:
    assert plain(text, encoding) == expected


def table() -> Table:
    table = Table(box=SIMPLE_HEAD, title="a title")
    for name in ("trial", "seen by", "pose"):
        table.add_column(name, no_wrap=True)
    table.add_row("a-rather-long-name", "measured\ntruth", "1.40 ± 0.05\n1.45 ± 0.05")
    return table


def test_columns_stay_columns_without_utf8() -> None:
    lines = shown(table(), 80, "ascii").splitlines()
    starts = [line.index("1.4") for line in lines if "1.4" in line]
    assert len(starts) == 2 and len(set(starts)) == 1
    assert max(map(len, lines)) <= 80


def test_a_table_that_is_too_wide_is_shown_row_by_row_and_whole() -> None:
    lines = [line.rstrip() for line in shown(table(), 36).splitlines()]
    assert lines == [
        "a title",
        "a-rather-long-name",
        "  seen by measured    truth",
        "  pose    1.40 ± 0.05 1.45 ± 0.05",
    ]


def trial(name: str, status: str) -> dict:
    figures = {key: {"mean": 1.4, "std": 0.05} for key in ("go_pose_mm", "eo_pose_mm", "wrench_N")}
    row = {"name": name, "skill": "s", "controller": name, "status": status, "extrinsic_object": "pentagon"}
    return row | {"measured": figures, "truth": figures}


def test_the_summary_of_a_run_is_whole_in_60_columns_of_ascii() -> None:
    trials = [trial("extrinsic_pivoting-closed_loop_pi-12", "lost_contact"), trial("tip", "completed")]
    said = shown(error_table({"experiment": "e", "station": "s", "seed": 0, "trials": trials}), 60, "ascii")
    assert max(map(len, said.splitlines())) <= 60
    assert said.count("1.40 +- 0.05") == 12  # two trials, three figures, seen twice
    for name in ("extrinsic_pivoting-closed_loop_pi-12", "lost_contact", "eo pose [mm]", "truth"):
        assert name in said


def test_the_faults_that_fell_short_are_readable_in_60_columns() -> None:
    short = "the arm moved on for 120 ms, 100 are allowed"
    row = {"fault": {"kind": "delay", "device": "camera", "value": 0.2}, "moment": "in contact", "status": "completed"}
    said = shown(faults_table([row | {"moved_on_s": 0.12, "force_N": None, "short": [short]}]), 60)
    assert short in said
    assert "moved on [ms]" in said
