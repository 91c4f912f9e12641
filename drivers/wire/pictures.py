"""How large a compressed picture says that it is, before anybody makes room for it."""

from __future__ import annotations

import struct
import zlib

MOST = 4096 * 4096
"""Pixels that a picture may have: the largest that a station file can ask for."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_CHUNKS = frozenset((b"IHDR", b"IDAT", b"IEND", b"pHYs", b"gAMA", b"sRGB", b"cHRM", b"sBIT", b"bKGD", b"tIME", b"tEXt"))
_BASELINE = (0xC0, 0xC1)  # frames of one pass; of progressive ones a small file can ask for hours
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a length


def pixels(data: bytes) -> int | None:
    """The pixels of a PNG or a baseline JPEG by its header; None for anything else."""
    if data.startswith(_PNG):
        return _png_pixels(data)
    return _jpeg_pixels(data) if data.startswith(_JPEG) else None


def _png_pixels(data: bytes) -> int | None:
    """Whole chunks only, and such as need no unpacking: OpenCV makes the room that a chunk's length asks for."""
    at = len(_PNG)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if kind not in _CHUNKS or end > len(data):
            return None
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return None
        if kind == b"IEND":
            break
        at = end
    if data[12:16] != b"IHDR" or len(data) < 26 or data[25] not in (0, 2):  # grey or colour
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return width * height


def _jpeg_pixels(data: bytes) -> int | None:
    at = len(_JPEG)
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # filling
            at += 1
        elif marker in _BARE:
            at += 2
        elif marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width * height if marker in _BASELINE else None
        else:
            at += 2 + max(struct.unpack_from(">H", data, at + 2)[0], 2)
    return None
