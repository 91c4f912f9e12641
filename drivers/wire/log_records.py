"""The records of an MCAP file, each taken only as far as the file vouches for it: lengths before room is made, check
sums before contents are believed.

The `mcap` library's reader makes the room that a damaged length asks for, unpacks what a chunk says it holds, and
reads a short record as if it were whole; a log that a killed process has left behind is read here.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"

ROOM = 2**26
"""Bytes that a record or a chunk unpacked may have: 16 times what `drivers.wire.log` puts into one."""

# of a record: opcode and length; of a message: channel, sequence, time of logging, time of publishing; of a chunk:
# first and last time of logging, size and check sum unpacked, length of the compression's name
_RECORD, _MESSAGE, _CHUNK = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQII")
_LENGTH, _SUM, _FOOTER = struct.Struct("<Q"), struct.Struct("<I"), struct.Struct("<QQI")
_ZSTD = b"\x04\x00\x00\x00zstd"
_CHUNK_HEAD = _RECORD.size + _CHUNK.size + len("zstd") + _LENGTH.size
_READ: dict[int, type] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
    Opcode.STATISTICS: Statistics,
}
_KNOWN, _PRIVATE = frozenset(Opcode), 0x80
_GARBAGE = (McapError, struct.error, zstandard.ZstdError, UnicodeDecodeError, OverflowError, MemoryError)


class Broken(Exception):
    """What begins at byte ``at`` is not what was written there, or not all of it: then the file is ``torn``."""

    def __init__(self, at: int, why: str, *, torn: bool = False):
        self.at, self.why, self.torn = at, why, torn
        super().__init__(at, why)


class Record(NamedTuple):
    """One record of the file: where it begins, its kind, what is in it, and where the next one begins."""

    at: int
    opcode: int
    body: bytes
    end: int

    def crc(self, before: int) -> int:
        """The check sum of the file up to the record's end, from that up to its begin."""
        return zlib.crc32(self.body, zlib.crc32(_RECORD.pack(self.opcode, len(self.body)), before))


def record_at(file: BinaryIO, at: int, size: int) -> Record:
    """The record at a byte of a file of ``size`` bytes. Raises Broken."""
    file.seek(at)
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        raise Broken(at, "the file ends within a record" if head else "the end is missing", torn=True)
    opcode, length = _RECORD.unpack(head)
    end = at + _RECORD.size + length
    if opcode == 0:  # no record has it: a file system that lost its last writes leaves zeros
        raise Broken(at, "zeros instead of a record", torn=True)
    if opcode not in _KNOWN and opcode < _PRIVATE:
        raise Broken(at, f"a record of no kind that there is, {opcode}")
    if end > size:
        raise Broken(at, "the file ends within a record", torn=True)
    if length > ROOM:
        raise Broken(at, f"a record of {length} bytes, {ROOM} at most are read")
    return Record(at, opcode, file.read(length), end)


def parsed(record: Record) -> Iterator[McapRecord]:
    """What is in a record: the records within a chunk, else the record itself; nothing for kinds nobody needs.

    Nothing of a chunk is given before all of it has been checked. Raises Broken.
    """
    try:
        if record.opcode == Opcode.CHUNK:
            contents = _contents(record)
            _check_framing(contents)
            yield from _within(contents)
        elif record.opcode == Opcode.MESSAGE:
            yield _message(record.body, 0, len(record.body))
        elif record.opcode in _READ:
            yield _single(record.opcode, record.body)
    except _GARBAGE as error:
        raise Broken(record.at, str(error) or "the file ends within a record") from None


def _single(opcode: int, body: bytes) -> McapRecord:
    """A record other than a chunk or a message."""
    stream = ReadDataStream(BytesIO(body))
    read: McapRecord = _READ[opcode].read(stream)
    if stream.count > len(body):
        raise McapError("a record that is longer than it says")
    if isinstance(read, Attachment):
        (expected,) = _SUM.unpack_from(body, len(body) - _SUM.size)
        if expected and zlib.crc32(body[: -_SUM.size]) != expected:
            raise McapError(f"the check sum of the attachment {read.name!r} is wrong")
    return read


class _Head(NamedTuple):
    begin_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int


