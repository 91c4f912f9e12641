from __future__ import annotations

import errno
import os
import select
import subprocess
import sys
import threading
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from drivers.errors import DeviceFault, ProtocolError
from drivers.wire import messages
from drivers.wire.bus import Bus
from drivers.wire.codec import encode_reading
from drivers.wire.log import LogWriter
from drivers.wire.log_reader import LogReader
from mechanics.readings import Stamp, TagDetection, TagReading, TruthReading, WrenchReading
from mechanics.records import EventRecord, PlanarState, WaypointRecord


def wrench(i: int) -> WrenchReading:
    return WrenchReading(Stamp(i * 1_000_000, i * 1_000_000, i, "wrist_ft"), np.arange(6.0) + i)


def fill(log: LogWriter, count: int) -> None:
    for i in range(count):
        reading = wrench(i)
        stamp = reading.stamp.capture_ns
        log.write("sim/ft/wrench", messages.WRENCH, encode_reading(reading), sequence=i, publish_ns=stamp, log_ns=stamp)


def test_the_log_holds_the_bytes_that_went_over_the_bus(served: Bus, joined: Bus, tmp_path: Path) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    sent = [encode_reading(wrench(i)) for i in range(3000)]
    with LogWriter(tmp_path / "log.mcap") as log:
        log.attach(joined, {"lab/ft/wrench": messages.WRENCH}, lockstep=True)
        assert publisher.wait_matched(5.0)
        for i, payload in enumerate(sent):
            publisher.put(payload, i, i * 1_000_000)
        assert joined.subscribe("lab/ft/wrench").wait(2999, None, time.monotonic() + 5)
    assert log.counts == {"lab/ft/wrench": publisher.count}
    assert log.overflows == 0
    assert log.gaps == {}
    with (tmp_path / "log.mcap").open("rb") as file:
        found = [message for _, _, message in make_reader(file, validate_crcs=True).iter_messages()]
    assert [message.data for message in found] == sent
    assert [message.sequence for message in found] == list(range(3000))
    assert [message.publish_time for message in found] == [i * 1_000_000 for i in range(3000)]
    assert [message.log_time for message in found] == [i * 1_000_000 for i in range(3000)]


def test_in_real_time_messages_are_filed_under_their_arrival(served: Bus, joined: Bus, tmp_path: Path) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    before = time.time_ns()
    with LogWriter(tmp_path / "log.mcap") as log:
        log.attach(joined, {"lab/ft/wrench": messages.WRENCH}, lockstep=False)
        assert publisher.wait_matched(5.0)
        publisher.put(b"", 0, 5)
        assert joined.subscribe("lab/ft/wrench").wait(0, None, time.monotonic() + 5)
    (found,) = LogReader(tmp_path / "log.mcap").messages()
    assert found.publish_ns == 5
    assert before <= found.log_ns <= time.time_ns()


