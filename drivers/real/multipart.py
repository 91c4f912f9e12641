"""The multipart body that an MJPEG camera sends over HTTP (multipart/x-mixed-replace), cut into its parts.

Servers differ: with or without Content-Length, with or without an empty line before the delimiter, with dashes in the
boundary that they declare. So the delimiter is looked for in what comes, and a Content-Length that is there says only
where a part ends sooner than the next delimiter tells. Memory is bounded, whatever comes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import ProtocolError

#: bytes of the largest part that is read: a picture of 4096 × 4096 in good quality has about six million
LARGEST = 16 * 2**20
_HEAD = 8192  # bytes of a part's header
_REST = re.compile(rb"(--)?[ \t]{0,64}\r?\n")  # of a delimiter's line
_REST_SIZE = 68
_BLANK = re.compile(rb"\r?\n[ \t]*\r?\n")


@dataclass(frozen=True, slots=True)
class Part:
    """One part: its ``data``, and its ``headers`` by lower-case name."""

    data: bytes
    headers: Mapping[str, str]


class MultipartParser:
    """Takes a body as it comes, in pieces of any size, and gives its parts as soon as each is complete.

    A part that another one cuts short, or whose Content-Length is wrong, is given with what there is of it: whether
    that is a picture is for who reads it. What stands between parts is left out and counted in ``skipped`` [bytes].
    """

    def __init__(self, name: str, boundary: str, largest: int = LARGEST, asked: str = "read its stream"):
        """``name`` is the device's and ``asked`` what is done, for errors; ``boundary`` as Content-Type declares it."""
        core = boundary.encode("latin-1", "replace").strip().strip(b'"').strip(b"-")
        if not core or len(core) > 200:
            raise ProtocolError(name, asked, f"the boundary {boundary[:40]!r}", "This is no MJPEG stream")
        self._name, self._asked, self._mark, self._largest = name, asked, b"--" + core, largest
        self._buffer = bytearray()
        self._scanned = 0  # of the buffer, without finding what is looked for
        self._state = self._seek
        self._headers: dict[str, str] = {}
        self._length: int | None = None
        self._astray = 0  # bytes since the last part
        self.skipped = 0
        #: the closing delimiter has come
        self.ended = False

    @property
    def midway(self) -> bool:
        """Whether a part has begun and not ended."""
        return self._state != self._seek

    def feed(self, data: bytes) -> list[Part]:
        """The parts that ``data`` completes. Raises ProtocolError for what exceeds the bounds."""
        parts: list[Part] = []
        # piece by piece: the buffer never holds much more than one part
        for at in range(0, len(data), 1 << 16):
            self._buffer += data[at : at + (1 << 16)]
            while not self.ended and self._state(parts):
                pass
        if self.ended:
            self._buffer.clear()
        return parts

    # -- states: each returns whether there may be more to do with what is in the buffer -------------------------------

    def _seek(self, parts: list[Part]) -> bool:
        found = self._delimiter()
        gone = self._scanned if found is None else found[0]
        self.skipped += gone if self._buffer[:gone].strip(b"\r\n-") else 0
        self._astray += gone
        if self._astray > self._largest:
            raise self._error(f"{self._astray} bytes without a picture")
        if found is None:
            self._cut(gone)
            return False
        # the line's end stays: it may be half of the empty line that ends the header
        self._begin_head(found)
        return True

    def _head(self, parts: list[Part]) -> bool:
        end = _BLANK.search(self._buffer, 0, _HEAD)
        if end is None:
            if len(self._buffer) >= _HEAD:
                raise self._error(f"a part's header of more than {_HEAD} bytes")
            return False
        self._headers = {}
        for line in bytes(self._buffer[: end.start()]).splitlines():
            name, colon, value = line.decode("latin-1").partition(":")
            if colon:
                self._headers[name.strip().lower()] = value.strip()
        self._length = self._declared()
        self._cut(end.end())
        self._state = self._body
        return True

    def _body(self, parts: list[Part]) -> bool:
        found = self._delimiter(inside=True)
        if found is not None and (self._length is None or found[0] < self._length):
            self._give(parts, _without_line_end(self._buffer[: found[0]]))
            self._begin_head(found)
            return True
        if self._length is not None and len(self._buffer) >= self._length:
            self._give(parts, self._buffer[: self._length])
            self._cut(self._length)
            self._state, self._astray = self._seek, 0
            return True
        if len(self._buffer) > self._largest:
            raise self._error(f"a part of more than {self._largest} bytes")
        return False

    # -- pieces --------------------------------------------------------------------------------------------------------

    def _begin_head(self, delimiter: tuple[int, int, bool]) -> None:
        _, end, last = delimiter
        self.ended = last
        self._cut(end - (2 if self._buffer[end - 2 : end] == b"\r\n" else 1))
        self._state, self._astray = self._head, 0

    def _give(self, parts: list[Part], data: bytearray) -> None:
        parts.append(Part(bytes(data), self._headers))

    def _cut(self, size: int) -> None:
        del self._buffer[:size]
        self._scanned = 0

    def _declared(self) -> int | None:
        text = self._headers.get("content-length", "")
        if not (text.isascii() and text.isdigit()):
            return None
        if len(text) > 18 or int(text) > self._largest:
            raise self._error(f"a part of {text[:20]} bytes; at most {self._largest} are read")
        return int(text)

    def _delimiter(self, inside: bool = False) -> tuple[int, int, bool] | None:
        """Where the next delimiter's line begins and ends, and whether it closes the body; None where none is yet.

        ``inside`` a part it has to begin a line, or to follow the end of a JPEG: pictures hold any bytes.
        """
        buffer, size = self._buffer, len(self._mark)
        while (at := buffer.find(self._mark, self._scanned)) >= 0:
            rest = _REST.match(buffer, at + size)
            begin = at
            while begin > max(0, at - 8) and buffer[begin - 1] == 0x2D:
                begin -= 1
            proper = not inside or begin == 0 or buffer[begin - 1] == 0x0A or buffer[begin - 2 : begin] == b"\xff\xd9"
            if proper and rest is not None:
                return begin, rest.end(), rest.group(1) is not None
            if proper and len(buffer) - at < size + _REST_SIZE:
                self._scanned = begin
                return None  # its line may not have come as a whole
            self._scanned = at + 1
        # what may be the beginning of one is looked at again, with what comes
        self._scanned = max(self._scanned, len(buffer) - size - 8, 0)
        return None

    def _error(self, got: str) -> ProtocolError:
        return ProtocolError(self._name, self._asked, got, "Is the address that of an MJPEG stream?")


def _without_line_end(data: bytearray) -> bytearray:
    for end in (b"\r\n", b"\n"):
        if data.endswith(end):
            return data[: -len(end)]
    return data
