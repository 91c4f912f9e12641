"""Optimisers of contact trajectories, behind one interface and by name."""

from planning.optimisers.base import OPTIMISERS, Objective, Optimiser, Optimum, Quadratic
from planning.optimisers.gradient import Gradient
from planning.optimisers.icem import ICEM, Elites
from planning.optimisers.lm import LevenbergMarquardt, Warm
from planning.optimisers.mppi import MPPI

__all__ = [
    "ICEM",
    "MPPI",
    "OPTIMISERS",
    "Elites",
    "Gradient",
    "LevenbergMarquardt",
    "Objective",
    "Optimiser",
    "Optimum",
    "Quadratic",
    "Warm",
]
