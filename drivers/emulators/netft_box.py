"""An ATI Net F/T box on this machine: RDT over UDP, `netftapi2.xml` over HTTP (manual 9610-05-1022).

It keeps the box's own rules: one client at a time, the newest that asks; the RDT sequence starts at 1 with each start
request; the F/T sequence counts the 7000 measurements of each second since power-up, whoever listens. What is done to
its stream on purpose is drawn from a seed and counted exactly.
"""

from __future__ import annotations

import random
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer
from typing import Self

INTERNAL_RATE = 7000
_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">III6i")
_HEADER, _STOP, _START, _START_BUFFERED, _BIAS = 0x1234, 0x0000, 0x0002, 0x0003, 0x0042
#: the error summary, and what a saturated transducer adds to it
SATURATION = 0x80020000
_WORD = 0xFFFFFFFF
_INT32 = 2**31 - 1
#: who slept for longer does not send what it has missed [s]
_OVERSLEPT = 0.25


@dataclass(frozen=True)
class Unit:
    """A unit as the box names it, its size in SI, and how many counts it has."""

    name: str
    size: float = 1.0
    counts: int = 1_000_000


NEWTON, NEWTON_METRE = Unit("N"), Unit("Nm")


@dataclass(frozen=True)
class BoxCounts:
    """What was done, in datagrams (``measured``: in records).

    ``sent`` left in order, ``dropped`` never left, ``duplicated`` left twice, ``delayed`` left behind a later one.
    """

    requests: int = 0
    measured: int = 0
    sent: int = 0
    dropped: int = 0
    duplicated: int = 0
    delayed: int = 0


class _Server(TCPServer):
    allow_reuse_address = True  # a box that is switched off and on is found at the same port


@dataclass
class _Client:
    address: tuple[str, int]
    buffered: bool
    left: int | None
    sequence: int
    due: float
    pending: bytearray = field(default_factory=bytearray)
    held: bytes | None = None


