"""JSON that a run or a campaign left, read back: what others build on is there and of its kind, or it is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field

#: a trial's figures are 6 deep in results.json
_DEPTH = 32

#: what a log calls the attachment that says what was known when its run began
BEGUN = "run.json"

Word = Annotated[str, Field(max_length=1000)]


class Planned(BaseModel):
    """What a table needs of a trial that was not run; a row says more."""

    skill: Word | None
    controller: Word


class Figure(BaseModel):
    """Mean and spread over the waypoints of a trial."""

    mean: float
    std: float


Errors = dict[Word, Figure | None]


class Trial(Planned):
    """What tables and the report need of a row of results.json."""

    status: Word
    reason: str = ""
    measured: Errors | None = None
    truth: Errors | None = None


class _Mended(BaseModel):
    ending: str


class _Repair(BaseModel):
    logs: list[_Mended]


class _Ended(BaseModel):
    status: Word
    calibration: dict[Word, dict[str, Any]] | None = None
    plans: list[dict[str, Any]] = []
    log: dict[str, Any] | None = None
    repair: _Repair | None = None


class Results(_Ended):
    """results.json (design §6), as far as tables are made of it."""

    reason: str
    trials: list[Trial]


class NamedTrial(Trial):
    """A trial that the report shows."""

    name: Word


class ShownResults(_Ended):
    """results.json, as far as the report shows it."""

    trials: list[NamedTrial]


class Begun(BaseModel):
    """What is known of a run when it begins; its log carries it, so that it outlives results.json."""

    started: Word
    provenance: dict[Word, Any]


def read_json(file: Path, model: type[BaseModel]) -> dict[str, Any] | None:
    """The JSON in ``file``, which says at least what ``model`` asks for; None where it does not, or is not there."""
    try:
        return parse_json(file.read_bytes(), model)
    except FileNotFoundError:
        return None


def parse_json(data: bytes, model: type[BaseModel]) -> dict[str, Any] | None:
    """The JSON in ``data``, which says at least what ``model`` asks for; None where it does not."""
    try:
        found = json.loads(data.decode("utf-8"), parse_constant=_refuse)
        model.model_validate(found, strict=True)
        return found if _depth(found) <= _DEPTH else None
    except (ValueError, RecursionError):  # pydantic's error is a ValueError
        return None


def _depth(value: Any) -> int:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return 1 + max(map(_depth, inner), default=0)


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no figure")
