"""The Net F/T driver and what can go wrong: silence, restarts, strangers, a page that is none, a wrong station file."""

from __future__ import annotations

import random
import socket
import struct
import threading
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.emulators.netft_box import NetFtBox
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.real.ati_netft import AtiNetFt
from drivers.real.rdt import Command
from mechanics.readings import Status
from tests.drivers.real.netft_lab import (
    IMPATIENT,
    Load,
    box_and_sensor,
    config_of,
    free_port,
    next_readings,
    wait_until,
)
from tests.drivers.real.test_netft_setup import BOMB

LOAD = (1.5, -2.25, 30.0, 0.125, -0.5, 0.75)


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not [t.name for t in threading.enumerate() if "reader" in t.name or "Net F/T" in t.name]


def refused(kind: type[DriverError], box: NetFtBox | None = None, **changed) -> DriverError:
    """What opening the sensor ends in; the device is named, and what to do."""
    sensor = AtiNetFt("wrist_ft", config_of(box, **changed))
    with pytest.raises(kind) as caught:
        sensor.connect()
    assert not sensor.connected
    assert caught.value.device == "wrist_ft"
    assert caught.value.remedy
    return caught.value


# -- silence -----------------------------------------------------------------------------------------------------------


def test_a_silent_box_is_a_timeout_that_names_its_address():
    with NetFtBox(Load()) as box:
        box.silent = True
        error = refused(DeviceTimeout, box, **IMPATIENT)
        assert f"{box.address}:{box.port}" in str(error) and "cable" in error.remedy


def test_a_box_that_falls_silent_is_told_and_found_again():
    with box_and_sensor(Load(*LOAD), IMPATIENT) as (box, sensor):
        before = sensor.latest().stamp
        box.silent = True
        wait_until(sensor, lambda: sensor.trouble is not None)
        for read in (sensor.latest, lambda: sensor.since(0)):
            with pytest.raises(DeviceTimeout, match=f"{box.address}:{box.port}"):
                read()
        box.silent = False
        wait_until(sensor, lambda: sensor.trouble is None)
        after = sensor.latest()
        assert sensor.reconnections == 1
        np.testing.assert_allclose(after.wrench, LOAD, atol=1e-6)
        # what was missed in the silence is counted by the clock
        silent = (after.stamp.capture_ns - before.capture_ns) * 1e-9
        assert silent > sensor._config.timeout
        assert after.stamp.sequence - before.sequence == pytest.approx(1000 * silent, rel=0.1)
        assert sensor.gaps == pytest.approx(1000 * silent, rel=0.3)


def test_a_tare_outlives_a_silence():
    with box_and_sensor(Load(*LOAD), IMPATIENT) as (box, sensor):
        sensor.tare()
        box.silent = True
        wait_until(sensor, lambda: sensor.trouble is not None)
        box.silent = False
        wait_until(sensor, lambda: sensor.trouble is None)
        np.testing.assert_allclose(sensor.latest().wrench, 0.0, atol=1e-9)


def test_a_box_that_was_switched_off_and_on_is_asked_again():
    with box_and_sensor(Load(*LOAD), IMPATIENT) as (box, sensor):
        before = sensor.latest().stamp
        requests = box.counts.requests
        box.reboot()  # and waits to be asked
        wait_until(sensor, lambda: sensor.trouble is not None)
        wait_until(sensor, lambda: sensor.trouble is None)
        after = sensor.latest()
        assert box.counts.requests > requests
        assert after.stamp.sequence > before.sequence and after.stamp.capture_ns > before.capture_ns
        assert after.stamp.status is Status.OK
        np.testing.assert_allclose(after.wrench, LOAD, atol=1e-6)


def test_a_box_that_comes_back_otherwise_than_it_went_is_not_read():
    with box_and_sensor(Load(*LOAD), IMPATIENT) as (box, sensor):
        box.silent, box.serial = True, "FT99999"
        wait_until(sensor, lambda: sensor.trouble is not None)
        box.silent = False
        wait_until(sensor, lambda: isinstance(sensor.trouble, DeviceFault))
        with pytest.raises(DeviceFault, match="set up otherwise: serial"):
            sensor.latest()


