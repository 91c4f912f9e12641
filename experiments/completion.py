"""What the shell completes beside commands and options: what is shipped and what lies here, runs, devices.

Where nothing of that fits, shells complete paths by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import typer

from experiments import shipped

Completed = Iterable[tuple[str, str]]
#: a shell's list is for the newest; older runs are typed
_RUNS = 30


def experiments(incomplete: str) -> Completed:
    """Shipped experiments, and YAML files here."""
    return _names_and_files(shipped.experiments(), incomplete)


def stations(incomplete: str) -> Completed:
    """Shipped stations, those under ``stations/``, and YAML files here."""
    own = {path.stem: "in stations/" for path in sorted(Path("stations").glob("*.yaml"))}
    return _names_and_files({**shipped.stations(), **own}, incomplete)


def tables(incomplete: str) -> Completed:
    """Tables of the paper, and YAML files here."""
    return _names_and_files(shipped.tables(), incomplete)


def benchmarks(incomplete: str) -> Completed:
    """Benchmarks."""
    return _beginning(incomplete, shipped.BENCHMARKS)


def runs(incomplete: str) -> Completed:
    """The newest run folders under ``runs/``."""
    return _newest(incomplete, "experiment.yaml")


def runs_and_sweeps(incomplete: str) -> Completed:
    """The newest folders of runs, sweeps and tables under ``runs/``."""
    return _newest(incomplete, "experiment.yaml", "campaign.json", "asked.json")


def _newest(incomplete: str, *marks: str) -> Completed:
    found = {str(path.parent): "" for mark in marks for path in Path("runs").glob(f"*/{mark}")}
    newest = dict(sorted(found.items(), key=lambda item: item[0].rsplit("-", 1)[-1], reverse=True)[:_RUNS])
    return _beginning(incomplete, newest)


def devices(context: typer.Context, incomplete: str) -> Completed:
    """The devices of the station that was named before."""
    from experiments.files import load_station
    from mechanics.yaml_input import InputError

    try:
        config = load_station(context.params.get("station") or "", [])
    except InputError:  # said once the command is run
        return []
    return _beginning(incomplete, {name: device.kind for name, device in config.devices.items()})


def _names_and_files(names: dict[str, str], incomplete: str) -> Completed:
    here = {path.name: "here" for path in sorted(Path().glob("*.y*ml"))}
    return _beginning(incomplete, {**here, **names})


def _beginning(incomplete: str, names: dict[str, str]) -> Completed:
    return [(name, said) for name, said in names.items() if name.startswith(incomplete)]
