"""What an MJPEG camera answers over HTTP, from the first line to the pixels."""

from __future__ import annotations

import re
from contextlib import suppress

import cv2
import numpy as np

from drivers.errors import ProtocolError
from drivers.real.chunked import ChunkedBody
from drivers.real.jpeg import decoded
from drivers.real.mjpeg import boundary, exposed_ns, in_chunks
from drivers.real.multipart import MultipartParser

WORDS = (
    b"--boundary\r\n", b"\r\n--boundary--\r\n", b"\r\n\r\n", b"Content-Length: 1073741824\r\n",
    b"Content-Length: 0\r\n", b"X-Timestamp: 1e400\r\n", b"multipart/x-mixed-replace;boundary=", b"HTTP/1.1 500 \r\n",
    b"\xff\xd8", b"\xff\xd9", b"\xff\xda", b"\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03", b"\xff\xc2",
    b"\xff\xe1\xff\xff", b"\xff\xd0", b"\xff",
)  # fmt: skip
_LARGEST = 1 << 20
_PIECES = (1, 7, 64, 1500, 1 << 16)


def pictures() -> list[bytes]:
    """In colour and in grey, small and with all a JPEG of a camera has."""
    scene = cv2.GaussianBlur(np.random.default_rng(4).integers(0, 256, (48, 64, 3), np.uint8), (0, 0), 2)
    made = [
        cv2.imencode(".jpg", scene, [cv2.IMWRITE_JPEG_QUALITY, 80]),
        cv2.imencode(".jpg", scene[..., 0], [cv2.IMWRITE_JPEG_QUALITY, 30]),
        cv2.imencode(".jpg", scene, [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]),
    ]
    return [data.tobytes() for _, data in made]


def answers() -> list[bytes]:
    """Of servers with and without lengths and times, each with a byte in front that says in which pieces it comes."""
    first, second, third = pictures()
    told = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=boundary\r\n\r\n--boundary\r\n"
    for picture in (first, second):
        head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\nX-Timestamp: 1700000000.25\r\n\r\n" % len(picture)
        told += head + picture + b"\r\n--boundary\r\n"
    bare = b'HTTP/1.1 200 OK\nContent-Type: multipart/x-mixed-replace; boundary="--boundary"\nX: y\n\n'
    for picture in (third, second):
        bare += b"--boundary\nContent-Type: image/jpeg\n\n" + picture + b"\n"
    head, _, body = told.partition(b"\r\n\r\n")
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(c), c) for c in (body[i : i + 300] for i in range(0, len(body), 300)))
    chunked = head + b"\r\nTransfer-Encoding: chunked\r\n\r\n" + chunks + b"0\r\n\r\n"
    return [b"\x04" + told, b"\x02" + told, b"\x03" + bare + b"--boundary--\r\n", b"\x03" + chunked]


def take_answer(data: bytes) -> None:
    """As `drivers.real.mjpeg` takes it: what is damaged is left out, and the next part is looked at."""
    size, data = _PIECES[(data[0] if data else 0) % len(_PIECES)], data[1:]
    end = re.search(rb"\r?\n\r?\n", data)
    at = len(data) if end is None else end.end()
    parser = MultipartParser("camera", boundary("camera", "http://camera", data[:at]), _LARGEST)
    body = ChunkedBody("camera", "read") if in_chunks("camera", "http://camera", data[:at]) else None
    for begin in range(at, len(data), size):
        piece = data[begin : begin + size]
        for part in parser.feed(piece if body is None else body.feed(piece)):
            told = exposed_ns(part)
            assert told is None or told > 0
            with suppress(ProtocolError):
                take_picture(part.data)


def take_picture(data: bytes) -> None:
    """In colour and in grey."""
    image = decoded("camera", data)
    assert image.dtype == np.uint8 and image.ndim == 3
    assert decoded("camera", data, grey=True).shape == image.shape[:2]
