"""The body of an answer that comes in chunks, against the standard library's reader of the same bytes."""

import http.client
import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.real.chunked import ChunkedBody
from drivers.real.mjpeg import in_chunks

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n"


def in_pieces(data: bytes, size: int) -> tuple[bytes, bool]:
    body = ChunkedBody("camera", "read")
    out = b"".join(body.feed(data[i : i + size]) for i in range(0, len(data), size))
    return out, body.ended


class Spoken:
    """A socket that says these bytes."""

    def __init__(self, data: bytes):
        self._data = data

    def makefile(self, *_: Any) -> io.BytesIO:
        return io.BytesIO(self._data)


def by_the_library(data: bytes) -> bytes:
    answer = http.client.HTTPResponse(Spoken(HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + data))  # type: ignore[arg-type]
    answer.begin()
    return answer.read()


@given(
    st.lists(st.tuples(st.binary(min_size=1, max_size=200), st.sampled_from([b"", b";a=b", b" ; x"])), max_size=8),
    st.sampled_from([1, 2, 3, 7, 64, 10_000]),
)
def test_chunks_are_joined_however_the_bytes_come(parts, size):
    data = b"".join(b"%X%s\r\n%s\r\n" % (len(body), extension, body) for body, extension in parts) + b"0\r\n\r\n"
    assert in_pieces(data, size) == (by_the_library(data), True)


def test_a_stream_whose_end_has_not_come_goes_on():
    assert in_pieces(b"5\r\nhello\r\n5\r\nwo", 1) == (b"hellowo", False)


@pytest.mark.parametrize(
    "data", [b"xyz\r\n", b"\r\n", b"-5\r\nhello", b"5\r\nhelloworld\r\n", b"FFFFFFFF\r\n", b"5" * 2000, b"1 2\r\n"]
)
def test_what_are_no_chunks_is_refused(data):
    with pytest.raises(ProtocolError, match=r"size|behind a chunk") as caught:
        in_pieces(data, 64)
    assert caught.value.device == "camera"


def test_an_answer_says_whether_it_comes_in_chunks_and_a_compressed_one_is_refused():
    assert in_chunks("camera", "http://camera", HEAD + b"Transfer-Encoding: Chunked\r\n\r\n")
    assert not in_chunks("camera", "http://camera", HEAD + b"\r\n")
    with pytest.raises(ProtocolError, match="gzip"):
        in_chunks("camera", "http://camera", HEAD + b"Transfer-Encoding: gzip, chunked\r\n\r\n")
    with pytest.raises(ProtocolError, match="br"):
        in_chunks("camera", "http://camera", HEAD + b"Content-Encoding: br\r\n\r\n")
