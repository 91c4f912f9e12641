"""Times of planning: each thing warmed up first, then repeated while a budget lasts; and a look inside a long run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Array
from planning.optimisers.base import Objective, Quadratic

#: a measurement is repeated for about so long [s], within these numbers of repetitions
BUDGET, MOST = 0.5, 300


def repeated(work: Callable[[], object], least: int, budget: float = BUDGET, warm: int = 1) -> Array:
    """Wall times [s] of ``work`` after ``warm`` unmeasured calls: at least ``least``, more where they are short."""
    for _ in range(warm):
        work()
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < least or (time.perf_counter() - begin < budget and len(times) < MOST):
        before = time.perf_counter()
        work()
        times.append(time.perf_counter() - before)
    return np.array(times)


class Watched:
    """An objective whose ``gradient`` calls are timed: the iterations of a plan that is measured as a whole.

    It offers no Adam of its own, so that Adam asks for each gradient.
    """

    def __init__(self, objective: Objective):
        self._objective = objective
        self.times: list[float] = []

    @property
    def start(self) -> Array:
        """As the objective's."""
        return self._objective.start

    @property
    def free(self) -> NDArray[np.bool_]:
        """As the objective's."""
        return self._objective.free

    def values(self, z: Array) -> Array:
        """As the objective's."""
        return self._objective.values(z)

    def gradient(self, z: Array) -> tuple[float, Array]:
        """As the objective's, timed."""
        begin = time.perf_counter()
        found = self._objective.gradient(z)
        self.times.append(time.perf_counter() - begin)
        return found

    def quadratic(self, z: Array) -> Quadratic:
        """As the objective's."""
        return self._objective.quadratic(z)


def apart(found: Any, reference: Any) -> float:
    """Largest difference of two arrays, relative to the largest of the reference."""
    reference = np.asarray(reference, float)
    scale = float(np.abs(reference).max()) or 1.0
    return float(np.abs(np.asarray(found, float) - reference).max()) / scale
