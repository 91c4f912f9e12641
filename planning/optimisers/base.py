"""What an optimiser is, and what it may ask of a problem."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Array


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The Gauss–Newton model at a point: ``value``, ``gradient`` (K, D), and JᵀJ·2 as a symmetric block tridiagonal:
    ``diagonal`` (K, D, D) and ``below`` (K−1, D, D), the block of row k+1 and column k."""

    value: float
    gradient: Array
    diagonal: Array
    below: Array


class Objective(Protocol):
    """A loss over z (K, D); variables that are not free stay as they are in ``start`` and have no gradient."""

    @property
    def start(self) -> Array:
        """z (K, D) at the nominal values."""
        ...

    @property
    def free(self) -> NDArray[np.bool_]:
        """(K, D)."""
        ...

    def values(self, z: Array) -> Array:
        """The loss (B,) of ``z`` (B, K, D): +inf outside a barrier or where a program cannot be solved, never NaN."""
        ...

    def gradient(self, z: Array) -> tuple[float, Array]:
        """The loss and its gradient (K, D) at ``z`` (K, D)."""
        ...

    def quadratic(self, z: Array) -> Quadratic:
        """The Gauss–Newton model at ``z`` (K, D)."""
        ...


@dataclass(frozen=True, eq=False)
class Optimum:
    """What an optimiser found: ``z`` (K, D) with the least loss ``value`` that it saw, the ``curve`` of the loss per
    iteration, how often it asked for a whole trajectory (``queries``), and how it ended (``converged``, ``iterations``
    for a spent budget, ``stalled``). ``asked``, as long as the curve, is how often it had asked by each of its entries;
    empty where that is not known."""

    z: Array
    value: float
    curve: Array
    queries: int
    time_s: float
    status: str = "iterations"
    asked: tuple[int, ...] = ()


@dataclass
class Optimiser(ABC):
    """A method with its settings. The same ``rng`` gives the same answer."""

    name: ClassVar[str]

    @abstractmethod
    def optimise(self, objective: Objective, z: Array, rng: np.random.Generator) -> Optimum:
        """Improve ``z`` (K, D). Raises ValueError where the loss is not finite at ``z``."""


#: every optimiser by name
OPTIMISERS: dict[str, type[Optimiser]] = {}


Kind = TypeVar("Kind", bound=type[Optimiser])


def register(optimiser: Kind) -> Kind:
    """Class decorator: enter an optimiser under its name."""
    if optimiser.name in OPTIMISERS:
        raise ValueError(f"optimiser '{optimiser.name}' is registered twice: {OPTIMISERS[optimiser.name]}, {optimiser}")
    OPTIMISERS[optimiser.name] = optimiser
    return optimiser
