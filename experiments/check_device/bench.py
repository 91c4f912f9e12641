"""What every step of a checklist works with, and what the device is heard to say for a while."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.config import DeviceConfig
from drivers.errors import DeviceTimeout
from drivers.interfaces import Description
from experiments.check_device.findings import Finding
from experiments.check_device.opening import Opened
from experiments.check_device.person import Person
from mechanics.readings import ImageReading, Stamp, Status, TagReading

#: a rate is what comes in this time [s]
SPAN = 2.0
#: the print of a reading in which nothing was seen
EMPTY = -1
#: a mean of what comes in this time is better than the noise [s]
MOMENT = 0.5


@dataclass(frozen=True)
class Heard:
    """What came in ``seconds``: the stamps, a ``print`` of each value, and what was lost or could not be read."""

    stamps: tuple[Stamp, ...]
    prints: tuple[int, ...]
    gaps: int
    corrupt: int
    seconds: float

    @property
    def rate(self) -> float:
        """Readings per second [Hz], by when they were measured; 0 for less than two."""
        if len(self.stamps) < 2:
            return 0.0
        return (len(self.stamps) - 1) / ((self.stamps[-1].capture_ns - self.stamps[0].capture_ns) * 1e-9)

    @property
    def ages(self) -> np.ndarray:
        """(n,) [s]: how old each reading was when it came."""
        return np.array([(stamp.receive_ns - stamp.capture_ns) * 1e-9 for stamp in self.stamps])

    @property
    def statuses(self) -> dict[str, int]:
        """How many readings were not OK, by the name of their status."""
        found = [stamp.status.name.lower() for stamp in self.stamps if stamp.status is not Status.OK]
        return {name: found.count(name) for name in sorted(set(found))}


@dataclass
class Bench:
    """The device on the bench, and who stands beside it.

    ``move`` says whether it may move, ``reference`` where the picture of an untouched finger goes.
    """

    opened: Opened
    person: Person
    move: bool = False
    reference: Path | None = None
    _heard: Heard | None = field(default=None, init=False)

    @property
    def device(self) -> Any:
        """The device, as its kind's interface."""
        return self.opened.device

    @property
    def config(self) -> DeviceConfig:
        """What the station file says of it."""
        return self.opened.config.devices[self.opened.name]

    def describe(self) -> Description:
        """What the device says of itself."""
        return self.opened.device.describe()

    def heard(self) -> Heard:
        """What the device says in `SPAN`, listened to once."""
        if self._heard is None:
            self._heard = self._listen(SPAN)
        return self._heard

    def _listen(self, seconds: float) -> Heard:
        device, stamps, prints = self.opened.device, list[Stamp](), list[int]()
        gaps, corrupt = device.gaps, device.corrupt

        def note(reading: Any) -> None:
            stamps.append(reading.stamp)
            prints.append(_print(reading))

        stop = device.listen(note)
        try:
            time.sleep(seconds)  # a rate is what comes in a span of time: to end it early would falsify it
        finally:
            stop()
        return Heard(tuple(stamps), tuple(prints), device.gaps - gaps, device.corrupt - corrupt, seconds)

    def gather(self, value: Callable[[Any], Any], seconds: float = MOMENT) -> np.ndarray:
        """The ``value`` of each reading of the next ``seconds`` (n, ...). Raises DeviceTimeout where none comes."""
        values = list[Any]()
        stop = self.opened.device.listen(lambda reading: values.append(value(reading)))
        try:
            time.sleep(max(seconds, 3.0 / self.config.rate))  # all of a span of time is asked for
        finally:
            stop()
        if not values:
            raise DeviceTimeout(self.opened.name, "read", f"nothing for {seconds:g} s", "Check its power and cable")
        return np.array(values)


def _print(reading: Any) -> int:
    """A number that is another for another value."""
    if isinstance(reading, ImageReading):
        return zlib.crc32(reading.image.tobytes())
    if isinstance(reading, TagReading):
        return (
            hash(tuple((tag.id, tag.corners.tobytes()) for tag in reading.detections)) if reading.detections else EMPTY
        )
    if hasattr(reading, "wrench"):
        return hash(reading.wrench.tobytes())
    return reading.stamp.capture_ns  # a position that rests is none that is stuck


@dataclass(frozen=True)
class Step:
    """One step: its ``name``, what a person is to ``look`` at, and what is done; ``asks``: it commands the device."""

    name: str
    look: str
    do: Callable[[Bench], Finding]
    asks: bool = False
