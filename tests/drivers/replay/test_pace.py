"""A recording that plays at its pace, by itself: its stamps are of now, and late as they were."""

from __future__ import annotations

import threading
import time
from dataclasses import asdict

import numpy as np
import pytest

from drivers.config import REPLAYED, BusConfig, StationConfig
from drivers.device_host import DeviceHost, make
from drivers.errors import CommandRefused, DeviceTimeout
from drivers.interfaces import ArmTarget
from drivers.replay import Recording
from drivers.station import Station
from drivers.wire.bus import Bus
from mechanics.readings import ImageReading, Stamp
from tests.drivers.replay.tape import BEGIN, MS, Tape, device
from tests.drivers.wire.conftest import free_endpoint

#: long enough for a crowded machine; nothing takes as long where all is well [s]
PATIENCE = 30.0


class Ear:
    """What a device says, with the time when it said it; `wait` until it has said so much."""

    def __init__(self, sensor) -> None:
        self.readings: list = []
        self.arrivals: list[int] = []
        self._more = threading.Condition()
        self.stop = sensor.listen(self._hear)

    def _hear(self, reading) -> None:
        with self._more:
            self.arrivals.append(time.time_ns())
            self.readings.append(reading)
            self._more.notify_all()

    def wait(self, count: int) -> list:
        with self._more:
            assert self._more.wait_for(lambda: len(self.readings) >= count, PATIENCE), f"{len(self.readings)} came"
        return self.readings


