"""How a valid input is spoilt: flipped, cut, spliced, grown, its figures made extreme. Pure functions on bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from hypothesis import strategies as st

_BINARY = (
    *(bytes([value]) * size for value in (0x00, 0xFF) for size in (1, 4, 8)),
    *(number.to_bytes(4, "little") for number in (1, 2**31 - 1, 2**31)),
    *(number.to_bytes(8, "little") for number in (2**31, 2**63 - 1, 2**63)),
    *(struct.pack("<d", number) for number in (math.inf, -math.inf, math.nan, 1.7e308, 5e-324)),
)
_FIGURES = b"1e308 -1e308 1e-320 1e999 nan .nan -.inf NaN Infinity 0 -1 4294967296 9223372036854775808 0x1F 0o7".split()
_YAML = b"null ~ true '' \"\" [] {} [[]] &a *a <<: ? - : --- | > % @ ` \" ' \\ # !!python/object:x !!binary".split()
_UNICODE = b"\xef\xbb\xbf \xed\xa0\x80 \xc3 \xe2\x80\xa8 \xf0\x9f\xa4\x96 \xd9\xa3".split(b" ")
_LONG = (b"9" * 30, b"9" * 400, b"a" * 300, b"[" * 40, b"{a: " * 40, b"- " * 40, b"\n", b"  ", b"\t", b"\x0b")
_WORDS = (*_BINARY, *_FIGURES, *_YAML, *_UNICODE, *_LONG)

_STEP = struct.Struct("<BII")

STEPS = st.binary(max_size=6 * _STEP.size)
"""Up to six steps, of nine bytes each: one draw, because a case takes a millisecond and many are wanted."""


def spoilt(seeds: Sequence[bytes], which: int, steps: bytes, tokens: Sequence[bytes] = ()) -> bytes:
    """One of ``seeds`` after ``steps``; ``tokens`` are words of the format, to be put anywhere."""
    data = bytearray(seeds[which % len(seeds)])
    words = (*_WORDS, *tokens)
    for kind, a, b in _STEP.iter_unpack(steps[: len(steps) // _STEP.size * _STEP.size]):
        size = len(data)
        at, word = a % (size + 1), words[b % len(words)]
        match kind % 10:
            case 0 if size:  # one bit
                data[at % size] ^= 1 << (b % 8)
            case 1 if size:  # one byte
                data[at % size] = b % 256
            case 2:  # the end is missing
                del data[at:]
            case 3:  # a piece is missing
                del data[at : at + 1 + b % 64]
            case 4:  # a word over what stood there
                data[at : at + len(word)] = word
            case 5:  # a word between
                data[at:at] = word
            case 6:  # a piece of another input
                other = seeds[b % len(seeds)]
                begin = (b >> 8) % (len(other) + 1)
                data[at:at] = other[begin : begin + 1 + (b >> 16) % 256]
            case 7 if size:  # a piece again and again
                piece = bytes(data[at % size : at % size + 1 + (b >> 8) % 32])
                data[at:at] = piece * (1 + b % 64)
            case 8 if size:  # two pieces change places
                other_at = b % size
                here, there = data[at : at + 16], data[other_at : other_at + 16]
                data[at : at + 16], data[other_at : other_at + 16] = there, here
            case 9 if size:  # a digit, where there are figures
                digits = [i for i, c in enumerate(data[:4096]) if 0x30 <= c <= 0x39]
                if digits:
                    i = digits[a % len(digits)]
                    data[i : i + 1] = word if b % 2 else str(b)[: 1 + b % 9].encode()
            case _:
                pass
    return bytes(data)
