"""The body of an HTTP answer that comes in chunks (RFC 9112, section 7.1), taken apart as its bytes come.

A camera is asked by HTTP/1.0, which knows no chunks; some servers send them all the same.
"""

from __future__ import annotations

import re

from drivers.errors import ProtocolError

#: the longest line of a chunk's size with its extensions [bytes], and the largest chunk [bytes]
_LINE, _CHUNK = 1024, 1 << 26
_SIZE = re.compile(rb"([0-9A-Fa-f]{1,8})[ \t]*(?:;[^\r\n]*)?\r?\n")


class ChunkedBody:
    """Joins the chunks of one answer of the device ``name``; ``asked`` is what its errors say was asked."""

    def __init__(self, name: str, asked: str):
        self._name, self._asked = name, asked
        self._line = bytearray()  # what has come of the next size
        self._left = 0  # bytes that the chunk still has
        self._mark = False  # the line end behind a chunk has still to come
        #: the chunk of size 0 has come: nothing of the body is behind it
        self.ended = False

    def feed(self, data: bytes) -> bytes:
        """What of the body is in the next bytes. Raises ProtocolError for what are no chunks."""
        body, at = bytearray(), 0
        while at < len(data) and not self.ended:
            if self._left:
                taken = data[at : at + self._left]
                body += taken
                at += len(taken)
                self._left -= len(taken)
                self._mark = not self._left
                continue
            end = data.find(b"\n", at)
            self._line += data[at : len(data) if end < 0 else end + 1]
            if len(self._line) > _LINE:
                raise self._bad(f"a line of over {_LINE} bytes where a chunk's size should be")
            if end < 0:
                break
            at, line = end + 1, bytes(self._line)
            self._line.clear()
            if self._mark:
                self._mark = False
                if line.strip(b"\r\n"):
                    raise self._bad(f"{line[:20]!r} behind a chunk")
                continue
            self._left = self._size(line)
            self.ended = not self._left
        return bytes(body)

    def _size(self, line: bytes) -> int:
        found = _SIZE.fullmatch(line)
        size = -1 if found is None else int(found.group(1), 16)
        if not 0 <= size <= _CHUNK:
            raise self._bad(f"{line[:20]!r}, which is no size of a chunk")
        return size

    def _bad(self, got: str) -> ProtocolError:
        return ProtocolError(self._name, self._asked, got, "It is tried again by itself; restart the camera's server")
