"""The names of what is shipped: experiments, stations, tables, benchmarks. Cheap to ask: no file is parsed."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
STATIONS = FOLDER / "stations"
_TABLE = "table_"
_DATA = ("paper_tables", "targets")

BENCHMARKS = {
    "sim": "how fast the simulated station is",
    "estimation": "how right and how fast the estimators are",
    "planning": "the planner beside cvxpylayers, all optimisers",
    "load": "what is lost in 20 minutes at the lab's rates",
    "bus": "latency and loss between processes",
}
"""What `extrinsic bench` can measure (`experiments.bench`)."""


def experiments() -> dict[str, str]:
    """Every experiment with what its file's first line says of it."""
    others = no_experiments()
    return {name: said for name, said in _named(FOLDER).items() if name not in others}


def no_experiments() -> set[str]:
    """The names of the YAML files beside the experiments that are none."""
    return {*_DATA, *(_TABLE + name for name in tables())}


def stations() -> dict[str, str]:
    """Every station, as `experiments`."""
    return _named(STATIONS)


def tables() -> dict[str, str]:
    """Every table of the paper, as `experiments`."""
    return {name.removeprefix(_TABLE): said for name, said in _named(FOLDER).items() if name.startswith(_TABLE)}


def _named(folder: Path) -> dict[str, str]:
    return {path.stem: _first_line(path) for path in sorted(folder.glob("*.yaml"))}


def _first_line(path: Path) -> str:
    """The first line of the comment that a file begins with, up to its first colon or full stop."""
    with path.open(encoding="utf-8") as file:
        said = next((line[1:].strip() for line in file if line.startswith("# ") and "yaml-language" not in line), "")
    return said.split(":")[0].split(". ")[0].rstrip(".")
