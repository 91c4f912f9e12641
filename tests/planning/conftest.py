"""The scenes that the tests of this package share, and statics of both bodies by plain numpy."""

from types import SimpleNamespace

import numpy as np
import pytest

from mechanics.catalogue import load_object
from planning.skills.base import Extrinsic, Held, Scene

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
def scene_of(tall_box):
    """A scene with a shape of the catalogue on the table, or nothing."""

    def make(name=None, mass=None, mu_object=0.33, mu_ground=0.33):
        if name is None:
            return Scene(tall_box)
        shape = load_object(name)
        mass = shape.mass if mass is None else mass
        return Scene(tall_box, Extrinsic(shape.polygon.vertices, mass, mu_object, mu_ground))

    return make


@pytest.fixture(scope="session")
def statics():
    """Plain numpy statics, written without the package: balances of both bodies, and the finger's wrench."""

    def rotation(theta):
        return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])

    def cross(a, b):
        return a[0] * b[1] - a[1] * b[0]

    def force(plan, k, c):
        """The force (2,) in W of contact c on the body it acts on."""
        n = plan.contact_normals[k, c]
        return plan.contact_forces[k, c, 0] * n + plan.contact_forces[k, c, 1] * np.array([n[1], -n[0]])

    def balance(plan, k, body, com, mass, gravity):
        """Sum of weight and contact forces on a body at step k, and of their moments about the world's origin."""
        weight = np.array([0.0, -mass * gravity])
        total, moment = weight.copy(), cross(com, weight)
        for c, pair in enumerate(plan.contact_bodies):
            if body not in pair:
                continue
            sign = 1.0 if pair[0] == body else -1.0
            total += sign * force(plan, k, c)
            moment += sign * cross(plan.contact_points[k, c], force(plan, k, c))
        return np.array([*total, moment])

    def residual(plan, k, mass, gravity):
        """What the go's balance lacks at step k, about the world's origin: sensor, weight, contacts."""
        go, w = plan.go[k], plan.wrench[k]
        grasp = go[:2] + rotation(go[2]) @ plan.X_go_gocf[:2]
        sensor = np.array([*w[:2], w[2] + cross(grasp, w[:2])])
        return sensor + balance(plan, k, "go", go[:2] + rotation(go[2]) @ plan.com, mass, gravity)

    def eo_residual(plan, k, mass, gravity):
        """What the eo's balance lacks at step k, about the world's origin: weight, contacts."""
        return balance(plan, k, "eo", plan.eo[k, :2], mass, gravity)

    def sensor_wrench(K, go, grasp, ee):
        """K times the pose of ee in the grasp frame, turned to the axes of W."""
        angle = go[2] + grasp[2]
        origin = go[:2] + rotation(go[2]) @ np.asarray(grasp[:2])
        x = np.array([*(rotation(angle).T @ (ee[:2] - origin)), ee[2] - angle])
        w = K @ x
        return np.array([*(rotation(angle) @ w[:2]), w[2]])

    return SimpleNamespace(
        residual=residual, eo_residual=eo_residual, sensor_wrench=sensor_wrench, rotation=rotation, cross=cross
    )
