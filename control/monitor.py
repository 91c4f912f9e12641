"""Compares what a trial measures with what its plan expects of the contacts, and says what deviates and why."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mechanics import se2
from mechanics.friction import Mode, tangent
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning.plan import Plan

#: the ground's pose: its marks are points of W
_AT_REST = np.zeros(3)
#: the length that weighs a point's travel against a normal's turn where a contact's face is looked for [m]
_ARM = 0.01
#: the "waypoint" before the first: nothing has touched yet, and the objects are where the preload begins
_BEFORE = -1


@dataclass(frozen=True)
class Deviation:
    """What is not as planned: a ``status`` of design §6, the ``reason`` in words, and at which waypoint (``step``).

    ``contact`` names the planned contact that it was found at, and ``slip`` [m] says how far that has slipped since it
    was marked, positive for ``slip+``; None where the wrench alone has told.
    """

    status: str
    reason: str
    step: int = -1
    contact: str | None = None
    slip: float | None = None


@dataclass(frozen=True, eq=False)
class _Mark:
    """The points of both bodies that touched at waypoint ``step`` (−1: before touch-down): ``corner`` and ``face`` (2,)
    in their frames, as measured, and ``planned`` (2,), the face's as the plan has it. ``mode`` is the one planned
    there."""

    step: int
    mode: Mode
    corner: Array
    face: Array
    planned: Array


@dataclass
class ContactMonitor:
    """Watches at the waypoints whether each contact of ``plan`` behaves in its planned mode.

    The points of both bodies that touch are marked: where the extrinsic object sticks to the ground before touch-down
    (`before_touch`), else at the first waypoint at which the contact is seen. From then on they stay together where the
    contact sticks, part along the face as planned where it slips, and never leave each other along the normal: more
    than ``tolerance`` [m] is a deviation. So a contact that lands elsewhere, because the go lies otherwise in the
    fingers, has not slipped: it has to stick where it landed. What is not seen is judged by the wrench alone: ``load``
    is the fraction of the planned force on the go below which its contact counts as lost, ``force_limit`` [N] what ends
    a trial.
    """

    plan: Plan
    tolerance: float
    force_limit: float
    load: float = 0.1
    _marks: dict[int, _Mark] = field(default_factory=dict, init=False, repr=False)
    #: how far a contact that is to slip has come at most, the planned way [m]
    _best: dict[int, float] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        self._pairs = [corner_and_face(self.plan, c) for c in range(len(self.plan.contact_names))]

    def before_touch(self, X_W_eo: Array) -> None:
        """Mark where the extrinsic object stands on the ground, seen at ``X_W_eo`` (3,) before anything touched it.

        Where it is to stick, it has to stick from there on: it may slide in the preload as well as later.
        """
        state = PlanarState(self.plan.preload_ee[0], None, X_W_eo, np.zeros(3))
        for c, mode in enumerate(self.plan.contact_modes[0]):
            if mode is Mode.STICK:
                self._marked(c, _BEFORE, state)

    def check(self, step: int, measured: PlanarState, weight: Array) -> Deviation | None:
        """The deviation at waypoint ``step``, or None. ``weight`` (2,) [N] is the force of gravity on the go in W."""
        if not measured.is_finite:
            return Deviation("diverged", f"waypoint {step}: a measurement is not finite", step)
        force = float(np.hypot(*measured.wrench[:2]))
        if force > self.force_limit:
            reason = f"waypoint {step}: {force:.1f} N exceeds the limit of {self.force_limit:g} N"
            return Deviation("stopped", reason, step)
        moved = self._moved(step, measured)
        if moved is not None and moved.status == "slipped":  # what has slid away may bear on nothing any more
            return moved
        # the environment's force on the go is what balance leaves: -(sensor + weight)
        environment = -(measured.wrench[:2] + weight)
        planned = -(self.plan.wrench[step, :2] + weight)
        size = float(np.linalg.norm(planned))
        if size > 0 and float(environment @ planned) / size < self.load * size:
            along = float(environment @ planned) / size
            reason = f"waypoint {step}: {along:.2f} N along the planned contact force of {size:.2f} N"
            return Deviation("lost_contact", reason, step)
        return moved

    def has_slipped(self, step: int, seen: PlanarState) -> bool:
        """Whether a contact that is marked has slipped from there otherwise than planned; nothing is marked by it."""
        found = self._moved(step, seen, make=False) if seen.is_finite else None
        return found is not None and found.status == "slipped"

    def restart(self, step: int, measured: PlanarState) -> None:
        """Mark the contacts anew as they are at waypoint ``step``: what has happened so far is taken in."""
        self._marks.clear()
        self._best.clear()
        for c in range(len(self.plan.contact_names)):
            self._marked(c, step, measured)

    def _moved(self, step: int, measured: PlanarState, *, make: bool = True) -> Deviation | None:
        """What has not slipped as planned, or else what has opened. A slip that opens its own contact is a lost one."""
        opened = None
        for c, name in enumerate(self.plan.contact_names):
            mark = self._marked(c, step, measured, make=make)
            if mark is None:
                continue
            slip, gap = self._since(mark.face, mark, c, step, measured)
            where, since = f"waypoint {step}: contact '{name}'", _since_when(mark.step)
            wrong = self._not_as_planned(mark, c, step, slip)
            if gap > self.tolerance:
                reason = f"{where} has opened by {gap * 1e3:.1f} mm {since}"
                opened = opened or Deviation("lost_contact", reason, step, name, slip)
            elif wrong:
                return Deviation("slipped", f"{where} {wrong} {since}", step, name, slip)
        return opened

    def _marked(self, c: int, step: int, measured: PlanarState, *, make: bool = True) -> _Mark | None:
        """The marks of a contact, made now where there are none of its present mode, unless ``make`` forbids it; None
        where there are none, or it is not seen."""
        mode, mark = self.plan.contact_modes[max(step, 0)][c], self._marks.get(c)
        if mark is not None and mark.mode is not mode:
            del self._marks[c]
            self._best.pop(c, None)
        corner, face = self._pairs[c]
        X_corner, X_face = _pose(measured, corner), _pose(measured, face)
        if mode is Mode.FREE or X_corner is None or X_face is None:
            return None
        if make and c not in self._marks:
            told, planned = max(step, 0), _planned(self.plan, step)  # a plan tells contacts from its first waypoint on
            X_told = _known(_planned(self.plan, told), corner)
            of_corner = se2.transform(se2.inverse(X_told), self.plan.contact_points[told, c])
            touched = se2.transform(se2.inverse(X_face), se2.transform(X_corner, of_corner))
            meant = se2.transform(_known(planned, corner), of_corner)
            of_face = se2.transform(se2.inverse(_known(planned, face)), meant)
            self._marks[c] = _Mark(step, mode, of_corner, touched, of_face)
        return self._marks.get(c)

    def _since(self, face: Array, mark: _Mark, c: int, step: int, state: PlanarState) -> tuple[float, float]:
        """(slip, gap) [m] in a state since the mark was made, whose point on the face is at ``face`` (2,)."""
        corner_body, face_body = self._pairs[c]
        X_corner, X_face = _known(state, corner_body), _known(state, face_body)
        apart = se2.transform(X_corner, mark.corner) - se2.transform(X_face, face)
        # the normal goes with the face, and points into the body acted on
        turned = X_face[2] - _known(_planned(self.plan, step), face_body)[2]
        normal = se2.rotate(turned, self.plan.contact_normals[step, c])
        acted_on = (self.plan.contact_bodies or ())[c][0]
        if corner_body == acted_on:
            apart = -apart
        return float(apart @ tangent(normal)), -float(apart @ normal)

    def _planned_slip(self, mark: _Mark, c: int, step: int) -> float:
        """How far [m] the contact is planned to slip from its mark to a step."""
        return self._since(mark.planned, mark, c, step, _planned(self.plan, step))[0]

    def _not_as_planned(self, mark: _Mark, c: int, step: int, slip: float) -> str:
        """What is wrong with a contact that has slipped so far [m]; empty: nothing.

        A slipping contact may be late by what it is to slip in one step: it moves all the same.
        """
        planned = self._planned_slip(mark, c, step)
        if mark.mode is Mode.STICK:
            return f"has slipped by {_told(slip)}" if abs(slip - planned) > self.tolerance else ""
        sign = mark.mode.slip_sign
        before = self._planned_slip(mark, c, max(step - 1, mark.step))
        best = self._best[c] = max(slip * sign, self._best.get(c, 0.0))
        if best - slip * sign > self.tolerance:
            return f"slips the wrong way: {_told(slip)}, where {_told(planned)} are planned,"
        if (before - slip) * sign > self.tolerance:
            return f"sticks: it has slipped by {_told(slip)}, where {_told(planned)} are planned,"
        return ""


def touches_go(plan: Plan, contact: int) -> bool:
    """Whether a contact of a plan is one of the go's."""
    return plan.contact_bodies is None or "go" in plan.contact_bodies[contact]


