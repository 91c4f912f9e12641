"""A plan of one step from what the independent quasi-static solver found."""

from typing import Any

import numpy as np

from mechanics.friction import Mode
from planning.plan import Plan
from tests.drivers.sim.oracle.cases import GRASP, soft_bubble


def plan_of(oracle, ee, modes):
    """The plan whose only step is what ``oracle`` holds with the ee at ``ee``; ``modes`` by (body, other)."""
    go, names, bodies, points, normals, forces = oracle.go, [], [], [], [], []
    for i, touch in enumerate(oracle.touches):
        along = np.array([touch.normal[1], -touch.normal[0]])
        names.append(f"{touch.body}-{touch.other}-{i}")
        bodies.append((touch.body, touch.other))
        points.append(touch.point)
        normals.append(touch.normal)
        forces.append([touch.force @ touch.normal, touch.force @ along])
    count = len(names)
    one: dict[str, Any] = dict.fromkeys(("ee", "preload_ee", "unload_ee"), np.asarray(ee)[None])
    one |= dict.fromkeys(("go", "preload_go", "unload_go"), go[None])
    one |= dict.fromkeys(("wrench", "preload_wrench", "unload_wrench"), oracle.wrench[None])
    has_eo = any("eo" in pair for pair in bodies)
    eo = oracle.eo[None] if has_eo else None
    one |= dict.fromkeys(("eo", "preload_eo", "unload_eo"), eo)
    return Plan(
        name="found",
        skill="any",
        planner="none",
        X_go_gocf=np.append(GRASP, 0.0),
        stiffness=np.array(soft_bubble()),
        mass=0.1,
        com=np.zeros(2),
        gravity=9.81,
        contact_names=tuple(names),
        contact_points=np.array(points).reshape(1, count, 2),
        contact_normals=np.array(normals).reshape(1, count, 2),
        contact_forces=np.array(forces).reshape(1, count, 2),
        contact_modes=(tuple(Mode(modes[pair]) for pair in bodies),),
        contact_mu=np.full(count, 0.33),
        contact_bodies=tuple(bodies),
        **one,
    )
