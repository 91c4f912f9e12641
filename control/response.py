"""What a small motion of the end-effector does to everything it is in contact with, as the contact modes allow it.

The linearised quasi-static balance of the whole chain, end-effector – fingers – go – (eo) – ground, about a step of a
plan. Modes, normals and forces: the convention of `mechanics.friction`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq

from mechanics import se2
from mechanics.contact import force_in_world
from mechanics.friction import Mode, tangent
from mechanics.readings import Array
from planning.plan import Plan


@dataclass(frozen=True, eq=False)
class Response:
    """Changes (…, 3) per small motion (3,) of the ee along the axes of gocf, (x, y, θ) [m, m, rad].

    ``go`` (3, 3): motion of the grasp centre and turn of the go, axes of gocf. ``wrench`` (3, 3) [N, N, N·m]: of the
    sensor on the go about the grasp centre, which moves with the go, axes of W. ``eo`` (3, 3): of the pose X_W_eo;
    None without an extrinsic object.
    """

    go: Array
    wrench: Array
    eo: Array | None


def response(plan: Plan, step: int, modes: Sequence[Mode] | None = None) -> Response:
    """The response about a plan's step, with the plan's contact modes there unless ``modes`` (C) says others.

    Unknown are the motions of go and eo and the change of each contact's force. Equations: the balance of each body,
    with K (dee − dgo) turned along with the go and with the arms of all forces and of the weight, and what each
    contact's mode says. ``stick``: the two material points move as one. ``slip±``: they keep together along the
    normal, and the force stays on its edge of the cone, which turns with the face. ``free``: no force. Contacts may
    be redundant (both ends of a resting face): then their forces are the smallest that do, and everything else is
    unique all the same.
    """
    return _Chain(plan, step, plan.contact_modes[step] if modes is None else tuple(modes)).solve()


class _Chain:
    """The linear system A z = B dee in the axes of W; z = (grasp centre 2, θ_go, eo 3, contact forces 2 C)."""

    def __init__(self, plan: Plan, step: int, modes: tuple[Mode, ...]):
        self._plan, self._step, self._modes = plan, step, modes
        self._gocf = se2.compose(plan.go[step], plan.X_go_gocf)
        #: reference point and first column of each body that moves
        self._bodies = {"go": (self._gocf[:2], 0)}
        if plan.eo is not None:
            self._bodies["eo"] = (plan.eo[step, :2], 3)
        self._forces = 3 * len(self._bodies)
        self._width = self._forces + 2 * len(plan.contact_names)
        self._points = plan.contact_points[step]
        self._pushes = force_in_world(plan.contact_normals[step], plan.contact_forces[step])

    def solve(self) -> Response:
        spring, given = self._spring()
        balance = [self._balance(body, spring if body == "go" else None) for body in self._bodies]
        contacts = [self._contact(c, mode) for c, mode in enumerate(self._modes)]
        A = np.vstack([*balance, *contacts])
        B = np.zeros((len(A), 3))
        B[:3] = -given
        z = np.asarray(lstsq(A, B)[0])  # pyright: ignore[reportOptionalSubscript]
        turn = np.eye(3)
        turn[:2, :2] = se2.rotation(self._gocf[2])
        eo = z[3:6] @ turn if "eo" in self._bodies else None
        return Response(turn.T @ z[:3] @ turn, (spring @ z + given) @ turn, eo)

    def _spring(self) -> tuple[Array, Array]:
        """Change of the fingers' wrench on the go, axes of W: by the unknowns (3, n) and by the ee's motion (3, 3)."""
        plan, R = self._plan, np.eye(3)
        R[:2, :2] = se2.rotation(self._gocf[2])
        K = R @ plan.stiffness @ R.T
        by_go = -K
        # as the go turns, the ee's place in gocf turns back, and the wrench's axes turn along
        across = _across(plan.ee[self._step, :2] - self._gocf[:2])
        by_go[:, 2] -= K[:, :2] @ across
        by_go[:2, 2] += _across(plan.wrench[self._step, :2])
        return np.hstack([by_go, np.zeros((3, self._width - 3))]), K

    def _balance(self, body: str, spring: Array | None) -> Array:
        """Rows (3, n): the sum of the changes of force, and of torque about the body's reference point."""
        plan = self._plan
        rows = np.zeros((3, self._width)) if spring is None else spring.copy()
        reference, at = self._bodies[body]
        if body == "go":
            turn = plan.go[self._step, 2]
            across = _across(se2.rotate(turn, plan.com - plan.X_go_gocf[:2]))
            rows[2, at + 2] -= across[0] * plan.mass * plan.gravity
        # the eo's weight acts at its reference point, its centre of mass, and stays as it is
        for c, pair in enumerate(plan.contact_bodies or ()):
            if body not in pair:
                continue
            sign, force, arm = 1.0 if pair[0] == body else -1.0, self._pushes[c], self._points[c] - reference
            columns = slice(self._forces + 2 * c, self._forces + 2 * c + 2)
            rows[:2, columns] += sign * np.eye(2)
            rows[2, columns] += sign * np.array([-arm[1], arm[0]])
            moved = self._motion(self._vertex_of(c), self._points[c])
            moved[:, at : at + 2] -= np.eye(2)
            rows[2] += sign * (force[1] * moved[0] - force[0] * moved[1])
        return rows

    def _contact(self, c: int, mode: Mode) -> Array:
        """Rows (2, n) of what the contact's mode says."""
        on, by = (self._plan.contact_bodies or ())[c]
        force = np.zeros((2, self._width))
        force[:, self._forces + 2 * c : self._forces + 2 * c + 2] = np.eye(2)
        if mode is Mode.FREE:
            return force
        apart = self._motion(on, self._points[c]) - self._motion(by, self._points[c])
        if mode is Mode.STICK:
            return apart
        normal = self._plan.contact_normals[self._step, c]
        edge = normal + mode.slip_sign * self._plan.contact_mu[c] * tangent(normal)
        face = by if self._vertex_of(c) == on else on
        if face in self._bodies:
            force[:, self._bodies[face][1] + 2] -= _across(self._pushes[c])
        return np.vstack([normal @ apart, _across(edge) @ force])

    def _motion(self, body: str, point: Array) -> Array:
        """Rows (2, n): motion in W of the body's material point at ``point`` (2,)."""
        rows = np.zeros((2, self._width))
        if body in self._bodies:
            reference, at = self._bodies[body]
            rows[:, at : at + 2] = np.eye(2)
            rows[:, at + 2] = _across(point - reference)
        return rows

    def _vertex_of(self, c: int) -> str:
        """Whose corner the contact is: it moves with that body, and its normal with the other.

        Between go and eo it is the one on which the plan's contact keeps its place, the go's if it does so on both.
        """
        plan = self._plan
        pair = (plan.contact_bodies or ())[c]
        if "ground" in pair or plan.eo is None:
            return pair[0] if pair[1] == "ground" else pair[1]
        wanders = {}
        for body, poses in (("go", plan.go), ("eo", plan.eo)):
            seen = se2.transform(se2.inverse(poses), plan.contact_points[:, c])
            wanders[body] = float(np.ptp(seen, axis=0).max())
        return "eo" if wanders["eo"] < wanders["go"] - 1e-6 else "go"


def _across(vector: Array) -> Array:
    """d/dθ (2,) of a turned vector (2,)."""
    return np.array([-vector[1], vector[0]])
