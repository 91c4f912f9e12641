"""The Net F/T driver against an emulated box: what it reads, what it counts, what it says."""

from __future__ import annotations

import json
import struct
import threading
from dataclasses import asdict

import numpy as np
import pynetft
import pytest
from scipy import constants
from scipy.spatial.transform import Rotation

from drivers.emulators.netft_box import NetFtBox, Unit
from drivers.errors import DeviceFault, DeviceTimeout, NotConnected
from drivers.real.ati_netft import DRIVER, AtiNetFt
from drivers.real.netft_setup import parse
from drivers.registry import driver
from mechanics.readings import Status
from tests.drivers.real.netft_lab import (
    IMPATIENT,
    Load,
    box_and_sensor,
    config_of,
    mean_wrench,
    next_readings,
    wait_until,
)

LOAD = (1.5, -2.25, 30.0, 0.125, -0.5, 0.75)


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not [t.name for t in threading.enumerate() if "reader" in t.name or "Net F/T" in t.name]


# -- what it reads -----------------------------------------------------------------------------------------------------


def test_the_station_file_names_it():
    assert driver("ati_netft") is DRIVER


def test_reads_the_load_in_si():
    with box_and_sensor(Load(*LOAD)) as (_, sensor):
        reading = sensor.latest()
    np.testing.assert_allclose(reading.wrench, LOAD, atol=1e-6)
    assert reading.stamp.status is Status.OK
    assert reading.stamp.frame == sensor.describe().frame


@pytest.mark.parametrize(
    ("force", "torque"),
    [
        (Unit("lbf", constants.lbf, 4000), Unit("lbf-in", constants.lbf * constants.inch, 8000)),
        (Unit("kN", 1000.0, 10**8), Unit("Nmm", 1e-3, 1000)),
        (Unit("kgf", constants.kgf, 10**6), Unit("kgf-cm", constants.kgf * 0.01, 10**5)),
    ],
)
def test_reads_si_whatever_the_box_counts_in(force, torque):
    units = {"force": force, "torque": torque, "full_scale": (1e4,) * 6}
    with box_and_sensor(Load(*LOAD), **units) as (_, sensor):
        np.testing.assert_allclose(sensor.latest().wrench, LOAD, rtol=1e-12, atol=2e-3)


def test_turned_transducer_reads_in_the_frame_of_the_sensor():
    # Z points down at the wrist, X stays
    with box_and_sensor(Load(*LOAD), {"rotation_deg": (180, 0, 0)}) as (_, sensor):
        np.testing.assert_allclose(sensor.latest().wrench, np.array(LOAD) * (1, -1, -1, 1, -1, -1), atol=1e-6)
    angles = (20.0, -35.0, 110.0)
    turn = Rotation.from_rotvec([0, 0, np.radians(110)]) * Rotation.from_rotvec([0, np.radians(-35), 0])
    turn = turn * Rotation.from_rotvec([np.radians(20), 0, 0])
    with box_and_sensor(Load(*LOAD), {"rotation_deg": angles}) as (_, sensor):
        expected = np.concatenate([turn.apply(LOAD[:3]), turn.apply(LOAD[3:])])
        np.testing.assert_allclose(sensor.latest().wrench, expected, atol=1e-5)


def test_load_on_the_mounting_side_is_felt_with_the_opposite_sign():
    with box_and_sensor(Load(*LOAD), {"reversed": True}) as (_, sensor):
        np.testing.assert_allclose(sensor.latest().wrench, np.negative(LOAD), atol=1e-6)


def test_what_nobody_takes_is_read_in_heaps_and_each_has_its_own_instant():
    with box_and_sensor(Load(*LOAD)) as (_, sensor):
        sensor.wanted = lambda: False
        stamps = [reading.stamp for reading in next_readings(sensor, 500)]
    assert np.diff([stamp.sequence for stamp in stamps]).tolist() == [1] * 499
    measured, read = (np.diff([getattr(s, name) for s in stamps]) * 1e-6 for name in ("capture_ns", "receive_ns"))
    assert np.median(measured) == pytest.approx(1.0, rel=0.2)  # ms
    assert np.sort(read)[-50:].sum() > 0.5 * read.sum()  # one by one, a tenth of the gaps is a tenth of the time


