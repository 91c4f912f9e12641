"""The paper's own figures, to stand beside ours: `experiments/paper_tables.yaml`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

import experiments
from mechanics.yaml_input import parse, read_yaml

FILE = Path(experiments.__file__).parent / "paper_tables.yaml"

MeanStd = tuple[float, float]
#: mean and standard deviation by the figure's name; a summary has no deviation
Figures = Mapping[str, tuple[float, float | None]]

#: the law that the paper's Tables 2 to 4 were made with
LAW = "closed_loop_pi"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Grasped(_Strict):
    wrench_N: MeanStd
    go_pose_mm: MeanStd


class _Extrinsic(_Strict):
    go_pose_mm: MeanStd
    eo_pose_mm: MeanStd


class _Pivoting(_Strict):
    fx_N: MeanStd
    fy_N: MeanStd
    tau_Nmm: MeanStd
    wrench_summary_N: float
    x_mm: MeanStd
    y_mm: MeanStd
    theta_deg: MeanStd
    pose_summary_mm: float


class _Executed(_Strict):
    eo_pose_mm: MeanStd
    wrench_N: MeanStd


class _Optimiser(_Strict):
    soft_bubble: _Executed
    gelslim: _Executed
    plan_time_s: MeanStd


class PaperTables(_Strict):
    """The file: Table 1 by skill and controller, Table 2 by skill, Table 3 by object, Table 4 by optimiser."""

    source: str
    grasped: dict[str, dict[str, _Grasped]]
    extrinsic: dict[str, _Extrinsic]
    pivoting: dict[str, _Pivoting]
    optimizers: dict[str, _Optimiser]


@cache
def tables() -> PaperTables:
    """The shipped file."""
    return parse(PaperTables, read_yaml(FILE))


def paper_figures(path: Iterable[str]) -> Figures:
    """The figures at ``path`` in the file, such as ``pivoting``, ``z``; none where there is no such place."""
    here: Any = tables().model_dump()
    for key in path:
        here = here.get(key) if isinstance(here, dict) else None
    if not isinstance(here, dict):
        return {}
    pairs = {name: value if isinstance(value, tuple) else (value, None) for name, value in here.items()}
    return {name: value for name, value in pairs.items() if isinstance(value[0], float)}


def beside(rows: list[dict]) -> dict:
    """What the paper has for trials (rows of results.json): its source, and figures by trial name where it has any."""
    found = {}
    for row in rows:
        printed = {name: pair for name, pair in paper_figures(_place(row)).items() if pair[1] is not None}
        if printed:
            found[row["name"]] = {name: {"mean": mean, "std": std} for name, (mean, std) in printed.items()}
    return {"source": tables().source, "rows": found}


def _place(row: Mapping[str, Any]) -> list[str]:
    """Where the paper's figures for a trial stand, if it has any."""
    skill, eo = row["skill"], str(row.get("extrinsic_object"))
    if skill.startswith("grasped_"):
        return ["grasped", skill.removeprefix("grasped_"), row["controller"]]
    if row["controller"] != LAW:
        return []
    if skill == "extrinsic_pivoting":
        return ["pivoting", eo]
    return ["extrinsic", skill] if eo == "hbox" else []
