"""A Rerun recording that is written by columns: a log is a hundred thousand small readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Array

if TYPE_CHECKING:
    import rerun as rr

TIME, WAYPOINT = "station_time", "waypoint"
"""The timelines: the station's clock, and within a trial the number of the waypoint."""

_ROOM = 20_000
"""Rows of a column that are kept before they are written."""


class At(NamedTuple):
    """When something was: on the station's clock [ns], at a waypoint of its trial, or both."""

    t_ns: int | None = None
    waypoint: int | None = None


class _Column:
    """Rows of one archetype at one path, each with any number of instances."""

    def __init__(self, archetype: Any):
        self.archetype = archetype
        self.at: list[At] = []
        self.counts: list[int] = []
        self.fields: dict[str, list[Any]] = {}

    def add(self, at: At, count: int, fields: dict[str, Sequence[Any] | NDArray[Any]]) -> None:
        self.at.append(at)
        self.counts.append(count)
        for name, values in fields.items():
            self.fields.setdefault(name, []).append(values)


class Sheet:
    """Rows for a Rerun recording, written when there are enough of them, and by `flush`.

    Time is shown as the time of day where ``clock`` is Unix time, otherwise as seconds.
    """

    def __init__(self, recording: rr.RecordingStream, *, clock: bool):
        self.recording, self._clock = recording, clock
        self._columns: dict[tuple[str, str, bool, bool], _Column] = {}
        self._noted: set[str] = set()

    def put(self, path: str, archetype: Any, at: At, count: int, **fields: Sequence[Any] | NDArray[Any]) -> None:
        """Add a row of ``count`` instances at ``path``; each field has one value per instance."""
        key = (path, archetype.__name__, at.t_ns is None, at.waypoint is None)
        column = self._columns.get(key)
        if column is None:
            column = self._columns[key] = _Column(archetype)
        column.add(at, count, fields)
        if len(column.at) >= _ROOM:
            self._write(path, self._columns.pop(key))

    def pose(self, path: str, at: At, pose: Array) -> None:
        """Add where the frame of ``path`` is in its parent: a planar pose (3,)."""
        import rerun as rr

        x, y, theta = (float(value) for value in pose)
        turn = [0.0, 0.0, np.sin(0.5 * theta), np.cos(0.5 * theta)]
        self.put(path, rr.Transform3D, at, 1, translation=[[x, y, 0.0]], quaternion=[turn])

    def scalars(self, path: str, at: At, values: Sequence[float] | Array) -> None:
        """Add a row of figures, one for each curve of the path."""
        import rerun as rr

        self.put(path, rr.Scalars, at, len(values), scalars=values)

    def once(self, path: str, made: Callable[[], Any]) -> None:
        """Log what ``made`` gives, which does not change with time, the first time that it is said of this path."""
        if path not in self._noted:
            self.still(path, made())

    def still(self, path: str, archetype: Any) -> None:
        """Log something that does not change with time (or several things), in place of what was said before."""
        self._noted.add(path)
        self.recording.log(path, *(archetype if isinstance(archetype, tuple) else (archetype,)), static=True)

    def log(self, path: str, at: At, *archetypes: Any) -> None:
        """Log something large or seldom at once: a picture, a line of text."""
        self.recording.reset_time()
        if at.t_ns is not None:
            if self._clock:
                self.recording.set_time(TIME, timestamp=np.datetime64(at.t_ns, "ns"))
            else:
                self.recording.set_time(TIME, duration=np.timedelta64(at.t_ns, "ns"))
        if at.waypoint is not None:
            self.recording.set_time(WAYPOINT, sequence=at.waypoint)
        self.recording.log(path, *archetypes)

    def flush(self) -> None:
        """Hand everything to Rerun."""
        columns, self._columns = self._columns, {}
        for (path, *_), column in columns.items():
            self._write(path, column)

    def _write(self, path: str, column: _Column) -> None:
        import rerun as rr

        indexes = []
        times = [at.t_ns for at in column.at if at.t_ns is not None]
        steps = [at.waypoint for at in column.at if at.waypoint is not None]
        if times and self._clock:
            indexes.append(rr.TimeColumn(TIME, timestamp=np.array(times, "datetime64[ns]")))
        elif times:
            indexes.append(rr.TimeColumn(TIME, duration=np.array(times, "timedelta64[ns]")))
        if steps:
            indexes.append(rr.TimeColumn(WAYPOINT, sequence=steps))
        fields = {name: _joined(values) for name, values in column.fields.items()}
        columns = column.archetype.columns(**fields).partition(column.counts)
        self.recording.send_columns(path, indexes=indexes, columns=columns)


def _joined(rows: list[Any]) -> Any:
    """The values of all rows, one after the other."""
    if any(isinstance(row, np.ndarray) for row in rows):
        return np.concatenate([row for row in rows if len(row)] or rows)
    return list(chain.from_iterable(rows))