def _head(body: bytes) -> _Head:
    begin_ns, end_ns, size, crc, name_length = _CHUNK.unpack_from(body)
    data_at = _CHUNK.size + name_length + _LENGTH.size
    if name_length > 16 or data_at > len(body):
        raise McapError("a chunk that is shorter than it says")
    compression = body[_CHUNK.size : _CHUNK.size + name_length].decode()
    return _Head(begin_ns, end_ns, size, crc, compression, data_at)


def _contents(record: Record) -> bytes:
    """A chunk unpacked, its check sum right."""
    body = record.body
    head = _head(body)
    data = memoryview(body)[head.data_at :]
    if _LENGTH.unpack_from(body, head.data_at - _LENGTH.size)[0] != len(data):
        raise McapError("a chunk that is shorter than it says")
    if head.size > ROOM:
        raise McapError(f"a chunk of {head.size} bytes unpacked, {ROOM} at most are read")
    if head.compression == "zstd":
        if head.size and zstandard.frame_content_size(data) not in (head.size, -1):  # what unpacking makes room for
            raise McapError("a chunk of another size than it says")
        contents = zstandard.ZstdDecompressor().decompress(data, max_output_size=head.size) if head.size else b""
    elif not head.compression:
        contents = bytes(data)
    else:
        raise McapError(f"a chunk packed by {head.compression!r}, which is not read")
    if len(contents) != head.size:
        raise McapError("a chunk of another size than it says")
    if head.crc and zlib.crc32(contents) != head.crc:
        raise McapError("the check sum of a chunk is wrong")
    return contents


def _check_framing(contents: bytes) -> None:
    size, at = len(contents), 0
    while at < size:
        opcode, length = _RECORD.unpack_from(contents, at)
        at += _RECORD.size + length
        if at > size or not opcode or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
            raise McapError("a chunk that ends within a record")


def _within(contents: bytes) -> Iterator[McapRecord]:
    """The records of a chunk; an end within a record is an end. A log is a hundred thousand small messages: quickly."""
    size, at = len(contents), 0
    while at + _RECORD.size <= size:
        opcode, length = _RECORD.unpack_from(contents, at)
        begin, at = at + _RECORD.size, at + _RECORD.size + length
        if at > size:
            return
        if opcode == Opcode.MESSAGE:
            yield _message(contents, begin, at)
        elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            yield _single(opcode, contents[begin:at])


def _message(data: bytes, begin: int, end: int) -> Message:
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, begin)
    return Message(channel, log_time, data[begin + _MESSAGE.size : end], publish_time, sequence)


# -- behind damage -----------------------------------------------------------------------------------------------------


def next_chunk(file: BinaryIO, after: int, size: int) -> int | None:
    """Where the next whole chunk begins behind byte ``after``: one whose check sum is right. Chunks of zstd only."""
    if size <= after + _CHUNK_HEAD:
        return None
    with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as content:
        found = content.find(_ZSTD, after + 1 + _RECORD.size + _CHUNK.size - 4)
        while found >= 0:
            at = found - _RECORD.size - (_CHUNK.size - 4)
            if content[at] == Opcode.CHUNK and _is_whole(file, at, size):
                return at
            found = content.find(_ZSTD, found + 1)
    return None


def _is_whole(file: BinaryIO, at: int, size: int) -> bool:
    try:
        record = record_at(file, at, size)
        if not _head(record.body).crc:
            return False  # nothing vouches for it
        _check_framing(_contents(record))
    except (Broken, *_GARBAGE):
        return False
    return True


def definitions(file: BinaryIO, size: int) -> Iterator[McapRecord]:
    """Schemas and channels as the end of a file that was closed repeats them; nothing where that end is damaged."""
    end = size - len(MAGIC)
    footer_at = end - _RECORD.size - _FOOTER.size
    if footer_at < len(MAGIC):
        return
    file.seek(footer_at)
    foot = file.read()
    opcode, length = _RECORD.unpack_from(foot)
    at, _, crc = _FOOTER.unpack_from(foot, _RECORD.size)
    known = opcode == Opcode.FOOTER and length == _FOOTER.size and foot.endswith(MAGIC)
    if not known or not len(MAGIC) < at < footer_at or footer_at - at > ROOM:
        return
    file.seek(at)
    if not crc or zlib.crc32(file.read(end - _SUM.size - at)) != crc:
        return
    try:
        while at < footer_at:
            record = record_at(file, at, footer_at)
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield _single(record.opcode, record.body)
            at = record.end
    except (Broken, *_GARBAGE):
        return
