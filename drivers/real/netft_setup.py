"""How a Net F/T box is set up: its `netftapi2.xml`, fetched over HTTP and read as data from a stranger.

Every value is of the *active* configuration. The document is small, without DTD or entities; anything else is refused.
"""

from __future__ import annotations

import io
import math
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse
from typing import cast
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

PAGE = "/netftapi2.xml"
#: between two looks whether somebody still waits for the answer, and how long reaching the box may take [s]
_PATIENCE, _REACH = 0.2, 3.0
#: of a whole answer; a box's is about 4 kB
MOST_BYTES = 256 * 1024

_LBF = 4.4482216152605
_KGF = 9.80665
_INCH, _FOOT = 0.0254, 0.3048

#: N in each unit of force, by its name without signs between
FORCE_UNITS: dict[str, float] = {
    "lbf": _LBF,
    "n": 1.0,
    "klbf": 1e3 * _LBF,
    "kn": 1e3,
    "kgf": _KGF,
    "kg": _KGF,
    "gf": 1e-3 * _KGF,
    "g": 1e-3 * _KGF,
}
#: N·m in each unit of torque
TORQUE_UNITS: dict[str, float] = {
    "lbfin": _LBF * _INCH,
    "lbfft": _LBF * _FOOT,
    "nm": 1.0,
    "nmm": 1e-3,
    "kgfcm": _KGF * 0.01,
    "kgcm": _KGF * 0.01,
    "knm": 1e3,
}
#: the low-pass filter's cut-off [Hz] by its code; 0: none
FILTERS: dict[int, float] = {
    0: 0, 1: 838, 2: 326, 3: 152, 4: 73, 5: 35, 6: 18, 7: 8, 8: 5, 9: 1500, 10: 2000, 11: 2500, 12: 3000,
}  # fmt: skip


class SetupError(Exception):
    """The document says nothing that could be used; the message says what and where."""


class HttpError(Exception):
    """The answer was no document; the message says what came instead."""


@dataclass(frozen=True)
class BoxSetup:
    """What a box says of itself. ``force`` [N] and ``torque`` [N·m] are of one count.

    ``rate`` [Hz], ``records`` per datagram, ``filter`` [Hz] (0: none) and ``rdt`` (whether it is switched on) are None
    where the box does not tell. ``full_scale`` is of the six axes in counts, or (). ``bias`` and ``tool`` (offsets of
    the gages, the tool's transform) are its own words.
    """

    product: str
    serial: str
    firmware: str
    force: float
    torque: float
    rate: float | None
    records: int | None
    filter: float | None
    rdt: bool | None
    full_scale: tuple[float, ...]
    bias: str
    tool: str

    def differs(self, other: BoxSetup) -> tuple[str, ...]:
        """The names of what is not as in ``other``."""
        return tuple(name for name, value in vars(self).items() if value != getattr(other, name))


# -- the document ------------------------------------------------------------------------------------------------------


def parse(document: bytes) -> BoxSetup:
    """Read a `netftapi2.xml`. Raises SetupError for whatever does not say how counts become newtons."""
    try:
        root = cast("Element", fromstring(document, forbid_dtd=True))
    except DefusedXmlException as error:
        raise SetupError(f"a DTD or an entity, where a box sends none ({type(error).__name__})") from error
    except (ParseError, ValueError, LookupError) as error:  # the last two: an encoding that nobody knows
        raise SetupError(f"no XML: {str(error)[:100]}") from error
    fields = _fields(root)
    force_unit, torque_unit = _need(fields, "scfgfu"), _need(fields, "scfgtu")
    per_force, per_torque = (_positive(fields, name) for name in ("cfgcpf", "cfgcpt"))
    newton, newton_metre = _unit(force_unit, FORCE_UNITS, "scfgfu"), _unit(torque_unit, TORQUE_UNITS, "scfgtu")
    rate = next((_positive(fields, name) for name in ("comrdtrate", "commrdtrate") if name in fields), None)
    return BoxSetup(
        product=fields.get("prodname", ""),
        serial=fields.get("cfgcalsn", ""),
        firmware=fields.get("mfgdigver", ""),
        force=newton / per_force,
        torque=newton_metre / per_torque,
        rate=rate,
        records=_whole(fields, "comrdtbsiz"),
        filter=FILTERS.get(_whole(fields, "setuserfilter") or 0) if "setuserfilter" in fields else None,
        rdt=_switch(fields, "comrdte"),
        full_scale=_full_scale(fields, per_force, per_torque),
        bias=fields.get("setbias", ""),
        tool=fields.get("cfgtfx", ""),
    )