def theirs(box: NetFtBox) -> pynetft.Config:
    """How pynetft reaches the box; patiently, on a machine that has other work."""
    return pynetft.Config(
        sensor_host=box.address,
        rdt_port=box.port,
        http_port=box.http_port,
        receive_timeout=10.0,
        configuration_connect_timeout=10.0,
        configuration_timeout=20.0,
    )


def test_pynetft_reads_the_same_box_to_the_same_values():
    load = Load()
    rng = np.random.default_rng(1)
    units = {
        "force": Unit("N", 1.0, 123_457),
        "torque": Unit("Nmm", 1e-3, 7_919),
        "full_scale": (400,) * 3 + (1e4,) * 3,
    }
    with NetFtBox(load, **units) as box:
        for _ in range(4):
            load.values = rng.uniform(-1, 1, 6) * (100, 100, 100, 8, 8, 8)
            with AtiNetFt("wrist_ft", config_of(box)) as sensor:
                ours = sensor.latest().wrench
            with pynetft.Client(theirs(box)) as client:
                sample = next(client.samples(timeout=30.0))
            assert (sample.force_unit, sample.torque_unit) == (
                pynetft.ForceUnit.NEWTON,
                pynetft.TorqueUnit.NEWTON_MILLIMETER,
            )
            expected = [*sample.force, *(value * 1e-3 for value in sample.torque)]
            np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=0)
            np.testing.assert_allclose(ours, load.values, atol=1e-4)


def test_describes_itself_open_or_closed():
    with NetFtBox(Load()) as box:
        sensor = AtiNetFt("wrist_ft", config_of(box, serial="FT00042", pose=(0.0, 0.01, 0.2), model="ATI Gamma"))
        closed = sensor.describe()
        with sensor:
            assert sensor.describe() == closed
            assert sensor.box is not None and sensor.box.serial == "FT00042"
    assert (closed.kind, closed.model, closed.serial, closed.rate) == ("force_torque", "ATI Gamma", "FT00042", 1000.0)
    assert closed.extra["mount"] == "wrist" and closed.extra["pose"] == [0.0, 0.01, 0.2]
    assert json.loads(json.dumps(asdict(closed)))["extra"] == closed.extra


# -- what it counts ----------------------------------------------------------------------------------------------------


