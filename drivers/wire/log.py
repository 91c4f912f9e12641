"""The log: MCAP files of the bytes that went over the bus, written beside the control thread.

Foxglove, PlotJuggler, Rerun and ``ros2 bag`` open them as they are: profile ``ros2``, CDR, ``ros2msg`` schemas.
`drivers.wire.log_reader` reads them, torn ones too.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from drivers.errors import DeviceFault, ProtocolError
from drivers.wire import messages
from drivers.wire.bus import Bus
from drivers.wire.records import STREAMS, Record, encode_record
from drivers.wire.streams import Sample
from mechanics.records import StatusRecord

ROOM = 256 * 2**20
"""Bytes that may wait to be written: half a minute of everything, half a gigabyte of a stuck disk's arrears never."""

_CHUNK = 4 * 2**20
_TICK = 0.02
_LAST = 60.0  # how long closing may wait for the disk [s]
_MARGIN = 0.8  # of the flush period; the rest is for writing

Job = Callable[[Writer], None]


class _PackedIndex:
    """A chunk's index as the bytes it will be in the file: a fifth of the object, and all stay until the end."""

    __slots__ = ("_record",)

    def __init__(self, index: ChunkIndex):
        stream = RecordBuilder()
        index.write(stream)
        self._record = stream.end()

    def write(self, stream: RecordBuilder) -> None:
        """As `ChunkIndex.write`."""
        stream.write(self._record)


