"""The messages of a recording, file after file, in the order of their log time; a second of them is in memory."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from drivers.errors import ProtocolError
from drivers.wire.log_reader import Logged, LogReader

#: streams are filed each by a thread of its own, and in lockstep a message that was delayed under the time when it was
#: captured: as far as that they come out of order [ns]
WINDOW_NS = 1_000_000_000
#: messages that are kept for that at most
ROOM = 20_000


class Frame(NamedTuple):
    """A message, and the part of the recording that it is of.

    Within a ``part`` log time never runs backwards. A new one begins with each file, and where the world was reset.
    """

    part: int
    logged: Logged


class Reel:
    """Reads the files once, from begin to end; ``ending`` then says how that was: ``complete``, or what broke off."""

    def __init__(self, files: tuple[Path, ...]):
        self.files = files
        self.ending = "complete"
        self._read = 0
        self._reader: LogReader | None = None

    @property
    def share(self) -> float:
        """How much of the files has been read."""
        now = 0.0 if self._reader is None else self._reader.share
        return (self._read + now) / max(len(self.files), 1)

    def frames(self) -> Iterator[Frame]:
        """Every message. What a damaged file has lost is left out."""
        self.ending, part = "complete", -1
        for number, file in enumerate(self.files):
            self._read = number
            part += 1
            try:
                self._reader = reader = LogReader(file, salvage=True)
                for frame in _sorted(reader, part):
                    part = frame.part
                    yield frame
                ending = reader.ending
            except ProtocolError as error:
                ending = error.got
            except OSError as error:
                ending = str(error)
            if self.ending == "complete" and ending != "complete":
                self.ending = f"{file.name} is {ending}"


def _sorted(reader: LogReader, part: int) -> Iterator[Frame]:
    waiting: list[tuple[int, int, Logged]] = []
    newest: dict[str, tuple[int, int]] = {}  # sequence and log time
    reached = 0
    for count, logged in enumerate(reader.messages()):
        sequence, log_ns = newest.get(logged.topic, (-1, 0))
        if logged.log_ns < log_ns and logged.sequence <= sequence:  # both begin anew: the world was reset
            yield from _drained(waiting, part)
            part, reached = part + 1, 0
            newest.clear()
        newest[logged.topic] = logged.sequence, logged.log_ns
        reached = max(reached, logged.log_ns)
        heapq.heappush(waiting, (logged.log_ns, count, logged))
        while waiting[0][0] < reached - WINDOW_NS or len(waiting) > ROOM:
            yield Frame(part, heapq.heappop(waiting)[2])
    yield from _drained(waiting, part)


def _drained(waiting: list[tuple[int, int, Logged]], part: int) -> Iterator[Frame]:
    while waiting:
        yield Frame(part, heapq.heappop(waiting)[2])