class Counting:
    """A load that says how many records were made of it."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1
        return (1e-3 * self.count, 0.0, 0.0, 0.0, 0.0, 0.0)


def assert_nothing_is_lost(seconds: float) -> None:
    with box_and_sensor(Counting()) as (box, sensor):
        readings = next_readings(sensor, round(1000 * seconds))
        assert sensor.gaps == sensor.counts.lost == 0
    stamps = [reading.stamp for reading in readings]
    assert np.all(np.diff([stamp.sequence for stamp in stamps]) == 1)
    assert np.all(np.diff([stamp.capture_ns for stamp in stamps]) > 0)
    assert all(stamp.receive_ns >= stamp.capture_ns for stamp in stamps)
    assert {stamp.status for stamp in stamps} == {Status.OK}
    # every record that was made, in order, and none twice
    np.testing.assert_allclose(np.diff([reading.wrench[0] for reading in readings]), 1e-3, atol=1e-9)
    assert box.counts.sent == box.counts.measured


def test_two_seconds_at_1_khz_with_nothing_lost():
    assert_nothing_is_lost(2.0)


@pytest.mark.slow
def test_ten_seconds_at_1_khz_with_nothing_lost():
    assert_nothing_is_lost(10.0)


@pytest.mark.parametrize("first", [1, 2**32 - 1500])  # 0xFFFFFFFF is followed by 0
def test_what_is_lost_duplicated_and_late_is_counted_exactly(first):
    with box_and_sensor(Counting(), first_sequence=first, seed=3) as (box, sensor):
        heard = []
        sensor.listen(heard.append)
        box.drop, box.duplicate, box.delay = 0.01, 0.005, 0.005
        wait_until(sensor, lambda: box.counts.measured > 3000)
        box.drop = box.duplicate = box.delay = 0.0
        next_readings(sensor, 20)
        told, did = sensor.counts, box.counts
        assert min(did.dropped, did.duplicated, did.delayed) > 0
        assert (told.lost, told.duplicate, told.late) == (did.dropped, did.duplicated, did.delayed)
        assert sensor.gaps == did.dropped + did.delayed
        assert (told.stray, told.alien, told.malformed, told.restarts, sensor.corrupt) == (0, 0, 0, 0, 0)
        # and each reading is of the record that its number says
        apart = [reading.stamp.sequence - 1e3 * reading.wrench[0] for reading in heard]
        np.testing.assert_allclose(apart, apart[0], atol=1e-3)
        assert np.all(np.diff([reading.stamp.sequence for reading in heard]) > 0)


def test_pynetft_counts_what_the_emulated_box_says_that_it_did():
    with NetFtBox(Load(), seed=3) as box, pynetft.Client(theirs(box), queue_size=10_000) as client:
        samples = client.samples(timeout=30.0)
        next(samples)
        box.drop, box.duplicate, box.delay = 0.01, 0.005, 0.005
        while box.counts.measured < 2000:
            next(samples)
        box.drop = box.duplicate = box.delay = 0.0
        last = box.counts.measured
        while next(samples).rdt_sequence <= last:
            pass
        told, did = client.health(), box.counts
    assert min(did.dropped, did.duplicated, did.delayed) > 0
    assert told.reconnect_count == 0
    assert (told.duplicate_count, told.out_of_order_count) == (did.duplicated, did.delayed)
    assert told.lost_count == did.dropped + did.delayed


def test_the_rate_at_which_readings_come_is_measured():
    sensor = AtiNetFt("wrist_ft", config_of())
    sensor._take_setup(parse(NetFtBox(Load()).document()))
    assert sensor.measured_rate is None
    for i in range(100):
        record = struct.pack(">III6i", i, 28 * i, 0, *[0] * 6)
        sensor._accept(record, ("192.168.1.1", 49152), 10**18 + 4_000_000 * i)
    assert sensor.measured_rate == pytest.approx(250.0)


def test_several_records_in_one_datagram_are_several_readings():
    with box_and_sensor(Counting(), records=8) as (box, sensor):
        readings = next_readings(sensor, 800)
        assert sensor.gaps == 0 and box.counts.sent < 200
    np.testing.assert_allclose(np.diff([reading.wrench[0] for reading in readings]), 1e-3, atol=1e-9)
    apart = np.diff([reading.stamp.capture_ns for reading in readings])
    assert np.all(apart > 0) and np.median(apart) == pytest.approx(1e6, rel=0.01)


def test_a_known_latency_is_taken_off_the_arrival():
    with box_and_sensor(Load(), {"latency": 0.02}) as (_, sensor):
        assert all(r.stamp.receive_ns - r.stamp.capture_ns >= 20e6 for r in next_readings(sensor, 50))


# -- what it says ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "status", "said"),
    [
        (0x80020000, Status.SATURATED, "saturated"),
        (0x90000000, Status.INVALID, "analog board error"),
        (0x80000200, Status.INVALID, "excitation current too high"),
        (0x80010000, Status.OK, "threshold"),
        (0x80080000, Status.OK, "EtherNet/IP"),
    ],
)
def test_a_status_word_becomes_the_status_of_the_reading(word, status, said):
    with box_and_sensor(Load()) as (box, sensor):
        box.status = word
        wait_until(sensor, lambda: sensor.condition != ())
        assert sensor.latest().stamp.status is status
        assert said in sensor.condition[0]
        box.status = 0
        wait_until(sensor, lambda: sensor.condition == ())
        assert next_readings(sensor, 2)[-1].stamp.status is Status.OK


def test_a_status_word_is_logged_once_by_name(caplog):
    with box_and_sensor(Load()) as (box, sensor):
        for word in (0x90000000, 0, 0x90000000, 0x80000008):
            box.status = word
            wait_until(sensor, lambda word=word: sensor._word == word)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 2
    assert "wrist_ft" in told[0] and box.address in told[0] and "analog board error" in told[0]
    assert "reference voltage" in told[1]


def test_beyond_full_scale_is_saturated():
    load = Load()
    with box_and_sensor(load) as (_, sensor):
        load.values = (0.0, 0.0, -1000.0, 0.0, 0.0, 0.0)
        wait_until(sensor, lambda: sensor.condition != ())
        saturated = next_readings(sensor, 5)[-1]
    assert saturated.stamp.status is Status.SATURATED
    assert saturated.wrench[2] == -400.0


def test_a_box_that_is_broken_from_the_start_is_not_opened():
    with NetFtBox(Load()) as box:
        box.status = 0x90000000
        with pytest.raises(DeviceFault, match="analog board error") as caught:
            AtiNetFt("wrist_ft", config_of(box)).connect()
        assert caught.value.device == "wrist_ft" and box.address in caught.value.remedy


# -- tare --------------------------------------------------------------------------------------------------------------


def test_tare_makes_the_present_load_the_zero():
    load = Load(*LOAD)
    with box_and_sensor(load) as (_, sensor):
        sensor.tare()
        np.testing.assert_allclose(mean_wrench(next_readings(sensor, 100)), 0.0, atol=1e-9)
        load.values = np.add(LOAD, (0.0, 0.0, -5.0, 0.0, 0.0, 0.0))
        wait_until(sensor, lambda: sensor.latest().wrench[2] < -4)
        np.testing.assert_allclose(next_readings(sensor, 1)[0].wrench, (0, 0, -5, 0, 0, 0), atol=1e-6)


def test_tare_averages_the_noise():
    rng = np.random.default_rng(0)
    with box_and_sensor(lambda: rng.normal(3.0, 0.5, 6)) as (_, sensor):
        sensor.tare()
        assert np.abs(sensor._zero - 3.0).max() < 5 * 0.5 / 10  # of a hundred readings


def test_a_new_connection_is_not_tared():
    with NetFtBox(Load(*LOAD)) as box:
        sensor = AtiNetFt("wrist_ft", config_of(box))
        with sensor:
            sensor.tare()
        with sensor:
            np.testing.assert_allclose(sensor.latest().wrench, LOAD, atol=1e-6)


def test_a_saturated_sensor_is_not_tared():
    with box_and_sensor(Load(*LOAD)) as (box, sensor):
        box.status = 0x80020000
        wait_until(sensor, lambda: sensor.condition != ())
        with pytest.raises(DeviceFault, match="saturated"):
            sensor.tare()
        box.status = 0
        wait_until(sensor, lambda: sensor.condition == ())
        np.testing.assert_allclose(next_readings(sensor, 1)[0].wrench, LOAD, atol=1e-6)


def test_a_closed_sensor_is_not_tared():
    with pytest.raises(NotConnected, match="wrist_ft"):
        AtiNetFt("wrist_ft", config_of()).tare()


def test_a_tare_in_silence_ends_in_a_timeout():
    with box_and_sensor(Load(), IMPATIENT) as (box, sensor):
        box.silent = True
        with pytest.raises(DeviceTimeout, match=f"wrist_ft.*{box.address}:{box.port}.*cable"):
            sensor.tare()
