"""The plant of the hand-written plan: a weightless object on a corner at the origin, by two equations at most."""

import numpy as np
from scipy.optimize import root

from mechanics.records import PlanarState


def turned(angle, vector):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


class OnCorner:
    """Springs ``K`` hold the object at (0, 0.1) in its frame, off by ``lies`` (3,); its origin is the corner.

    The corner stays where it is, or, with ``mu``, is dragged to the right. ``felt`` (3,) is what the go's pose is
    believed to be off.
    """

    def __init__(self, K, lies=(0, 0, 0), mu=None, felt=(0, 0, 0)):
        self.K, self.lies, self.mu, self.felt = K, np.array(lies, float), mu, np.array(felt, float)
        self.go = np.zeros(3)

    def wrench(self, go, ee):
        x = np.append(turned(-go[2], ee[:2] - go[:2] - turned(go[2], [0, 0.1])), ee[2] - go[2]) - self.lies
        w = self.K @ x
        return np.append(turned(go[2], w[:2]), w[2])

    def move(self, ee):
        """The state with the end-effector at ``ee``: no moment about the corner, and friction where it slips."""

        def lacks(z):
            go = np.array([z[0], 0.0, z[1]])
            w, arm = self.wrench(go, ee), turned(go[2], [0, 0.1])
            held = z[0] * 1e3 if self.mu is None else w[0] - self.mu * -w[1]
            return [held, (w[2] + arm[0] * w[1] - arm[1] * w[0]) * 10]

        found = root(lacks, [self.go[0], self.go[2]], tol=1e-12)
        assert np.abs(found.fun).max() < 1e-9
        place, angle = found.x
        self.go = np.array([place, 0.0, angle])
        return PlanarState(ee, self.go + self.felt, None, self.wrench(self.go, ee))

    def hang(self, ee):
        """The state in free air, where nothing deforms the springs."""
        angle = ee[2] - self.lies[2]
        at = ee[:2] - turned(angle, np.array([0, 0.1]) + self.lies[:2])
        return PlanarState(ee, np.append(at, angle) + self.felt, None, np.zeros(3))


def settle(law, plant, step=0, updates=60):
    """Correct at one waypoint until it rests, after three looks in free air; every state in contact (n)."""
    above = law.plan.go[0] + [0.0, 0.01, 0.0]
    for _ in range(3):
        law.in_air(above, plant.hang(law.command(above, above + np.array([0.0, 0.1, 0.0]))))
    states = [plant.move(law.waypoint(step))]
    for _ in range(updates):
        law.in_contact(step, states[-1])
        states.append(plant.move(law.waypoint(step)))
    return states
