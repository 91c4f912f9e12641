"""What `extrinsic bench planning` measures on: a problem with every objective on it, and what is known of it so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.bench.figures import Figure, figure_of
from mechanics.readings import Array
from planning.problem import Problem


@dataclass(frozen=True)
class Case:
    """A problem, every objective on it, where all begin, and the medians until now, by method and quantity.

    ``whole``: whole plans go through cvxpylayers.
    """

    problem: Problem
    objectives: dict[str, Any]
    start: Array
    runs: int
    whole: bool
    known: dict[tuple[str, str], float] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """K."""
        return self.problem.steps

    def figure(self, method: str, quantity: str, values: Any, unit: str, what: str = "") -> Figure:
        """A figure of a method, on this problem."""
        name = f"{method}, {self.problem.form.value} form, {self.steps} steps: {quantity}"
        found = figure_of(name, np.atleast_1d(values), unit, what)
        self.known[method, quantity] = found.median
        return found
