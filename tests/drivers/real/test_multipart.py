"""The parts of an MJPEG stream, in every dialect, whole or spoilt."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.real.multipart import MultipartParser

BODIES = [bytes(np.random.default_rng(i).integers(0, 256, 700 + 90 * i, np.uint8)) for i in range(4)]


def mjpg_streamer(bodies):
    """Delimiter after the header of the answer, and behind each part."""
    out = b"--boundarydonotcross\r\n"
    for body in bodies:
        out += b"Content-Type: image/jpeg\r\nContent-Length: %d\r\nX-Timestamp: 12.5\r\n\r\n" % len(body)
        out += body + b"\r\n--boundarydonotcross\r\n"
    return out


def delimiter_before_each(bodies):
    head = b"\r\n--frame\r\nContent-type: image/jpeg\r\ncontent-length:%d\r\nX-Timestamp: 12.5\r\n\r\n"
    return b"".join(head % len(body) + body for body in bodies) + b"\r\n--frame\r\n"


def without_length(bodies):
    return b"".join(b"--frame\r\nX-Timestamp: 12.5\r\n\r\n" + body + b"\r\n" for body in bodies) + b"--frame\r\n"


def bare_line_feeds(bodies):
    head = b"--frame\nContent-Length: %d\nX-Timestamp: 12.5\n\n"
    return b"".join(head % len(body) + body + b"\n" for body in bodies) + b"--frame\n"


def dashes_declared(bodies):
    """The boundary is declared as ``--frame`` and, against RFC 2046, no further dashes stand before it."""
    return delimiter_before_each(bodies)


def dashes_added(bodies):
    """The boundary is declared as ``--frame`` and, by RFC 2046, two more dashes stand before it."""
    return delimiter_before_each(bodies).replace(b"--frame", b"----frame")


DIALECTS = {
    mjpg_streamer: "boundarydonotcross",
    delimiter_before_each: "frame",
    without_length: "frame",
    bare_line_feeds: '"frame"',
    dashes_declared: "--frame",
    dashes_added: "--frame",
}


def parsed(data, boundary="frame", pieces=(1 << 20,), largest=1 << 20):
    parser, parts, at, i = MultipartParser("camera", boundary, largest), [], 0, 0
    while at < len(data):
        size = pieces[i % len(pieces)]
        parts += parser.feed(data[at : at + size])
        at, i = at + size, i + 1
    return parser, parts


@given(pieces=st.lists(st.integers(1, 900), min_size=1, max_size=20))
@pytest.mark.parametrize("dialect", DIALECTS, ids=lambda dialect: dialect.__name__)
def test_parts_come_whole_in_whatever_pieces_the_stream_comes(dialect, pieces):
    parser, parts = parsed(dialect(BODIES), DIALECTS[dialect], pieces)
    assert [part.data for part in parts] == BODIES
    assert {part.headers["x-timestamp"] for part in parts} == {"12.5"}
    assert parser.skipped == 0 and not parser.ended


def test_a_part_comes_as_soon_as_its_length_is_there():
    whole = delimiter_before_each(BODIES[:1])
    parser = MultipartParser("camera", "frame")
    assert parser.feed(whole[: -len(b"\r\n--frame\r\n") - 1]) == []
    (part,) = parser.feed(whole[-len(b"\r\n--frame\r\n") - 1 : -len(b"\r\n--frame\r\n")])
    assert part.data == BODIES[0]


def test_what_looks_like_a_delimiter_within_a_picture_is_none():
    bodies = [b"a--frame b", b"x\n--frameless\r\ny", b"z--frame\r\nz", b"--frame?"]
    _, parts = parsed(delimiter_before_each(bodies))
    assert [part.data for part in parts] == bodies


def test_a_part_that_another_cuts_short_is_what_there_is_of_it():
    first, second = delimiter_before_each(BODIES[:1]), delimiter_before_each(BODIES[1:2])
    _, parts = parsed(first[:400] + second)
    assert parts[0].data == BODIES[0][: 400 - first.index(BODIES[0])]
    assert parts[1].data == BODIES[1]


@pytest.mark.parametrize("error", [-300, -1, 1, 9, 400, 100_000])
def test_a_wrong_length_spoils_one_picture_and_no_other(error):
    length = b"content-length:%d"
    stream = delimiter_before_each(BODIES).replace(length % len(BODIES[1]), length % (len(BODIES[1]) + error))
    _, parts = parsed(stream)
    good = [data for part in parts if (data := part.data.removesuffix(b"\r")) in BODIES]
    assert good == [body for body in BODIES if body != BODIES[1] or error > 0]  # too long: the delimiter ends it


def test_garbage_between_parts_is_left_out_and_counted():
    garbage = bytes(range(256)) * 8
    stream = delimiter_before_each(BODIES).replace(b"\r\n--frame", garbage + b"\r\n--frame")
    parser, parts = parsed(stream)
    assert [part.data for part in parts] == BODIES
    assert parser.skipped == 5 * (len(garbage) + len(b"\r\n"))


def test_the_closing_delimiter_ends_the_stream():
    parser, parts = parsed(delimiter_before_each(BODIES)[:-2] + b"--\r\n" + delimiter_before_each(BODIES))
    assert len(parts) == len(BODIES) and parser.ended


@pytest.mark.parametrize(
    "stream",
    [
        b"--frame\r\nContent-Length: 1073741824\r\n\r\n",
        b"--frame\r\nContent-Length: 99999999999999999999999\r\n\r\n",
        b"--frame\r\n\r\n" + bytes(3 << 20),
        b"--frame\r\nX: " + b"a" * 10_000,
        bytes(3 << 20),
    ],
    ids=["announced", "figure without end", "endless part", "endless header", "no part at all"],
)
def test_what_exceeds_the_bounds_is_a_protocol_error(stream):
    with pytest.raises(ProtocolError, match="camera"):
        parsed(stream)


@pytest.mark.parametrize("size", [1 << 10, 1 << 16, 32 << 20])
def test_memory_is_bounded_by_the_largest_part(size):
    parser, piece = MultipartParser("camera", "frame", 1 << 20), bytes(size)
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError):
            parser.feed(b"--frame\r\n\r\n")
            while True:
                parser.feed(piece)
        assert tracemalloc.get_traced_memory()[1] < 3 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("boundary", ["", "--", "a" * 300])
def test_a_boundary_that_is_none_is_a_protocol_error(boundary):
    with pytest.raises(ProtocolError, match="boundary"):
        MultipartParser("camera", boundary)