def test_a_stream_that_another_program_restarts_for_us_goes_on():
    with box_and_sensor(Load()) as (_, sensor):
        next_readings(sensor, 50)
        assert sensor._link is not None
        sensor._link.ask(Command.START)
        wait_until(sensor, lambda: sensor.counts.restarts == 1)
        readings = next_readings(sensor, 20)
        assert np.all(np.diff([reading.stamp.sequence for reading in readings]) == 1)
        assert sensor.trouble is None


def test_closing_a_silent_sensor_leaves_nothing_behind():
    with NetFtBox(Load()) as box:
        sensor = AtiNetFt("wrist_ft", config_of(box, **IMPATIENT))
        sensor.connect()
        box.silent = True
        wait_until(sensor, lambda: sensor.trouble is not None)
        sensor.close()
        sensor.close()
        assert not sensor.connected
        with pytest.raises(NotConnected):
            sensor.latest()


def test_closing_stops_the_stream_and_opening_begins_anew():
    with NetFtBox(Load()) as box:
        sensor = AtiNetFt("wrist_ft", config_of(box))
        for _ in range(2):
            with sensor:
                assert box.streaming
                assert next_readings(sensor, 5)[0].stamp.sequence < 5000
                assert sensor.gaps == 0


def test_a_slow_stream_is_not_taken_for_silence():
    with box_and_sensor(Load(), {"timeout": 0.05}, rate=10.0) as (_, sensor):
        next_readings(sensor, 5)
        assert sensor.reconnections == 0 and sensor.counts.restarts == 0


# -- strangers ---------------------------------------------------------------------------------------------------------


def test_only_the_box_is_heard():
    port = free_port(socket.SOCK_DGRAM)
    with box_and_sensor(Load(*LOAD), {"local_port": port}) as (_, sensor):
        lie = struct.pack(">III6i", 1, 1, 0, *[10**9] * 6)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for datagram in (lie, b"", bytes(2000), b"\xff" * 36):
                stranger.sendto(datagram, ("127.0.0.1", port))
        wait_until(sensor, lambda: sensor.counts.alien == 4)
        for reading in next_readings(sensor, 20):
            np.testing.assert_allclose(reading.wrench, LOAD, atol=1e-6)
        assert sensor.gaps == 0 and sensor.corrupt == 0


@pytest.mark.parametrize("size", [0, 1, 8, 35, 37, 72, 1440, 3000, 60_000])
def test_a_datagram_of_another_length_is_counted_and_ignored(size):
    with box_and_sensor(Load(*LOAD)) as (box, sensor):
        box.send(b"\x01" * size)
        wait_until(sensor, lambda: sensor.counts.malformed == 1)
        for reading in next_readings(sensor, 20):
            np.testing.assert_allclose(reading.wrench, LOAD, atol=1e-6)
        assert sensor.corrupt == 1 and sensor.gaps == 0


def test_random_records_from_the_box_itself_are_never_readings():
    chance = random.Random(5)
    with box_and_sensor(Load(*LOAD)) as (box, sensor):
        heard = []
        sensor.listen(heard.append)
        for _ in range(500):
            box.send(chance.randbytes(36))
        wait_until(sensor, lambda: sensor.counts.stray == 500)
        next_readings(sensor, 5)
        assert sensor.gaps == 0 and sensor.trouble is None
        np.testing.assert_allclose([reading.wrench for reading in heard], np.tile(LOAD, (len(heard), 1)), atol=1e-6)


def test_a_box_that_sends_only_what_nobody_can_read_counts_as_silent():
    with NetFtBox(Load(), records=3) as box:
        document = box.document().replace(b"<comrdtbsiz>3</comrdtbsiz>", b"")
        box.xml = document
        error = refused(DeviceTimeout, box, records=2, **IMPATIENT)
        assert "another length" in error.got and "records" in error.got