class LogWriter:
    """Writes a new MCAP file from a thread of its own; a context manager.

    Every ``flush`` seconds what came so far is a finished chunk on the disk, so that not more is lost when the process
    is killed. ``counts`` are messages accepted per topic, ``overflows`` those that found no room or came after a
    failure, ``gaps`` sequence numbers that never came. Raises DeviceFault when the file exists or cannot be made.
    """

    def __init__(self, path: Path | str, *, flush: float = 0.5, room: int = ROOM):
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self.gaps: dict[str, int] = {}
        self.overflows = 0
        self.failure: DeviceFault | None = None
        self._newest: dict[str, int] = {}
        self._statuses: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._jobs: deque[tuple[Job | None, str, bytes, int, int, int]] = deque()
        self._waiting, self._room = 0, room
        self._lock = threading.Lock()
        self._settled = threading.Condition(self._lock)  # on the disk, or failed
        self._stops: list[Callable[[], None]] = []
        self._closing, self._closed = threading.Event(), False
        self._period = flush * _MARGIN
        try:
            self._file = self.path.open("xb")
        except OSError as error:
            raise DeviceFault("log", f"create {self.path}", str(error), "A log is never overwritten") from error
        self._writer = Writer(self._file, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="extrinsic")
        self._packed = 0
        self._thread = threading.Thread(target=self._run, name=f"log {self.path.name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except DeviceFault:
            if value is None:
                raise

    def attach(self, bus: Bus, topics: Mapping[str, str], *, lockstep: bool) -> None:
        """Log these topics of a bus, given with their types, from now on.

        In ``lockstep`` messages are filed under their capture time, otherwise under the time of their arrival.
        """

        def receive(sample: Sample) -> None:
            self._receive(sample, sample.capture_ns if lockstep else sample.receive_ns)

        for topic, type_name in topics.items():
            self._types[topic] = type_name
            self._stops.append(bus.subscribe(topic).listen(receive))

    def detach(self) -> None:
        """Log nothing more from the bus."""
        stops, self._stops = self._stops, []
        for stop in stops:
            stop()

    def write(
        self, topic: str, type_name: str, payload: bytes, *, sequence: int = 0, publish_ns: int, log_ns: int
    ) -> None:
        """File one message. Raises DeviceFault when the log has failed or found no room."""
        known = self._types.setdefault(topic, type_name)
        if known != type_name:
            raise DeviceFault("log", f"write {topic}", f"it holds {known}, not {type_name}", "One topic, one type")
        if not self._put(None, topic, payload, sequence, publish_ns, log_ns):
            raise self.failure or DeviceFault("log", f"write {topic}", "the disk is too slow", "Log less, or elsewhere")

    def write_record(self, record: Record) -> None:
        """File one of the run's own records (`mechanics.records`), under ``run/…``. Raises as `write`."""
        topic, type_name = STREAMS[type(record)]
        stamp = record.capture_ns
        self.write(topic, type_name, encode_record(record), sequence=self._next(topic), publish_ns=stamp, log_ns=stamp)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the log: the station, the experiment."""
        now = time.time_ns()
        self._put(lambda writer: writer.add_attachment(now, now, name, media_type, data), name, data, 0, 0, 0)

    def drain(self, timeout: float = 10.0) -> None:
        """Return once everything accepted so far is on the disk. Raises DeviceFault when that fails or takes longer."""
        done = threading.Event()

        def sync(_: Writer) -> None:
            self._sync()
            with self._settled:
                done.set()
                self._settled.notify_all()

        if not self._put(sync, "", b"", 0, 0, 0):
            if self.failure is not None:
                raise self.failure
            return  # closed: everything is on the disk
        with self._settled:
            settled = self._settled.wait_for(lambda: done.is_set() or self.failure is not None, timeout)
        if not settled:
            raise DeviceFault("log", f"write {self.path}", f"not done within {timeout:g} s", "Check the disk")
        if not done.is_set() and self.failure is not None:
            raise self.failure

    def close(self) -> None:
        """Write what waits, finish the file, join the thread; idempotent. Raises DeviceFault if anything failed."""
        if self._closed:
            return
        self._closed = True
        self.detach()
        self._closing.set()
        self._thread.join(_LAST)
        if self._thread.is_alive():
            self._fail(TimeoutError(f"the disk did not take it within {_LAST:g} s"))
        if self.failure is not None:
            raise self.failure

    def _receive(self, sample: Sample, log_ns: int) -> None:
        topic, sequence = sample.topic, sample.sequence
        last = self._newest.get(topic, sequence)
        self._newest[topic] = sequence
        if sequence > last + 1:  # a smaller one begins a new count: the world was reset
            self.gaps[topic] = self.gaps.get(topic, 0) + sequence - last - 1
        if sample.status != self._statuses.get(topic, 0):  # it travels beside the message, and would be lost
            self._statuses[topic] = sample.status
            self._note_status(StatusRecord(max(sample.capture_ns, 0), topic, sequence, sample.status), log_ns)
        self._put(None, topic, sample.payload, sequence, sample.capture_ns, log_ns)

    def _note_status(self, record: StatusRecord, log_ns: int) -> None:
        topic, type_name = STREAMS[StatusRecord]
        self._types.setdefault(topic, type_name)
        try:
            payload = encode_record(record)
        except ProtocolError:  # a status or a stamp that no message has room for: what cannot be told is left out
            return
        self._put(None, topic, payload, self._next(topic), record.capture_ns, log_ns)

    def _next(self, topic: str) -> int:
        """The next sequence number of a topic that is written here."""
        with self._lock:
            number = self._newest[topic] = self._newest.get(topic, -1) + 1
        return number

    def _put(self, job: Job | None, topic: str, payload: bytes, sequence: int, publish_ns: int, log_ns: int) -> bool:
        with self._lock:
            if self._closed or self.failure is not None or self._waiting + len(payload) > self._room:
                self.overflows += job is None
                return False
            self._waiting += len(payload)
            self._jobs.append((job, topic, payload, sequence, publish_ns, log_ns))
            if job is None:
                self.counts[topic] = self.counts.get(topic, 0) + 1
        return True

    def _run(self) -> None:
        due = time.monotonic() + self._period
        try:
            while not self._closing.wait(_TICK):
                self._drain()
                if time.monotonic() >= due:
                    self._sync()
                    due = time.monotonic() + self._period
            self._drain()
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        except Exception as error:  # whatever it is, the run must hear of it
            self._fail(error)
        finally:
            try:
                self._file.close()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        if self.failure is None:
            with self._lock:
                self.overflows += sum(job[0] is None for job in self._jobs)
                self._jobs.clear()
                self.failure = DeviceFault("log", f"write {self.path}", str(error), "Check the disk")
                self._settled.notify_all()

    def _drain(self) -> None:
        jobs, writer = self._jobs, self._writer
        done = 0
        while jobs:
            job, topic, payload, sequence, publish_ns, log_ns = jobs.popleft()
            done += len(payload)
            if job is not None:
                job(writer)
                continue
            channel = self._channels.get(topic) or self._channel(topic)
            writer.add_message(
                channel,
                log_time=max(log_ns, 0),
                data=payload,
                publish_time=max(publish_ns, 0),
                sequence=sequence & 0xFFFFFFFF,
            )
        if done:
            with self._lock:
                self._waiting -= done

    def _channel(self, topic: str) -> int:
        type_name = self._types[topic]
        schema = self._schemas.get(type_name)
        if schema is None:
            text = messages.schema_text(type_name).encode()
            schema = self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text)
        channel = self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        return channel

    def _sync(self) -> None:
        self._writer.flush()
        os.fsync(self._file.fileno())
        self._pack_indices()

    def _pack_indices(self) -> None:
        """Have the indices of finished chunks take 3 MB an hour, not 20: where this mcap keeps them, or not at all."""
        indices: list[Any] = getattr(self._writer, "_Writer__chunk_indices", [])
        for i in range(self._packed, len(indices)):
            indices[i] = _PackedIndex(indices[i])
        self._packed = len(indices)
