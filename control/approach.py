"""Where a trial comes from and where its plan stands: the way into contact, and the anchor on table and object."""

from __future__ import annotations

import numpy as np

from control.monitor import touches_go
from mechanics import se2
from mechanics.readings import Array
from planning.plan import Plan

UP = np.array([0.0, 1.0])


def retreat(plan: Plan, step: int = 0) -> Array:
    """The unit vector (2,) in W along which the go leaves what it touches at a step, by the contacts' normals.

    Up where nothing is touched.
    """
    away = np.zeros(2)
    for c, (on, _by) in enumerate(plan.contact_bodies or ()):
        if touches_go(plan, c):  # normals point into the body acted on
            away += plan.contact_normals[step, c] * (1.0 if on == "go" else -1.0)
    size = float(np.linalg.norm(away))
    return UP if size < 1e-6 else away / size


def resting_eo(plan: Plan) -> Array | None:
    """X_W_eo (3,) where a trial finds the extrinsic object; None where the plan has none."""
    return None if plan.preload_eo is None else plan.preload_eo[0]


def anchored(plan: Plan, X_W_table: Array, X_W_eo: Array | None = None) -> Plan:
    """The plan for a table at ``X_W_table`` (3,) on which the extrinsic object was seen at ``X_W_eo`` (3,).

    Height and angle are the table's, which carries the object; along the table the plan stands where the object does.
    """
    planned = resting_eo(plan)
    if planned is None or X_W_eo is None:
        return plan.reanchored(X_W_table)
    along = se2.between(X_W_table, X_W_eo)[0] - planned[0]
    return plan.reanchored(se2.compose(X_W_table, np.array([along, 0.0, 0.0])))
