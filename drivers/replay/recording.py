"""A recording that is played: the source that all its devices share, and their clock."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self
from weakref import WeakValueDictionary

from drivers.config import DeviceConfig, ReplayDevice, StationConfig
from drivers.errors import NotConnected
from drivers.interfaces import Description
from drivers.replay.contents import Contents, contents_of
from drivers.replay.devices import REPLAYS
from drivers.replay.reel import Frame, Reel
from drivers.replay.sensor import ReplaySensor, Take
from drivers.roles import Roles
from drivers.wire.log_reader import Logged

log = logging.getLogger(__name__)

_RUN = "run/"
_JOIN = 5.0

_shared: WeakValueDictionary[tuple[Path, float, bool], Recording] = WeakValueDictionary()
_sharing = threading.Lock()


class Recording:
    """A run's folder, or one log, that its devices are played from, together and in the order of log time.

    Without ``speed`` it is its devices' `drivers.interfaces.Clock`, in lockstep: `sleep` and `advance_to` play what was
    recorded meanwhile, and `now_ns` is recorded time. With ``speed`` a thread plays, at so many times the pace of the
    recording: stamps are moved so that what was recorded now is of now, and come as late as they came then (over
    ``speed``). Speed 0 plays as fast as it can be read, stamps as recorded. With ``loop`` it begins again at its end.

    It plays from when the first of its devices is opened until the last one is closed; then it begins anew. Where time
    itself began anew, at a reset or in the next log of a run that went on, that follows at once. A message is in memory
    for a second. Nothing is opened before a device is. Raises ValueError for a speed that is none.
    """

    def __init__(self, path: Path | str, *, speed: float | None = None, loop: bool = False):
        if speed is not None and not (math.isfinite(speed) and speed >= 0):
            raise ValueError(f"a recording at speed {speed}; expected a finite number that is not negative")
        self.path, self.speed = Path(path).expanduser(), speed
        self.lockstep = speed is None
        self._loop = loop and not self.lockstep
        self._contents: Contents | None = None

        self._gate, self._turn, self._opening = threading.RLock(), threading.RLock(), threading.Lock()
        self._players: list[ReplaySensor] = []
        self._takers: dict[str, list[Take]] = {}
        self._records: tuple[Callable[[Logged], None], ...] = ()
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._reel = Reel(())
        self._frames: Iterator[Frame] = iter(())
        self._next: Frame | None = None
        self._part, self._timed, self._now = -1, False, 0
        self._base, self._anchor_ns, self._anchor = 0, 0, 0.0
        self._ended = False
        self._why = ""

    # -- what is in it -------------------------------------------------------------------------------------------------

    @property
    def contents(self) -> Contents:
        """What the recording says of itself. Raises NotConnected where there is none."""
        with self._opening:
            if self._contents is None:
                self._contents = contents_of(self.path)
            return self._contents

    @property
    def ended(self) -> bool:
        """Whether all of it was played."""
        return self._ended

    @property
    def share(self) -> float:
        """How much of its files was read."""
        return self._reel.share

    @property
    def ending(self) -> str:
        """How its files end, once it has ended: ``complete``, or what is the matter with one."""
        return self._why or self._reel.ending

    def device(self, name: str, source: str = "", config: DeviceConfig | None = None) -> ReplaySensor:
        """The device ``source`` of the log (by default ``name``), closed, under ``name``.

        ``config`` is what a station file says of it; without one the log says of which kind it is. Raises NotConnected
        where that is asked and the log has no such device.
        """
        source = source or name
        kind = config.kind if config is not None else self.described(name, source).kind
        return REPLAYS[kind](name, self, source, config)

    def described(self, name: str, source: str) -> Description:
        """What the log says of its device ``source``. Raises NotConnected, for ``name``, where it has none."""
        try:
            known = self.contents.devices
        except NotConnected as error:
            raise NotConnected(name, error.asked, error.got, error.remedy) from None
        if source not in known or known[source].kind not in REPLAYS:
            has = f"it has {', '.join(known)}" if known else "it has none: another tool's log, or an empty one"
            raise NotConnected(
                name, f"play {self.path}", f"the log has no device '{source}'; {has}", "Name one of its as `stream`"
            )
        return known[source]

    def devices(self, config: StationConfig | None = None) -> PlayedDevices:
        """The devices of a station file that are in the log, all of the log's by default; opened by a ``with``."""
        return PlayedDevices(self, config)

    def listen(self, callback: Callable[[Logged], None]) -> Callable[[], None]:
        """Call ``callback`` with each of the run's own records as it is played; returns the way to stop."""
        self._records = (*self._records, callback)

        def stop() -> None:
            self._records = tuple(c for c in self._records if c is not callback)

        return stop

    # -- the clock -----------------------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        """As `drivers.interfaces.Clock.now_ns`: recorded time, and Unix time where it is played at its pace."""
        return time.time_ns() if self.speed else self._now

    def sleep(self, seconds: float) -> None:
        """As `drivers.interfaces.Clock.sleep`: play so much of it; at its end time goes on without anything."""
        if not 0.0 <= seconds < 1e6:
            raise ValueError(f"a sleep of {seconds} s; expected a finite time that is not negative")
        if self.lockstep:
            with self._turn:
                self._advance(self._now + round(seconds * 1e9))
        else:
            time.sleep(seconds)  # station time, which here is everybody's

    def advance_to(self, t_ns: int) -> None:
        """Play on until recorded time ``t_ns``; nothing where that is past. In lockstep only."""
        self._need_lockstep("advance")
        with self._turn:
            self._advance(t_ns)

    def seek(self, t_ns: int) -> None:
        """Go to recorded time ``t_ns``, forth or back; what lies between is not played. In lockstep only."""
        self._need_lockstep("seek")
        with self._turn:
            if t_ns < self._now:
                self._rewind()
            takers, self._takers, records, self._records = self._takers, {}, self._records, ()
            try:
                self._advance(t_ns)
            finally:
                self._takers, self._records = takers, records
            for device in self._players:
                device.forget()

    def step(self) -> bool:
        """Play the next message, whenever that was; False at the end. In lockstep only."""
        self._need_lockstep("step")
        with self._turn:
            frame = self._peek()
            if frame is None:
                return False
            self._enter(frame)
            self._deliver()
            return True

    def _need_lockstep(self, asked: str) -> None:
        if not self.lockstep:
            raise ValueError(f"{self.path}: {asked}: it plays by itself; open it without a speed")

    def _advance(self, target: int) -> None:
        while (frame := self._peek()) is not None:
            before = self._now
            if self._enter(frame):
                target = self._now + max(target - before, 0)
            if self._timed and frame.logged.log_ns > target:
                break
            self._deliver()
        self._now = max(self._now, target)

    # -- playing -------------------------------------------------------------------------------------------------------

    def _peek(self) -> Frame | None:
        if self._next is None and not self._ended:
            self._next = next(self._frames, None)
            self._ended = self._next is None and not self._loop
        return self._next

    def _enter(self, frame: Frame) -> bool:
        """Whether a new part begins with this message: its time begins with the first message of a device."""
        if frame.part != self._part:
            self._part, self._timed = frame.part, False
        if self._timed or frame.logged.topic.startswith(_RUN):
            return False
        self._timed = True
        self._now = self._base = frame.logged.log_ns
        self._anchor_ns, self._anchor = time.time_ns(), time.monotonic()
        return True

    def _deliver(self) -> None:
        frame, self._next = self._next, None
        assert frame is not None
        logged = frame.logged
        if self._timed:
            self._now = max(self._now, logged.log_ns)
        if logged.topic.startswith(_RUN):
            for callback in self._records:
                callback(logged)
        else:
            for take in self._takers.get(logged.topic, ()):
                take(logged, self._moved)

    def _moved(self, t_ns: int) -> int:
        """A recorded instant as its devices' readings say it."""
        if not self.speed:
            return t_ns
        since = t_ns - self._base
        return self._anchor_ns + (since if self.speed == 1.0 else round(since / self.speed))

    def _rewind(self) -> None:
        self._wind_up()
        self._reel = Reel(self.contents.files)
        self._frames = self._reel.frames()
        self._next, self._part, self._timed, self._ended, self._why = None, -1, False, False, ""
        frame = self._peek()
        if frame is not None:  # its own records may be of a time before there was a clock
            self._now = frame.logged.log_ns
            self._enter(frame)

    def _wind_up(self) -> None:
        """Close what is open of the files."""
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()
        self._frames = iter(())

    def join(self, device: ReplaySensor, topics: dict[str, Take]) -> None:
        """Play for a device that is opened. Raises NotConnected."""
        with self._gate:
            first = not self._players
            with self._turn:
                if first:
                    self._rewind()
                self._players.append(device)
                for topic, take in topics.items():
                    self._takers.setdefault(topic, []).append(take)
            if first and not self.lockstep:
                self._closing.clear()
                self._thread = threading.Thread(target=self._play, name=f"play {self.path.name}", daemon=True)
                self._thread.start()

    def leave(self, device: ReplaySensor, topics: dict[str, Take]) -> None:
        """A device was closed; idempotent."""
        with self._gate:
            with self._turn:
                self._players = [player for player in self._players if player is not device]
                for topic, take in topics.items():
                    self._takers[topic] = [known for known in self._takers.get(topic, ()) if known != take]
            if self._players:
                return
            self._closing.set()
            thread, self._thread = self._thread, None
            if thread is not None and thread is not threading.current_thread():
                thread.join(_JOIN)
            with self._turn:
                self._wind_up()

    def _play(self) -> None:
        """Play at its pace, by absolute deadlines."""
        try:
            passes = True
            while passes and not self._closing.is_set():
                played = self._play_once()
                passes = self._loop and played
                if passes:
                    with self._turn:
                        self._rewind()
        except Exception as error:  # its devices fall silent, and say why
            log.exception("%s cannot be played", self.path)
            self._why = f"{type(error).__name__}: {error}"
        if self._closing.is_set():
            return
        with self._turn:
            self._ended = True
        for device in tuple(self._players):
            device.wake()

    def _play_once(self) -> bool:
        """Play it to its end; whether there was anything of a device."""
        timed = False
        while not self._closing.is_set():
            with self._turn:
                frame = self._peek()
                if frame is None:
                    return timed
                self._enter(frame)
                timed = timed or self._timed
            if self.speed and self._timed:
                due = self._anchor + (frame.logged.log_ns - self._base) * 1e-9 / self.speed
                left = due - time.monotonic()
                if left > 0 and self._closing.wait(left):
                    return timed
            with self._turn:
                self._deliver()
        return timed


