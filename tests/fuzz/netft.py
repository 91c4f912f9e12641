"""What comes from a Net F/T box, or from whoever stands at its address: datagrams, and answers for its page."""

from __future__ import annotations

import struct
from functools import cache
from itertools import pairwise

import numpy as np

from drivers.emulators.netft_box import NetFtBox, Unit
from drivers.real.ati_netft import AtiNetFt, AtiNetFtConfig
from drivers.real.netft_setup import BoxSetup, document_of, parse
from drivers.real.rdt import told
from mechanics.readings import Status

WORDS = (
    b"<cfgcpf>",
    b"</netft>",
    b"<!DOCTYPE n [",
    b'<!ENTITY a "b">',
    b"&a;",
    b"<![CDATA[",
    b"Content-Length: ",
    b"\r\n",
)

#: a datagram's place in a case: its length comes before it
_LENGTH = struct.Struct(">H")
_PERIOD = 1_000_000


def _document(**kinds) -> bytes:
    return NetFtBox(lambda: (0.0,) * 6, **kinds).document()


def setups() -> list[bytes]:
    """Setups in two systems of units."""
    return [_document(), _document(force=Unit("lbf", 4.4482, 1000), torque=Unit("kgf-cm", 0.0980665, 777), rate=50.0)]


def pages() -> list[bytes]:
    """Whole answers, plain and in chunks."""
    body = _document()
    head = b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n"
    chunked = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
    return [
        head + b"Content-Length: %d\r\n\r\n" % len(body) + body,
        head + b"Transfer-Encoding: chunked\r\n\r\n" + chunked,
        head.replace(b"1.1", b"1.0") + b"\r\n" + body,
    ]


def datagrams() -> list[bytes]:
    """Streams of one record each datagram: a plain one, one around the wrap, one with losses and a restart."""
    plain = [struct.pack(">III6i", n, 7 * n, 0, *range(n, n + 6)) for n in range(1, 12)]
    wrapped = [
        struct.pack(">III6i", (2**32 - 5 + n) % 2**32, 7 * n, 0x80020000 * (n % 2), *[-n] * 6) for n in range(12)
    ]
    torn = plain[:3] + plain[5:7] + plain[4:5] + plain[6:9] + plain[:4]
    return [b"".join(_LENGTH.pack(len(each)) + each for each in stream) for stream in (plain, wrapped, torn)]


def _sensible(box: BoxSetup) -> None:
    assert 0 < box.force < np.inf and 0 < box.torque < np.inf
    assert all(0 < value < np.inf for value in box.full_scale)


def take_setup(data: bytes) -> None:
    """Whatever is accepted has a meaning."""
    _sensible(parse(data))


def take_page(data: bytes) -> None:
    """As `take_setup`, from the answer of a server."""
    _sensible(parse(document_of(data)))


@cache
def _usual() -> tuple[AtiNetFtConfig, BoxSetup]:
    return AtiNetFtConfig(kind="force_torque", driver="ati_netft", mount="wrist"), parse(_document())


def take_datagrams(data: bytes) -> None:
    """Give a sensor what stands in ``data``; what it gives out is in order, finite, and what some datagram said."""
    config, setup = _usual()
    sensor = AtiNetFt("wrist_ft", config)
    sensor._take_setup(setup)
    said, at, count = set(), 0, 0
    while at + _LENGTH.size <= len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        datagram = data[at + _LENGTH.size : at + _LENGTH.size + length]
        at += _LENGTH.size + length
        count += 1
        sensor._accept(datagram, sensor._peer, count * _PERIOD)
        told(sensor._word)
        if len(datagram) == 36:
            said.add(struct.unpack(">6i", datagram[12:]))
    readings = sensor._readings
    counts = sensor.counts
    assert counts.readings == len(readings) and counts.malformed == sensor.corrupt
    assert counts.readings + counts.late + counts.duplicate + counts.stray + counts.malformed <= count
    stamps = [reading.stamp for reading in readings]
    assert all(a.sequence < b.sequence and a.capture_ns < b.capture_ns for a, b in pairwise(stamps))
    assert counts.lost >= 0 and all(isinstance(stamp.status, Status) for stamp in stamps)
    for reading in readings:
        assert tuple(np.rint(reading.wrench * 1e6).astype(int)) in said
