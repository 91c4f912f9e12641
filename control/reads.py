"""How an observer reads its devices, and what it has gone by: so that a recording can be read in the same way."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

from drivers.interfaces import ImagingSensor, Sensor
from mechanics.readings import GripperReading, ImageReading, PoseReading, Stamp, TagReading, WrenchReading

R = TypeVar("R", PoseReading, WrenchReading, GripperReading, ImageReading, TagReading)


class Read(NamedTuple):
    """A device was read: capture time [ns] and sequence number of the newest reading that was taken of it.

    Where none was taken, of that time and later, ``sequence`` is −1.
    """

    source: str
    capture_ns: int
    sequence: int


class Reads:
    """Reads devices, and remembers from `begin` to `end` what was read."""

    def __init__(self) -> None:
        self._taken: list[tuple[Sensor, Stamp]] | None = None

    def begin(self) -> None:
        """Remember what is read from now on."""
        self._taken = []

    def end(self) -> list[Read]:
        """What was read since `begin`, in its order."""
        taken, self._taken = self._taken or [], None
        return [Read(sensor.name, stamp.capture_ns, stamp.sequence) for sensor, stamp in taken]

    def latest(self, sensor: Sensor[R]) -> R:
        """As `Sensor.latest`."""
        reading = sensor.latest()
        self._take(sensor, reading.stamp)
        return reading

    def since(self, sensor: Sensor[R], capture_ns: int) -> list[R]:
        """As `Sensor.since`."""
        readings = sensor.since(capture_ns)
        self._take(sensor, readings[-1].stamp if readings else Stamp(capture_ns, capture_ns, -1, ""))
        return readings

    def capture(self, sensor: ImagingSensor[R]) -> R:
        """As `ImagingSensor.capture`."""
        reading = sensor.capture()
        self._take(sensor, reading.stamp)
        return reading

    def _take(self, sensor: Sensor[R], stamp: Stamp) -> None:
        if self._taken is not None:
            self._taken.append((sensor, stamp))
