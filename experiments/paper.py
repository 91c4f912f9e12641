"""The paper's own figures, to stand beside ours: `experiments/paper_tables.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pydantic import BaseModel, ConfigDict

import experiments
from mechanics.yaml_input import parse, read_yaml

FILE = Path(experiments.__file__).parent / "paper_tables.yaml"

MeanStd = tuple[float, float]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Row(_Strict):
    wrench_N: MeanStd
    go_pose_mm: MeanStd


class PaperTables(_Strict):
    """The file: Table 1 by skill and controller."""

    source: str
    grasped: dict[str, dict[str, _Row]]


@cache
def tables() -> PaperTables:
    """The shipped file."""
    return parse(PaperTables, read_yaml(FILE))


def beside(rows: list[dict]) -> dict:
    """What the paper has for trials (rows of results.json): its source, and figures by trial name where it has any."""
    found = {}
    for row in rows:
        skill = row["skill"].removeprefix("grasped_")
        ours = tables().grasped.get(skill, {}).get(row["controller"]) if row["skill"] != skill else None
        if ours is not None:
            found[row["name"]] = {key: {"mean": mean, "std": std} for key, (mean, std) in ours.model_dump().items()}
    return {"source": tables().source, "rows": found}
