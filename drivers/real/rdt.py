"""ATI's Raw Data Transfer (RDT): the datagrams that a Net F/T box takes and gives out (UDP port 49152, big-endian).

A request is 8 bytes: 0x1234, a command, the number of records that are wanted (0: until told to stop). A record is 36
bytes: its number in the stream, the number of the measurement behind it, the status word, and six axes in counts. Both
numbers are of 32 bits and wrap around. There is no checksum but UDP's own.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

PORT = 49152
HEADER = 0x1234
_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">III6i")
RECORD_SIZE = _RECORD.size
#: records that a box puts into one datagram at most
MOST_RECORDS = 40


class Command(enum.IntEnum):
    """What a request asks for. BIAS makes the present load the box's own zero, for whoever reads it."""

    STOP = 0x0000
    START = 0x0002
    START_BUFFERED = 0x0003
    BIAS = 0x0042


class Record(NamedTuple):
    """One measurement as the box sends it: ``counts`` are Fx, Fy, Fz, Tx, Ty, Tz."""

    rdt_sequence: int
    ft_sequence: int
    status: int
    counts: tuple[int, int, int, int, int, int]


def request(command: Command, count: int = 0) -> bytes:
    """The datagram that asks a box for ``command``."""
    return _REQUEST.pack(HEADER, command, count)


def decode(datagram: bytes, records: int = 1) -> list[Record]:
    """The ``records`` of one datagram, oldest first. Raises ValueError for one of another length."""
    if len(datagram) != records * RECORD_SIZE:
        raise ValueError(f"{len(datagram)} bytes, where {records} records of {RECORD_SIZE} bytes were expected")
    return [Record(row[0], row[1], row[2], row[3:]) for row in _RECORD.iter_unpack(datagram)]


# -- the status word ---------------------------------------------------------------------------------------------------

SUMMARY = 1 << 31
SATURATED = 1 << 17

STATUS_BITS: dict[int, str] = {
    30: "CPU or RAM error",
    29: "digital board error",
    28: "analog board error",
    27: "serial link between the boards failed",
    26: "program memory failed verification",
    25: "halted by configuration errors",
    24: "settings failed validation",
    23: "configuration does not suit the calibration",
    22: "network communication failure",
    21: "CAN communication error",
    20: "RDT communication error",
    19: "EtherNet/IP failure",
    18: "DeviceNet failure",
    17: "transducer saturated, or A/D error",
    16: "a monitored threshold was crossed",
    14: "watchdog timeout",
    13: "stack check error",
    12: "settings memory (I2C) failed",
    11: "flash memory (SPI) failed",
    10: "analog board watchdog timeout",
    9: "strain gage excitation current too high",
    8: "strain gage excitation current too low",
    7: "artificial analog ground out of range",
    6: "analog board supply too high",
    5: "analog board supply too low",
    4: "no data on the serial link",
    3: "reference voltage or power monitoring error",
    2: "internal temperature error",
    1: "HTTP failure",
}
"""What the bits of the status word say (manual 9610-05-1022, *System status code*)."""

#: what has no part in the wrench: a threshold that somebody set, and the networks beside this one
HARMLESS = sum(1 << bit for bit in (16, 18, 19, 21, 1))


def faults(status: int) -> int:
    """The bits of ``status`` by which a reading is not to be trusted; saturation among them."""
    bad = status & ~HARMLESS & ~SUMMARY
    told = status & (HARMLESS | bad)
    return bad if told else status & SUMMARY  # the summary says no more than the bits it sums up


def told(status: int) -> tuple[str, ...]:
    """What a status word says, in words; () where all is well."""
    words = [STATUS_BITS.get(bit, f"status bit {bit}") for bit in range(30, -1, -1) if status >> bit & 1]
    return tuple(words) if words or not status else ("an error that has no bit of its own",)


# -- the stream --------------------------------------------------------------------------------------------------------


class Verdict(enum.Enum):
    """What a record is to the stream: it begins it, goes on with it, begins another, or is to be dropped.

    REPEATED: a new record of the measurement before. LATE: overtaken by a newer one. STRAY: its numbers have nothing
    to do with the stream's.
    """

    FIRST = enum.auto()
    NEXT = enum.auto()
    REPEATED = enum.auto()
    RESTARTED = enum.auto()
    DUPLICATE = enum.auto()
    LATE = enum.auto()
    UNCONFIRMED = enum.auto()
    STRAY = enum.auto()


#: a box measures 7000 times a second; between two records of a stream it does no more often than this
_MOST_AGED = 100_000


def _ahead(new: int, old: int) -> int:
    """How far ``new`` is ahead of ``old`` on the circle of 32 bits; negative: behind."""
    return (new - old + 0x80000000 & 0xFFFFFFFF) - 0x80000000


@dataclass
class Sequence:
    """Follows the numbers of a stream, as RFC 3550 (A.1) does: a jump is believed when two records in a row tell it.

    So a stream begins with its second record. ``dropout`` is how many records may be missing at once. ``step`` is by
    how many records the newest accepted one is ahead of the one before.
    """

    dropout: int = 3000
    step: int = 0
    _newest: tuple[int, int] | None = None
    _suspect: tuple[int, int] | None = None
    #: numbers that were passed over, in order
    _missing: dict[int, None] = field(default_factory=dict)

    def take(self, rdt: int, ft: int) -> Verdict:
        """Judge a record by its two numbers."""
        if self._newest is not None:
            step, aged = _ahead(rdt, self._newest[0]), _ahead(ft, self._newest[1])
            if 0 < step <= self.dropout and 0 <= aged <= _MOST_AGED * step:
                self._pass_over(self._newest[0], step)
                self.step, self._newest, self._suspect = step, (rdt, ft), None
                return Verdict.NEXT if aged else Verdict.REPEATED
            if -self.dropout <= step <= 0 and aged <= 0:
                if rdt not in self._missing:
                    return Verdict.DUPLICATE
                del self._missing[rdt]
                return Verdict.LATE
        suspect, self._suspect = self._suspect, (rdt, ft)
        if suspect is not None and _ahead(rdt, suspect[0]) == 1 and 0 <= _ahead(ft, suspect[1]) <= _MOST_AGED:
            verdict = Verdict.FIRST if self._newest is None else Verdict.RESTARTED
            self._missing.clear()
            self.step, self._newest, self._suspect = 1, (rdt, ft), None
            return verdict
        return Verdict.UNCONFIRMED if self._newest is None else Verdict.STRAY

    def _pass_over(self, old: int, step: int) -> None:
        for ahead in range(1, step):
            self._missing[(old + ahead) & 0xFFFFFFFF] = None
        while len(self._missing) > self.dropout:
            del self._missing[next(iter(self._missing))]
