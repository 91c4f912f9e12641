"""A held polygon on one corner on the ground, by hand: a linear spring, the balance of three, and Coulomb's law.

Quasi-static and without anything of the package: what laws are tested against.
"""

import numpy as np
from scipy.optimize import root


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


class CornerPlant:
    """``K`` (3, 3) of the spring between ee and the go at ``grasp`` (3,), the true ones; ``corner`` (2,) in the go's
    frame; ``mu`` of the ground y = 0. `go` (3,) and `force` (2,) of the ground on the go after the last `move`."""

    def __init__(self, K, grasp, corner, mu, mass, gravity=9.81):
        self.K, self.grasp, self.corner, self.mu = np.array(K), np.array(grasp), np.array(corner), mu
        self.weight = np.array([0.0, -mass * gravity])
        self.ee = self.place = None  # where the corner touched first, or has slipped to

    def wrench(self, go, ee):
        """(3,) of the spring on the go about the grasp centre, axes of W."""
        angle = go[2] + self.grasp[2]
        centre = go[:2] + turn(go[2]) @ self.grasp[:2]
        x = np.append(turn(angle).T @ (ee[:2] - centre), ee[2] - angle)
        w = self.K @ x
        return np.append(turn(angle) @ w[:2], w[2])

    def _lacks(self, go, ee, point):
        """Ground force that balances the forces, and what the moments about the grasp centre lack then."""
        w, centre = self.wrench(go, ee), go[:2] + turn(go[2]) @ self.grasp[:2]
        f = -(w[:2] + self.weight)
        return f, w[2] + cross(go[:2] - centre, self.weight) + cross(point - centre, f)

    def _at(self, place, theta):
        return np.append(np.array([place, 0.0]) - turn(theta) @ self.corner, theta)

    def hang(self, ee):
        """The go (3,) in free air."""

        def lacks(go):
            w, centre = self.wrench(go, ee), go[:2] + turn(go[2]) @ self.grasp[:2]
            return [*(w[:2] + self.weight), (w[2] + cross(go[:2] - centre, self.weight)) * 10]

        angle = ee[2] - self.grasp[2]
        found = root(lacks, np.append(ee[:2] - turn(angle) @ self.grasp[:2], angle), tol=1e-12)
        assert found.success
        return found.x

    def move(self, ee, steps=20):
        """Take the ee to a pose along a straight line; the corner sticks, slips, or leaves the ground."""
        ee = np.array(ee, float)
        before = ee if self.ee is None else self.ee
        for s in np.linspace(0, 1, steps + 1)[1:]:
            self._step(before + s * (ee - before))
        self.ee = ee

    def _step(self, ee):
        air = self.hang(ee)
        tip = air[:2] + turn(air[2]) @ self.corner
        if tip[1] >= 0:
            self.go, self.force, self.place = air, np.zeros(2), None
            return
        if self.place is None:
            self.place = tip[0]
        guess = air[2]
        stuck = root(lambda q: self._lacks(self._at(self.place, q[0]), ee, np.array([self.place, 0.0]))[1], [guess])
        go = self._at(self.place, stuck.x[0])
        f = self._lacks(go, ee, np.array([self.place, 0.0]))[0]
        if abs(f[0]) > self.mu * f[1]:
            sign = np.sign(f[0])

            def lacks(q):
                f, torque = self._lacks(self._at(q[0], q[1]), ee, np.array([q[0], 0.0]))
                return [f[0] - sign * self.mu * f[1], torque * 10]

            slid = root(lacks, [self.place, stuck.x[0]])
            assert slid.success
            self.place = slid.x[0]
            go = self._at(self.place, slid.x[1])
            f = self._lacks(go, ee, np.array([self.place, 0.0]))[0]
        self.go, self.force = go, f