class NetFtBox:
    """The box, switched on for a ``with`` block. Attributes may be set at any time, from any thread.

    ``wrench`` returns what acts on the transducer's tool side (6,) [N, N·m], in its axes; it is called once per record,
    in the box's thread; where it raises, the box falls silent. ``status`` is the status word, ``silent`` cuts the cable
    of its stream, ``http_status`` and ``xml`` say what its page answers (None: its setup). ``drop``, ``duplicate`` and
    ``delay`` are shares of datagrams.
    """

    def __init__(
        self,
        wrench: Callable[[], Iterable[float]],
        *,
        rate: float = 1000.0,
        records: int = 1,
        force: Unit = NEWTON,
        torque: Unit = NEWTON_METRE,
        full_scale: Sequence[float] = (130.0, 130.0, 400.0, 10.0, 10.0, 10.0),
        serial: str = "FT00042",
        product: str = "Net F/T",
        filter_code: int = 0,
        address: str = "127.0.0.1",
        port: int = 0,
        http_port: int = 0,
        first_sequence: int = 1,
        seed: int = 0,
    ):
        """``full_scale`` is in the box's units; ``first_sequence`` is that of each stream's first record."""
        self.wrench = wrench
        self.rate, self.records, self.force, self.torque = rate, records, force, torque
        self.full_scale, self.serial, self.product, self.filter_code = tuple(full_scale), serial, product, filter_code
        self.first_sequence = first_sequence
        self.status = 0
        self.silent = False
        self.http_status = 200
        self.xml: bytes | None = None
        self.rdt_enabled = True
        self.drop = self.duplicate = self.delay = 0.0
        self.address, self.port, self.http_port = address, port, http_port
        self._random = random.Random(seed)
        self._tally = dict.fromkeys(vars(BoxCounts()), 0)
        self._lock = threading.Lock()
        self._client: _Client | None = None
        self._power_up()

    def _power_up(self) -> None:
        self._since = time.monotonic()
        self._bias = [0] * 6

    # -- switching it on and off -----------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._stopping = False
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._wake, self._waker = socket.socketpair()
        try:
            self._udp.bind((self.address, self.port))
            self._udp.setblocking(False)
            self._http = _Server((self.address, self.http_port), self._page())
        except OSError:
            for each in (self._udp, self._wake, self._waker):
                each.close()
            raise
        self.port, self.http_port = self._udp.getsockname()[1], self._http.server_address[1]
        self._power_up()
        self._threads = (
            threading.Thread(target=self._stream, name="Net F/T box, RDT"),
            threading.Thread(target=self._http.serve_forever, args=(0.05,), name="Net F/T box, HTTP"),
        )
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._waker.send(b"x")
        self._http.shutdown()
        for thread in self._threads:
            thread.join()
        self._http.server_close()
        for each in (self._udp, self._wake, self._waker):
            each.close()

    def reboot(self) -> None:
        """Lose what power keeps: the client, both counters, the bias."""
        with self._lock:
            self._forget_client()
            self._power_up()

    def send(self, datagram: bytes) -> None:
        """Send any bytes to the client, from the box's own port."""
        with self._lock:
            if self._client is not None:
                self._udp.sendto(datagram, self._client.address)

    @property
    def streaming(self) -> bool:
        """Whether it has a client."""
        return self._client is not None

    @property
    def counts(self) -> BoxCounts:
        """What it has done since it was made."""
        with self._lock:
            return BoxCounts(**self._tally)

    # -- RDT -------------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        while not self._stopping:
            client = self._client
            wait = None if client is None else max(0.0, client.due - time.monotonic())
            ready, _, _ = select.select([self._udp, self._wake], [], [], wait)
            if self._udp in ready:
                self._obey()
            with self._lock:
                if self._client is not None and time.monotonic() >= self._client.due:
                    self._measure(self._client)

    def _obey(self) -> None:
        with suppress(OSError):  # a client that has gone says so here
            request, address = self._udp.recvfrom(2048)
            if len(request) != _REQUEST.size or self.silent or not self.rdt_enabled:
                return
            header, command, count = _REQUEST.unpack(request)
            if header != _HEADER:
                return
            with self._lock:
                self._tally["requests"] += 1
                if command in (_START, _START_BUFFERED):
                    self._forget_client()
                    buffered = command == _START_BUFFERED
                    due = time.monotonic() + 1 / self.rate
                    self._client = _Client(address, buffered, count or None, self.first_sequence & _WORD, due)
                elif command == _STOP:
                    self._forget_client()
                elif command == _BIAS:
                    self._bias = self._load()

    def _measure(self, client: _Client) -> None:
        """Take one record, and send what is complete."""
        now = time.monotonic()
        if now - client.due > _OVERSLEPT:
            client.due = now
        ft = round((client.due - self._since) * INTERNAL_RATE) & _WORD
        client.due += 1 / self.rate
        counts, status = self._counts_of(self._load())
        client.pending += _RECORD.pack(client.sequence, ft, status, *counts)
        client.sequence = (client.sequence + 1) & _WORD
        self._tally["measured"] += 1
        size = self.records if client.buffered else 1
        if len(client.pending) >= size * _RECORD.size:
            datagram, client.pending = bytes(client.pending), bytearray()
            if not self.silent:
                self._post(client, datagram)
        if client.left is not None:
            client.left -= 1
            if client.left == 0:
                self._forget_client()

    def _forget_client(self) -> None:
        if self._client is not None and self._client.held is not None:
            self._tally["dropped"] += 1
        self._client = None

    def _post(self, client: _Client, datagram: bytes) -> None:
        """Send a datagram, or do to it what chance wants."""
        chance = self._random.random()
        if chance < self.drop:
            self._tally["dropped"] += 1
            return
        chance -= self.drop
        if chance < self.delay and client.held is None:
            client.held = datagram
            return
        twice = 0 <= chance - self.delay < self.duplicate
        for _ in range(1 + twice):
            self._out(client, datagram)
        self._tally["sent"] += 1
        self._tally["duplicated"] += twice
        if client.held is not None:
            held, client.held = client.held, None
            self._out(client, held)
            self._tally["delayed"] += 1

    def _out(self, client: _Client, datagram: bytes) -> None:
        with suppress(OSError):
            self._udp.sendto(datagram, client.address)

    def _load(self) -> list[int]:
        """The present load in counts, before bias and full scale."""
        values = self.wrench()
        return [
            round(float(value) / unit.size * unit.counts)
            for value, unit in zip(values, (self.force,) * 3 + (self.torque,) * 3, strict=True)
        ]

    def _counts_of(self, load: list[int]) -> tuple[list[int], int]:
        """What is sent for a load, and the status word beside it."""
        status, counts = self.status, []
        for i, (value, zero, most) in enumerate(zip(load, self._bias, self.full_scale, strict=True)):
            limit = min(_INT32, round(most * (self.force if i < 3 else self.torque).counts))
            if abs(value) > limit:
                status |= SATURATION
                value = limit if value > 0 else -limit  # noqa: PLW2901
            counts.append(max(-_INT32, min(_INT32, value - zero)))
        return counts, status

    # -- the web page ----------------------------------------------------------------------------------------------

    def document(self) -> bytes:
        """Its `netftapi2.xml`, as far as a client needs it."""
        with self._lock:
            fields = {
                "runstat": f"0x{self.status:08X}",
                "runft": "0;0;0;0;0;0",
                "runrate": INTERNAL_RATE,
                "prodname": self.product,
                "cfgnam": "Configuration #1",
                "cfgcalsel": 0,
                "cfgcalsn": self.serial,
                "scfgfu": self.force.name,
                "scfgtu": self.torque.name,
                "cfgtfx": "0;0;0;0;0;0",
                "cfgcpf": self.force.counts,
                "cfgcpt": self.torque.counts,
                "cfgmr": ";".join(f"{value:g}" for value in self.full_scale),
                "setcfgsel": 0,
                "setuserfilter": self.filter_code,
                "setbias": ";".join(str(value) for value in self._bias),
                "netip": self.address,
                "comrdte": "Enabled" if self.rdt_enabled else "Disabled",
                "comrdtrate": f"{self.rate:g}",
                "comrdtbsiz": self.records,
                "mfgdigsn": "E00042",
                "mfgdigver": "2.2.59",
            }
        body = "".join(f"<{name}>{value}</{name}>\n" for name, value in fields.items())
        return f'<?xml version="1.0"?>\n<netft>\n{body}</netft>\n'.encode()

    def _page(self) -> type[BaseHTTPRequestHandler]:
        box = self

        class Page(BaseHTTPRequestHandler):
            timeout = 2.0

            def do_GET(self) -> None:
                """Answer for the one page that there is."""
                status = box.http_status if self.path.partition("?")[0] == "/netftapi2.xml" else 404
                body = b"" if status != 200 else box.document() if box.xml is None else box.xml
                self.send_response(status)
                self.send_header("Content-Type", "text/xml")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        return Page