def short(tape: Tape) -> None:
    """A fifth of a second: the wrist comes 3 ms late and the arm 12."""
    for i in range(200):
        tape.wrench(i, BEGIN + i * MS, late_ns=3 * MS)
        if i % 10 == 0:
            tape.pose(i // 10, BEGIN + i * MS, late_ns=12 * MS)


def together(recording: Recording) -> tuple[Ear, Ear]:
    """Ears at arm and wrist from the first message on."""
    arm, wrist = device(recording, "arm"), device(recording, "wrist")
    with recording._turn:  # nothing is played meanwhile
        arm.connect()
        wrist.connect()
        return Ear(arm), Ear(wrist)


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_stamps_are_moved_to_now_by_one_constant_and_delays_stay_as_they_were(record, speed) -> None:
    recording = Recording(record(short), speed=speed)
    before = time.time_ns()
    arm, wrist = together(recording)
    try:
        arm.wait(20)
        wrist.wait(200)
        captured = [BEGIN + i * MS for i in range(200)]
        moved = [reading.stamp.capture_ns for reading in wrist.readings]
        start = moved[0]
        # the first message to arrive is now; it was captured 3 ms of the recording before
        assert before - 3 * MS / speed <= start
        assert moved == [start + round((t - BEGIN) / speed) for t in captured]
        poses = [reading.stamp.capture_ns for reading in arm.readings]
        expected = [start + round((t - BEGIN) / speed) for t in captured[::10]]
        assert all(abs(found - wanted) <= 1 for found, wanted in zip(poses, expected, strict=True))
        for ear, late in ((arm, 12 * MS), (wrist, 3 * MS)):
            stamps = [reading.stamp for reading in ear.readings]
            assert [s.receive_ns - s.capture_ns for s in stamps] == pytest.approx([late / speed] * len(stamps), abs=2)
            # nothing comes before its time
            assert all(at >= s.receive_ns for at, s in zip(ear.arrivals, stamps, strict=True))
            assert [s.sequence for s in stamps] == list(range(len(stamps)))
        np.testing.assert_array_equal(wrist.readings[7].wrench, np.arange(6.0) + 7)
    finally:
        for ear in (arm, wrist):
            ear.stop()
        for sensor in tuple(recording._players):
            sensor.close()


def test_at_its_end_the_devices_are_silent_and_say_why(record) -> None:
    recording = Recording(record(short), speed=4.0)
    with device(recording, "wrist") as wrist, device(recording, "skin") as skin:
        with pytest.raises(DeviceTimeout, match="skin: capture: the recording has ended"):
            skin.capture(timeout=PATIENCE)  # it is woken at the end, and does not wait for long
        assert recording.ended
        with pytest.raises(DeviceTimeout, match="the recording has ended"):
            while True:  # the last readings are fresh for a while
                wrist.latest(timeout=0.05)
        assert wrist.since(0)[-1].stamp.sequence == 199


def test_a_loop_begins_again_with_rising_stamps(record) -> None:
    recording = Recording(record(short), speed=20.0, loop=True)
    with device(recording, "wrist") as wrist:
        ear = Ear(wrist)
        readings = ear.wait(700)
        ear.stop()
        assert wrist.gaps == 0 and not recording.ended
    sequences = [reading.stamp.sequence for reading in readings]
    begin = sequences.index(0, 1)
    assert sequences[begin : begin + 200] == list(range(200)) and sequences[begin - 1] == 199
    assert np.all(np.diff([reading.stamp.receive_ns for reading in readings]) > 0)


def test_a_loop_of_nothing_ends(record) -> None:
    recording = Recording(record(lambda tape: None), speed=1.0, loop=True)
    with device(recording, "skin") as skin, pytest.raises(DeviceTimeout, match="has ended"):
        skin.capture(timeout=PATIENCE)


def test_speed_0_plays_as_fast_as_it_is_read_with_stamps_as_recorded(record) -> None:
    def say(tape: Tape) -> None:
        for i in range(100):
            tape.wrench(i, BEGIN + i * 1000 * MS)  # a hundred seconds

    recording = Recording(record(say), speed=0.0)
    with device(recording, "wrist") as wrist:
        assert wrist.describe().rate == 0  # nobody can say how often
        with pytest.raises(DeviceTimeout):
            while not recording.ended:
                wrist.latest(timeout=PATIENCE)
            wrist._raise_ended("read")
        assert [reading.stamp.capture_ns for reading in wrist.since(0)] == [BEGIN + i * 1000 * MS for i in range(100)]
        assert wrist.latest().stamp.sequence == 99  # it is never too old


def test_a_frame_that_is_asked_for_is_captured_after_that(record) -> None:
    recording = Recording(
        record(lambda tape: [tape.touch(i, BEGIN + i * 20 * MS) for i in range(400)]), speed=1.0, loop=True
    )
    with device(recording, "skin") as skin:
        before = time.time_ns()
        first, second = skin.capture(PATIENCE), skin.capture(PATIENCE)
        assert before <= first.stamp.capture_ns < second.stamp.capture_ns
        with pytest.raises(DeviceTimeout, match="nothing within 0 s"):
            skin.capture(timeout=0.0)


def test_tare_waits_for_the_readings_that_follow(record) -> None:
    def say(tape: Tape) -> None:
        for i in range(1000):
            tape.wrench(0 if i == 0 else i, BEGIN + i * MS)

    recording = Recording(record(say), speed=2.0)
    with device(recording, "wrist") as wrist:
        ear = Ear(wrist)
        before = ear.wait(1)[-1].stamp.sequence
        wrist.tare()
        readings = ear.wait(1000 - ear.readings[0].stamp.sequence)
        numbers = np.array([reading.stamp.sequence for reading in readings])
        zeros = numbers[:, None] + np.arange(6.0) - np.array([reading.wrench for reading in readings])
        adjusted = zeros.any(axis=1)
        # the hundredth completes the mean, and has the zero already: what comes before it has none, what follows, too
        hundredth = numbers[adjusted][0]
        assert hundredth - 99 > before
        assert (adjusted == (numbers >= hundredth)).all()
        assert (zeros[adjusted] == np.arange(hundredth - 99, hundredth + 1).mean() + np.arange(6.0)).all()
        ear.stop()


def config(path, name: str, kind: str, **more):
    return REPLAYED[kind].model_validate({"kind": kind, "backend": "replay", "log": str(path), **more})


def test_devices_that_name_one_log_share_one_recording_that_starts_with_the_first(record) -> None:
    path = record(short)
    arm = make("arm", config(path, "arm", "arm"))
    felt = make("felt", config(path, "felt", "force_torque", stream="wrist", mount="wrist"))
    other = make("arm", config(path, "arm", "arm", speed=2.0))
    assert arm.recording is felt.recording is not other.recording  # type: ignore[attr-defined]
    recording = arm.recording  # type: ignore[attr-defined]
    assert recording._thread is None
    with arm, felt:
        [thread] = {recording._thread}
        assert thread is not None and felt.describe().name == "felt"
        ear = Ear(felt)
        ear.wait(1)
    assert recording._thread is None and not thread.is_alive()


def test_a_recording_on_the_bus_is_a_station_like_any_other(record) -> None:
    def say(tape: Tape) -> None:
        untouched = np.full((6, 8), 7, np.uint16)
        tape.put("skin/reference", ImageReading(Stamp(BEGIN, BEGIN, 0, "skin"), untouched, "16UC1"))
        for i in range(3000):
            tape.wrench(i, BEGIN + i * MS, late_ns=3 * MS)
            if i % 10 == 0:
                tape.pose(i // 10, BEGIN + i * MS)
            if i % 30 == 0:
                tape.touch(i // 30, BEGIN + i * MS)

    path = record(say)
    station = StationConfig.model_validate(
        {
            "name": "replayed",
            "bus": BusConfig(endpoint=free_endpoint()).model_dump(),
            "devices": {
                "arm": {
                    "kind": "arm",
                    "backend": "replay",
                    "log": str(path),
                    "loop": True,
                    "limits": dict.fromkeys(("force", "torque", "jump", "speed", "acceleration"), 1e5),
                },
                "wrist": {
                    "kind": "force_torque",
                    "backend": "replay",
                    "log": str(path),
                    "mount": "wrist",
                    "loop": True,
                },
                "skin": {
                    "kind": "tactile",
                    "sensor": "soft_bubble",
                    "finger": "left",
                    "backend": "replay",
                    "log": str(path),
                    "loop": True,
                },
            },
        }
    )
    ready = threading.Event()
    with Bus(station.bus.endpoint, listen=True, shared_memory=False) as bus:
        host = DeviceHost(station, bus)
        thread = threading.Thread(target=host.run, args=(ready.set,), name="serve a recording")
        thread.start()
        try:
            assert ready.wait(PATIENCE)
            with Station(station).connect() as devices:
                wrist = devices.force_torque("wrist")
                ear = Ear(wrist)
                for reading in ear.wait(50):
                    i = reading.stamp.sequence
                    np.testing.assert_array_equal(reading.wrench, np.arange(6.0) + i)
                assert wrist.gaps == 0
                assert asdict(wrist.describe()) == asdict(host.devices["wrist"].describe())
                assert (devices.tactile("left").reference() == 7).all()
                before = time.time_ns()
                assert devices.tactile("left").capture().stamp.capture_ns >= before
                assert devices.arm.latest().pose[1] == 0.25
                with devices.arm.lease("me"), pytest.raises(CommandRefused, match="does not move"):
                    devices.arm.command(ArmTarget(devices.arm.latest().pose, np.zeros(3), 0.02))
                ear.stop()
        finally:
            host.stop()
            thread.join(PATIENCE)
