"""What a zeroed wrist sensor still says wrong: noise, and what no mean takes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.force_torque import WristSensor
from mechanics.readings import Array

#: `ForceTorqueErrors.drift` is that of so many seconds
_DRIFT_TIME = 30.0


@dataclass(frozen=True)
class ForceTorqueErrors:
    """1 sigma of the errors of a planar reading (fx, fy, τ) [N, N, N·m], in the sensor's frame.

    ``noise`` of one reading; ``drift`` of the zero 30 s after it was taken, which grows with the root of time;
    ``gain``, the share of the load since then by which every axis may be wrong; ``tool``, the share of its weight by
    which the tool may be heavier than believed. The defaults are assumed, for a six-axis strain-gauge sensor of 130 N.
    """

    noise: tuple[float, float, float] = (0.03, 0.03, 0.0006)
    drift: tuple[float, float, float] = (0.05, 0.05, 0.0015)
    gain: float = 0.005
    tool: float = 0.02

    def covariance(self, readings: int, seconds: float, load: Array) -> Array:
        """Of the mean of ``readings``, ``seconds`` after the zero, (3, 3).

        ``load`` (3,) is what the sensor bears more than at its zero, in its frame.
        """
        noise = np.square(self.noise) / readings
        drift = np.square(self.drift) * max(seconds, 0.0) / _DRIFT_TIME
        return np.diag(noise + drift + np.square(self.gain * load))


@dataclass(frozen=True, eq=False)
class Zero:
    """When a wrist sensor was zeroed, and the pose (3,) of the end-effector in W there."""

    capture_ns: int
    X_W_ee: Array

    def covariance(
        self, errors: ForceTorqueErrors, wrist: WristSensor, capture_ns: int, X_W_ee: Array, load: Array, readings: int
    ) -> Array:
        """Of the mean of ``readings`` until ``capture_ns``, a planar reading in the sensor's frame: (3, 3).

        ``load`` (3,) is that of the go on the sensor. A tool of another weight than believed shows as the arm turns.
        """
        nothing, origin = np.zeros(3), np.zeros(2)
        turned = wrist.reading_of(nothing, X_W_ee, origin) - wrist.reading_of(nothing, self.X_W_ee, origin)
        seconds = (capture_ns - self.capture_ns) * 1e-9
        return errors.covariance(readings, seconds, load + turned) + errors.tool**2 * np.outer(turned, turned)
