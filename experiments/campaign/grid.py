"""From ``--grid`` and ``--seeds`` to jobs: every combination, every seed, every trial."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import SequenceNode

from experiments.campaign.jobs import Job, digest, resolve
from experiments.files import Resolved
from experiments.schema import ExecuteStage
from mechanics.yaml_input import InputError, Problem, read_text

#: nobody means to start more jobs than this by hand; a range that was mistyped does
MOST_JOBS = 100_000
_GRID_FORM = "key=value,value,..., such as friction.go-ground=0.3,0.5"
_SEEDS_FORM = "seeds and ranges of seeds, such as 0-4 or 0,3,7"
_SEEDS = re.compile(r"\s*(\d{1,18})\s*(?:-\s*(\d{1,18})\s*)?")

Grid = Mapping[str, tuple[str, ...]]


def parse_grid(options: Sequence[str], sets: Sequence[str] = ()) -> Grid:
    """The values of each key, as the texts that ``--set`` takes, in the order given.

    Values are the items of a YAML list: what stands in brackets, braces or quotes is one value. Raises InputError, also
    for a key that is or holds one that the grid or ``sets`` have already, and for two values that mean the same.
    """
    grid: dict[str, tuple[str, ...]] = {}
    taken = _keys(sets)
    for option in options:
        key, equals, text = (part.strip() for part in option.partition("="))
        if not equals or not key:
            raise _refused("", f"{option!r} is no key with values", _GRID_FORM)
        for other in grid:
            if _within(key, other) or _within(other, key):
                also = "" if other == key else f": {other}"
                raise _refused(key, f"--grid has this key already{also}", "each key once")
        if any(_within(other, key) for other in taken):
            raise _refused(key, "--set has this key already", "each key once")
        values = _items(key, text)
        meant = [_meaning(value) for value in map(_read, values)]
        twice = next((i for i, value in enumerate(meant) if value in meant[:i]), None)
        if twice is not None:
            raise _refused(key, f"the value {values[twice]} stands twice", "each value once")
        grid[key] = values
    return grid


def parse_seeds(text: str | None) -> tuple[int, ...]:
    """Seeds from ``0-4`` or ``0,3,7``, each once; none where there is no text. Raises InputError."""
    seeds: dict[int, None] = {}
    for part in [] if text is None else text.split(","):
        match = _SEEDS.fullmatch(part)
        if match is None:
            raise InputError([Problem("--seeds", None, "", f"{part!r} is no seed", _SEEDS_FORM)])
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        if not first <= last < first + MOST_JOBS:
            wrong = f"{part!r} is an empty range" if last < first else f"{part!r} is more than {MOST_JOBS} seeds"
            raise InputError([Problem("--seeds", None, "", wrong, _SEEDS_FORM)])
        seeds.update(dict.fromkeys(range(first, last + 1)))
    return tuple(seeds)


def sweep_jobs(
    experiment: str, station: str | None, sets: Sequence[str], grid: Grid, seeds: Sequence[int]
) -> list[Job]:
    """The jobs of a sweep: one for each combination of the grid, each seed and each trial.

    Raises InputError for what does not load, naming the combination, and for two combinations that are the same run.
    """
    if seeds and any(_within(key, "experiment.seed") for key in (*grid, *_keys(sets))):
        raise InputError([Problem("--seeds", None, "seed", "the seed is set elsewhere, too", "one of them")])
    whole: list[Job] = []
    for i, values in enumerate(product(*grid.values())):
        chosen = dict(zip(grid, values, strict=True))
        tags = {key: tag_of(value) for key, value in chosen.items()}
        given = (*sets, *(f"{key}={value}" for key, value in chosen.items()))
        if not seeds:
            whole.append(Job(f"c{i:03d}", experiment, station, given, tags))
        for seed in seeds:
            both = (*given, f"experiment.seed={seed}")
            whole.append(Job(f"c{i:03d}-s{seed}", experiment, station, both, {**tags, "seed": seed}))
        if len(whole) > MOST_JOBS:
            raise InputError([Problem("--grid", None, "", f"more than {MOST_JOBS} runs", "a smaller grid")])
    resolved = resolve(whole)
    _refuse_doubles(whole, resolved)
    return [
        replace(part, tags={**part.tags, "seed": resolved[job.id].experiment.seed})
        for job in whole
        for part in split(job, resolved[job.id])
    ]


def split(job: Job, resolved: Resolved) -> list[Job]:
    """One job for each trial, all controllers of a trial together, so that workers share them.

    A run that calibrates stays whole, for its trials need what it finds, and so does one whose execute stages have
    different numbers of trials.
    """
    stages = resolved.experiment.stages
    executes = [(i, stage) for i, stage in enumerate(stages) if isinstance(stage, ExecuteStage)]
    counts = {stage.trials for _, stage in executes}
    if len(counts) != 1 or counts == {1} or any(stage.stage.startswith("calibrate") for stage in stages):
        return [job]
    parts: list[Job] = []
    for n in range(counts.pop()):
        own = [
            text
            for i, stage in executes
            for text in (f"experiment.stages.{i}.first={stage.first + n}", f"experiment.stages.{i}.trials=1")
        ]
        number = executes[0][1].first + n
        parts.append(replace(job, id=f"{job.id}-t{number}", sets=(*job.sets, *own)))
    return parts


def tag_of(text: str) -> Any:
    """A value for the table: what YAML reads in ``text`` where that is a figure or a word, else the text."""
    value = _read(text)
    return value if isinstance(value, int | float | str) else text


def _read(text: str) -> Any:
    [value] = read_text(f"value: [{text}]", "--grid").data["value"]
    return value


def _meaning(value: Any) -> Any:
    """What is equal for values that mean the same: 0.2 and 0.20, 1 and 1.0; not 1 and true."""
    match value:
        case dict():
            return {key: _meaning(inner) for key, inner in value.items()}
        case list():
            return [_meaning(inner) for inner in value]
    return type(value) is bool, value


def _keys(sets: Sequence[str]) -> list[str]:
    return [text.partition("=")[0].strip() for text in sets]


def _within(key: str, other: str) -> bool:
    """Whether ``key`` is ``other``, or something in it; without ``experiment.`` or ``station.`` it may mean either."""
    (file, path), (other_file, other_path) = _parted(key), _parted(other)
    return path[: len(other_path)] == other_path and (not file or not other_file or file == other_file)


def _parted(key: str) -> tuple[str, list[str]]:
    """The file that a key names, or "", and its path, an index written as in every other way."""
    path = [str(int(name)) if name.isascii() and name.isdecimal() else name for name in key.split(".")]
    return (path[0], path[1:]) if path[0] in ("experiment", "station") and len(path) > 1 else ("", path)


def _refuse_doubles(jobs: Sequence[Job], resolved: Mapping[str, Resolved]) -> None:
    """Raises InputError where two combinations come to the same experiment on the same station."""
    first: dict[str, Job] = {}
    for job in jobs:
        same = first.setdefault(digest(resolved[job.id]), job)
        if same is not job:
            wrong = f"{same.told} and {job.told} are one and the same run"
            raise InputError([Problem("--grid", None, "", wrong, "combinations that differ")])


def _items(key: str, text: str) -> tuple[str, ...]:
    """The items of the YAML list ``[text]``, each as it was written."""
    listed = f"[{text}]"
    try:
        node = YAML(typ="safe", pure=True).compose(io.StringIO(listed))
    except (YAMLError, ValueError, RecursionError):
        node = None
    # what closes the bracket early is another list than the one that was meant
    if not isinstance(node, SequenceNode) or node.end_mark.index != len(listed):
        raise _refused(key, f"{text!r} is no list of values", _GRID_FORM)
    items = tuple(listed[item.start_mark.index : item.end_mark.index].strip() for item in node.value)
    if not items or not all(items):
        raise _refused(key, "a value is missing", _GRID_FORM)
    return items


def _refused(key: str, wrong: str, expected: str) -> InputError:
    return InputError([Problem(f"--grid {key}".rstrip(), None, key, wrong, expected)])
