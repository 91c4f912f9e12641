"""Profiles made of a few figures, worlds that have them, and what a figure says of samples."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
import pytest

from drivers.interfaces import ArmTarget
from drivers.sim.mismatch import Mismatch
from drivers.sim.world import World


def profile(**sections: Any) -> Mismatch:
    """A profile with these sections and nothing else."""
    return Mismatch.model_validate(sections)


def sigma_of(samples: np.ndarray) -> float:
    """Standard deviation about zero, which is what a figure of 1 sigma says."""
    return float(np.sqrt(np.mean(np.square(samples))))


def about(sigma: float, n: int) -> Any:
    """What the standard deviation of ``n`` normal draws may be: within four of its own standard errors."""
    return pytest.approx(sigma, rel=4 / sqrt(2 * n))


def device(world: World, name: str) -> Any:
    return world.devices[name]


def move(world: World, *poses: tuple[float, float, float], seconds: float = 0.3) -> None:
    """One motion to each pose, with a rest after it."""
    arm = device(world, "arm")
    with arm.lease("test"):
        for pose in poses:
            arm.command(ArmTarget(np.array(pose), np.zeros(3), seconds))
            world.advance(seconds + 0.2)
