"""A plan written by hand, so that what controllers make of it can be worked out by hand too."""

import numpy as np
import pytest

from mechanics.friction import Mode
from planning.plan import Plan

K = np.diag([2000.0, 1000.0, 4.0])


@pytest.fixture
def plan():
    """Two waypoints of a weightless object on one corner at the origin, 4 N of normal force, grasp 0.1 m above it."""
    go = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]])
    ee = np.array([[0.0, 0.096, 0.0], [0.001, 0.096, 0.1]])
    wrench = np.array([[0.0, -4.0, 0.0]] * 2)
    return Plan(
        name="hand",
        skill="grasped_pivoting",
        planner="hand",
        X_go_gocf=np.array([0.0, 0.1, 0.0]),
        stiffness=K,
        mass=0.0,
        com=np.zeros(2),
        gravity=9.81,
        ee=ee,
        go=go,
        eo=None,
        wrench=wrench,
        contact_names=("corner",),
        contact_points=np.zeros((2, 1, 2)),
        contact_normals=np.tile([0.0, 1.0], (2, 1, 1)),
        contact_forces=np.tile([4.0, 0.0], (2, 1, 1)),
        contact_modes=((Mode("stick"),), (Mode("stick"),)),
        contact_mu=np.array([0.33]),
        preload_ee=ee[:1],
        preload_go=go[:1],
        preload_wrench=wrench[:1],
        unload_ee=ee[1:],
        unload_go=go[1:],
        unload_wrench=wrench[1:],
    )
