"""Reads a log in the order of its file, as far as it goes, and says how it ends."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream

from drivers.errors import ProtocolError
from drivers.wire import messages
from drivers.wire.codec import TYPES, Reading, decode_reading
from drivers.wire.records import STREAMS, Record, decode_record

_READINGS = {*TYPES.values(), messages.COMPRESSED_IMAGE}
_RECORDS = {type_name for _, type_name in STREAMS.values()}
_LARGEST = 2**30
# of an MCAP record: opcode and length; of a message: channel, sequence, time of logging, time of publishing
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_BROKEN = (McapError, struct.error, zstandard.ZstdError, UnicodeDecodeError, MemoryError, OverflowError)


class Logged(NamedTuple):
    """One message of a log, its bytes as they went over the bus."""

    topic: str
    type_name: str
    payload: bytes
    sequence: int
    publish_ns: int
    log_ns: int

    def value(self) -> Reading | Record:
        """The reading or record in it. Raises ProtocolError for other types and for garbage."""
        if self.type_name in _RECORDS:
            return decode_record(self.type_name, self.payload)
        return decode_reading(self.type_name, self.payload, self.sequence, receive_ns=self.log_ns)


class LogReader:
    """A log file. After an iteration ``ending`` is ``complete``, or says where and why the file broke off.

    Raises ProtocolError for a file that is no MCAP, OSError for one that cannot be read.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.ending = "not read yet"
        with self.path.open("rb") as file:
            magic = file.read(8)
        if magic != b"\x89MCAP0\r\n":
            raise ProtocolError("log", f"read {self.path}", "no MCAP file", "Give a log.mcap of a run folder")

    @property
    def complete(self) -> bool:
        """Whether the last iteration reached the end of a file that was closed in order."""
        return self.ending == "complete"

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Logged]:
        """Messages in the order of the file, of all topics or those given."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records():
            if isinstance(record, Message):
                channel = channels.get(record.channel_id)
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

    def attachments(self) -> dict[str, bytes]:
        """The files in the log, by name."""
        return {record.name: record.data for record in self._records() if isinstance(record, Attachment)}

    def counts(self) -> dict[str, int]:
        """Messages per topic."""
        counts: dict[str, int] = {}
        for logged in self.messages():
            counts[logged.topic] = counts.get(logged.topic, 0) + 1
        return counts

    def _records(self) -> Iterator[McapRecord]:
        self.ending = "not read to its end"
        closed = False
        with self.path.open("rb") as file:
            try:
                reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST)
                for record in reader.records:
                    closed = closed or isinstance(record, Footer)
                    if isinstance(record, Chunk):
                        yield from _within(record)
                    else:
                        yield record
            except InvalidMagic:
                self.ending = f"torn at byte {file.tell()}: the end is missing"
            except CRCValidationError as error:
                self.ending = f"damaged before byte {file.tell()}: {error}"
            except (
                McapError,
                struct.error,
                zstandard.ZstdError,
                UnicodeDecodeError,
                MemoryError,
                OverflowError,
            ) as error:
                self.ending = f"torn at byte {file.tell()}: {str(error) or 'the file ends within a record'}"
            else:
                self.ending = "complete" if closed else f"torn at byte {file.tell()}: no footer"


def _within(chunk: Chunk) -> list[McapRecord]:
    """What is in a chunk, all of it or nothing. A log is a hundred thousand small messages: the library takes its time.

    Raises what the library does for a chunk that is damaged.
    """
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    data, at = stream.read(size), 0
    records: list[McapRecord] = []
    while at < size:
        opcode, length = _RECORD.unpack_from(data, at)
        begin, at = at + _RECORD.size, at + _RECORD.size + length
        if at > size:
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, begin)
            payload = data[begin + _MESSAGE.size : at]
            records.append(Message(channel, log_time, payload, publish_time, sequence))
        elif opcode == Opcode.CHANNEL:
            records.append(Channel.read(ReadDataStream(BytesIO(data[begin:at]))))
        elif opcode == Opcode.SCHEMA:
            records.append(Schema.read(ReadDataStream(BytesIO(data[begin:at]))))
    return records
