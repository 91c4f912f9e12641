"""The emulated Net F/T box, by a plain socket and by pynetft: it keeps the box's own rules."""

from __future__ import annotations

import socket
import struct
from urllib.request import urlopen

import numpy as np
import pynetft
import pytest
from defusedxml.ElementTree import fromstring

from drivers.emulators.netft_box import NetFtBox

LOAD = (1.0, -2.0, 3.0, 0.5, -0.25, 0.125)
RECORD = struct.Struct(">III6i")


@pytest.fixture
def client():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.settimeout(10)
        yield link


def ask(link: socket.socket, box: NetFtBox, command: int, count: int = 0) -> None:
    link.sendto(struct.pack(">HHI", 0x1234, command, count), (box.address, box.port))


def records(link: socket.socket, count: int) -> list[tuple[int, ...]]:
    return [RECORD.unpack(link.recv(4096)) for _ in range(count)]


def test_gives_as_many_records_as_are_asked_for(client):
    with NetFtBox(lambda: LOAD) as box:
        ask(client, box, 2, count=5)
        assert [row[0] for row in records(client, 5)] == [1, 2, 3, 4, 5]
        ask(client, box, 2, count=1)
        assert records(client, 1)[0][0] == 1  # the next of the first stream never came
        assert box.counts.measured == 6


def test_sends_counts_of_the_load(client):
    with NetFtBox(lambda: LOAD) as box:
        ask(client, box, 2)
        np.testing.assert_array_equal(records(client, 1)[0][3:], np.multiply(LOAD, 1_000_000))


def test_measures_seven_thousand_times_a_second_whoever_listens(client):
    with NetFtBox(lambda: LOAD) as box:
        ask(client, box, 2, count=100)
        first = records(client, 100)
        assert set(np.diff([row[1] for row in first])) == {7}
        ask(client, box, 2, count=1)
        assert records(client, 1)[0][1] > first[-1][1]


def test_streams_to_one_client_at_a_time(client):
    with NetFtBox(lambda: LOAD) as box, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.settimeout(10)
        ask(client, box, 2)
        records(client, 3)
        ask(other, box, 2)
        assert records(other, 3)[0][0] == 1
        ask(other, box, 0, 0)


def test_what_is_no_request_is_ignored(client):
    with NetFtBox(lambda: LOAD) as box:
        for request in (b"", b"\x12\x34\x00\x02", bytes(8), b"\x12\x34\x00\x02" + bytes(40)):
            client.sendto(request, (box.address, box.port))
        ask(client, box, 0x99)
        ask(client, box, 2, count=1)
        records(client, 1)
        assert box.counts.measured == 1


def test_bias_makes_the_present_load_the_zero():
    with NetFtBox(lambda: LOAD) as box:
        config = pynetft.Config(
            sensor_host=box.address,
            rdt_port=box.port,
            http_port=box.http_port,
            receive_timeout=10.0,
            configuration_connect_timeout=10.0,
            configuration_timeout=20.0,
        )
        with pynetft.Client(config) as theirs:
            samples = theirs.samples(timeout=30.0)
            assert next(samples).force == LOAD[:3]
            theirs.bias()
            while any((*(sample := next(samples)).force, *sample.torque)):
                pass
        box.reboot()  # and it is forgotten
        with pynetft.Client(config) as theirs:
            assert next(theirs.samples(timeout=30.0)).force == LOAD[:3]


def test_its_page_is_a_small_document_without_a_dtd():
    with NetFtBox(lambda: LOAD, serial="FT7") as box:
        answer = urlopen(f"http://{box.address}:{box.http_port}/netftapi2.xml", timeout=10)
        with answer:
            fields = {element.tag: element.text for element in fromstring(answer.read(), forbid_dtd=True)}
    assert (fields["cfgcalsn"], fields["cfgcpf"], fields["scfgfu"]) == ("FT7", "1000000", "N")


def test_a_saturated_transducer_says_so(client):
    with NetFtBox(lambda: (0, 0, 401.0, 0, 0, -11.0)) as box:
        ask(client, box, 2, count=1)
        row = records(client, 1)[0]
    assert row[2] == 0x80020000
    assert row[3:] == (0, 0, 400_000_000, 0, 0, -10_000_000)


def test_comes_back_at_the_ports_that_it_had():
    with (
        NetFtBox(lambda: LOAD) as first,
        urlopen(f"http://{first.address}:{first.http_port}/netftapi2.xml", timeout=10),
    ):
        pass
    with NetFtBox(lambda: LOAD, port=first.port, http_port=first.http_port) as again:
        assert (again.port, again.http_port) == (first.port, first.http_port)


def test_a_port_in_use_is_an_error_and_leaves_nothing_open():
    with NetFtBox(lambda: LOAD) as box, pytest.raises(OSError, match="in use"), NetFtBox(lambda: LOAD, port=box.port):
        pass
