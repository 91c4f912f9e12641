"""Where an optimiser sets out: the skill's nominal trajectory, or one that is off it by a drawn error.

A first guess by hand is off by a millimetre or a newton, and by about as much for whole stretches of the motion. The
nominal trajectory, which a skill works out from its geometry, is so good that every optimiser ends beside it.
"""

from __future__ import annotations

import numpy as np

from mechanics.readings import Array
from planning import evaluation
from planning.errors import InfeasiblePlan
from planning.optimisers.base import Objective
from planning.optimisers.noise import coloured
from planning.problem import Problem

#: so many trajectories are drawn until one has a finite loss
TRIES = 1000


class NoStart(InfeasiblePlan):
    """Whatever was drawn off the nominal trajectory has an infinite loss: ``reason`` says why the last one has."""

    def __str__(self) -> str:
        return f"no start has a finite loss, in {TRIES} draws; the last: step {self.step}: {self.reason}"


def disturbed(
    problem: Problem, objective: Objective, rng: np.random.Generator, sigma: float, beta: float = 0.0
) -> Array:
    """Return z (K, 5) off the nominal trajectory by ``sigma`` (1σ, about mm and N) in every free variable.

    ``beta`` colours the error along the steps as samplers colour their noise; 0 is white. Trajectories are drawn until
    the loss is finite. Raises NoStart.
    """
    z = problem.start
    for _ in range(TRIES):
        z = problem.start + sigma * np.where(problem.free, coloured(rng, (1, *problem.free.shape), beta)[0], 0.0)
        if np.isfinite(objective.values(z[None])[0]):
            return z
    found = evaluation.refusal(problem, z)
    if found is None:  # the objective's backend has found no force, and the reference has
        raise NoStart(0, problem.contacts[0].name, np.nan, np.nan, reason="its programs were not solved")
    reason = found.reason or f"{found.contact} needs µ ≥ {found.need:.3g}, has {found.have:.3g}"
    raise NoStart(found.step, found.contact, found.need, found.have, by=found.by, reason=reason)
