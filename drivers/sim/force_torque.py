"""The simulated force/torque sensor, on the wrist or under the table."""

from __future__ import annotations

from collections import deque
from math import cos, sin, sqrt
from operator import gt

import numpy as np

from drivers.config import ForceTorqueConfig
from drivers.errors import DeviceTimeout
from drivers.interfaces import Description, ForceTorqueSensor
from drivers.sim.device import DeviceWorld, Simulated
from drivers.sim.faults import Guard, WrenchGuard
from drivers.sim.mismatch import ForceTorqueFigures
from mechanics.readings import Array, Status, WrenchReading

#: full scale (fx, fy, fz, tx, ty, tz) [N, N·m] of an ATI Gamma, calibration SI-130-10
RANGE = (130.0, 130.0, 400.0, 10.0, 10.0, 10.0)
#: readings that a tare averages
TARE_READINGS = 100
#: readings whose disturbances are drawn at once
BLOCK = 256


class Electronics:
    """From the load on a sensor to its digits: gain, zero, drift, warming, noise, full scale and quantisation.

    Gain, bias and the sensitivity to temperature are one sensor's, drawn once; drift and temperature walk.
    """

    def __init__(self, figures: ForceTorqueFigures, rate: float, rng: np.random.Generator):
        """``rate`` [Hz] is that of the readings."""
        own, self._rng = rng.spawn(2)
        self._noise = np.array(figures.noise)
        self._drift_step = np.repeat([figures.drift_force, figures.drift_torque], 3) / sqrt(30 * rate)
        self._warming_step = figures.temperature_walk / sqrt(60 * rate)
        self._gain = 1 + figures.gain_error * own.standard_normal(6)
        self._bias = np.repeat([figures.bias_force, figures.bias_torque], 3) * own.standard_normal(6)
        self._zero_by_kelvin = np.repeat(
            [figures.temperature_force, figures.temperature_torque], 3
        ) * own.standard_normal(6)
        self._gain_by_kelvin = figures.temperature_gain * own.standard_normal(6)
        resolution = np.array(figures.resolution)
        self._step = np.where(resolution > 0, resolution, 1.0)
        #: which axes are digital
        self._digital, self._all_digital = resolution > 0, bool((resolution > 0).all())
        self._any_digital = bool((resolution > 0).any())
        self._drift, self._warmth = self._bias, 0.0
        self._next = BLOCK
        #: whether the digits differ from the load at all; full scale aside
        self.perfect = not any(
            np.any(value)
            for name, value in figures
            if name not in ("latency", "dropout", "tool_mass", "tool_centre_mm", "tool_error")
        )

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Walk and noise anew, from ``rng``: the same sensor, its zero and its warmth as at the reset."""
        self._rng = rng
        self._drift, self._warmth, self._next = self._bias, 0.0, BLOCK

    def read(self, load: Array) -> tuple[Array, bool]:
        """Digits (6,) for a load (6,), and whether an axis was at full scale."""
        if not self.perfect:
            if self._next == BLOCK:
                self._draw()
            load = load * self._gains[self._next] + self._zeros[self._next]
            self._next += 1
        saturated = any(map(gt, map(abs, load.tolist()), RANGE))
        if saturated:
            load = np.clip(load, np.negative(RANGE), RANGE)
        if self._any_digital:
            digits = np.rint(load / self._step) * self._step
            load = digits if self._all_digital else np.where(self._digital, digits, load)
        return load, saturated

    def _draw(self) -> None:
        normal = self._rng.standard_normal((BLOCK, 13))
        drift = self._drift + np.cumsum(self._drift_step * normal[:, :6], axis=0)
        warmth = self._warmth + np.cumsum(self._warming_step * normal[:, 6:7], axis=0)
        self._zeros = drift + warmth * self._zero_by_kelvin + self._noise * normal[:, 7:]
        self._gains = self._gain * (1 + warmth * self._gain_by_kelvin)
        self._drift, self._warmth, self._next = drift[-1], float(warmth[-1, 0]), 0


class SimForceTorque(Simulated[WrenchReading], ForceTorqueSensor):
    """Six axes whose frame embeds the plane as the world does: plane x → X, plane y → Z, torque τ about −Y.

    On the wrist the load is the tool: its weight, and the fingers, which hand on what the go does to them. Under the
    table it is the table top, which hands on what stands on it. The sensor's own side carries no weight.
    """

    def __init__(self, name: str, config: ForceTorqueConfig, world: DeviceWorld):
        super().__init__(name, config.rate, world)
        self._config = config
        self._mount = (config.pose[0], config.pose[1], config.pose[2])
        self._recent: deque[Array] = deque(maxlen=TARE_READINGS)
        self._zero = np.zeros(6)
        self._set_up(np.random.default_rng(0))

    def _figures(self) -> ForceTorqueFigures:
        return self._world.profile.force_torque

    def _set_up(self, rng: np.random.Generator) -> None:
        figures = self._figures()
        self._electronics = Electronics(figures, self.rate, rng)
        self._recent.clear()
        self._zero = np.zeros(6)
        self._tool_mass = figures.tool_mass if self._config.mount == "wrist" else 0.0
        self._tool_x, self._tool_y = (v * 1e-3 for v in figures.tool_centre_mm)
        self._known_mass = self._tool_mass * (1 + figures.tool_error * float(rng.spawn(1)[0].standard_normal()))

    def describe(self) -> Description:
        """``extra`` holds the mount, the sensor's pose in the ee (wrist) or in W (table), and the tool.

        ``tool`` has the ``mass`` [kg] that was weighed and its ``centre`` [m] in the ee.
        """
        extra: dict = {"mount": self._config.mount, "pose": list(self._mount)}
        if self._known_mass:
            extra["tool"] = {"mass": self._known_mass, "centre": [self._tool_x, self._tool_y]}
        return Description(
            name=self.name,
            kind="force_torque",
            model="simulated six-axis sensor",
            backend="sim",
            serial=self._config.serial,
            frame=self.name,
            rate=self.rate,
            range=RANGE,
            resolution=self._figures().resolution,
            extra=extra,
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
        self._guard.restart()

    def restart(self, rng: np.random.Generator) -> None:
        """Begin a new epoch, untared, with a sensor drawn from the profile."""
        super().restart(rng)
        self._set_up(rng)

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Draw drift, warming and noise from ``rng`` from now on, from where they were at the reset.

        The zero jumps back by what it has drifted, and nobody is to take that for a fault or into a tare.
        """
        super().begin_trial(rng)
        self._electronics.begin_trial(rng)
        self._recent.clear()
        self._guard.restart()

    def _make_guard(self) -> Guard:
        figures = self._figures()
        perfect = Electronics(figures, self.rate, np.random.default_rng(0)).perfect
        return WrenchGuard(figures.noise, figures.resolution, perfect)

    def _read(self) -> WrenchReading:
        fx, fy, tau = self._planar()
        digits, saturated = self._electronics.read(np.array([fx, 0.0, fy, 0.0, -tau, 0.0]))
        self._recent.append(digits)
        return WrenchReading(self._stamp(Status.SATURATED if saturated else Status.OK), digits - self._zero)

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
            if self._tool_mass:
                weight = self._tool_mass * plant.scene.gravity
                lever = ex + c * self._tool_x - s * self._tool_y - x
                fy, tau = fy - weight, tau - lever * weight
        else:
            fx, fy, tau = plant.table_load(x, y)
        if angle:
            c, s = cos(angle), sin(angle)
            fx, fy = c * fx + s * fy, c * fy - s * fx
        return fx, fy, tau
