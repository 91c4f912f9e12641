"""What the simulated devices share: stamps, exact rates, and the wish for a scene."""

from __future__ import annotations

from abc import abstractmethod
from fractions import Fraction
from typing import Protocol, TypeVar

import numpy as np

from drivers.errors import DeviceTimeout
from drivers.interfaces import Sensor, _Stamped
from drivers.sim.mismatch import Mismatch
from drivers.sim.plant import Plant
from mechanics.readings import Stamp, Status

R = TypeVar("R", bound=_Stamped)


class DeviceWorld(Protocol):
    """What a simulated device needs of its world."""

    lockstep: bool
    profile: Mismatch

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


class Simulated(Sensor[R]):
    """A simulated sensor that samples the plant at its rate while it is open.

    In lockstep nothing arrives while somebody waits, so `latest` never waits.
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

    def restart(self, rng: np.random.Generator) -> None:
        """Begin a new epoch after the world was reset: sequence numbers start at 0 and old readings are gone."""
        self._forget()
        self._ticker.restart()
        self._sequence = 0
        self._rng = rng

    @property
    def count(self) -> int:
        """Readings produced since the world was reset."""
        return self._sequence

    def sample(self) -> None:
        """Called by the world after every step."""
        if self._ticker.due() and self._connected:
            self._push(self._read())

    def _stamp(self, status: Status = Status.OK) -> Stamp:
        now = self._world.now_ns()
        stamp = Stamp(now, now, self._sequence, self.frame, status)
        self._sequence += 1
        return stamp

    @abstractmethod
    def _read(self) -> R:
        """One reading of the present state, stamped."""

    def latest(self, timeout: float = 1.0) -> R:
        """The newest reading. Raises DeviceTimeout when none was taken since the reset."""
        self._need_connection("read")
        self._world.plant(self.name, "read")
        if self._world.lockstep and not self._readings:
            raise DeviceTimeout(
                self.name, "read", "no reading since the reset", "Let station time pass first: `clock.sleep(seconds)`"
            )
        return super().latest(timeout)

    def _open(self, timeout: float) -> None:
        self._forget()

    def _shut(self) -> None:
        pass