# -- the page ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("status", [500, 404, 301])
def test_a_page_that_is_refused_is_told(status):
    with NetFtBox(Load()) as box:
        box.http_status = status
        error = refused(ProtocolError, box)
        assert f"HTTP {status}" in error.got and f"http://{box.address}:{box.http_port}" in error.asked


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(b"<netft><cfgcpf>1", id="cut off"),
        pytest.param(b"<html></html>", id="another page"),
        pytest.param(BOMB, id="a bomb"),
        pytest.param(b"<netft>" + b" " * 400_000 + b"</netft>", id="too much"),
        pytest.param(b"", id="nothing"),
    ],
)
def test_a_page_that_is_no_setup_is_told(page):
    with NetFtBox(Load()) as box:
        box.xml = page
        error = refused(ProtocolError, box)
        assert f"http://{box.address}:{box.http_port}/netftapi2.xml" in error.asked


@contextmanager
def server(behave):
    """Somebody else at the port of the page: ``behave(link, over)`` for each who comes."""
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(0.1)

        def run() -> None:
            while not over.is_set():
                try:
                    link, _ = listening.accept()
                except TimeoutError:
                    continue
                with link, suppress(OSError):  # who came may have gone
                    link.settimeout(5)
                    assert link.recv(4096).startswith(b"GET /netftapi2.xml ")
                    behave(link, over)

        thread = threading.Thread(target=run)
        thread.start()
        yield listening.getsockname()[1]
        over.set()
        thread.join()


def drip(link: socket.socket, over: threading.Event) -> None:
    link.sendall(b"HTTP/1.1 200 OK\r\n")
    while not over.wait(0.02):
        link.sendall(b"a")


@pytest.mark.parametrize("behave", [lambda link, over: over.wait(5), drip], ids=["mute", "byte by byte"])
def test_a_page_that_never_comes_is_a_timeout(behave):
    with server(behave) as port:
        error = refused(DeviceTimeout, address="127.0.0.1", http_port=port, **IMPATIENT)
        assert f"http://127.0.0.1:{port}" in error.asked


def test_a_page_that_breaks_off_is_told():
    with server(lambda link, _: link.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 900\r\n\r\n<netft>")) as port:
        assert "no whole HTTP answer" in refused(ProtocolError, address="127.0.0.1", http_port=port).got


def test_a_wrong_address_is_told():
    error = refused(NotConnected, address="127.0.0.1", http_port=free_port(socket.SOCK_STREAM))
    assert "refused" in error.got and "127.0.0.1" in error.asked and "`address` (127.0.0.1)" in error.remedy


def test_a_local_port_in_use_is_told():
    with NetFtBox(Load()) as box, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        error = refused(NotConnected, box, local_port=port)
        assert str(port) in error.asked and "in use" in error.got and "local_port" in error.remedy


# -- a station file that is not the box's ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"serial": "FT11111"}, ("FT11111", "FT00042")),
        ({"rate": 500.0}, ("500 Hz", "1000 Hz")),
        ({"records": 4}, ("`records` is 4", "1 at the box")),
        ({"filter": 73.0}, ("`filter` is 73", "326")),
    ],
)
def test_a_box_that_is_set_otherwise_is_refused_with_both_figures(changed, told):
    with NetFtBox(Load(), filter_code=2) as box:
        error = refused(NotConnected, box, **changed)
        assert all(word in error.got for word in told)
        assert f"http://{box.address}/" in error.remedy


def test_a_box_whose_rdt_is_off_is_refused():
    with NetFtBox(Load()) as box:
        box.rdt_enabled = False
        assert "RDT is switched off" in refused(NotConnected, box).got


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("address", "192.168.1.999"),
        ("address", "ati.lab"),
        ("address", "0.0.0.0"),
        ("address", "224.0.0.1"),
        ("port", 0),
        ("records", 41),
        ("timeout", 0),
        ("filter", 100),
        ("rate", 0),
        ("rotation", (0, 0, 0)),
    ],
)
def test_a_station_file_without_meaning_is_refused(key, value):
    with pytest.raises(ValidationError):
        config_of(None, **{key: value})
