"""What the simulated devices share: stamps, exact rates, and the wish for a scene."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from fractions import Fraction
from typing import Protocol, TypeVar

import numpy as np

from drivers.errors import DeviceTimeout
from drivers.interfaces import _Stamped, freshness
from drivers.sim.faults import Faulty, Guard, guarded, received
from drivers.sim.mismatch import Lab, Mismatch, Stream
from drivers.sim.plant import Plant
from mechanics.readings import Stamp, Status

R = TypeVar("R", bound=_Stamped)


class DeviceWorld(Protocol):
    """What a simulated device needs of its world."""

    lockstep: bool
    profile: Mismatch
    #: what the profile comes to for the seed of the last reset
    lab: Lab

    @property
    def timestep_ns(self) -> int:
        """Length of a plant step [ns]."""
        ...

    def now_ns(self) -> int:
        """Present instant [ns]."""
        ...

    def plant(self, device: str, asked: str) -> Plant:
        """The plant. Raises DeviceFault, for ``device`` that ``asked``, while there is no scene."""
        ...


class Ticker:
    """Marks the steps in which a device samples: exactly ``rate`` [Hz] on average, by integers, without drift."""

    def __init__(self, rate: float, timestep_ns: int):
        share = Fraction(rate).limit_denominator(10**6) * timestep_ns / 10**9
        self._share, self._whole = share.numerator, share.denominator
        self.restart()

    def restart(self) -> None:
        """Start a new epoch: the first sample comes one period from now."""
        self._sum = 0

    def due(self) -> bool:
        """Whether the device samples in this step; called once per step."""
        self._sum += self._share
        if self._sum >= self._whole:
            self._sum -= self._whole
            return True
        return False


class Simulated(Faulty[R]):
    """A simulated sensor that samples the plant at its rate while it is open.

    In lockstep nothing arrives while somebody waits, so `latest` never waits. A reading that the profile or a fault
    drops leaves a gap in the sequence numbers; one that they delay keeps its capture time and arrives when it is due.
    """

    def __init__(self, name: str, rate: float, world: DeviceWorld):
        super().__init__(name)
        if rate * world.timestep_ns > 1e9:
            raise ValueError(
                f"devices.{name}.rate: {rate:g} Hz is faster than the world steps ({1e9 / world.timestep_ns:g} Hz); "
                f"lower the rate or world.timestep"
            )
        self.rate = rate
        #: frame of the values
        self.frame = name
        self._world = world
        self._ticker = Ticker(rate, world.timestep_ns)
        self._sequence = 0
        self._rng = np.random.default_rng(0)
        self._losses = self._rng
        self._under_way: deque[tuple[int, R]] = deque()
        self._link = Stream()
        self._guard = Guard()
        self._still = world.lockstep

    def _make_guard(self) -> Guard:
        """What looks over the device's readings before they are handed on."""
        return Guard()

    def _station_ns(self) -> int:
        return self._world.now_ns()

    def _figures(self) -> Stream:
        """What the profile does to this device's readings on their way."""
        return Stream()

    def restart(self, rng: np.random.Generator) -> None:
        """Begin a new epoch after the world was reset: sequence numbers start at 0 and old readings are gone."""
        self._forget()
        self._ticker.restart()
        self._sequence = 0
        # losses have numbers of their own, so that they change nothing of what is not lost
        self._rng, self._losses = rng, rng.spawn(1)[0]
        self._under_way.clear()
        self._link = self._figures()
        self._guard = self._make_guard()

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Draw what is lost on the way from ``rng`` from now on."""
        self._losses = rng.spawn(1)[0]

    @property
    def count(self) -> int:
        """Readings produced since the device began its present epoch."""
        return self._sequence

    def sample(self) -> None:
        """Called by the world after every step."""
        if self._under_way:
            self._deliver()
        if self._ticker.due() and self._connected:
            line, link = self.line, self._link
            if line.silent:
                return
            reading = guarded(self._guard, line.altered(self._read()))
            if (link.dropout and self._losses.random() < link.dropout) or line.loses():
                return
            latency = link.latency + line.delay
            if latency or self._under_way:
                due = self._world.now_ns() + round(latency * 1e9)
                # readings never overtake one another
                self._under_way.append((max(due, self._under_way[-1][0]) if self._under_way else due, reading))
            else:
                self._deliver_or_damage(reading)

    def _deliver(self) -> None:
        now = self._world.now_ns()
        while self._under_way and self._under_way[0][0] <= now:
            reading = self._under_way.popleft()[1]
            if self._connected and not self.line.silent:
                self._deliver_or_damage(received(reading, now))

    def _stamp(self, status: Status = Status.OK) -> Stamp:
        now = self._world.now_ns()
        stamp = Stamp(now, now, self._sequence, self.frame, status)
        self._sequence += 1
        return stamp

    @abstractmethod
    def _read(self) -> R:
        """One reading of the present state, stamped."""

    def latest(self, timeout: float = 1.0) -> R:
        """As `Sensor.latest`. Raises DeviceTimeout at once when none was taken since the reset."""
        self._need_connection("read")
        self._world.plant(self.name, "read")
        if self._world.lockstep and not self._readings and self._damaged is None:
            raise DeviceTimeout(
                self.name, "read", "no reading since the reset", "Let station time pass first: `clock.sleep(seconds)`"
            )
        return super().latest(timeout)

    def _open(self, timeout: float) -> None:
        self._forget()
        self._under_way.clear()
        self.max_age = freshness(self.rate)

    def _shut(self) -> None:
        self._under_way.clear()
