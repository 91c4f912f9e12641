"""The fault campaign: a part of the shipped one, and that its verdict can be other than good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from drivers.wire.log_reader import LogReader
from experiments.check import check
from experiments.files import load
from mechanics.yaml_input import InputError

SHIPPED = Path(__file__).parents[2] / "experiments" / "faults.yaml"
#: cells of the shipped campaign that are quick and unlike each other, by kind and device
PART = {("freeze", "arm"), ("disconnect", "wrist_ft"), ("saturate", "wrist_ft"), ("freeze", "gripper"), ("crash", None)}


def campaign(folder: Path, cells: list[dict[str, Any]]) -> Path:
    """The shipped campaign with other cells."""
    whole = yaml.safe_load(SHIPPED.read_text("utf-8"))
    whole["stages"][1]["cells"] = cells
    path = folder / "part.yaml"
    path.write_text(yaml.safe_dump(whole), "utf-8")
    return path


def shipped_cells() -> list[dict[str, Any]]:
    return yaml.safe_load(SHIPPED.read_text("utf-8"))["stages"][1]["cells"]


def test_the_shipped_campaign_has_sixty_cells_and_more_in_every_moment() -> None:
    stage = load(str(SHIPPED)).experiment.stages[1]
    assert stage.stage == "faults"
    assert stage.count >= 60
    assert {moment for cell in stage.cells for moment in cell.moments} == {"before", "approach", "contact", "logging"}
    assert any(f"{stage.count} cells" in line for line in check(load(str(SHIPPED))))


def test_a_controller_that_does_not_exist_is_found_before_any_cell_runs() -> None:
    with pytest.raises(InputError) as refused:
        load(str(SHIPPED), None, ["stages.1.controller=closed_lop"])
    [problem] = refused.value.problems
    assert problem.key == "stages.1.controller"
    assert (problem.wrong, problem.nearest) == ("unknown controller 'closed_lop'", "closed_loop")


def test_a_part_of_the_campaign_ends_as_expected_with_every_log_whole(command, tmp_path: Path) -> None:
    cells = [cell for cell in shipped_cells() if (cell["fault"]["kind"], cell["fault"].get("device")) in PART]
    assert len(cells) == len(PART)
    part = campaign(tmp_path, [cell | {"moments": ["approach", "contact"]} for cell in cells])
    finished = command.run(str(part))
    assert finished.code == 0, finished.out + finished.err
    rows = finished.results["faults"]
    assert [row["short"] for row in rows] == [[]] * 10
    assert {row["status"] for row in rows} == {"device_failed", "stopped", "completed"}
    assert "10 cells, all as expected" in finished.out
    for row in rows:
        reader = LogReader(finished.folder / "cells" / row["name"] / "log.mcap")
        assert reader.counts()["run/trial"] >= 1
        assert reader.complete


def test_an_outcome_that_is_not_the_expected_one_is_told_and_ends_with_1(command, tmp_path: Path) -> None:
    cell = {
        "fault": {"kind": "freeze", "device": "wrist_ft"},
        "moments": ["contact"],
        "expect": {"contact": "completed"},
    }
    finished = command.run(str(campaign(tmp_path, [cell])))
    assert finished.code == 1
    assert "it ended device_failed" in finished.results["faults"][0]["short"][0]
    assert "not completed" in finished.results["reason"]


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        (
            {"fault": {"kind": "freeze", "device": "arm"}, "moments": ["contact"], "expect": {"before": "stopped"}},
            "contact",
        ),
        ({"fault": {"kind": "melt", "device": "arm"}, "expect": {"before": "stopped"}}, "kind"),
        ({"fault": {"kind": "freeze", "device": "arm"}, "expect": {"before": "fine"}}, "expect"),
    ],
)
def test_a_cell_that_makes_no_sense_is_refused_by_its_key(tmp_path: Path, cell: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        load(str(campaign(tmp_path, [cell])))
