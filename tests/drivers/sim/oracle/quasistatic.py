"""An independent plant: quasi-static complementarity time stepping after Stewart and Trinkle, solved by Lemke.

A held polygon (go), a free polygon (eo) and the ground y = 0. In each step the end-effector moves and the bodies find
the poses in which every force balances: the fingers' K x, weight, and contact forces with

    0 ≤ φ ⊥ λ_n ≥ 0,    |λ_t| ≤ µ λ_n, and λ_t opposes the slip of the step,

where φ is the gap of a vertex over an edge and the slip is the change of the vertex's place along the edge. Both are
functions of the poses in space, not of rates, so that a sticking vertex stays where it is on its edge for ever. The
complementarity problem of one linearisation is solved by Lemke and the linearisation is repeated at the solution.

`move` is quasi-static. `drive` steps in time, with the bodies' inertia but without any damping. Nothing is taken from
the package. Inside, lengths are in mm, forces in N and angles in units of 1/ARM rad, so that all unknowns are of one
size; the interface is SI.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from .lemke import lemke

#: length by which angles are scaled [mm]
ARM = 50.0
#: a free body has no stiffness: it is tied to where it was an iteration ago [N/mm], until it no longer moves
TETHER = 0.02
#: vertices nearer than this to an edge can meet it within a step [mm]
NEAR = 3.0
#: the balance is found when an iteration moves nothing by more than this [mm]
STILL = 1e-7
ITERATIONS = 200


@dataclass(frozen=True)
class Touch:
    """A contact of the newest step: the vertex of ``body`` on the edge of ``other``; SI, axes of W.

    ``force`` (2,) acts on ``body`` at ``point`` (2,), ``normal`` points into ``body``, ``slip`` is how far the vertex
    has moved along the edge since the start, along the normal turned by −90°.
    """

    body: str
    other: str
    vertex: int
    edge: int
    point: np.ndarray
    normal: np.ndarray
    force: np.ndarray
    slip: float


@dataclass
class _Outline:
    """A rigid polygon; ``at`` is where its pose stands among the unknowns."""

    name: str
    vertices: np.ndarray
    at: int
    weight: float = 0.0
    corners: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        ends = [*self.vertices, self.vertices[0]]
        self.edges = [_edge(a, b) for a, b in pairwise(ends)]
        for i in range(len(self.vertices)):
            (_, before, _, _), (_, after, _, _) = self.edges[i - 1], self.edges[i]
            # a vertex at which the outline turns inward touches nothing
            if before[0] * after[1] - before[1] * after[0] > 0:
                self.corners.append(i)


def _edge(a: np.ndarray, b: np.ndarray) -> tuple:
    """First end, unit tangent, outward normal and length of the edge a → b of a counter-clockwise outline."""
    length = float(np.hypot(*(b - a)))
    u = (b - a) / length
    return a, u, np.array([u[1], -u[0]]), length


GROUND = _Outline("ground", np.array([[-1e6, -1e6], [1e6, -1e6], [1e6, 0.0], [-1e6, 0.0]]), at=-1)
GROUND.edges = [(np.zeros(2), np.array([-1.0, 0.0]), np.array([0.0, 1.0]), np.inf)]


def _turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _across(v: np.ndarray) -> np.ndarray:
    """d/dθ of a turned vector."""
    return np.array([-v[1], v[0]])


class Oracle:
    """The bodies of a scene, balanced for the pose of the end-effector that `move` was last given."""

    def __init__(self, scene, stiffness_scale: float = 1.0):
        """``scene``: any object with the attributes of the driver's scene, in SI."""
        self._K = np.asarray(scene.stiffness, float) * stiffness_scale * np.outer([1, 1, 1e3], [1, 1, 1e3]) * 1e-3
        self._grasp = np.asarray(scene.grasp, float) * [1e3, 1e3, 1.0]
        outlines = [_outline("go", scene.grasped, 0, scene.gravity)]
        self._mu = {("go", "ground"): scene.friction["go-ground"]}
        ee = np.asarray(scene.start, float) * [1e3, 1e3, 1.0]
        back = ee[2] - self._grasp[2]
        self._q = np.append(ee[:2] - _turn(back) @ self._grasp[:2], back * ARM)
        if scene.extrinsic is not None:
            outlines.append(_outline("eo", scene.extrinsic, 3, scene.gravity))
            self._mu |= {("eo", "ground"): scene.friction["eo-ground"], ("go", "eo"): scene.friction["go-eo"]}
            self._q = np.append(self._q, np.asarray(scene.extrinsic_pose) * [1e3, 1e3, ARM])
        self._mu |= {(b, a): mu for (a, b), mu in self._mu.items()}
        self._bodies = outlines
        self._pairs = [(a, b) for a in outlines for b in [*outlines, GROUND] if a is not b]
        self._inertia = np.concatenate(
            [_inertia(body) for body in (scene.grasped, scene.extrinsic) if body is not None]
        )
        self._slips: dict[tuple, float] = {}
        self.touches: list[Touch] = []
        self.iterations = 0
        self.move(scene.start)

    # -- poses and wrench ------------------------------------------------------------------------------------------

    @property
    def go(self) -> np.ndarray:
        """X_W_go (3,)."""
        return self._q[:3] / [1e3, 1e3, ARM]

    @property
    def eo(self) -> np.ndarray:
        """X_W_eo (3,)."""
        return self._q[3:6] / [1e3, 1e3, ARM]

    @property
    def wrench(self) -> np.ndarray:
        """Wrench (3,) of the fingers on the go about the grasp centre, axes of W."""
        fx, fy, tau, _ = self._fingers(self._q[:3])
        return np.array([fx, fy, tau * 1e-3])

    def touch(self, body: str, other: str) -> Touch:
        """The one contact of ``body``'s vertex on ``other``."""
        (touch,) = (t for t in self.touches if (t.body, t.other) == (body, other))
        return touch

    # -- time ------------------------------------------------------------------------------------------------------

    def move(self, ee, steps: int = 1) -> None:
        """Bring the end-effector to X_W_ee (3,) along a straight line of ``steps`` steps."""
        goal = np.asarray(ee, float) * [1e3, 1e3, 1.0]
        start = getattr(self, "_ee", goal)
        for i in range(1, steps + 1):
            self._ee = start + i / steps * (goal - start)
            self._balance()

    def drive(self, ee, seconds: float, steps: int, rest: float = 0.0) -> None:
        """Bring the end-effector to X_W_ee (3,) along a quintic ramp, then ``rest`` [s], in steps of equal length."""
        goal, start, h = np.asarray(ee, float) * [1e3, 1e3, 1.0], self._ee, seconds / steps
        before = self._q.copy()
        for i in range(1, steps + 1 + round(rest / h)):
            s = min(i / steps, 1.0)
            self._ee = start + s**3 * (10 - 15 * s + 6 * s * s) * (goal - start)
            coasting = 2 * self._q - before
            before = self._q.copy()
            self._balance(self._inertia / h**2, coasting)

    def _balance(self, inertia: np.ndarray | float = 0.0, coasting: np.ndarray | float = 0.0) -> None:
        """Find the poses in balance; ``inertia`` [N/mm] draws them to where they would be ``coasting``."""
        q = self._q.copy()
        near = self._near(q)
        places = np.array([self._place(q, *contact)[1] for contact in near])
        mu = np.array([self._mu[a.name, b.name] for a, _, b, _ in near])
        weight = np.zeros(len(q))
        for body in self._bodies:
            weight[body.at + 1] -= body.weight
        m, step = len(near), q
        for _ in range(ITERATIONS):
            self.iterations += 1
            rows = [self._place(q, *contact) for contact in near]
            gap = np.array([r[0] for r in rows])
            slip = np.array([r[1] for r in rows]) - places
            N = np.array([r[2] for r in rows]).reshape(m, len(q))
            T = np.array([r[3] for r in rows]).reshape(m, len(q))
            load, A = self._stiffness(q)
            load, A = load + inertia * (coasting - q), A + inertia * np.eye(len(q))
            normal, along = _solve(A, load + weight, gap, slip, N, T, mu)
            step = np.linalg.solve(A, load + weight + N.T @ normal + T.T @ along)
            q += step
            if np.abs(step).max() < STILL:
                break
        else:
            raise ArithmeticError(f"no balance: the last iteration still moved by {np.abs(step).max():.3g} mm")
        self._q = q
        self._keep(near, normal, along, slip)

    def _keep(self, near, normal, along, slip) -> None:
        self.touches = []
        for (a, i, b, k), fn, ft, moved in zip(near, normal, along, slip, strict=True):
            key = (a.name, i, b.name, k)
            if fn <= 1e-9:
                self._slips.pop(key, None)
                continue
            self._slips[key] = self._slips.get(key, 0.0) + moved
            _, u, n, _ = b.edges[k]
            turn = np.eye(2) if b.at < 0 else _turn(self._q[b.at + 2] / ARM)
            point = self._q[a.at : a.at + 2] + _turn(self._q[a.at + 2] / ARM) @ a.vertices[i]
            force = turn @ (fn * n + ft * u)
            # the outline runs along the normal turned by +90°
            self.touches.append(
                Touch(a.name, b.name, i, k, point * 1e-3, turn @ n, force, -self._slips[key] * 1e-3),
            )

    # -- geometry --------------------------------------------------------------------------------------------------

    def _near(self, q: np.ndarray) -> list[tuple]:
        """Every (body, vertex, other, edge) that may touch."""
        found = []
        for a, b in self._pairs:
            at = q[a.at : a.at + 2] + a.vertices @ _turn(q[a.at + 2] / ARM).T
            if b.at >= 0:
                at = (at - q[b.at : b.at + 2]) @ _turn(q[b.at + 2] / ARM)
            for k, (start, u, n, length) in enumerate(b.edges):
                for i in a.corners:
                    along = u @ (at[i] - start)
                    if abs(n @ (at[i] - start)) < NEAR and (length == np.inf or 0 <= along <= length):
                        found.append((a, i, b, k))
        return found

    def _place(self, q: np.ndarray, a: _Outline, i: int, b: _Outline, k: int) -> tuple:
        """Gap and place along the edge of vertex i of a over edge k of b, and their gradients."""
        start, u, n, _ = b.edges[k]
        lever = _turn(q[a.at + 2] / ARM) @ a.vertices[i]
        p = q[a.at : a.at + 2] + lever
        if b.at >= 0:
            turn = _turn(q[b.at + 2] / ARM)
            p = p - q[b.at : b.at + 2]
            start, u, n = turn @ start, turn @ u, turn @ n
        rows = []
        for axis in (n, u):
            row = np.zeros(len(q))
            row[a.at : a.at + 3] = *axis, axis @ _across(lever) / ARM
            if b.at >= 0:
                # axis · (p − start) seen from b, which turns the other way
                row[b.at : b.at + 3] = *-axis, -axis @ _across(p) / ARM
            rows.append(row)
        return n @ (p - start), u @ (p - start), *rows

    # -- forces ----------------------------------------------------------------------------------------------------

    def _fingers(self, go: np.ndarray) -> tuple:
        """Force, torque about the grasp centre and about the go's origin; ``go`` may be complex."""
        R = _turn(go[2] / ARM)
        lever = R @ self._grasp[:2]
        G = _turn(go[2] / ARM + self._grasp[2])
        d = G.T @ (self._ee[:2] - go[:2] - lever)
        w = self._K @ np.array([d[0], d[1], self._ee[2] - go[2] / ARM - self._grasp[2]])
        f = G @ w[:2]
        return f[0], f[1], w[2], w[2] + lever[0] * f[1] - lever[1] * f[0]

    def _stiffness(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The fingers' load (n,) on the unknowns, and how much it falls per unknown (n, n), by complex steps."""
        load, A = np.zeros(len(q)), TETHER * np.eye(len(q))
        for j in range(3):
            go = q[:3].astype(complex)
            go[j] += 1e-30j
            fx, fy, _, tau = self._fingers(go)
            w = np.array([fx, fy, tau / ARM])
            A[:3, j] = -np.imag(w) / 1e-30
            load[:3] = np.real(w)
        return load, A


def _solve(A, load, gap, slip, N, T, mu) -> tuple[np.ndarray, np.ndarray]:
    """Contact forces (normal, along the edge) of one linearisation."""
    m = len(mu)
    if m == 0:
        return np.zeros(0), np.zeros(0)
    J = np.vstack([N, T, -T])
    E = np.vstack([np.eye(m), np.eye(m)])
    M = np.zeros((4 * m, 4 * m))
    M[: 3 * m, : 3 * m] = J @ np.linalg.solve(A, J.T)
    M[m : 3 * m, 3 * m :] = E
    M[3 * m :, :m] = np.diag(mu)
    M[3 * m :, m : 3 * m] = -E.T
    moved = J @ np.linalg.solve(A, load)
    z = lemke(M, np.concatenate([gap + moved[:m], slip + moved[m : 2 * m], -slip + moved[2 * m :], np.zeros(m)]))
    return z[:m], z[m : 2 * m] - z[2 * m : 3 * m]


def _inertia(body) -> np.ndarray:
    """Of a body's three unknowns [N·s²/mm]."""
    v = np.asarray(body.vertices, float)
    w = np.roll(v, -1, axis=0)
    cross = v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0]
    polar = body.mass * (cross @ (v * v + v * w + w * w).sum(axis=1)) / (6 * cross.sum())
    return np.array([body.mass, body.mass, polar * 1e6 / ARM**2]) * 1e-3


def _outline(name: str, body, at: int, gravity: float) -> _Outline:
    return _Outline(name, np.asarray(body.vertices, float) * 1e3, at, body.mass * gravity)
