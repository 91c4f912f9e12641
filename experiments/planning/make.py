"""From a plan stage to a plan: what the skill is told of the scene, the task, the objective, and the plan itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np

from experiments import registries
from experiments.files import Resolved
from experiments.planning.schema import PlanStage
from experiments.provenance import provenance
from experiments.setup import GRAVITY, Believed
from mechanics.catalogue import ObjectModel
from planning.plan import Plan
from planning.problem import Problem
from planning.skills.base import Extrinsic, Held, Scene, SkillTask


def planning_scene(resolved: Resolved, known: Believed) -> Scene:
    """What skills are told: the grasped object in the fingers and the extrinsic one, with what is believed of them."""
    grasped, extrinsic = resolved.grasped, resolved.extrinsic
    held = Held(
        vertices=grasped.polygon.vertices,
        mass=grasped.mass,
        grasp=resolved.grasp,
        stiffness=known.stiffness,
        mu=known.friction["go-ground"],
        gravity=GRAVITY,
        rho=grasped.polygon.radius_of_gyration,
    )
    return Scene(held, None if extrinsic is None else _extrinsic(extrinsic, known.friction))


def _extrinsic(shape: ObjectModel, friction: dict[str, float]) -> Extrinsic:
    return Extrinsic(
        vertices=shape.polygon.vertices,
        mass=shape.mass,
        rho=shape.polygon.radius_of_gyration,
        mu_object=friction["go-eo"],
        mu_ground=friction["eo-ground"],
    )


def task(resolved: Resolved, stage: PlanStage, known: Believed) -> SkillTask:
    """What the planner is asked for.

    Raises ValueError naming the parameter that the geometry does not allow, and InfeasiblePlan.
    """
    return registries.skills()[stage.skill].task(
        stage.skill_parameters,
        planning_scene(resolved, known),
        form=stage.planner_form(),
        weights=stage.loss_weights(),
        limits=stage.limits.limits(),
    )


def objective(backend: str) -> Callable[[Problem], Any]:
    """What makes the loss of a problem, its programs solved by ``backend``."""
    if backend == "fused":
        from planning.fused.objective import FusedObjective

        return FusedObjective
    from planning.objective import TorchObjective

    return lambda problem: TorchObjective(problem, backend)


def generator(resolved: Resolved, stage: PlanStage) -> np.random.Generator:
    """A plan's random numbers: first its start, then the optimiser's. They follow seed and name, nothing else."""
    return np.random.default_rng([resolved.experiment.seed, crc32(stage.name.encode())])


def try_start(resolved: Resolved, stage: PlanStage, made_of: SkillTask) -> None:
    """Draw the start that `make` will draw. Raises `experiments.planning.start.NoStart`."""
    from experiments.planning.start import disturbed

    if stage.start.sigma:
        loss = objective("fused")(made_of.problem)
        disturbed(made_of.problem, loss, generator(resolved, stage), stage.start.sigma, stage.start.beta)


def make(resolved: Resolved, stage: PlanStage, known: Believed, made_of: SkillTask | None = None) -> Plan:
    """The plan of a stage, ``made_of`` its `task`; the same seed gives the same plan.

    Raises InfeasiblePlan and ValueError.
    """
    from experiments.planning.start import disturbed
    from planning.planner import plan

    asked = task(resolved, stage, known) if made_of is None else made_of
    away = partial(disturbed, sigma=stage.start.sigma, beta=stage.start.beta)
    told = stage.model_dump(mode="json", include={"parameters", "backend", "limits", "start"})
    return plan(
        asked,
        stage.name,
        optimiser=stage.make_optimiser(),
        objective=objective(stage.backend),
        start=away if stage.start.sigma else None,
        rng=generator(resolved, stage),
        provenance={"experiment": resolved.experiment.name, "seed": resolved.experiment.seed, **told, **provenance()},
    )


def resting_eo(asked: SkillTask) -> tuple[float, float, float] | None:
    """X_W_eo where a trial of the task finds the extrinsic object; None where there is none."""
    if asked.problem.eo_body is None:
        return None
    x, y, theta = (asked.rest or asked.problem).eo[0].tolist()
    return x, y, theta
