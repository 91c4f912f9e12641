"""Wrenches as a wrist sensor with noise would report them: drawn reading by reading, moved by hand."""

from __future__ import annotations

import numpy as np

from estimation.contact_wrench import EnvironmentWrench, wrist_covariance
from experiments.bench.contact import wrench_of

MU = 0.33
#: one reading of an ATI: 0.05 N and 2 N·mm; one camera period holds 33 of them
ATI = np.diag([0.05, 0.05, 0.002]) ** 2
READINGS = 33
#: the sensor is 200 mm above the grasp, and that is 45 mm above the centroid
SENSOR = np.array([0.0, 0.245, 0.0])


def covariance() -> np.ndarray:
    """Of the mean over a camera period, about the go's origin."""
    return wrist_covariance(ATI, SENSOR, np.zeros(2)) / READINGS


def measured(point, force, rng: np.random.Generator | None = None) -> EnvironmentWrench:
    """As the sensor has it; without ``rng`` there is no noise, though the covariance speaks of it."""
    wrench = wrench_of(np.asarray(point, float), np.asarray(force, float))
    if rng is not None:
        # noise is drawn where it arises, at the sensor, reading by reading
        shape = (*wrench.shape[:-1], READINGS, 3)
        noise = (rng.standard_normal(shape) * np.sqrt(np.diag(ATI))).mean(axis=-2)
        lever = SENSOR[:2]
        noise[..., 2] += lever[0] * noise[..., 1] - lever[1] * noise[..., 0]
        wrench = wrench + noise
    return EnvironmentWrench.of(wrench, covariance())
