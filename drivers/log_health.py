"""How the devices of a station fared, by its log: rates, silences, ages, gaps, what readings said of themselves.

`drivers.health` looks at a station while it is open; this looks back, message by message, at no device.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.errors import ProtocolError
from drivers.interfaces import Description
from drivers.wire import topics
from drivers.wire.codec import decode_gates
from drivers.wire.log_reader import Logged
from mechanics.readings import Status

NANO = 1e-9

#: streams that carry no reading of a device, and who speaks on the bus without being one
_NO_READINGS = ("target", "safety", "reference")
_NO_DEVICES = ("run", topics.WORLD, topics.ESTIMATOR)
#: kinds of devices that in lockstep speak when somebody asks
_ASKED = ("tag_camera", "tactile")


@dataclass(frozen=True)
class Worst:
    """The largest of something, and the station's time at which it was."""

    value: float
    at_ns: int


@dataclass(frozen=True)
class StreamHealth:
    """How one stream of a device fared.

    ``rate`` and ``declared`` [Hz] are the mean and what the device says of itself, ``silence`` [s] is the longest time
    between two captures and ``age`` [s] the largest of a reading when it arrived: None where they say nothing, as in
    lockstep, where readings arrive as they are made and pictures are taken ``on_request``. ``lost`` messages are
    missing, in ``gaps`` gaps, ``gap`` the largest. ``conditions``: how many readings were not OK, and since when.
    """

    device: str
    stream: str
    kind: str
    messages: int
    declared: float | None
    rate: float | None
    silence: Worst | None
    age: Worst | None
    lost: int
    gaps: int
    gap: Worst | None
    conditions: dict[Status, tuple[int, int]]
    on_request: bool


@dataclass(frozen=True)
class GateHealth:
    """What the gates of an arm had told last: set-points by what became of them since the arm's server began.

    ``troubles`` are what else they said, each with the time at which it began: what was refused, held, stopped.
    """

    device: str
    accepted: int
    refused: dict[str, int]
    troubles: tuple[tuple[int, str], ...]


@dataclass
class _Stream:
    """One topic under way; times in ns."""

    device: str
    stream: str
    messages: int = 0
    spans: int = 0
    spanned_ns: int = 0
    newest_ns: int | None = None
    sequence: int = 0
    silence: Worst | None = None
    age: Worst | None = None
    lost: int = 0
    gaps: int = 0
    gap: Worst | None = None
    conditions: dict[int, list[int]] = field(default_factory=dict)

    def take(self, sequence: int, capture_ns: int, arrival_ns: int, status: int) -> None:
        self.messages += 1
        before = self.newest_ns
        if before is not None and capture_ns >= before:
            self.spans += 1
            self.spanned_ns += capture_ns - before
            self._silent(before, capture_ns)
            missing = sequence - self.sequence - 1
            if missing > 0:  # a smaller number begins a new count: the world was reset
                self.lost += missing
                self.gaps += 1
                if self.gap is None or missing > self.gap.value:
                    self.gap = Worst(missing, before)
        self.newest_ns, self.sequence = capture_ns, sequence
        age = (arrival_ns - capture_ns) * NANO
        if self.age is None or age > self.age.value:
            self.age = Worst(age, capture_ns)
        if status:
            self.conditions.setdefault(status, [0, capture_ns])[0] += 1

    def end(self, last_ns: int) -> None:
        """The log ends at ``last_ns``, or goes on in another file."""
        if self.newest_ns is not None:
            self._silent(self.newest_ns, last_ns)
        self.newest_ns = None

    def _silent(self, since_ns: int, until_ns: int) -> None:
        silent = (until_ns - since_ns) * NANO
        if self.silence is None or silent > self.silence.value:
            self.silence = Worst(silent, since_ns)


class LogHealth:
    """Takes the messages of the logs of a run, file by file. Broken messages count as messages; nothing here raises."""

    def __init__(self) -> None:
        self._streams: dict[str, _Stream | None] = {}
        self._gates: dict[str, tuple[Counter[str], list[tuple[int, str]]]] = {}
        self._last_ns = 0

    def take(self, logged: Logged) -> None:
        """Count one message."""
        self._last_ns = max(self._last_ns, logged.publish_ns)
        try:
            found = self._streams[logged.topic]
        except KeyError:
            found = self._streams[logged.topic] = _opened(logged.topic)
        if found is not None:
            found.take(logged.sequence, logged.publish_ns, logged.log_ns, logged.status)
        elif logged.topic.endswith("/safety"):
            self._heed(logged)

    def end_file(self) -> None:
        """A file of the log has ended: who was silent until then was silent."""
        for found in self._streams.values():
            if found is not None:
                found.end(self._last_ns)
        self._last_ns = 0

    def _heed(self, logged: Logged) -> None:
        try:
            said, counts = decode_gates(logged.payload)
        except ProtocolError:
            return
        device, _ = topics.device_and_stream(logged.topic)
        _, troubles = self._gates.get(device, (Counter(), []))
        if said and (not troubles or troubles[-1][1] != said):
            troubles.append((logged.publish_ns, said))
        self._gates[device] = Counter(counts), troubles

    def streams(self, devices: Mapping[str, Description], *, lockstep: bool) -> list[StreamHealth]:
        """Every stream that carried readings, by device; ``devices`` are what they say of themselves."""
        found = [stream for stream in self._streams.values() if stream is not None]
        return [_fared(stream, devices.get(stream.device), lockstep) for stream in sorted(found, key=_named)]

    def silent(self, devices: Mapping[str, Description], *, lockstep: bool) -> dict[str, bool]:
        """The ``devices`` that carried no reading, and whether that is no wonder: in lockstep nobody may have asked."""
        spoke = {stream.device for stream in self._streams.values() if stream is not None}
        return {name: lockstep and said.kind in _ASKED for name, said in devices.items() if name not in spoke}

    def gates(self) -> list[GateHealth]:
        """Every arm whose gates spoke."""
        found = []
        for device, (counts, troubles) in sorted(self._gates.items()):
            refused = {k.removeprefix("refused by "): n for k, n in counts.items() if k.startswith("refused by ") and n}
            found.append(GateHealth(device, counts["accepted"], refused, tuple(troubles)))
        return found


def _opened(topic: str) -> _Stream | None:
    device, stream = topics.device_and_stream(topic)
    return None if stream in _NO_READINGS or device in _NO_DEVICES or not device else _Stream(device, stream)


def _named(stream: _Stream) -> tuple[str, str]:
    return stream.device, stream.stream


def _fared(found: _Stream, described: Description | None, lockstep: bool) -> StreamHealth:
    kind = "" if described is None else described.kind
    asked = lockstep and kind in _ASKED
    declared = described.rate if described is not None and described.rate > 0 else None
    return StreamHealth(
        found.device,
        found.stream,
        kind,
        found.messages,
        None if asked else declared,
        found.spans / (found.spanned_ns * NANO) if found.spanned_ns and not asked else None,
        None if asked else found.silence,
        None if lockstep else found.age,
        found.lost,
        found.gaps,
        found.gap,
        {Status(code): (count, since) for code, (count, since) in found.conditions.items() if code in _STATUSES},
        asked,
    )


_STATUSES = {status.value for status in Status}
