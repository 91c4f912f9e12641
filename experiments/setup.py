"""From a resolved experiment to what the layers below work with: the scene, the tags, the weight, a skill's task."""

from __future__ import annotations

import numpy as np

from drivers.scene import Body, Scene, TagMount
from estimation.force_torque import FreeAirLoad
from experiments import registries
from experiments.files import Resolved
from experiments.schema import PlanStage
from mechanics import se2
from mechanics.camera import TagGeometry
from mechanics.elasticity import Elasticity
from planning.skills.base import Held
from planning.task import Task

GRAVITY = 9.81
#: height of the grasped object above the table before the first trial [m]
START_HEIGHT = 0.03


def free_air_load(resolved: Resolved) -> FreeAirLoad:
    """The weight of the grasped object, as the wrist sensor carries it."""
    return FreeAirLoad(resolved.grasped.mass, np.zeros(2), GRAVITY)


def tags(resolved: Resolved) -> dict[str, tuple[TagGeometry, ...]]:
    """The tags of each body: ``table`` from the station, ``go`` and ``eo`` from the objects."""
    found = {"table": tuple(_geometry(mount) for mount in resolved.station.table_tags)}
    for body, shape in (("go", resolved.grasped), ("eo", resolved.extrinsic)):
        tag = None if shape is None else shape.body(body)["tag"]
        found[body] = () if tag is None else (_geometry(TagMount.model_validate(tag)),)
    return found


def _geometry(mount: TagMount) -> TagGeometry:
    return TagGeometry(mount.id, mount.size, mount.pose, mount.height)


def scene(resolved: Resolved) -> Scene:
    """The initial scene: the grasped object upright in the fingers, clear of the table."""
    lowest = float(resolved.grasped.polygon.vertices[:, 1].min())
    upright = np.array([0.0, START_HEIGHT - lowest, 0.0])
    carried = free_air_load(resolved).wrench_on_go(upright, se2.compose(upright, resolved.grasp)[:2])
    start = Elasticity(resolved.sensor.stiffness).ee_pose(upright, resolved.grasp, carried)
    bodies = {
        role: None if shape is None else Body.model_validate(shape.body(role))
        for role, shape in (("go", resolved.grasped), ("eo", resolved.extrinsic))
    }
    return Scene.model_validate(
        {
            "grasped": bodies["go"],
            "extrinsic": bodies["eo"],
            "grasp": resolved.grasp.tolist(),
            "stiffness": resolved.sensor.stiffness.tolist(),
            "friction": resolved.friction,
            "start": start.tolist(),
            "gravity": GRAVITY,
        }
    )


def task(resolved: Resolved, stage: PlanStage) -> Task:
    """What the planner is asked for. Raises ValueError naming the parameter that the geometry does not allow."""
    held = Held(
        vertices=resolved.grasped.polygon.vertices,
        mass=resolved.grasped.mass,
        grasp=resolved.grasp,
        stiffness=resolved.sensor.stiffness,
        mu=resolved.friction["go-ground"],
        gravity=GRAVITY,
    )
    return registries.skills()[stage.skill].task(stage.skill_parameters, held)
