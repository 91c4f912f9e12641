"""Reads a log in the order of its file, as far as it goes, and says how it ends."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Attachment, Channel, DataEnd, Footer, Header, McapRecord, Message, Schema, Statistics

from drivers.errors import ProtocolError
from drivers.wire import log_records, messages
from drivers.wire.codec import TYPES, Reading, decode_reading
from drivers.wire.log_records import MAGIC, Broken
from drivers.wire.records import STREAMS, Record, decode_record
from mechanics.records import StatusRecord

_READINGS = {*TYPES.values(), messages.COMPRESSED_IMAGE}
_RECORDS = {type_name for _, type_name in STREAMS.values()}
_STATUS = STREAMS[StatusRecord]


class Logged(NamedTuple):
    """One message of a log, its bytes as they went over the bus."""

    topic: str
    type_name: str
    payload: bytes
    sequence: int
    publish_ns: int
    log_ns: int
    status: int = 0

    def value(self) -> Reading | Record:
        """The reading or record in it. Raises ProtocolError for other types and for garbage."""
        if self.type_name in _RECORDS:
            return decode_record(self.type_name, self.payload)
        return decode_reading(self.type_name, self.payload, self.sequence, self.status, self.log_ns)


class Break(NamedTuple):
    """A stretch of a file that is lost: its bytes ``at`` to ``until``, and why."""

    at: int
    until: int
    why: str


class LogReader:
    """A log file. After an iteration ``ending`` is ``complete``, or says where and why the file broke off.
    ``share`` is how much of it the iteration has read.

    With ``salvage`` it goes on behind damage, at the next chunk whose check sum is right; ``breaks`` are the stretches
    that are lost. A chunk that the file ends within is one: nothing vouches for a part of it. Raises ProtocolError for
    a file that is no MCAP, OSError for one that cannot be read.
    """

    def __init__(self, path: Path | str, *, salvage: bool = False):
        self.path = Path(path)
        self.ending = "not read yet"
        self.breaks: list[Break] = []
        self.share = 0.0
        self._salvage = salvage
        with self.path.open("rb") as file:
            magic = file.read(len(MAGIC))
        if magic != MAGIC:
            raise ProtocolError("log", f"read {self.path}", "no MCAP file", "Give a log.mcap of a run folder")

    @property
    def complete(self) -> bool:
        """Whether the last iteration reached the end of a file that was closed in order."""
        return self.ending == "complete"

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Logged]:
        """Messages in the order of the file, of all topics or those given."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        statuses: dict[str, int] = {}
        for record in self.records():
            if isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is not None and channel.topic == _STATUS[0]:
                    _note(record.data, statuses)
                if channel is None or (topics is not None and channel.topic not in topics):
                    continue
                schema = schemas.get(channel.schema_id)
                yield Logged(
                    channel.topic,
                    "" if schema is None else schema.name,
                    record.data,
                    record.sequence,
                    record.publish_time,
                    record.log_time,
                    statuses.get(channel.topic, 0),
                )
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record

    def values(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, Reading | Record]]:
        """(topic, reading or record) in the order of the file, of the types that are either."""
        for logged in self.messages(topics):
            if logged.type_name in _READINGS or logged.type_name in _RECORDS:
                yield logged.topic, logged.value()

    def library(self) -> str | None:
        """The program that wrote the file; None where it breaks off before it says so. Our logs say ``extrinsic``."""
        first = next(self.records(), None)
        return first.library if isinstance(first, Header) else None

    def attachments(self) -> dict[str, bytes]:
        """The files in the log, by name."""
        return {record.name: record.data for record in self.records() if isinstance(record, Attachment)}

    def counts(self) -> dict[str, int]:
        """Messages per topic."""
        counts: dict[str, int] = {}
        for logged in self.messages():
            counts[logged.topic] = counts.get(logged.topic, 0) + 1
        return counts

    def records(self) -> Iterator[McapRecord]:
        """The records of the file, those within chunks among them, without indexes."""
        self.ending, self.breaks = "not read to its end", []
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            at: int | None = len(MAGIC)
            while at is not None:
                try:
                    yield from self._run(file, at, size)
                    at = None
                except Broken as broken:
                    if not self.breaks:
                        self.ending = f"{'torn' if broken.torn else 'damaged'} at byte {broken.at}: {broken.why}"
                    at = yield from self._behind(file, broken, size)
        if not self.breaks:
            self.ending = "complete"

    def _run(self, file: BinaryIO, at: int, size: int) -> Iterator[McapRecord]:
        """The records from byte ``at`` to the footer. Raises Broken."""
        crc = zlib.crc32(MAGIC) if at == len(MAGIC) else None
        count = 0
        while True:
            record = log_records.record_at(file, at, size)
            for part in log_records.parsed(record):
                if isinstance(part, DataEnd) and crc is not None and part.data_section_crc not in (0, crc):
                    raise Broken(at, "the check sum of the file is wrong")
                if isinstance(part, Message):
                    count += 1
                elif isinstance(part, Statistics) and crc is not None and part.message_count != count:
                    raise Broken(at, f"{count} messages, where {part.message_count} were written")
                yield part
                if isinstance(part, Footer):
                    if file.read(len(MAGIC) + 1) != MAGIC:
                        raise Broken(record.end, "the end is missing", torn=True)
                    return
            crc = None if crc is None else record.crc(crc)
            at = record.end
            self.share = at / size

    def _behind(self, file: BinaryIO, broken: Broken, size: int) -> Iterator[McapRecord]:
        """What the end of the file says of topics; returns where reading goes on, None where nothing follows."""
        following: int | None = None
        if self._salvage:
            following = log_records.next_chunk(file, broken.at, size)
            if following is not None:
                yield from log_records.definitions(file, size)
        self.breaks.append(Break(broken.at, size if following is None else following, broken.why))
        return following


def _note(payload: bytes, statuses: dict[str, int]) -> None:
    """Take in which status the readings of a stream have from here on."""
    try:
        record = decode_record(_STATUS[1], payload)
    except ProtocolError:
        return
    if isinstance(record, StatusRecord):
        statuses[record.stream] = record.status
