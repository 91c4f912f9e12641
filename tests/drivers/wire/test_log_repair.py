"""A torn log is mended beside itself: all that was whole, byte for byte, and nothing that was not written."""

from __future__ import annotations

import os
import select
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from rosbags.rosbag2 import Reader

from drivers.errors import DeviceFault, ProtocolError
from drivers.wire import messages
from drivers.wire.codec import encode_reading
from drivers.wire.log import LogWriter
from drivers.wire.log_reader import LogReader
from drivers.wire.log_repair import mended_path, repair_log
from mechanics.readings import Stamp, WrenchReading

STEP = 1_000_000  # between two messages [ns]
PART = 15  # messages in a chunk
PARTS = 4


def payload(i: int) -> bytes:
    return encode_reading(WrenchReading(Stamp(i * STEP, i * STEP, i, "wrist_ft"), np.array([i, -i, 0.5, i, 0.0, 1.0])))


def fill(log: LogWriter, first: int, count: int, topic: str = "lab/ft/wrench") -> None:
    for i in range(first, first + count):
        log.write(topic, messages.WRENCH, payload(i), sequence=i, publish_ns=i * STEP, log_ns=i * STEP)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A whole log: an attachment, then four chunks of 15 wrenches."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    with LogWriter(path, flush=60.0) as log:
        log.add_attachment("experiment.yaml", "application/yaml", b"name: x\n")
        for part in range(PARTS):
            fill(log, part * PART, PART)
            log.drain()
    return path.read_bytes()