def slips(plan: Plan) -> bool:
    """Whether a plan has a contact slip."""
    return any(mode.slip_sign for row in plan.contact_modes for mode in row)


def corner_and_face(plan: Plan, contact: int) -> tuple[str, str]:
    """Which body of a contact brings the corner, and which one the face, of ``go``, ``eo`` and ``ground``.

    The ground has faces only. Of two objects, the one with the face has the normal at rest in its frame, and the other
    one the point, over the steps of the plan. Where nothing moves either will do, and the go's corner is taken.
    """
    assert plan.contact_bodies is not None  # Plan fills them in
    on, by = plan.contact_bodies[contact]
    if by == "ground":
        return on, by
    point, normal = plan.contact_points[:, contact], plan.contact_normals[:, contact]

    def unrest(corner: str, face: str) -> float:
        X_corner, X_face = _track(plan, corner), _track(plan, face)
        in_corner, in_face = se2.transform(se2.inverse(X_corner), point), se2.rotate(-X_face[:, 2], normal)
        return float(np.ptp(in_corner, axis=0).max() / _ARM + np.ptp(in_face, axis=0).max())

    return ("eo", "go") if unrest("eo", "go") < unrest("go", "eo") - 1e-6 else ("go", "eo")


def _track(plan: Plan, body: str) -> Array:
    """X_W_body (K, 3) as planned."""
    poses = {"go": plan.go, "eo": plan.eo}[body]
    assert poses is not None  # a contact of the eo needs one
    return poses


def _planned(plan: Plan, step: int) -> PlanarState:
    """Where the plan has everything at a waypoint, or as the preload begins."""
    if step == _BEFORE:
        eo = None if plan.preload_eo is None else plan.preload_eo[0]
        return PlanarState(plan.preload_ee[0], plan.preload_go[0], eo, plan.preload_wrench[0])
    return PlanarState(plan.ee[step], plan.go[step], None if plan.eo is None else plan.eo[step], plan.wrench[step])


def _pose(state: PlanarState, body: str) -> Array | None:
    """X_W_body (3,), None where it was not seen."""
    return {"go": state.go, "eo": state.eo, "ground": _AT_REST}[body]


def _known(state: PlanarState, body: str) -> Array:
    pose = _pose(state, body)
    assert pose is not None  # asked for only where it was seen
    return pose


def _since_when(step: int) -> str:
    return "since touch-down" if step == _BEFORE else f"since waypoint {step}"


def _told(slip: float) -> str:
    """A slip [m] in words."""
    mode = Mode.SLIP_POSITIVE if slip > 0 else Mode.SLIP_NEGATIVE
    return f"{abs(slip) * 1e3:.1f} mm ({mode.value})"
