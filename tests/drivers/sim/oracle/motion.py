"""Quintic ramps of the end-effector, as the controllers drive it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np


def tell(figures: str) -> None:
    """A line for whoever runs the tests with ``-s`` to read the figures."""
    sys.stdout.write(figures + "\n")


class Hand:
    """Moves a plant's end-effector along straight quintic ramps, with its velocity fed forward."""

    def __init__(self, plant: Any):
        self.plant, self.at = plant, np.array(plant.ee_pose)

    def ramp(self, goal, seconds: float, half_way: Callable[[], object] = lambda: None) -> None:
        """Go to X_W_ee (3,), and call ``half_way`` where it is fastest."""
        start, n = self.at, round(seconds / self.plant.timestep)
        step = np.asarray(goal, float) - start
        for i in range(1, n + 1):
            s = i / n
            place = s**3 * (10 - 15 * s + 6 * s * s)
            speed = 30 * s * s * (1 - s) ** 2 / seconds
            self.plant.step(tuple((start + place * step).tolist()), tuple((speed * step).tolist()))
            if i == n // 2:
                half_way()
        self.at = start + step

    def rest(self, seconds: float) -> None:
        """Stay."""
        for _ in range(round(seconds / self.plant.timestep)):
            self.plant.step(tuple(self.at.tolist()), (0.0, 0.0, 0.0))
