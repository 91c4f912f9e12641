"""The simulated force/torque sensor, on the wrist or under the table."""

from __future__ import annotations

from collections import deque
from math import cos, sin

import numpy as np

from drivers.config import ForceTorqueConfig
from drivers.errors import DeviceTimeout
from drivers.interfaces import Description, ForceTorqueSensor
from drivers.sim.device import DeviceWorld, Simulated
from mechanics.readings import Array, Status, WrenchReading

#: full scale (fx, fy, fz, tx, ty, tz) [N, N·m] and resolution of an ATI Gamma, calibration SI-65-5
RANGE = (65.0, 65.0, 200.0, 5.0, 5.0, 5.0)
RESOLUTION = (1 / 80, 1 / 80, 1 / 40, 1 / 1333, 1 / 1333, 1 / 1333)
#: readings that a tare averages
TARE_READINGS = 100


class SimForceTorque(Simulated[WrenchReading], ForceTorqueSensor):
    """Six axes whose frame embeds the plane as the world does: plane x → X, plane y → Z, torque τ about −Y.

    On the wrist the load is the fingers, which hand on what the go does to them; under the table it is the table top,
    which hands on what stands on it. The sensor's own side carries no weight.
    """

    def __init__(self, name: str, config: ForceTorqueConfig, world: DeviceWorld):
        super().__init__(name, config.rate, world)
        self._config = config
        self._mount = (config.pose[0], config.pose[1], config.pose[2])
        self._recent: deque[Array] = deque(maxlen=TARE_READINGS)
        self._zero = np.zeros(6)

    def describe(self) -> Description:
        """``extra`` holds the mount and the sensor's pose in the ee (wrist) or in W (table)."""
        return Description(
            name=self.name,
            kind="force_torque",
            model="simulated six-axis sensor",
            backend="sim",
            serial=self._config.serial,
            frame=self.name,
            rate=self.rate,
            range=RANGE,
            resolution=RESOLUTION if self._noisy else (0.0,) * 6,
            extra={"mount": self._config.mount, "pose": list(self._mount)},
        )

    def tare(self) -> None:
        """Make the present load the zero: the mean of the newest readings, of the last 100 periods at most.

        The simulated world stands still meanwhile, so it cannot wait for readings to come. A reset undoes the tare.
        """
        self._need_connection("tare")
        self._world.plant(self.name, "tare")
        if not self._recent:
            raise DeviceTimeout(
                self.name, "tare", "no reading since the reset", "Let station time pass first: `clock.sleep(seconds)`"
            )
        self._zero = np.mean(self._recent, axis=0)

    def restart(self, rng: np.random.Generator) -> None:
        """Begin a new epoch, untared."""
        super().restart(rng)
        self._recent.clear()
        self._zero = np.zeros(6)

    @property
    def _noisy(self) -> bool:
        return self._world.profile.force_noise > 0 or self._world.profile.torque_noise > 0

    def _read(self) -> WrenchReading:
        fx, fy, tau = self._planar()
        raw = np.array([fx, 0.0, fy, 0.0, -tau, 0.0])
        if self._noisy:
            profile = self._world.profile
            sigma = np.repeat([profile.force_noise, profile.torque_noise], 3)
            raw += sigma * self._rng.standard_normal(6)
        status = Status.OK
        if abs(fx) > RANGE[0] or abs(fy) > RANGE[2] or abs(tau) > RANGE[4]:
            status = Status.SATURATED
            raw = np.clip(raw, np.negative(RANGE), RANGE)
        self._recent.append(raw)
        return WrenchReading(self._stamp(status), raw - self._zero)

    def _planar(self) -> tuple[float, float, float]:
        """The load on the sensor (fx, fy, τ) about its origin, in its frame."""
        plant = self._world.plant(self.name, "read")
        x, y, angle = self._mount
        if self._config.mount == "wrist":
            ex, ey, turned = plant.ee_pose
            c, s = cos(turned), sin(turned)
            x, y, angle = ex + c * x - s * y, ey + s * x + c * y, turned + angle
            grip = plant.grip
            fx, fy, tau = -grip.fx, -grip.fy, -grip.torque_about(x, y)
        else:
            fx, fy, tau = plant.table_load(x, y)
        if angle:
            c, s = cos(angle), sin(angle)
            fx, fy = c * fx + s * fy, c * fy - s * fx
        return fx, fy, tau
