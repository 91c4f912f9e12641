"""The simulated gripper, whose compliant fingers hold the grasped object."""

from __future__ import annotations

from math import isfinite

from drivers.config import GripperConfig
from drivers.errors import CommandRefused
from drivers.interfaces import Description, Gripper
from drivers.sim.device import DeviceWorld, Simulated
from drivers.sim.faults import Guard, MotionGuard
from drivers.sim.mismatch import Stream
from drivers.sim.model import HALF_DEPTH
from mechanics.readings import GripperReading

#: widest opening [m], largest and usual grasp force [N]
OPEN, STRONGEST, USUAL = 0.08, 70.0, 20.0

#: faster than this [m/s, N/s] no reading changes by itself; a command that asks for more than `SEEN` [m, N] shows
FASTEST, SEEN = (0.1, 100.0), (1e-4, 0.1)


class SimGripper(Simulated[GripperReading], Gripper):
    """Fingers that rest at once. A reset world begins with the go between them."""

    def __init__(self, name: str, config: GripperConfig, world: DeviceWorld):
        super().__init__(name, config.rate, world)
        self._config = config
        self._width, self._force = 2 * HALF_DEPTH, USUAL

    def describe(self) -> Description:
        """``range`` is the widest opening [m] and the largest force [N]."""
        return Description(
            name=self.name,
            kind="gripper",
            model="simulated two-finger gripper",
            backend="sim",
            serial=self._config.serial,
            frame=self.name,
            rate=self.rate,
            range=(OPEN, STRONGEST),
            resolution=(0.0, 0.0),
        )

    def restart(self, rng) -> None:
        """Begin a new epoch with the go in hand."""
        super().restart(rng)
        self._width, self._force = 2 * HALF_DEPTH, USUAL

    def grasp(self, force: float) -> None:
        """Close on what is between the fingers; where nothing is, they close fully and the reading says so."""
        self._need_connection("grasp")
        plant = self._world.plant(self.name, "grasp")
        if not (isfinite(force) and 0 < force <= STRONGEST):
            raise CommandRefused(self.name, "grasp", f"the force must be in (0, {STRONGEST:g}] N, it is {force:g}")
        holding = plant.grasp()
        self._width, self._force = (2 * HALF_DEPTH, force) if holding else (0.0, 0.0)

    def release(self) -> None:
        """Open the fingers; the go falls."""
        self._need_connection("release")
        self._world.plant(self.name, "release").release()
        self._width, self._force = OPEN, 0.0

    def _figures(self) -> Stream:
        return self._world.profile.gripper

    def _make_guard(self) -> Guard:
        return MotionGuard(FASTEST, SEEN, lambda: (self._width, self._force))

    def _read(self) -> GripperReading:
        return GripperReading(self._stamp(), self._width, self._force, self._world.plant(self.name, "read").held)
