"""What editors are told of the files that people write: a JSON Schema for each kind, shipped in ``schemas/``.

``extrinsic schema --out experiments/schemas`` makes the shipped ones anew; a test sees that they are what the models
say.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.run_folder import write_atomic
from mechanics.json_schema import DRAFT, schema_of, schemas_of
from mechanics.yaml_input import InputError, Problem, nearest, one_of

SCHEMAS = Path(__file__).parent / "schemas"

#: what stands in the first line of a YAML file, for the editors that look there
MODELINE = "# yaml-language-server: $schema="


def schema_text(kind: str) -> str:
    """The JSON Schema of the files of this kind (`KINDS`), as its file has it. Raises InputError for another kind."""
    if kind not in KINDS:
        wrong = f"no kind of file is called {kind!r}"
        raise InputError([Problem("schema", None, "KIND", wrong, one_of(KINDS), nearest(kind, KINDS))])
    return json.dumps(KINDS[kind](), indent=1, ensure_ascii=False) + "\n"


def write_schema(kind: str, file: Path) -> None:
    """Write `schema_text` to a file, whole or not at all. Raises InputError."""
    text = schema_text(kind)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(file, text)
    except OSError as error:
        wrong, expected = f"cannot be written: {error.strerror}", "a file that you may write"
        raise InputError([Problem(str(file), None, "--out", wrong, expected)]) from None


def _experiment() -> dict[str, Any]:
    """An experiment, or what a run's folder has: the experiment and its station in one file."""
    from drivers.config import StationConfig
    from experiments.schema import Experiment

    (experiment, station), definitions = schemas_of([Experiment, StationConfig])
    both = {"experiment": experiment, "station": station}
    return {
        "$schema": DRAFT,
        "title": "experiment",
        "if": {"required": ["experiment"]},
        "then": {"properties": both, "required": list(both), "additionalProperties": False},
        "else": experiment,
        "definitions": definitions,
    }


def _station() -> dict[str, Any]:
    from drivers.config import StationConfig

    return schema_of(StationConfig, "station")


def _object() -> dict[str, Any]:
    from mechanics.catalogue import ObjectModel

    return schema_of(ObjectModel, "object")


def _sensor() -> dict[str, Any]:
    from mechanics.catalogue import SensorModel

    return schema_of(SensorModel, "sensor")


def _profile() -> dict[str, Any]:
    from drivers.sim.mismatch import Mismatch

    return schema_of(Mismatch, "profile")


def _table() -> dict[str, Any]:
    from experiments.table.schema import Table

    return schema_of(Table, "table")


#: the kinds of files that there are schemas for
KINDS: dict[str, Callable[[], dict[str, Any]]] = {
    "experiment": _experiment,
    "station": _station,
    "object": _object,
    "sensor": _sensor,
    "profile": _profile,
    "table": _table,
}
