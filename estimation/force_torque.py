"""From a wrist force/torque reading to the wrench of the sensor on the grasped object.

Quasi-static: between the wrist sensor and the object there is only the gripper, so what the fingers do to the object
is the negative of what the tool side does to the sensor, moved to the grasp centre and turned into the axes of W.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mechanics import se2, wrench
from mechanics.contact import gravity_wrench
from mechanics.readings import Array, Status, WrenchReading
from mechanics.task_plane import TaskPlane


@dataclass(frozen=True)
class WristSensor:
    """Where a wrist force/torque sensor sits and what it reads at no load.

    ``X_ee_s`` (3,) is its pose in the end-effector; ``offset`` (3,) = (fx, fy, τ) [N, N, N·m] the planar reading at
    no load, in the sensor's frame. The tool (gripper and fingers) hangs on it with ``tool_mass`` [kg] at ``p_ee_tool``
    (2,) [m] in the end-effector: a weight that turns in the sensor's frame as the arm turns, which no tare takes out.
    """

    X_ee_s: Array
    offset: Array
    tool_mass: float = 0.0
    p_ee_tool: Array = field(default_factory=lambda: np.zeros(2))
    gravity: float = 9.81

    def wrench_on_go(self, reading: Array, X_W_ee: Array, p_W_grasp: Array) -> Array:
        """Wrench (fx, fy, τ) of the sensor on the go about the grasp centre, axes of W.

        ``reading`` (6,) is of the load side on the sensor (see `WrenchReading`), ``X_W_ee`` (3,) the measured pose of
        the end-effector, ``p_W_grasp`` (2,) the grasp centre in W.
        """
        X_W_s = se2.compose(X_W_ee, self.X_ee_s)
        on_sensor = wrench.rotated(TaskPlane().wrench_to_planar(reading) - self.offset, X_W_s[2])
        if self.tool_mass:
            on_sensor = on_sensor - self._tool_weight(X_W_ee)
        return wrench.about(-on_sensor, X_W_s[:2], p_W_grasp)

    def _tool_weight(self, X_W_ee: Array) -> Array:
        """The tool's weight on the sensor about its origin, axes of W."""
        lever = se2.transform(X_W_ee, self.p_ee_tool) - se2.compose(X_W_ee, self.X_ee_s)[:2]
        return gravity_wrench(self.tool_mass, lever, self.gravity)

    def reading_of(self, wrench_on_go_W: Array, X_W_ee: Array, p_W_grasp: Array) -> Array:
        """Planar reading (3,) in the sensor's frame, less its offset, that `wrench_on_go` turns into the wrench."""
        X_W_s = se2.compose(X_W_ee, self.X_ee_s)
        on_sensor = wrench.about(-wrench_on_go_W, p_W_grasp, X_W_s[:2])
        if self.tool_mass:
            on_sensor = on_sensor + self._tool_weight(X_W_ee)
        return wrench.rotated(on_sensor, -X_W_s[2])

    def zeroed(self, reading: Array, X_W_ee: Array, X_W_go: Array, grasp: Array, weight: FreeAirLoad) -> WristSensor:
        """The same sensor with its offset taken in free air, where it carries the go's known weight and nothing else.

        The weight stays in every later reading: it belongs to the go's balance, and a tare that took it out would
        make the fingers look unloaded (design §3).
        """
        p_W_grasp = se2.compose(X_W_go, grasp)[:2]
        expected = self.reading_of(weight.wrench_on_go(X_W_go, p_W_grasp), X_W_ee, p_W_grasp)
        return replace(self, offset=TaskPlane().wrench_to_planar(reading) - expected)


@dataclass(frozen=True)
class FreeAirLoad:
    """The weight of the grasped object: ``mass`` [kg] at ``p_com`` (2,) [m] in the go's frame, ``gravity`` [m/s²]."""

    mass: float
    p_com: Array
    gravity: float = 9.81

    def wrench_on_go(self, X_W_go: Array, p_W: Array) -> Array:
        """Wrench of the sensor on the go about ``p_W`` (axes of W) that carries the weight alone."""
        lever = se2.transform(X_W_go, self.p_com) - p_W
        return -gravity_wrench(self.mass, lever, self.gravity)


def mean_wrench(readings: list[WrenchReading]) -> Array:
    """Mean (6,) of the readings that can be trusted. Raises ValueError where there is none."""
    good = [reading.wrench for reading in readings if reading.stamp.status is Status.OK]
    if not good:
        raise ValueError(f"no trustworthy force/torque reading among {len(readings)}")
    return np.mean(good, axis=0)