def _fields(root: Element) -> dict[str, str]:
    found: dict[str, str] = {}
    for element in root:
        name, text = element.tag.rpartition("}")[2].lower(), (element.text or "").strip()
        if name in found and found[name] != text:
            raise SetupError(f"<{name[:20]}> stands there twice, with two values")
        found[name] = text
    return found


def _need(fields: dict[str, str], name: str) -> str:
    if not fields.get(name):
        raise SetupError(f"<{name}> is missing")
    return fields[name]


def _positive(fields: dict[str, str], name: str) -> float:
    text = _need(fields, name)
    with suppress(ValueError):
        value = float(text) if text.isascii() and "_" not in text else math.nan
        if 1e-9 < value < 1e15:  # beyond, a count is nothing, or its reciprocal
            return value
    raise SetupError(f"<{name}> is {text[:40]!r}, not a positive number")


def _whole(fields: dict[str, str], name: str) -> int | None:
    text = fields.get(name)
    if text is None:
        return None
    if text.isascii() and text.isdecimal() and len(text) < 10:
        return int(text)
    raise SetupError(f"<{name}> is {text[:40]!r}, not a whole number")


def _switch(fields: dict[str, str], name: str) -> bool | None:
    words = {"enabled": True, "1": True, "disabled": False, "0": False}
    return words.get(fields.get(name, "").lower())


def _unit(name: str, units: dict[str, float], tag: str) -> float:
    plain = "".join(letter for letter in name.lower() if letter.isalpha())
    if plain not in units:
        raise SetupError(f"<{tag}> is {name[:40]!r}, a unit that nobody knows; known are {', '.join(units)}")
    return units[plain]


def _full_scale(fields: dict[str, str], per_force: float, per_torque: float) -> tuple[float, ...]:
    """The calibrated range in counts; () where it is not told, or belongs to another origin than the readings."""
    try:
        moved = any(float(value) for value in fields.get("cfgtfx", "").split(";") if value.strip())
        ratings = [float(value) for value in fields.get("cfgmr", "").split(";")]
    except ValueError:
        return ()
    if moved or len(ratings) != 6 or not all(0 < value < math.inf for value in ratings):
        return ()
    return tuple(value * (per_force if i < 3 else per_torque) for i, value in enumerate(ratings))


# -- over HTTP ---------------------------------------------------------------------------------------------------------


def fetch(address: str, port: int, deadline: float, cancelled: Callable[[], bool] = lambda: False) -> bytes:
    """The document of the box at ``address``, by the monotonic ``deadline`` [s] whatever the other side does.

    Raises OSError where nobody is reached, TimeoutError, HttpError for what is no document.
    """
    with socket.create_connection((address, port), timeout=min(_left(deadline), _REACH)) as link:
        link.sendall(f"GET {PAGE} HTTP/1.0\r\nHost: {address}\r\nConnection: close\r\n\r\n".encode())
        answer = bytearray()
        while not cancelled():
            link.settimeout(min(_left(deadline), _PATIENCE))
            with suppress(TimeoutError):
                piece = link.recv(65536)
                if not piece:
                    return document_of(bytes(answer))
                answer += piece
                if len(answer) > MOST_BYTES:
                    raise HttpError(f"more than {MOST_BYTES // 1024} kB came for {PAGE}")
    raise TimeoutError


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left


class _Received:
    """What has been received, in the form that the HTTP parser reads from."""

    def __init__(self, answer: bytes):
        self._answer = answer

    def makefile(self, *_: object) -> io.BytesIO:
        return io.BytesIO(self._answer)


def document_of(answer: bytes) -> bytes:
    """The body of a whole HTTP answer. Raises HttpError for one that is no document."""
    response = HTTPResponse(cast("socket.socket", _Received(answer)), method="GET")
    try:
        response.begin()
        if response.status != 200:
            raise HttpError(f"HTTP {response.status} for {PAGE}")
        return response.read()
    except (HTTPException, ValueError, OverflowError) as error:
        raise HttpError(f"no whole HTTP answer for {PAGE} ({type(error).__name__})") from error
    finally:
        response.close()
