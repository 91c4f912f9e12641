"""What a log holds of one topic, as arrays: a row for each message, its columns named."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.wire import messages
from drivers.wire.codec import Reading
from drivers.wire.log_reader import Logged, LogReader
from drivers.wire.records import Record
from mechanics.readings import (
    Array,
    GripperReading,
    ImageReading,
    PoseReading,
    TagReading,
    TruthReading,
    WrenchReading,
)
from mechanics.records import (
    EventRecord,
    LookRecord,
    PhaseRecord,
    PlanarState,
    StatusRecord,
    TrialRecord,
    WaypointRecord,
)

if TYPE_CHECKING:
    from pandas import DataFrame

_NAN = (math.nan,) * 3
_POSE, _PLANAR_WRENCH = ("x", "y", "theta"), ("fx", "fy", "tau")
_BODIES = ("ee", "go", "eo")
_WITNESSES = ("planned", "measured", "truth", "estimated")
_CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "uv")

WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
GRIPPER = ("width", "force", "holding")
TARGET = (*_POSE, "vx", "vy", "vtheta", "duration")
TAGS = ("id", *_CORNERS, "hamming", "margin", "ambiguity")
TRUTH = (*(f"{body}_{axis}" for body in _BODIES for axis in _POSE), *_PLANAR_WRENCH)
WAYPOINT = (
    "step",
    *(f"commanded_{axis}" for axis in _POSE),
    *(f"{witness}_{name}" for witness in _WITNESSES for name in TRUTH),
    "contact_x",
    "contact_y",
)
STATUS, DIAGNOSTICS = ("sequence", "status"), ("level",)
#: fields of records that are no words, or plans
_NO_WORDS = ("capture_ns", "plan", "sources", "stamps", "sequences")


@dataclass(frozen=True, eq=False)
class Series:
    """The messages of a topic in the order of the log, N of them; N detections of tags, N lines of diagnostics.

    ``times_ns`` (N,) is when each was captured, in the station's clock. ``values`` are (N, C), a column for each of
    ``columns``, SI, NaN where there is nothing; of pictures (N, h, w[, 3]), as `mechanics.readings.ImageReading` has
    them. ``status`` (N,) is `mechanics.readings.Status`, 0 where all is well. ``texts`` are columns that are no
    figures, N words each.
    """

    topic: str
    times_ns: NDArray[np.int64]
    values: NDArray[Any]
    columns: tuple[str, ...]
    status: NDArray[np.int8]
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.times_ns)

    def __repr__(self) -> str:
        return f"Series({self.topic}: {len(self)} × {', '.join((*self.texts, *self.columns)) or 'pictures'})"

    @property
    def times(self) -> Array:
        """When each was captured (N,) [s]."""
        return self.times_ns.astype(np.float64) * 1e-9

    def __getitem__(self, column: str) -> Array:
        """One column (N,). Raises KeyError, with those that there are."""
        if column not in self.columns:
            raise KeyError(f"{self.topic} has no column {column!r}; it has {', '.join(self.columns) or 'pictures'}")
        return self.values[:, self.columns.index(column)]

    def frame(self) -> DataFrame:
        """The columns as a data frame, by time [s]. Raises ValueError for pictures."""
        import pandas as pd

        if self.values.ndim > 2:
            raise ValueError(f"{self.topic}: pictures are no table; take `values`")
        figures = dict(zip(self.columns, self.values.T, strict=True))
        return pd.DataFrame({**self.texts, **figures}, index=pd.Index(self.times, name="t"))


def topics(files: Iterable[Path]) -> dict[str, int]:
    """The topics of the logs, each with how many messages it has."""
    found: dict[str, int] = {}
    for file in files:
        for topic, count in LogReader(file).counts().items():
            found[topic] = found.get(topic, 0) + count
    return found


def readings(files: Iterable[Path], topic: str) -> Iterator[Reading | Record]:
    """The readings or records of a topic, one after the other. Raises ProtocolError for a topic of another type."""
    for file in files:
        for logged in LogReader(file).messages([topic]):
            yield logged.value()


def series(files: Iterable[Path], topic: str) -> Series:
    """All messages of a topic as arrays. Raises ProtocolError for a type that no station has, and for garbage."""
    rows: list[Any] = []
    times: list[int] = []
    statuses: list[int] = []
    texts: dict[str, list[str]] = {}
    columns: tuple[str, ...] = ()
    for file in files:
        for logged in LogReader(file).messages([topic]):
            found = _rows(logged)
            columns = found.columns
            rows += found.rows
            times += [found.capture_ns] * len(found.rows)
            statuses += [found.status] * len(found.rows)
            for words in found.words:
                for name, word in words.items():
                    texts.setdefault(name, []).append(word)
    pictures = bool(rows) and isinstance(rows[0], np.ndarray)
    values = _stacked(topic, rows) if pictures else np.array(rows, np.float64).reshape(len(rows), len(columns))
    named = {name: tuple(column) for name, column in texts.items()}
    return Series(topic, np.array(times, np.int64), values, columns, np.array(statuses, np.int8), named)


def _stacked(topic: str, pictures: list[NDArray[Any]]) -> NDArray[Any]:
    shapes = {picture.shape for picture in pictures}
    if len(shapes) > 1:
        sizes = ", ".join(map(str, sorted(shapes)))
        raise ProtocolError("log", f"stack the pictures of {topic}", f"they are of several sizes: {sizes}", "")
    return np.stack(pictures)


class _Rows(NamedTuple):
    """What a message comes to: capture time [ns], status, a row of figures for each of its parts, and its words."""

    columns: tuple[str, ...]
    capture_ns: int
    status: int
    rows: list[Any]
    words: Sequence[Mapping[str, str]] = ()


def _rows(logged: Logged) -> _Rows:
    if logged.type_name == messages.TARGET:
        target = messages.decode(logged.payload, logged.type_name)
        figures = [*target.pose.tolist(), *target.twist.tolist(), target.duration]
        return _Rows(TARGET, messages.stamp_ns(target.header.stamp), 0, [figures])
    if logged.type_name == messages.DIAGNOSTICS:
        return _diagnostics(messages.decode(logged.payload, logged.type_name))
    value = logged.value()
    if isinstance(value, WaypointRecord):
        return _Rows(WAYPOINT, value.capture_ns, 0, [_waypoint(value)], [{"trial": value.trial}])
    if isinstance(value, StatusRecord):
        return _Rows(STATUS, value.capture_ns, 0, [[value.sequence, value.status]], [{"stream": value.stream}])
    if isinstance(value, TrialRecord | PhaseRecord | EventRecord | LookRecord):
        words = {name: getattr(value, name) for name in type(value).__slots__ if name not in _NO_WORDS}
        return _Rows((), value.capture_ns, 0, [[]], [words])
    columns, rows = _READINGS[type(value)]
    return _Rows(columns, value.stamp.capture_ns, int(value.stamp.status), rows(value))


def _diagnostics(value: Any) -> _Rows:
    rows = [[float(status.level)] for status in value.status]
    words = [
        {
            "name": status.name,
            "message": status.message,
            "values": json.dumps({pair.key: pair.value for pair in status.values}, ensure_ascii=False),
        }
        for status in value.status
    ]
    return _Rows(DIAGNOSTICS, messages.stamp_ns(value.header.stamp), 0, rows, words)


def _planar(state: PlanarState | TruthReading | None) -> list[float]:
    """As `TRUTH` has it."""
    if state is None:
        return [math.nan] * len(TRUTH)
    poses = [*state.ee, *(_NAN if state.go is None else state.go), *(_NAN if state.eo is None else state.eo)]
    return [*map(float, poses), *map(float, state.wrench)]


def _waypoint(record: WaypointRecord) -> list[float]:
    point = None if record.contact is None else record.contact.point
    figures = [float(record.step), *record.commanded.tolist()]
    for witness in (record.planned, record.measured, record.truth, record.estimated):
        figures += _planar(witness)
    return [*figures, *(_NAN[:2] if point is None else point.tolist())]


def _tags(reading: TagReading) -> list[list[float]]:
    return [
        [
            tag.id,
            *tag.corners.ravel().tolist(),
            tag.hamming,
            tag.margin,
            math.nan if tag.ambiguity is None else tag.ambiguity,
        ]
        for tag in reading.detections
    ]


_READINGS: dict[type, tuple[tuple[str, ...], Callable[[Any], list[Any]]]] = {
    PoseReading: (_POSE, lambda reading: [reading.pose.tolist()]),
    WrenchReading: (WRENCH, lambda reading: [reading.wrench.tolist()]),
    GripperReading: (GRIPPER, lambda reading: [[reading.width, reading.force, float(reading.holding)]]),
    TagReading: (TAGS, _tags),
    TruthReading: (TRUTH, lambda reading: [_planar(reading)]),
    ImageReading: ((), lambda reading: [reading.image]),
}
