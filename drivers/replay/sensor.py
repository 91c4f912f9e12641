"""What all devices have in common whose readings come from a recording."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, TypeVar, cast

from drivers.config import DeviceConfig
from drivers.errors import DeviceTimeout, NotConnected, ProtocolError
from drivers.interfaces import (
    Description,
    ImagingSensor,
    R,
    Sensor,
    freshness,
)
from drivers.wire import topics
from drivers.wire.log_reader import Logged
from mechanics.readings import (
    Stamp,
    Status,
)

if TYPE_CHECKING:
    from drivers.replay.recording import Recording

Take = Callable[[Logged, Callable[[int], int]], None]
"""Takes a message of a stream, with what moves recorded instants [ns] to those of the present."""

T = TypeVar("T")

#: what a station file and a log are to agree on
_ALIKE = ("sensor", "finger", "mount")


class ReplaySensor(Sensor[R]):
    """The half that all devices of a recording share: the stream, the description, and the end of it."""

    kind: ClassVar[str]
    #: how many readings are kept: as many as of a device on the bus
    keeps: ClassVar[int] = 4096
    _reading: ClassVar[type]

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, self.keeps)
        self.recording, self.source = recording, source
        self._config = config
        self._takes: dict[str, Take] = {}
        self._newest_ns = 0
        self._still = recording.lockstep

    def describe(self) -> Description:
        """What the device said of itself when it was recorded, at the speed that it is played.

        Raises NotConnected where the log has no such device.
        """
        said = self.recording.described(self.name, self.source)
        config = self._config
        asked = f"play {self.recording.path}"
        if config is not None and said.kind != config.kind:
            got = f"'{self.source}' is a {said.kind} there, not a {config.kind}"
            raise NotConnected(self.name, asked, got, "Correct its kind, or the log's device under `stream`")
        for key in _ALIKE:
            mine, theirs = getattr(config, key, None), said.extra.get(key)
            if mine is not None and theirs is not None and mine != theirs:
                got = f"its {key} is {theirs} there, not {mine}"
                raise NotConnected(self.name, asked, got, f"Correct {key} in the station file, or `stream`")
        speed = 1.0 if self.recording.speed is None else self.recording.speed
        return replace(said, name=self.name, backend="replay", rate=said.rate * speed)

    def _open(self, timeout: float) -> None:
        del timeout  # nothing is waited for
        self.max_age = freshness(self.describe().rate)
        self._forget()
        self._takes = self._streams()
        self.recording.join(self, self._takes)

    def _shut(self) -> None:
        takes, self._takes = self._takes, {}
        self.recording.leave(self, takes)

    def _streams(self) -> dict[str, Take]:
        """What takes the messages of each topic."""
        return {self._topic(next(iter(topics.STREAMS[self.kind]))): self._take}

    def _topic(self, stream: str) -> str:
        return topics.key(self.recording.contents.station, self.source, stream)

    # -- readings ------------------------------------------------------------------------------------------------------

    def _take(self, logged: Logged, moved: Callable[[int], int]) -> None:
        try:
            value = logged.value()
        except ProtocolError:
            value = None
        if not isinstance(value, self._reading):
            self._push_damaged(self._ruin(logged, moved))
            return
        reading = cast("R", value)
        if self.recording.speed:
            stamp = reading.stamp
            stamp = replace(stamp, capture_ns=moved(stamp.capture_ns), receive_ns=moved(stamp.receive_ns))
            reading = replace(reading, stamp=stamp)  # pyright: ignore[reportArgumentType, reportType]
        self._push(self._adjusted(reading))

    def _ruin(self, logged: Logged, moved: Callable[[int], int]) -> Stamp:
        known = logged.status in Status.__members__.values()
        status = Status(logged.status) if known else Status.INVALID
        return Stamp(moved(logged.publish_ns), moved(logged.log_ns), logged.sequence, self.source, status)

    def _adjusted(self, reading: R) -> R:
        return reading

    def _arrive(self, stamp: Stamp) -> None:
        last = self._last_sequence
        if last is not None and (stamp.sequence <= last or stamp.capture_ns < self._newest_ns):
            self._drop()  # it counts anew: what came before is of another time
            self._last_sequence = None
        self._newest_ns = stamp.capture_ns
        super()._arrive(stamp)

    def _drop(self) -> None:
        """Drop the readings that were kept; `_arrived` is held."""
        self._readings.clear()

    def _forget(self) -> None:
        with self._arrived:
            self._drop()
        super()._forget()

    def forget(self) -> None:
        """Drop what was played: the recording goes to another place."""
        self._forget()

    def wake(self) -> None:
        """The recording has ended: who waits is to hear of it."""
        with self._arrived:
            self._arrived.notify_all()

    # -- waiting -------------------------------------------------------------------------------------------------------

    def _station_ns(self) -> int:
        return self.recording.now_ns()

    def latest(self, timeout: float = 1.0) -> R:
        """As `Sensor.latest`; in lockstep nothing arrives while somebody waits, so it never waits."""
        self._need_connection("read")
        if self.recording.lockstep and not self._readings and self._damaged is None:
            self._raise_ended("read")
            raise DeviceTimeout(
                self.name, "read", "nothing of it was played yet", "Let recorded time pass first: `sleep(seconds)`"
            )
        try:
            return super().latest(timeout)
        except DeviceTimeout:
            self._raise_ended("read")
            raise

    def _await(
        self, newest: Callable[[], int | None], timeout: float, check: Callable[[], object] = lambda: None
    ) -> None:
        def look() -> None:
            check()
            if self.recording.ended and newest() is None:
                self._raise_ended("read")

        look()
        super()._await(newest, timeout, look)

    def _raise_ended(self, asked: str) -> None:
        recording = self.recording
        if recording.ended:
            why = "" if recording.ending == "complete" else f": {recording.ending}"
            remedy = "Close its devices and open them again to play it from its begin"
            raise DeviceTimeout(self.name, asked, f"the recording has ended{why}", remedy)

    def _until(self, found: Callable[[], T | None], asked: str, timeout: float) -> T:
        """Play on until something is ``found``. Raises DeviceTimeout past ``timeout`` [s], and at the end."""
        recording = self.recording
        if recording.lockstep:
            while (answer := found()) is None:
                if not recording.step():
                    self._raise_ended(asked)
            return answer
        deadline = time.monotonic() + timeout
        with self._arrived:
            while (answer := found()) is None:
                self._raise_ended(asked)
                left = deadline - time.monotonic()
                if left <= 0:
                    got = f"nothing within {timeout:g} s"
                    raise DeviceTimeout(self.name, asked, got, "See how often it was recorded, or wait for longer")
                self._arrived.wait(left)
        return answer


class ReplayImager(ReplaySensor[R], ImagingSensor[R]):
    """One that gives frames: those that were recorded."""

    keeps = 64

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, recording, source, config)
        self._uncaptured: deque[R] = deque(maxlen=self.keeps)

    def _drop(self) -> None:
        super()._drop()
        self._uncaptured.clear()

    def _push(self, reading: R) -> None:
        super()._push(reading)
        with self._arrived:
            self._uncaptured.append(reading)
            self._arrived.notify_all()

    def capture(self, timeout: float = 2.0) -> R:
        """The next frame that was recorded now or later; each is given once. In lockstep it is played until there.

        Raises DeviceTimeout, at the end of the recording as well.
        """
        self._need_connection("capture")
        now = self.recording.now_ns()

        def found() -> R | None:
            with self._arrived:
                while self._uncaptured:
                    reading = self._uncaptured.popleft()
                    if reading.stamp.capture_ns >= now:
                        return reading
            return None

        return self._until(found, "capture", timeout)