def test_a_stock_ros_reader_decodes_every_type(tmp_path: Path) -> None:
    truth = TruthReading(Stamp(5, 5, 0, "world"), np.ones(3), np.full(3, 2.0), None, np.full(3, 3.0))
    tags = TagReading(Stamp(6, 6, 0, "camera"), (TagDetection(7, np.eye(4)[:, :2] * 9, 1, 50.0),))
    state = PlanarState(np.ones(3), np.full(3, 2.0), None, np.zeros(3))
    with LogWriter(tmp_path / "log.mcap") as log:
        fill(log, 1)
        for topic, type_name, value in (
            ("sim/world/truth", messages.TRUTH, truth),
            ("sim/camera/detections", messages.DETECTIONS, tags),
        ):
            log.write(topic, type_name, encode_reading(value), publish_ns=5, log_ns=5)
        log.write_record(WaypointRecord(7, "pivot 1", 3, state, np.ones(3), state))
    with (tmp_path / "log.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        found = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
        summary = reader.get_summary()
        assert summary is not None
        schemas = {schema.name: schema.encoding for schema in summary.schemas.values()}
    assert found["sim/ft/wrench"].wrench.torque.z == 5.0
    assert list(found["sim/world/truth"].go) == [2.0, 2.0, 2.0]
    assert found["sim/camera/detections"].detections[0].id == 7
    assert found["run/waypoint"].trial == "pivot 1"
    assert set(schemas.values()) == {"ros2msg"}
    assert "geometry_msgs/msg/WrenchStamped" in schemas


def test_readings_and_records_come_out_as_they_went_in(tmp_path: Path) -> None:
    event = EventRecord(9, "warning", "gripper slipped")
    with LogWriter(tmp_path / "log.mcap") as log:
        fill(log, 2)
        log.write_record(event)
        log.add_attachment("experiment.yaml", "application/yaml", b"name: x\n")
    reader = LogReader(tmp_path / "log.mcap")
    values = list(reader.values())
    assert reader.complete
    assert [topic for topic, _ in values] == ["sim/ft/wrench", "sim/ft/wrench", "run/event"]
    first = values[0][1]
    assert isinstance(first, WrenchReading)
    assert np.array_equal(first.wrench, np.arange(6.0))
    assert values[2][1] == event
    assert reader.attachments() == {"experiment.yaml": b"name: x\n"}
    assert reader.counts() == {"sim/ft/wrench": 2, "run/event": 1}


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(DeviceFault, match="never overwritten"):
        LogWriter(path)
    assert path.read_bytes() == b"precious"


def test_closing_twice_is_harmless_and_later_messages_are_counted(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "log.mcap")
    log.close()
    log.close()
    with pytest.raises(DeviceFault):
        fill(log, 1)
    assert log.overflows == 1
    assert LogReader(tmp_path / "log.mcap").counts() == {}


def test_what_finds_no_room_is_counted_and_told(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", room=0) as log:
        with pytest.raises(DeviceFault, match="too slow"):
            fill(log, 1)
        assert log.overflows == 1
        assert log.counts == {}


def test_a_full_disk_is_told_when_the_log_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = LogWriter(tmp_path / "log.mcap")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    fill(log, 1)
    with pytest.raises(DeviceFault, match="No space left"):
        log.drain()
    with pytest.raises(DeviceFault, match="No space left"):
        log.close()


def test_after_draining_everything_is_in_the_file(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", flush=0.5) as log:
        fill(log, 200)
        log.drain()
        reader = LogReader(tmp_path / "log.mcap")
        assert reader.counts() == {"sim/ft/wrench": 200}
        assert not reader.complete


def test_a_chunk_leaves_its_index_in_the_file_and_little_in_memory(tmp_path: Path) -> None:
    """Two chunks a second stay in the writer's memory until the end: a working day's 80 000 are to be 40 MB at most."""
    names, chunks = [f"t{k}" for k in range(22)], 200
    tracemalloc.start()
    before = 0
    try:
        with LogWriter(tmp_path / "log.mcap", flush=1000.0) as log:
            for i in range(chunks + 20):
                for k, name in enumerate(names):
                    log.write(name, messages.EMPTY, b"", sequence=i, publish_ns=i, log_ns=100 * i + k)
                log.drain()
                if i == 19:
                    before = tracemalloc.get_traced_memory()[0]
            grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 500 * chunks
    with (tmp_path / "log.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and len(summary.chunk_indexes) == chunks + 20
        assert all(len(index.message_index_offsets) == len(names) for index in summary.chunk_indexes)
        one = reader.iter_messages(["t7"], starting_at=10_000, ending_before=10_300)
        found = [(message.log_time, channel.topic) for _, channel, message in one]
    assert found == [(10_007, "t7"), (10_107, "t7"), (10_207, "t7")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    with LogWriter(path) as log:
        for part in range(4):
            fill(log, 50)
            if part < 3:
                log.drain()
    return path


@settings(max_examples=60)
@given(data=st.data())
def test_a_torn_log_gives_whole_messages_from_its_beginning_and_says_so(whole: Path, data: st.DataObject) -> None:
    intact = list(LogReader(whole).messages())
    content = whole.read_bytes()
    torn = whole.with_name("torn.mcap")
    torn.write_bytes(content[: data.draw(st.integers(8, len(content) - 1))])
    reader = LogReader(torn)
    found = list(reader.messages())
    assert found == intact[: len(found)]
    assert not reader.complete
    assert "torn" in reader.ending


@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_log_never_gives_a_message_that_was_not_written(whole: Path, data: st.DataObject) -> None:
    intact = set(LogReader(whole).messages())
    content = bytearray(whole.read_bytes())
    first_chunk = content.index(b"zstd")
    position = data.draw(st.integers(first_chunk + 20, len(content) - 200))
    content[position] ^= data.draw(st.integers(1, 255))
    damaged = whole.with_name("damaged.mcap")
    damaged.write_bytes(content)
    payloads = {message.payload for message in intact}
    assert {message.payload for message in LogReader(damaged).messages()} <= payloads


def test_what_is_no_log_is_told(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"")
    with pytest.raises(ProtocolError, match="no MCAP file"):
        LogReader(tmp_path / "x.mcap")


_WRITER = """
import sys, time
from pathlib import Path
from drivers.wire import messages
from drivers.wire.log import LogWriter
log = LogWriter(Path(sys.argv[1]), flush=0.5)
i = 0
while True:
    now = time.monotonic_ns()
    log.write("t", messages.EMPTY, b"", sequence=i, publish_ns=now, log_ns=now)
    i += 1
    if i == 400:
        print("two seconds' worth", flush=True)
    time.sleep(0.005)  # a source's pace: the claim is of seconds lost, and without one 400 messages pass in one flush
"""


def test_kill_9_loses_at_most_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    root = str(Path(__file__).parents[3])
    with subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], cwd=root, stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            assert select.select([child.stdout], [], [], 30)[0]
            assert child.stdout.readline()
        finally:
            killed = time.monotonic_ns()
            child.kill()
    reader = LogReader(path)
    found = list(reader.messages())
    assert not reader.complete
    assert [m.sequence for m in found] == list(range(len(found)))
    assert killed - found[-1].log_ns < 0.5e9


def test_writers_of_several_threads_lose_nothing(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:

        def run(name: str) -> None:
            for i in range(500):
                log.write(name, messages.EMPTY, b"", sequence=i, publish_ns=i, log_ns=i)

        threads = [threading.Thread(target=run, args=(f"t{k}",)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    sequences: dict[str, list[Any]] = {}
    for message in LogReader(tmp_path / "log.mcap").messages():
        sequences.setdefault(message.topic, []).append(message.sequence)
    assert sequences == {f"t{k}": list(range(500)) for k in range(4)}
