"""JPEG pictures of cameras: decoded where they are whole, refused where a piece is missing."""

from __future__ import annotations

import re
import struct
from typing import cast

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.wire import pictures

_END = b"\xff\xd9"
#: within a scan's data nothing begins but restarts, tables and further scans; least of all another picture
_ALIEN = re.compile(rb"\xff[\xc0-\xc3\xc5-\xcf\xd8\xd9]")


def decoded(name: str, data: bytes, grey: bool = False) -> NDArray[np.uint8]:
    """The picture in ``data``: (h, w, 3) blue first, or (h, w) where ``grey``; never turned by what it says of itself.

    Raises ProtocolError, for the device ``name``, where it is no baseline JPEG, larger than `pictures.MOST`, cut short,
    spliced, or decodes with bytes too many or too few. Most decoders fill what is missing with grey and say nothing.
    """
    size = pictures.pixels(data) if data.startswith(b"\xff\xd8") else None
    if size is None or not 0 < size <= pictures.MOST:
        said = f"{len(data)} bytes that are no baseline JPEG" if size is None else f"a picture of {size} pixels"
        raise _damaged(name, said)
    whole = data.rstrip(b"\0\r\n")
    if not whole.endswith(_END):
        raise _damaged(name, "a picture whose end is missing")
    scan = _scan(whole)
    if scan is None or _ALIEN.search(whole, scan, len(whole) - len(_END)):
        raise _damaged(name, "a picture with a piece missing")
    try:
        image = simplejpeg.decode_jpeg(whole, "GRAY" if grey else "BGR")
    except ValueError as error:
        raise _damaged(name, f"a damaged picture: {error}") from error
    return cast("NDArray[np.uint8]", image[..., 0] if grey else image)


def _scan(data: bytes) -> int | None:
    """Where the first scan's data begins."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # filling
            at += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # without a length
            at += 2
        else:
            at += 2 + max(struct.unpack_from(">H", data, at + 2)[0], 2)
            if marker == 0xDA:
                return at
    return None


def _damaged(name: str, got: str) -> ProtocolError:
    return ProtocolError(name, "read a picture", got, "See to the camera's cable and network")
