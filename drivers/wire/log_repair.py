"""Mends a log that was cut off or damaged: a whole one beside it, with everything that can be had, byte for byte."""

from __future__ import annotations

import filecmp
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from drivers.errors import DeviceFault
from drivers.wire.log_reader import Break, LogReader

MENDED = ".repaired"
"""Stands before the ending of a mended log's name: ``log.mcap`` is mended as ``log.repaired.mcap``."""

_LOG = re.compile(rf"log(?:\.([0-9]{{1,9}}))?(?:{re.escape(MENDED)})?\.mcap")
_CHUNK = 2**20


@dataclass(frozen=True)
class Account:
    """What a log holds and what it has lost.

    ``ending`` and ``breaks`` are of the log as it was left (`LogReader`). ``kept`` counts messages per topic from log
    time ``first_ns`` to ``last_ns``; ``lost`` counts those that the sequence numbers miss across damage in mid-file,
    ``gap_ns`` is the log time without a message there, and ``nameless`` are messages whose topic was lost. What was
    not written when the file broke off no file can count. ``mended`` is None for a log that is complete.
    """

    log: Path
    ending: str
    breaks: tuple[Break, ...] = ()
    kept: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    nameless: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_ns: int = 0
    mended: Path | None = None


def mended_path(log: Path) -> Path:
    """Where the mended form of a log lies."""
    return log.with_name(f"{log.stem}{MENDED}{log.suffix}")


def written_logs(folder: Path) -> list[Path]:
    """The logs of a run folder as runs wrote them, in order: ``log.mcap``, then ``log.1.mcap`` … where it went on.

    One of which only the mended form is left is among them.
    """
    found = {int(match[1] or 0) for file in folder.glob("log*.mcap") if (match := _LOG.fullmatch(file.name))}
    return [folder / (f"log.{number}.mcap" if number else "log.mcap") for number in sorted(found)]


def to_read(log: Path) -> Path:
    """A log in its mended form, where there is one."""
    return mended if (mended := mended_path(log)).is_file() else log


def repair_log(log: Path) -> Account:
    """Write the mended form of a torn or damaged log beside it; a complete log is left alone.

    Nothing is ever overwritten: to mend the same log again is to find the same file there. Nobody may write the log
    meanwhile. Raises DeviceFault for another file in the mended one's place and when it cannot be written,
    ProtocolError for no MCAP file, OSError for one that cannot be read.
    """
    reader = LogReader(log)
    whole = _Copy(reader)
    whole.take()
    if reader.complete:
        return whole.account(None)
    target = mended_path(log)
    aside = log.with_name(f".{target.name}.{os.getpid()}")
    try:
        reader = LogReader(log, salvage=True)
        with aside.open("wb") as file:
            copy = _Copy(reader, Writer(file, chunk_size=_CHUNK, compression=CompressionType.ZSTD))
            copy.take()
            copy.finish()
            file.flush()
            os.fsync(file.fileno())
        if not target.exists():
            aside.rename(target)
        elif not filecmp.cmp(aside, target, shallow=False):
            remedy = "Nothing recorded is overwritten: move that file away, then repair again"
            raise DeviceFault("log", f"mend {log}", f"{target.name} lies there and is another", remedy)
    except OSError as error:
        raise DeviceFault("log", f"mend {log}", str(error), "Check the disk and its permissions") from error
    finally:
        aside.unlink(missing_ok=True)
    return copy.account(target)


class _Copy:
    """One pass over a log that counts what is there and, with a ``writer``, writes it anew."""

    def __init__(self, reader: LogReader, writer: Writer | None = None):
        self.reader, self.writer = reader, writer
        self.kept: dict[str, int] = {}
        self.lost: dict[str, int] = {}
        self.nameless = 0
        self.first_ns, self.last_ns, self.gap_ns = -1, 0, 0
        self._newest: dict[str, int] = {}
        self._waiting: set[str] = set()  # topics without a message since the last break
        self._breaks = 0
        self._started = False

    def take(self) -> None:
        """Go through the file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        numbers: dict[int, int] = {}
        kinds: dict[int, int] = {}
        for record in self.reader.records():
            if isinstance(record, Header):
                self._start(record)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Attachment) and self.writer is not None:
                self._start()
                what = (record.create_time, record.log_time, record.name, record.media_type, record.data)
                self.writer.add_attachment(*what)
            elif isinstance(record, Metadata) and self.writer is not None:
                self._start()
                self.writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    self.nameless += 1
                    continue
                if self.writer is not None:
                    self._write(self.writer, record, channel, schemas.get(channel.schema_id), numbers, kinds)
                self._count(channel.topic, record)

    def _start(self, header: Header | None = None) -> None:
        if self.writer is not None and not self._started:
            self._started = True
            profile, library = ("ros2", "extrinsic") if header is None else (header.profile, header.library)
            self.writer.start(profile=profile, library=library)

    def _write(
        self,
        writer: Writer,
        message: Message,
        channel: Channel,
        schema: Schema | None,
        numbers: dict[int, int],
        kinds: dict[int, int],
    ) -> None:
        self._start()
        if channel.id not in numbers:
            kind = 0
            if schema is not None:
                if schema.id not in kinds:
                    kinds[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                kind = kinds[schema.id]
            numbers[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, kind, channel.metadata
            )
        number = numbers[channel.id]
        writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)

    def _count(self, topic: str, message: Message) -> None:
        if len(self.reader.breaks) > self._breaks:
            self._breaks = len(self.reader.breaks)
            self._waiting = set(self._newest)
            self.gap_ns += max(message.log_time - self.last_ns, 0)
        if topic in self._waiting:
            self._waiting.discard(topic)
            missing = message.sequence - self._newest[topic] - 1
            if missing > 0:  # a smaller number begins a new count: the world was reset
                self.lost[topic] = self.lost.get(topic, 0) + missing
        self._newest[topic] = message.sequence
        self.kept[topic] = self.kept.get(topic, 0) + 1
        self.first_ns = message.log_time if self.first_ns < 0 else min(self.first_ns, message.log_time)
        self.last_ns = max(self.last_ns, message.log_time)

    def finish(self) -> None:
        """Write the indexes."""
        self._start()
        if self.writer is not None:
            self.writer.finish()

    def account(self, mended: Path | None) -> Account:
        """What was found."""
        reader = self.reader
        return Account(
            reader.path,
            reader.ending,
            tuple(reader.breaks),
            self.kept,
            self.lost,
            self.nameless,
            max(self.first_ns, 0),
            self.last_ns,
            self.gap_ns,
            mended,
        )