@pytest.fixture
def log(written: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    path.write_bytes(written)
    return path


def chunks(content: bytes) -> list[tuple[int, int]]:
    """Begin and end of each chunk, by the format's own framing: opcode, length, body."""
    found, at = [], 8
    while at < len(content) - 8:
        opcode, length = struct.unpack_from("<BQ", content, at)
        if opcode == 6:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


def by_index(path: Path) -> list[tuple[str, str, int, int, int, bytes]]:
    """What the mcap library's own seeking reader finds by the file's indexes, check sums on."""
    with path.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        return [
            (channel.topic, "" if schema is None else schema.name, m.sequence, m.log_time, m.publish_time, m.data)
            for schema, channel, m in reader.iter_messages(log_time_order=False)
        ]


def expected(numbers: list[int]) -> list[tuple[str, str, int, int, int, bytes]]:
    return [("lab/ft/wrench", messages.WRENCH, i, i * STEP, i * STEP, payload(i)) for i in numbers]


def test_a_complete_log_is_left_alone(log: Path) -> None:
    account = repair_log(log)
    assert account.ending == "complete"
    assert account.mended is None
    assert account.kept == {"lab/ft/wrench": PART * PARTS}
    assert [path.name for path in log.parent.iterdir()] == ["log.mcap"]


def test_the_mended_log_opens_by_its_indexes_and_holds_every_whole_message(log: Path, written: bytes) -> None:
    begin, end = chunks(written)[3]
    log.write_bytes(written[: (begin + end) // 2])
    account = repair_log(log)
    assert account.mended is not None
    assert account.mended.name == "log.repaired.mcap"
    assert account.ending == f"torn at byte {begin}: the file ends within a record"
    assert account.kept == {"lab/ft/wrench": 3 * PART}
    assert (account.first_ns, account.last_ns) == (0, (3 * PART - 1) * STEP)
    assert by_index(account.mended) == expected(list(range(3 * PART)))
    assert LogReader(account.mended).attachments() == {"experiment.yaml": b"name: x\n"}
    assert log.read_bytes() == written[: (begin + end) // 2]


def test_rosbags_reads_the_mended_log(log: Path, written: bytes) -> None:
    log.write_bytes(written[: chunks(written)[2][1]])
    mended = repair_log(log).mended
    assert mended is not None
    with Reader(mended) as reader:
        assert reader.message_count == 3 * PART
        assert [bytes(data) for _, _, data in reader.messages()] == [payload(i) for i in range(3 * PART)]


TOOL = shutil.which("pymcap-cli", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))))


@pytest.mark.skipif(TOOL is None, reason="the independent tool pymcap-cli is not installed")
def test_an_independent_tool_recovers_the_same_messages(log: Path, written: bytes) -> None:
    begin, end = chunks(written)[3]
    log.write_bytes(written[: (begin + end) // 2])
    theirs = log.with_name("theirs.mcap")
    assert TOOL is not None
    subprocess.run([TOOL, "recover", str(log), "-o", str(theirs), "--force"], check=False, capture_output=True)
    mended = repair_log(log).mended
    assert mended is not None
    assert by_index(mended) == by_index(theirs)


def test_to_mend_twice_is_to_mend_once(log: Path, written: bytes) -> None:
    log.write_bytes(written[:-30])
    first = repair_log(log)
    assert first.mended is not None
    content, inode = first.mended.read_bytes(), first.mended.stat().st_ino
    assert repair_log(log) == first
    assert (first.mended.read_bytes(), first.mended.stat().st_ino) == (content, inode)
    assert sorted(path.name for path in log.parent.iterdir()) == ["log.mcap", "log.repaired.mcap"]


def test_another_file_in_its_place_is_never_overwritten(log: Path, written: bytes) -> None:
    log.write_bytes(written[:-30])
    mended_path(log).write_bytes(b"precious")
    with pytest.raises(DeviceFault, match="is another"):
        repair_log(log)
    assert mended_path(log).read_bytes() == b"precious"
    assert len(list(log.parent.iterdir())) == 2


def test_wherever_the_last_chunk_is_cut_what_came_before_it_is_kept(written: bytes, tmp_path: Path) -> None:
    """Every byte of it: the chunk itself is whole or not there, for nothing vouches for a part of it."""
    begin, end = chunks(written)[3]
    log = tmp_path / "log.mcap"
    for cut in range(begin, end):
        log.write_bytes(written[:cut])
        mended_path(log).unlink(missing_ok=True)
        account = repair_log(log)
        assert account.kept == {"lab/ft/wrench": 3 * PART}
        assert account.ending.startswith(f"torn at byte {begin}:")
    log.write_bytes(written[:end])
    mended_path(log).unlink()
    assert repair_log(log).kept == {"lab/ft/wrench": 4 * PART}


@settings(max_examples=60)
@given(data=st.data())
def test_a_cut_anywhere_loses_no_whole_chunk(written: bytes, tmp_path_factory, data: st.DataObject) -> None:
    cut = data.draw(st.integers(8, len(written) - 1))
    log = tmp_path_factory.mktemp("cut") / "log.mcap"
    log.write_bytes(written[:cut])
    account = repair_log(log)
    whole = sum(end <= cut for _, end in chunks(written))
    assert account.mended is not None
    assert by_index(account.mended) == expected(list(range(whole * PART)))


def test_zeros_behind_the_last_chunk_end_the_log_at_once(log: Path, written: bytes) -> None:
    log.write_bytes(written[: chunks(written)[2][1]] + bytes(50_000_000))
    account = repair_log(log)
    assert "zeros" in account.ending
    assert account.kept == {"lab/ft/wrench": 3 * PART}


def test_a_flipped_byte_in_mid_file_costs_its_chunk_and_what_it_cost_is_told(log: Path, written: bytes) -> None:
    begin, end = chunks(written)[1]
    # of the chunk's head the kind, the length, the size and the check sum, the compression; then what it packs
    for position in (begin, begin + 3, begin + 26, begin + 34, begin + 42, (begin + end) // 2, end - 1):
        damaged = bytearray(written)
        damaged[position] ^= 0x10
        log.write_bytes(damaged)
        mended_path(log).unlink(missing_ok=True)
        account = repair_log(log)
        assert account.mended is not None
        kept = [*range(PART), *range(2 * PART, 4 * PART)]
        assert by_index(account.mended) == expected(kept), position
        assert account.lost == {"lab/ft/wrench": PART}
        assert account.gap_ns == (PART + 1) * STEP
        assert [(b.at, b.until) for b in account.breaks] == [(begin, chunks(written)[2][0])]


def test_a_chunk_that_passes_for_something_else_is_missed(log: Path, written: bytes) -> None:
    """One bit makes an index of a chunk: nothing looks damaged, but fewer messages are there than were written."""
    damaged = bytearray(written)
    damaged[chunks(written)[1][0]] ^= 1
    log.write_bytes(damaged)
    account = repair_log(log)
    assert account.ending.endswith("45 messages, where 60 were written")
    assert account.kept == {"lab/ft/wrench": 3 * PART}


def test_where_the_first_chunk_is_damaged_the_topics_come_from_the_end_of_the_file(log: Path, written: bytes) -> None:
    begin, end = chunks(written)[0]
    damaged = bytearray(written)
    damaged[(begin + end) // 2] ^= 1
    log.write_bytes(damaged)
    account = repair_log(log)
    assert account.mended is not None
    assert by_index(account.mended) == expected(list(range(PART, 4 * PART)))


def test_without_that_end_messages_of_unknown_topics_are_counted_as_lost(log: Path, written: bytes) -> None:
    begin, end = chunks(written)[0]
    damaged = bytearray(written[:-30])
    damaged[(begin + end) // 2] ^= 1
    log.write_bytes(damaged)
    account = repair_log(log)
    assert account.kept == {}
    assert account.nameless == 3 * PART


@settings(max_examples=100)
@given(data=st.data())
def test_damage_never_makes_a_message_that_was_not_written(
    written: bytes, tmp_path_factory, data: st.DataObject
) -> None:
    damaged = bytearray(written)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(8, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    log = tmp_path_factory.mktemp("damaged") / "log.mcap"
    log.write_bytes(damaged[: data.draw(st.integers(8, len(damaged)))])
    account = repair_log(log)
    found = by_index(account.mended) if account.mended is not None else by_index(log)
    assert set(found) <= set(expected(list(range(PART * PARTS))))


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r", b"%PDF-1.7 this is no log at all"])
def test_what_is_no_log_is_told(tmp_path: Path, content: bytes) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(content)
    with pytest.raises(ProtocolError, match="no MCAP"):
        repair_log(log)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_log_of_nothing_but_its_beginning_is_mended_to_an_empty_one(log: Path, written: bytes) -> None:
    log.write_bytes(written[:8])
    account = repair_log(log)
    assert account.mended is not None
    assert account.kept == {}
    assert by_index(account.mended) == []


def test_a_chunk_that_unpacks_to_more_than_anybody_writes_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    packed = zstandard.ZstdCompressor().compress(bytes(2**30))
    body = struct.pack("<QQQII", 0, 0, 2**30, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    assert len(packed) < 10**6
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body)
    reader = LogReader(path)
    assert list(reader.messages()) == []
    assert "at most are read" in reader.ending


_WRITER = """
import sys, time
from pathlib import Path
from drivers.wire import messages
from drivers.wire.log import LogWriter
log = LogWriter(Path(sys.argv[1]), flush=0.5)
i = 0
while True:
    now = time.monotonic_ns()
    log.write("t", messages.STRING, b"x" * 200, sequence=i, publish_ns=now, log_ns=now)
    if i % 100 == 0:
        print(now, flush=True)
    i += 1
    time.sleep(0.002)  # a source's pace: without one the claim, of seconds lost, would be of a flooded disk
"""


def test_after_kill_9_the_mended_log_lacks_at_most_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    root = str(Path(__file__).parents[3])
    with subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], cwd=root, stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            for _ in range(6):  # somewhere behind the first second
                assert select.select([child.stdout], [], [], 30)[0]
                assert child.stdout.readline()
        finally:
            killed = time.monotonic_ns()
            child.kill()
    account = repair_log(path)
    assert account.mended is not None
    found = by_index(account.mended)
    assert [m[2] for m in found] == list(range(len(found)))
    assert account.last_ns == found[-1][3]
    assert killed - account.last_ns < 0.5e9
