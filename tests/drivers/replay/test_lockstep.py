"""A recording as its devices' clock: what was recorded until now is there, as it was recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, NotConnected, ProtocolError
from drivers.interfaces import ArmTarget
from drivers.replay import Recording, reel
from drivers.wire import messages
from drivers.wire.log_reader import LogReader
from mechanics.readings import ImageReading, Stamp, Status
from mechanics.records import EventRecord
from tests.drivers.replay.tape import BEGIN, DEVICES, MS, device, opened


def same(found, expected) -> bool:
    """Whether two readings are equal to the last bit, arrays and stamps."""
    names = [name for name in found.__dataclass_fields__ if name != "detections"]
    for one, other in zip(getattr(found, "detections", ()), getattr(expected, "detections", ()), strict=True):
        assert np.array_equal(one.corners, other.corners) and one.id == other.id
    return all(np.array_equal(getattr(found, name), getattr(expected, name)) for name in names)


def test_readings_of_every_kind_come_back_as_they_were_recorded(record) -> None:
    put = {}

    def say(tape) -> None:
        put["arm"] = [tape.pose(i, BEGIN + i * 10 * MS, late_ns=MS) for i in range(5)]
        put["hand"] = [tape.grip(7, BEGIN + 5 * MS)]
        put["wrist"] = [tape.wrench(i, BEGIN + i * MS, late_ns=2 * MS) for i in range(40)]
        put["eye"] = [tape.tags(4, BEGIN + 20 * MS)]
        put["skin"] = [tape.touch(i, BEGIN + i * 33 * MS) for i in range(2)]

    with opened(record(say)) as devices:
        devices.clock.sleep(0.1)
        for name, readings in put.items():
            found = devices[name].since(0)
            assert len(found) == len(readings)
            assert all(map(same, found, readings)), name


def test_station_time_is_recorded_time_and_nothing_comes_before_it(record) -> None:
    def say(tape) -> None:
        for i in range(100):
            tape.wrench(i, BEGIN + i * MS)

    recording = Recording(record(say))
    with device(recording, "wrist") as wrist:
        assert recording.now_ns() == BEGIN
        recording.sleep(0.0105)
        assert recording.now_ns() == BEGIN + 10_500_000
        assert wrist.latest().stamp.sequence == 10
        recording.advance_to(BEGIN + 50 * MS)
        assert wrist.latest().stamp.sequence == 50
        recording.advance_to(BEGIN)  # it does not run backwards
        assert recording.now_ns() == BEGIN + 50 * MS
        recording.seek(BEGIN + 20 * MS)
        assert recording.now_ns() == BEGIN + 20 * MS and wrist.since(0) == []
        recording.sleep(0.002)
        assert [reading.stamp.sequence for reading in wrist.since(0)] == [21, 22]


def test_streams_play_in_the_order_of_log_time_however_their_threads_filed_them(record) -> None:
    def say(tape) -> None:  # each stream has a thread of its own, which files a whole step's at once
        for step in range(5):
            tape.pose(step, BEGIN + (step + 1) * 10 * MS)
            for i in range(10):
                tape.wrench(10 * step + i, BEGIN + (10 * step + i + 1) * MS)

    heard = []
    with opened(record(say)) as devices:
        for name in ("arm", "wrist"):
            devices[name].listen(heard.append)
        devices.clock.sleep(1.0)
    assert len(heard) == 55
    times = [reading.stamp.receive_ns for reading in heard]
    assert times == sorted(times)


def test_what_was_lost_is_counted_and_what_is_damaged_too(record) -> None:
    def say(tape) -> None:
        for i in (0, 1, 2, 5, 6, 9):
            tape.wrench(i, BEGIN + i * MS)
        tape.raw("wrist/wrench", messages.WRENCH, b"\xff\xff\xff", Stamp(BEGIN + 10 * MS, BEGIN + 10 * MS, 10, "wrist"))
        tape.wrench(11, BEGIN + 11 * MS)

    recording, ruined = Recording(record(say)), []
    with device(recording, "wrist") as wrist:
        wrist.listen(lambda _: None, ruined.append)
        recording.advance_to(BEGIN + 10 * MS)
        assert wrist.gaps == 4 and wrist.corrupt == 1
        with pytest.raises(ProtocolError, match="wrist: read"):
            wrist.latest()
        recording.sleep(0.001)
        assert wrist.latest().stamp.sequence == 11
        assert [reading.stamp.sequence for reading in wrist.since(0)] == [0, 1, 2, 5, 6, 9, 11]
    assert [(stamp.sequence, stamp.capture_ns) for stamp in ruined] == [(10, BEGIN + 10 * MS)]


def test_a_readings_status_is_in_the_log_and_comes_back(record) -> None:
    statuses = [Status.OK, Status.SATURATED, Status.SATURATED, Status.OK, Status.STALE, Status.STALE, Status.OK]

    def say(tape) -> None:
        for i, status in enumerate(statuses):
            tape.wrench(i, BEGIN + i * MS, status=status)
            tape.touch(i, BEGIN + i * MS, Status.NO_CONTACT)

    with opened(record(say)) as devices:
        devices.clock.sleep(0.1)
        assert [reading.stamp.status for reading in devices["wrist"].since(0)] == statuses
        touches = devices["skin"].since(0)
        assert {reading.stamp.status for reading in touches} == {Status.NO_CONTACT}


def test_capture_gives_each_frame_of_now_or_later_once_and_plays_until_it(record) -> None:
    def say(tape) -> None:
        for i in range(4):
            for k in range(2):
                tape.touch(2 * i + k, BEGIN + i * 100 * MS)
            tape.wrench(i, BEGIN + i * 100 * MS)

    with opened(record(say)) as devices:
        skin, clock = devices["skin"], devices.clock
        clock.advance_to(BEGIN + 100 * MS)
        assert [skin.capture().stamp.sequence for _ in range(2)] == [2, 3]
        assert clock.now_ns() == BEGIN + 100 * MS
        assert skin.capture().stamp.sequence == 4
        assert clock.now_ns() == BEGIN + 200 * MS
        clock.sleep(0.01)
        later = skin.capture()
        assert later.stamp.sequence == 6 and skin.latest().stamp == later.stamp
        assert skin.capture().stamp.sequence == 7
        with pytest.raises(DeviceTimeout, match="skin: capture: the recording has ended"):
            skin.capture()


def test_a_camera_gives_the_picture_behind_its_newest_capture(record) -> None:
    pictures = [np.full((16, 16), 40 * i, np.uint8) for i in range(4)]

    def say(tape) -> None:
        for i, picture in enumerate(pictures):
            at = BEGIN + i * 100 * MS
            tape.tags(i, at)
            if i < 3:
                image = ImageReading(Stamp(at, at + 30 * MS, i, "eye"), picture, "mono8")
                tape.put("eye/image", image, compress=True)
        tape.wrench(0, BEGIN + 2000 * MS)

    with opened(record(say)) as devices:
        eye = devices["eye"]
        assert eye.image() is None
        for i in range(3):
            reading, picture = eye.capture(), eye.image()
            assert reading.stamp.sequence == picture.stamp.sequence == i
            assert picture.encoding == "mono8" and np.abs(picture.image.astype(int) - pictures[i]).max() <= 2
        eye.capture()
        assert eye.image() is None


def untouched(tape, at_ns: int, value: int) -> np.ndarray:
    picture = np.full((6, 8), value, np.uint16)
    tape.put("skin/reference", ImageReading(Stamp(at_ns, at_ns, value, "skin"), picture, "16UC1"))
    return picture


def test_the_untouched_picture_is_the_one_that_was_taken_last_or_the_first_to_come(record) -> None:
    def say(tape) -> None:
        tape.touch(0, BEGIN)
        untouched(tape, BEGIN + 100 * MS, 1)
        untouched(tape, BEGIN + 200 * MS, 2)
        tape.touch(1, BEGIN + 300 * MS)

    recording = Recording(record(say))
    with device(recording, "skin") as skin:
        assert (skin.reference() == 1).all()
        assert recording.now_ns() == BEGIN  # it was looked for, nothing was played
        recording.sleep(0.25)
        assert (skin.reference() == 2).all() and skin.reference().dtype == np.uint16
        assert len(skin.since(0)) == 1


def test_a_log_without_the_untouched_picture_says_so(record) -> None:
    path = record(lambda tape: tape.touch(0, BEGIN))
    with device(Recording(path), "skin") as skin, pytest.raises(DeviceFault, match="has none") as caught:
        skin.reference()
    assert caught.value.device == "skin" and str(path) in caught.value.got


def test_nothing_moves_and_what_leaves_an_arm_at_rest_is_harmless(record) -> None:
    target = ArmTarget(np.zeros(3), np.zeros(3), 0.1)
    with opened(record(lambda tape: tape.pose(0, BEGIN))) as devices:
        arm, hand = devices["arm"], devices["hand"]
        for name, act, said in (
            ("arm", lambda: arm.command(target), "no lease"),
            ("hand", lambda: hand.grasp(20.0), "does not move"),
            ("hand", hand.release, "does not move"),
        ):
            with pytest.raises(CommandRefused, match=said) as caught:
                act()
            assert caught.value.device == name
        for act in (arm.hold, arm.stop, arm.recover):
            act()
        with arm.lease("me"):
            arm.acquire("me")
            with pytest.raises(CommandRefused, match="'me' holds the lease"):
                arm.acquire("you")
            with pytest.raises(CommandRefused, match="a recording does not move"):
                arm.command(target)
            arm.stop()
            with pytest.raises(CommandRefused, match="stopped"):
                arm.command(target)
        with arm.lease("you"):
            pass


def test_tare_takes_the_mean_of_the_readings_that_follow_for_the_zero(record) -> None:
    def say(tape) -> None:
        for i in range(300):
            tape.wrench(i, BEGIN + i * MS)

    recording = Recording(record(say))
    with device(recording, "wrist") as wrist:
        recording.advance_to(BEGIN + 49 * MS)
        wrist.tare()  # readings 50 to 149, whose mean is 99.5 more than the first
        assert recording.now_ns() == BEGIN + 149 * MS
        recording.sleep(0.001)
        assert np.allclose(wrist.latest().wrench, np.arange(6.0) + 150 - (np.arange(6.0) + 99.5))
        assert np.allclose(wrist.since(BEGIN + 48 * MS)[0].wrench, np.arange(6.0) + 49)  # what was read is left alone
        recording.advance_to(BEGIN + 250 * MS)
        with pytest.raises(DeviceTimeout, match="wrist: tare: the recording has ended"):
            wrist.tare()
    with device(recording, "wrist") as wrist:
        recording.sleep(0.0)
        assert np.allclose(wrist.since(0)[0].wrench, np.arange(6.0))


def test_reading_before_anything_was_played_and_after_the_end_says_which_it_is(record) -> None:
    def say(tape) -> None:
        tape.pose(0, BEGIN)
        tape.wrench(0, BEGIN + 500 * MS)

    with opened(record(say)) as devices:
        wrist, clock = devices["wrist"], devices.clock
        with pytest.raises(DeviceTimeout, match="nothing of it was played yet"):
            wrist.latest(timeout=30.0)
        clock.sleep(0.5)
        assert wrist.latest().stamp.sequence == 0
        clock.sleep(0.3)  # more than a 1 kHz stream may be silent
        assert clock.now_ns() == BEGIN + 800 * MS
        with pytest.raises(DeviceTimeout, match="the recording has ended"):
            wrist.latest(timeout=30.0)


def test_where_time_begins_anew_the_streams_do_and_what_is_left_of_a_sleep_goes_on(record) -> None:
    def say(tape) -> None:
        for at in (0, 0):
            for i in range(50):
                tape.wrench(i, at + (i + 1) * MS)

    recording = Recording(record(say, lockstep=True))
    with device(recording, "wrist") as wrist:
        recording.advance_to(40 * MS)
        assert len(wrist.since(0)) == 40
        recording.sleep(0.030)  # 10 ms to the end of the first, the rest from where the second begins
        assert [reading.stamp.sequence for reading in wrist.since(0)] == list(range(21))
        assert recording.now_ns() == 21 * MS and wrist.gaps == 0


def test_the_logs_of_a_run_that_went_on_follow_one_another_in_their_mended_form(record) -> None:
    def part(first: int):
        return lambda tape: [tape.wrench(first + i, BEGIN + (first + i) * MS) for i in range(3)]

    for name, first in (("log.mcap", 90), ("log.repaired.mcap", 0), ("log.1.mcap", 10), ("log.10.mcap", 20)):
        folder = record(part(first), f"run/{name}").parent
    (folder / "log.old.mcap").write_bytes(b"no log")
    recording, heard = Recording(folder), []
    with device(recording, "wrist") as wrist:
        wrist.listen(lambda reading: heard.append(reading.stamp.sequence))
        recording.sleep(10.0)
    assert heard == [0, 1, 2, 10, 11, 12, 20, 21, 22] and recording.ended


def test_no_more_than_a_second_of_a_log_is_in_memory(record, monkeypatch) -> None:
    def say(tape) -> None:
        for i in range(300):
            tape.touch(i, BEGIN + i * 100 * MS)

    read = [0]
    whole = LogReader.messages

    def counted(self, topics=None):
        for message in whole(self, topics):
            read[0] += 1
            yield message

    monkeypatch.setattr(LogReader, "messages", counted)
    with opened(record(say)) as devices:
        for _ in range(5):
            devices.clock.sleep(4.0)
            played = devices["skin"].latest().stamp.sequence
            assert 0 <= read[0] - played <= 2 + reel.WINDOW_NS // (100 * MS) + 1


def test_the_runs_own_records_are_heard_in_their_place(record) -> None:
    def say(tape) -> None:
        tape.log.write_record(EventRecord(0, "info", "before there was a clock"))
        tape.wrench(0, BEGIN)
        tape.log.write_record(EventRecord(BEGIN + 5 * MS, "info", "then"))
        tape.wrench(1, BEGIN + 10 * MS)

    recording: Any = Recording(record(say))
    heard: list[tuple[str, int]] = []
    stop = recording.listen(lambda logged: heard.append((logged.value().text, recording.now_ns())))
    with device(recording, "wrist") as wrist:
        recording.sleep(0.004)
        assert [text for text, _ in heard] == ["before there was a clock"] and len(wrist.since(0)) == 1
        recording.sleep(0.002)
        assert heard[-1] == ("then", BEGIN + 5 * MS)
    stop()


def test_a_device_describes_itself_as_it_was_recorded_open_or_closed(record) -> None:
    with opened(record(lambda tape: tape.pose(0, BEGIN))) as devices:
        said = {name: device.describe() for name, device in devices.items()}
    for name, expected in DEVICES.items():
        assert said[name] == replace(expected, backend="replay") == devices[name].describe()


def test_one_that_is_closed_is_not_read_and_opens_again_at_the_begin(record) -> None:
    recording = Recording(record(lambda tape: [tape.wrench(i, BEGIN + i * MS) for i in range(10)]))
    wrist = device(recording, "wrist")
    for _ in range(2):
        wrist.connect()
        wrist.connect()
        recording.sleep(0.003)
        assert [reading.stamp.sequence for reading in wrist.since(0)] == [0, 1, 2, 3] and wrist.gaps == 0
        wrist.close()
        wrist.close()
        for act in (wrist.latest, lambda: wrist.since(0), wrist.tare):
            with pytest.raises(NotConnected):
                act()


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_a_sleep_without_meaning_is_refused(record, seconds) -> None:
    with pytest.raises(ValueError, match="expected a finite time"):
        Recording(record(lambda tape: tape.pose(0, BEGIN))).sleep(seconds)
