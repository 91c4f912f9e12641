"""The problem that `extrinsic bench planning` measures on: the pivoting pentagon, at any horizon and in either form."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from experiments import setup
from experiments.calibrate.store import Calibrations
from experiments.files import Resolved, load
from experiments.planning import start
from experiments.planning.make import planning_scene
from experiments.planning.schema import PlanStage
from mechanics.readings import Array
from planning.optimisers.base import Objective
from planning.problem import Form, LossWeights, Problem

EXPERIMENT = "extrinsic_pivoting"
#: how far off the nominal trajectory measurements begin, 1σ in units of z: about 1 mm, 1 N
AWAY = 0.1
#: by how much the estimate of the grasp moves between two re-plans, 1σ [m, m, rad]
GRASP_NOISE = np.array([2e-4, 2e-4, np.radians(0.2)])


@cache
def _resolved() -> Resolved:
    return load(EXPERIMENT)


def pivoting_pentagon(steps: int, form: Form) -> Problem:
    """The plan stage of the shipped experiment over ``steps``: the same motion, cut finer, by the paper's losses.

    The experiment also tracks the nominal tilt. With that, second order has next to nothing left to win.
    """
    from experiments import registries

    resolved = _resolved()
    stage = next(stage for stage in resolved.experiment.stages if isinstance(stage, PlanStage))
    skill = registries.skills()[stage.skill]
    parameters = stage.skill_parameters.model_copy(update={"steps": steps})
    scene = planning_scene(resolved, setup.believed(resolved, Calibrations()))
    return skill.task(parameters, scene, form=form, weights=LossWeights()).problem


def disturbed(problem: Problem, objective: Objective, rng: np.random.Generator, away: float = AWAY) -> Array:
    """z (K, 5) off the nominal trajectory by white noise of ``away`` (1σ), as `experiments.planning.start` draws it."""
    return start.disturbed(problem, objective, rng, away)


def regrasped(problem: Problem, rng: np.random.Generator) -> Problem:
    """The problem with the grasp where an estimator may have it next."""
    return replace(problem, grasp=np.asarray(problem.grasp) + GRASP_NOISE * rng.standard_normal(3))


def described(problem: Problem) -> str:
    """The problem in words."""
    resolved = _resolved()
    eo, mu = resolved.extrinsic, resolved.friction
    assert eo is not None
    angles = np.degrees(problem.eo[[0, -1], 2])
    wish, weights = problem.contacts[0].wish[0, 0], problem.weights
    return (
        f"{eo.name}, {eo.mass:g} kg, turned from {angles[0]:.3g}° to {angles[1]:.3g}° at {wish:.3g} N, µ "
        f"{mu['go-eo']:g} at the object and {mu['eo-ground']:g} at the ground, {problem.form.value} form, "
        f"the paper's losses (weights: cone {weights.cone:g}, smooth {weights.smooth:g}, force {weights.force:g}, "
        f"penetration {weights.penetration:g}, slack {weights.slack:g}), slack weight {problem.slack_weight:g} beside "
        f"U = 1 in the program, "
        f"from {AWAY:g} mm and {AWAY:g} N (1σ) off the skill's nominal trajectory"
    )
