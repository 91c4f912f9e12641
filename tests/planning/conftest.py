"""The scene that the tests of this package share: tall_box in the soft bubble, as the blueprint fixes them."""

from types import SimpleNamespace

import numpy as np
import pytest

from planning.skills.base import Held

BUBBLE_PRINTED = np.array([[2208.96, -143.31, 399.86], [-143.31, 1875.92, -313.57], [399.86, -313.57, 1608.49]])
RHO = 0.0448


@pytest.fixture(scope="session")
def tall_box():
    """tall_box in the soft bubble."""
    s = np.diag([1, 1, RHO])
    return Held(
        vertices=np.array([[-25, -73.45], [25, -73.45], [25, 73.45], [-25, 73.45]]) * 1e-3,
        mass=0.1,
        grasp=np.array([0.0, 0.045, 0.0]),
        stiffness=s @ BUBBLE_PRINTED @ s,
        mu=0.33,
    )


@pytest.fixture(scope="session")
def statics():
    """Plain numpy statics, written without the package: residual and sensor wrench of the go, about any point."""

    def rotation(theta):
        return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])

    def cross(a, b):
        return a[0] * b[1] - a[1] * b[0]

    def residual(plan, k, mass, gravity):
        """Sum of forces and of moments about the world's origin at step k: sensor, weight, contacts."""
        go, w = plan.go[k], plan.wrench[k]
        grasp = go[:2] + rotation(go[2]) @ plan.X_go_gocf[:2]
        force, moment = w[:2].copy(), w[2] + cross(grasp, w[:2])
        com = go[:2] + rotation(go[2]) @ plan.com
        weight = np.array([0.0, -mass * gravity])
        force += weight
        moment += cross(com, weight)
        for c in range(len(plan.contact_names)):
            n = plan.contact_normals[k, c]
            t = np.array([n[1], -n[0]])
            f = plan.contact_forces[k, c, 0] * n + plan.contact_forces[k, c, 1] * t
            force += f
            moment += cross(plan.contact_points[k, c], f)
        return np.array([*force, moment])

    def sensor_wrench(K, go, grasp, ee):
        """K times the pose of ee in the grasp frame, turned to the axes of W."""
        angle = go[2] + grasp[2]
        origin = go[:2] + rotation(go[2]) @ np.asarray(grasp[:2])
        x = np.array([*(rotation(angle).T @ (ee[:2] - origin)), ee[2] - angle])
        w = K @ x
        return np.array([*(rotation(angle) @ w[:2]), w[2]])

    return SimpleNamespace(residual=residual, sensor_wrench=sensor_wrench)
