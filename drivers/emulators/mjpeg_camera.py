"""An MJPEG camera on the network: sends the pictures of a callable as mjpg-streamer and µStreamer send a camera's."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

BOUNDARY = "boundarydonotcross"

#: what goes wrong: see `MjpegCamera.fault`
Fault = Literal[
    "http_500", "no_http", "single", "cut", "stop", "garbage", "oversized", "endless", "damaged", "smaller", "silence",
    "slow", "bare",
]  # fmt: skip

_GARBAGE = bytes(range(256)) * 40
_ACCEPT = 0.2  # s; as long as closing may have to wait
_SEND = 2.0  # s; a client that takes nothing for so long is dropped
_JOIN = 5.0
_SLICES = 8  # of a slow part


class MjpegCamera:
    """Serves what ``picture`` gives, (h, w) or (h, w, 3) uint8, at ``rate`` [Hz] to whoever asks for ``path``.

    A picture is asked for only while somebody is connected, by absolute deadlines: one that takes too long makes the
    next ones late, but not for ever. A client that is slow misses pictures. Each part says its Content-Length and, in
    ``X-Timestamp``, when its picture was asked for [s, Unix time]. It listens on this machine only, unless told.
    """

    def __init__(
        self,
        picture: Callable[[], NDArray[np.uint8]],
        rate: float = 30.0,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        path: str = "/stream",
        quality: int = 90,
        timestamps: bool = True,
    ):
        self._picture, self._period = picture, 1.0 / rate
        self._where, self._path = (host, port), path
        self._quality, self._timestamps = quality, timestamps
        #: what goes wrong from now on. On connecting: ``http_500``, ``no_http``, ``single`` (a picture, no stream). In
        #: the stream: ``cut`` breaks off within a picture, ``stop`` falls silent there, ``silence`` between two,
        #: ``garbage`` comes between them, ``oversized`` announces a part of a gigabyte, ``endless`` is one that never
        #: ends, ``damaged`` lacks the end of each picture, ``smaller`` halves them, ``slow`` sends each in pieces all
        #: over its period, ``bare`` sends neither length nor time.
        self.fault: Fault | None = None
        #: pictures made, and clients that came, until now
        self.count = self.visits = 0
        self._news = threading.Condition()
        self._newest: tuple[int, float, bytes] = (0, 0.0, b"")
        self._connections: dict[threading.Thread, socket.socket] = {}
        self._streaming: set[threading.Thread] = set()
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._listener: socket.socket | None = None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        """``http://host:port/path`` while it is open."""
        assert self._listener is not None
        host, port = self._listener.getsockname()[:2]
        return f"http://{host}:{port}{self._path}"

    def open(self) -> None:
        """Listen. Raises OSError where the port is in use."""
        self._closing.clear()
        # the port is the same after closing and opening again
        self._listener = socket.create_server(self._where)
        self._where = self._listener.getsockname()[:2]
        self._listener.settimeout(_ACCEPT)
        self._threads = [
            threading.Thread(target=work, name=f"mjpeg camera {self._where[1]}", daemon=True)
            for work in (self._accept, self._produce)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Drop every client and stop; idempotent."""
        self._closing.set()
        with self._news:
            self._news.notify_all()
        for thread in self._threads:
            thread.join(timeout=_JOIN)
        self._threads = []
        with self._news:  # nobody comes any more
            clients = dict(self._connections)
        for connection in clients.values():
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in clients:
            thread.join(timeout=_JOIN)
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()

    @property
    def clients(self) -> int:
        """How many are sent pictures."""
        with self._news:
            return len(self._streaming)

    def await_count(self, count: int, timeout: float = 10.0) -> bool:
        """Wait until ``count`` pictures were made; whether they were within ``timeout`` [s]."""
        with self._news:
            return self._news.wait_for(lambda: self.count >= count, timeout)

    # -- the pictures --------------------------------------------------------------------------------------------------

    def _produce(self) -> None:
        due = time.monotonic()
        while not self._closing.is_set():
            with self._news:
                if not self._streaming:
                    self._news.wait_for(lambda: self._streaming or self._closing.is_set())
                    due = time.monotonic()
                    continue
            begin = time.time()
            image = self._picture()
            if self.fault == "smaller":
                image = np.ascontiguousarray(image[::2, ::2])
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
            with self._news:
                self.count += 1
                self._newest = (self.count, begin, data.tobytes())
                self._news.notify_all()
            due = max(due + self._period, time.monotonic() - self._period)
            self._closing.wait(max(due - time.monotonic(), 0.0))

    # -- the clients ---------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        listener = self._listener
        assert listener is not None
        while not self._closing.is_set():
            with suppress(TimeoutError):
                connection, _ = listener.accept()
                thread = threading.Thread(target=self._attend, args=(connection,), name="mjpeg client", daemon=True)
                with self._news:
                    self._connections[thread] = connection
                thread.start()

    def _attend(self, connection: socket.socket) -> None:
        me = threading.current_thread()
        with connection, suppress(OSError):
            connection.settimeout(_SEND)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._answered(connection):
                with self._news:
                    self._streaming.add(me)
                    self.visits += 1
                    self._news.notify_all()
                self._stream(connection)
        with self._news:
            self._streaming.discard(me)
            self._connections.pop(me, None)

    def _answered(self, connection: socket.socket) -> bool:
        """Read the request and answer it; whether a stream is to follow."""
        request = b""
        while b"\r\n\r\n" not in request and len(request) < 8192:
            more = connection.recv(4096)
            if not more:
                return False
            request += more
        words = request.split(b" ", 2)
        if self.fault == "no_http":
            connection.sendall(b"220 smtp.example.org ESMTP\r\n\r\n")
        elif self.fault == "http_500":
            connection.sendall(_head("500 Internal Server Error", "text/plain") + b"no camera\n")
        elif len(words) < 3 or words[0] != b"GET":
            connection.sendall(_head("400 Bad Request", "text/plain"))
        elif words[1].decode("latin-1") != self._path:
            connection.sendall(_head("404 Not Found", "text/plain"))
        elif self.fault == "single":
            connection.sendall(_head("200 OK", "image/jpeg"))
        else:
            connection.sendall(
                _head("200 OK", f"multipart/x-mixed-replace;boundary={BOUNDARY}") + f"--{BOUNDARY}\r\n".encode()
            )
            return True
        return False

    def _stream(self, connection: socket.socket) -> None:
        with self._news:
            sent = self._newest[0]
        while True:
            with self._news:
                self._news.wait_for(lambda last=sent: self._closing.is_set() or self._newest[0] > last)
                if self._closing.is_set():
                    return
                sent, begin, data = self._newest
            if not self._sent(connection, begin, data) or _gone(connection):
                return

    def _sent(self, connection: socket.socket, begin: float, data: bytes) -> bool:
        """Send a picture as a part, with what goes wrong; whether the stream goes on."""
        fault = self.fault
        if fault == "silence":
            return True
        head = ["Content-Type: image/jpeg"]
        if fault != "bare":
            head.append(f"Content-Length: {1 << 30 if fault == 'oversized' else len(data)}")
            head += [f"X-Timestamp: {begin:.6f}"] if self._timestamps else []
        if fault == "endless":
            head = head[:1]
        part = "\r\n".join([*head, "", ""]).encode() + data
        end = f"\r\n--{BOUNDARY}\r\n".encode()
        if fault in ("cut", "stop"):
            connection.sendall(part[: len(part) // 2])
            return fault == "stop" and self._fell_silent(connection)
        if fault == "endless":
            connection.sendall(part)
            while not self._closing.is_set() and self.fault == "endless":
                connection.sendall(data)
            return False
        if fault == "damaged":
            part = part[: -len(data) // 3]
        if fault == "garbage":
            end = b"\r\n" + _GARBAGE + end
        if fault == "slow":
            size = len(part) // _SLICES + 1
            for at in range(0, len(part), size):
                connection.sendall(part[at : at + size])
                self._closing.wait(self._period / _SLICES)
            part = b""
        connection.sendall(part + end)
        return True

    def _fell_silent(self, connection: socket.socket) -> bool:
        """Send nothing more to this client, until it goes or the camera closes."""
        while not self._closing.is_set():
            with suppress(TimeoutError):
                if not connection.recv(64):
                    break
        return False


def _gone(connection: socket.socket) -> bool:
    """Whether a client has hung up; one to whom nothing is sent shows it in no other way."""
    readable, _, _ = select.select([connection], [], [], 0)
    return bool(readable) and not connection.recv(64)


def _head(status: str, kind: str) -> bytes:
    lines = (f"HTTP/1.0 {status}", "Server: emulator", "Connection: close", "Cache-Control: no-store, no-cache", "")
    return "\r\n".join((*lines[:-1], f"Content-Type: {kind}", "", "")).encode()