class PlayedDevices(Roles[ReplaySensor]):
    """The devices of a recording as those of the station where it was made. ``clock`` is the recording's."""

    def __init__(self, recording: Recording, config: StationConfig | None = None):
        known = recording.contents.devices
        if config is None:
            made = {name: recording.device(name) for name, said in known.items() if said.kind in REPLAYS}
            config = StationConfig(name="recording", devices={})
        else:
            wanted = {name: device for name, device in config.devices.items() if name in known}
            made = {name: recording.device(name, "", device) for name, device in wanted.items()}
        super().__init__(config, made)
        self.recording = self.clock = recording
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for device in self._devices.values():
                stack.enter_context(device)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


def replayed(name: str, config: DeviceConfig) -> ReplaySensor:
    """The device that a station file wants played, closed.

    Those that name the same log, at the same speed, share one `Recording`. Raises ValueError for another device's.
    """
    if not isinstance(config, ReplayDevice):
        raise ValueError(f"{name} is not played back: its backend is {config.backend}")
    key = Path(config.log).expanduser().absolute(), config.speed, config.loop
    with _sharing:
        recording = _shared.get(key)
        if recording is None:
            recording = _shared[key] = Recording(key[0], speed=config.speed, loop=config.loop)
    return recording.device(name, config.stream, config)
