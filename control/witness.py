"""The force/torque sensor under the table, as a second witness of the force that the wrist measures."""

from __future__ import annotations

import numpy as np

from drivers.interfaces import ForceTorqueSensor
from estimation.force_torque import mean_wrench
from estimation.tool_identification import Agreement, under_table_check
from estimation.wrench_errors import ForceTorqueErrors
from mechanics import se2, wrench
from mechanics.readings import Array
from mechanics.task_plane import TaskPlane

#: a disagreement is what noise alone would bring about at one waypoint in ten thousand
SIGNIFICANCE = 1e-4
#: those of the sensor under the table
ERRORS = ForceTorqueErrors()


class TableWitness:
    """Compares what the fingers push down with what the table carries. It never ends a trial.

    ``sensor`` sits at ``X_W_s`` (3,); ``standing`` [N] is the weight of what stands on the table when it is zeroed, the
    extrinsic object's, ``held`` [N] that of the go; ``window_ns`` is how far back readings are averaged.
    """

    def __init__(self, sensor: ForceTorqueSensor, X_W_s: Array, held: float, standing: float, window_ns: int):
        self.sensor = sensor
        self._X_W_s, self._held, self._standing = np.asarray(X_W_s, float), held, standing
        self._window_ns = window_ns
        self._zero: tuple[int, Array] | None = None

    def zero(self, now_ns: int) -> bool:
        """Take the sensor's offset while nothing but the known weight stands on the table; False where it is silent."""
        found = self._reading(now_ns)
        self._zero = None
        if found is not None:
            standing = wrench.rotated(np.array([0.0, -self._standing, 0.0]), -self._X_W_s[2])
            self._zero = now_ns, found[0] - TaskPlane().wrench_to_spatial(standing)
        return self._zero is not None

    def compare(self, now_ns: int, wrench_on_go: Array, covariance: Array) -> Agreement | None:
        """What both sensors say at ``now_ns``, the arm at rest; None where this one has no trusted reading or no zero.

        ``wrench_on_go`` (3,) of the sensor on the go is the wrist's, axes of W, and ``covariance`` (2, 2) that of its
        force.
        """
        found = self._reading(now_ns)
        if found is None or self._zero is None or not np.isfinite(wrench_on_go).all():
            return None
        reading, count = found
        zeroed_ns, offset = self._zero
        tared, angle = reading - offset, float(self._X_W_s[2])
        load = TaskPlane().wrench_to_planar(tared)
        own = ERRORS.covariance(count, (now_ns - zeroed_ns) * 1e-9, load)[:2, :2]
        R = se2.rotation(angle)
        weight = self._held + self._standing
        return under_table_check(wrench_on_go, weight, tared, covariance + R @ own @ R.T, angle, SIGNIFICANCE)

    def _reading(self, now_ns: int) -> tuple[Array, int] | None:
        """Mean (6,) of the window before ``now_ns`` and how many readings it is of; None where none can be trusted."""
        readings = self.sensor.since(now_ns - self._window_ns)
        try:
            mean = mean_wrench(readings)
        except ValueError:
            return None
        return (mean, len(readings)) if np.isfinite(mean).all() else None
