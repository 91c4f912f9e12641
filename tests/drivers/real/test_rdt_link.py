"""The socket to a box: when things arrived, and whose port it is."""

from __future__ import annotations

import socket
import sys
import threading
import time

import pytest

from drivers.real.rdt import Command
from drivers.real.rdt_link import RdtLink


@pytest.fixture
def box():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", 0))
        there.settimeout(10)
        yield there


@pytest.fixture
def link(box):
    opened = RdtLink(box.getsockname(), 0, 10.0)
    yield opened
    opened.close()


def await_stamps(box, link, client, patience=10.0):
    """Linux begins to stamp datagrams a little after the first socket asks for it, when a worker of its comes round."""
    deadline, pause = time.monotonic() + patience, threading.Event()
    while True:
        box.sendto(b"early", client)
        pause.wait(0.02)
        read = time.time_ns()
        if link.receive()[2] < read:
            return
        assert time.monotonic() < deadline, f"the kernel stamps nothing within {patience:g} s"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a datagram arrives when it is read")
def test_a_datagram_arrived_when_it_came_however_late_it_is_read(box, link):
    link.ask(Command.START)
    request, client = box.recvfrom(64)
    await_stamps(box, link, client)
    before = time.time_ns()
    box.sendto(b"reading", client)
    after = time.time_ns()
    threading.Event().wait(0.05)  # kept from reading
    datagram, source, arrival = link.receive()
    assert (request[:2], datagram, source) == (b"\x12\x34", b"reading", box.getsockname())
    assert before <= arrival <= after


def test_closing_tells_the_box_to_stop(box, link):
    link.close()
    assert box.recv(64) == bytes.fromhex("1234 0000 00000000")
    link.close()


def test_nothing_within_the_patience_is_none(box):
    link = RdtLink(box.getsockname(), 0, 0.05)
    assert link.receive() is None
    link.close()


def test_an_empty_datagram_is_a_datagram(box, link):
    link.ask(Command.START)
    box.sendto(b"", box.recvfrom(64)[1])
    assert link.receive()[0] == b""
