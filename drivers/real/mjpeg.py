"""Frames from a camera that sends MJPEG over HTTP: mjpg-streamer, µStreamer, and most network cameras."""

from __future__ import annotations

import base64
import http.client
import io
import math
import re
import socket
import time
from collections.abc import Callable
from email.message import Message
from functools import partial
from ipaddress import ip_address
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.real.chunked import ChunkedBody
from drivers.real.frames import FrameSource
from drivers.real.guarded import guarded
from drivers.real.jpeg import decoded
from drivers.real.multipart import MultipartParser, Part
from drivers.streaming import POLL

_HEAD = 32768  # bytes of an answer's header
_CHUNK = 1 << 16
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})(?: ([^\r\n]*))?\r?\n")
_END_OF_HEAD = re.compile(rb"\r?\n\r?\n")
_REMEDIES = {
    401: "Name user and password in the address: http://user:password@host/path (Basic)",
    403: "Name user and password in the address: http://user:password@host/path (Basic)",
    404: "Usual paths are /?action=stream (mjpg-streamer) and /stream (µStreamer)",
}


class MjpegSource(FrameSource):
    """A camera behind ``address``, ``http://host:port/path``. One request, whose answer never ends.

    Every wait has a limit: for the host's name, the connection, the whole header of the answer, and each frame.
    """

    def __init__(self, name: str, address: str, *, rate: float, delay: float = 0.0, silence: float = 2.0):
        self._url = urlsplit(address)
        super().__init__(
            name,
            address.replace(f"{self._url.netloc.rpartition('@')[0]}@", ""),
            rate=rate,
            delay=delay,
            silence=silence,
        )
        self._socket: socket.socket | None = None
        self._parser: MultipartParser | None = None
        self._chunks: ChunkedBody | None = None  # where the answer comes in chunks
        self._begun = b""

    def _reach(self, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        try:
            self._socket = self._connected(deadline)
            self._socket.sendall(self._request())
            head, self._begun = self._head(self._socket, deadline)
        except TimeoutError:
            raise self._silent(timeout) from None
        except OSError as error:
            raise self._unreachable(error) from error
        asked = f"read {self.address}"
        self._parser = MultipartParser(self.name, boundary(self.name, self.address, head), asked=asked)
        self._chunks = ChunkedBody(self.name, asked) if in_chunks(self.name, self.address, head) else None

    def _connected(self, deadline: float) -> socket.socket:
        try:
            port = self._url.port or 80
        except ValueError as error:
            raise self._not_reached(str(error), "A port is a number from 1 to 65535") from None
        host = self._url.hostname or ""
        try:
            ip_address(host)
        except ValueError:  # a name; the resolver has no time-out of its own
            look = partial(socket.getaddrinfo, host, port, socket.AF_INET, socket.SOCK_STREAM)
            host = str(guarded(look, deadline - time.monotonic())[0][4][0])
        connection = socket.create_connection((host, port), timeout=max(deadline - time.monotonic(), 0.01))
        connection.settimeout(max(deadline - time.monotonic(), 0.01))
        return connection

    def _request(self) -> bytes:
        url = self._url
        target = (url.path or "/") + (f"?{url.query}" if url.query else "")
        # by 1.0 the answer should come as it is, not in chunks
        lines = [
            f"GET {target} HTTP/1.0",
            f"Host: {url.netloc.rpartition('@')[2]}",
            "Accept: multipart/x-mixed-replace",
        ]
        if url.username is not None:
            secret = f"{unquote(url.username)}:{unquote(url.password or '')}".encode()
            lines.append(f"Authorization: Basic {base64.b64encode(secret).decode()}")
        return "\r\n".join([*lines, "", ""]).encode("latin-1", "replace")

    def _head(self, connection: socket.socket, deadline: float) -> tuple[bytes, bytes]:
        """The header of the answer, and what has come of its body."""
        data = bytearray()
        while (end := _END_OF_HEAD.search(data)) is None:
            if len(data) > _HEAD:
                raise ProtocolError(self.name, f"read {self.address}", f"a header of over {_HEAD} bytes", _NO_STREAM)
            connection.settimeout(max(deadline - time.monotonic(), 0.01))
            if time.monotonic() >= deadline:
                raise TimeoutError
            more = connection.recv(_CHUNK)
            if not more:
                raise ProtocolError(self.name, f"read {self.address}", "the answer ended within its header", _NO_STREAM)
            data += more
        return bytes(data[: end.end()]), bytes(data[end.end() :])

    def _drain(self) -> None:
        connection, parser = self._socket, self._parser
        assert connection is not None and parser is not None
        data, self._begun = self._begun, b""
        if not data:
            connection.settimeout(POLL)
            try:
                data = connection.recv(_CHUNK)
            except TimeoutError:
                return
            except OSError as error:
                raise self._ended(error.strerror or str(error)) from error
            if not data:
                raise self._ended(f"it ended{' in the middle of a picture' if parser.midway else ''}")
        if self._chunks is not None:
            data = self._chunks.feed(data)
        for part in parser.feed(data):
            self._offer(partial(self._picture, part), exposed_ns(part))
        if parser.ended or (self._chunks is not None and self._chunks.ended):
            raise self._ended("the camera closed it")

    def _picture(self, part: Part) -> Callable[[bool], NDArray[np.uint8]]:
        return partial(decoded, self.name, part.data)

    def _detach(self) -> Callable[[], object]:
        connection, self._socket, self._begun = self._socket, None, b""
        return (lambda: None) if connection is None else connection.close

    # -- errors --------------------------------------------------------------------------------------------------------

    def _silent(self, timeout: float) -> DriverError:
        if self._socket is None:
            return self._not_reached(
                f"no answer within {timeout:.3g} s",
                "See whether the address is right, the camera is powered, and this machine is on its network",
            )
        return DeviceTimeout(
            self.name, f"connect to {self.address}", f"connected, but no stream within {timeout:.3g} s", "Restart it"
        )

    def _unreachable(self, error: OSError) -> NotConnected:
        if isinstance(error, socket.gaierror):
            return self._not_reached(f"nobody knows the host {self._url.hostname!r}", "Correct its name, or use its IP")
        if isinstance(error, ConnectionRefusedError):
            return self._not_reached(
                "connection refused", "See whether the camera's server runs, and whether the port is right"
            )
        return self._not_reached(error.strerror or str(error), "See whether the address is right")

    def _ended(self, got: str) -> DeviceFault:
        return DeviceFault(
            self.name, f"read {self.address}", f"the stream broke off: {got}", "It is tried again by itself", True
        )


_NO_STREAM = "Is it the address of an MJPEG stream?"


def boundary(name: str, address: str, head: bytes) -> str:
    """The boundary of the multipart body that an answer's header ``head`` announces.

    Raises NotConnected for a status that is not 200, ProtocolError for what is no HTTP, or no stream of parts.
    """
    headers = _headers(name, address, head)
    kind, mark = headers.get_content_type(), headers.get_boundary()
    if not kind.startswith("multipart/") or not mark:
        said = "a single picture" if kind.startswith("image/") else f"{kind} without a boundary"
        raise ProtocolError(name, f"connect to {address}", said, f"Name the stream itself. {_REMEDIES[404]}")
    return mark


def in_chunks(name: str, address: str, head: bytes) -> bool:
    """Whether the body behind ``head`` comes in chunks. Raises ProtocolError for any other coding, NotConnected."""
    headers = _headers(name, address, head)
    told = (headers.get("transfer-encoding", ""), headers.get("content-encoding", ""))
    codings = [word.strip().lower() for line in told for word in str(line).split(",") if word.strip()]
    alien = sorted(set(codings) - {"chunked", "identity"})
    if alien:
        raise ProtocolError(
            name, f"connect to {address}", f"a stream that is {', '.join(alien)[:80]}", "Turn its compression off"
        )
    return "chunked" in codings


def _headers(name: str, address: str, head: bytes) -> Message:
    status = _STATUS.match(head)
    if status is None:
        raise ProtocolError(name, f"connect to {address}", f"{head[:40]!r}, which is no HTTP", _NO_STREAM)
    code, reason = int(status.group(1)), (status.group(2) or b"").decode("latin-1")
    if code != 200:
        remedy = _REMEDIES.get(code, "The camera's own server is in trouble: restart it" if code >= 500 else _NO_STREAM)
        raise NotConnected(name, f"connect to {address}", f"HTTP {code} {reason[:80]}".rstrip(), remedy)
    try:
        return http.client.parse_headers(io.BytesIO(head[status.end() :]))
    except http.client.HTTPException as error:
        raise ProtocolError(name, f"connect to {address}", f"a bad header: {error}", _NO_STREAM) from error


def exposed_ns(part: Part) -> int | None:
    """When a part says, in ``X-Timestamp`` [s], that it was exposed [ns]; None where it does not."""
    try:
        seconds = float(part.headers.get("x-timestamp", "nan"))
    except ValueError:
        return None
    return round(seconds * 1e9) if math.isfinite(seconds) and 0 < seconds < 1e11 else None
