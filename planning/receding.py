"""What remains of a problem in the middle of its execution, as things were seen, and the warm re-plan of it.

A plan is kept to, not weighed anew: its relative angles and forces are the nominal values of what remains (`tracking`).
What was seen changes the problem itself: where the fingers hold the grasped object, where contacts that stick stand,
and how much friction they have (`Seen`, `as_seen`). `Receding` re-plans windows of it by Levenberg–Marquardt, each from
where the last one ended.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mechanics import se2
from mechanics.friction import Mode, cone_margin, required_friction, tangent
from mechanics.readings import Array
from planning.closure import place
from planning.errors import InfeasiblePlan
from planning.evaluation import Evaluation
from planning.fused.objective import FusedObjective
from planning.optimisers.lm import LevenbergMarquardt, Warm
from planning.plan import Plan
from planning.problem import Form, ObjectContact, Problem, Touch
from planning.verification import CONE_MISS


@dataclass(frozen=True, eq=False)
class Seen:
    """What a trial has seen of a problem.

    ``grasp`` (3,) X_go_gocf; ``along`` [m] how far along the ground (+x) the extrinsic object stands from where the
    problem has it; ``travel`` [m] how far along the touched face the go's contact is from there; ``mu`` (C,) of each
    contact, those of the go first.
    """

    grasp: Array
    mu: Array
    along: float = 0.0
    travel: float = 0.0


@dataclass(frozen=True, eq=False)
class Remaining:
    """A re-plan from step ``begin`` on: poses (N, 3), ``wrench`` (N, 3) of the sensor on the go about the grasp centre
    as seen, ``angle`` (N,) [rad] of the go on the other body, and the loss ``value``. In the problem's frame."""

    begin: int
    ee: Array
    go: Array
    eo: Array
    wrench: Array
    angle: Array
    value: float


def window(problem: Problem, begin: int, steps: int) -> Problem:
    """Return ``steps`` steps of a problem from ``begin`` on, or as many as there are."""
    cut = slice(begin, begin + steps)

    def of(thing: Any, *names: str) -> dict[str, Any]:
        return {name: getattr(thing, name)[cut] for name in names}

    return replace(
        problem,
        **of(problem, "eo", "angle", "travel", "free", "angle_limits"),
        contacts=tuple(replace(contact, **of(contact, "modes", "wish")) for contact in problem.contacts),
        ground=tuple(replace(contact, **of(contact, "modes")) for contact in problem.ground),
    )


def shifted(z: Array) -> Array:
    """Return z (K, D) one step further on: the last step stands twice."""
    return np.concatenate([z[1:], z[-1:]])


def as_seen(problem: Problem, seen: Seen) -> Problem:
    """Return the problem with grasp, contacts and friction as seen. Raises ValueError where a contact left its face."""
    n = len(problem.contacts)
    eo = problem.eo + np.array([seen.along, 0.0, 0.0]) if problem.eo_body is not None else problem.eo
    mu = [float(value) for value in seen.mu]
    return replace(
        problem,
        grasp=seen.grasp,
        eo=eo,
        travel=problem.travel + seen.travel,
        contacts=tuple(replace(contact, mu=value) for contact, value in zip(problem.contacts, mu[:n], strict=True)),
        ground=tuple(replace(contact, mu=value) for contact, value in zip(problem.ground, mu[n:], strict=True)),
    )


def tracking(problem: Problem, plan: Plan, weight: float) -> Problem:
    """Return the problem whose nominal angles and wishes are those of ``plan``, its track loss weighing ``weight``.

    In the closed form: re-plans are made of poses and forces. Raises ValueError where the plan is none of this problem.
    """
    name = f"problem '{problem.skill}'"
    if plan.steps != problem.steps or plan.skill != problem.skill:
        raise ValueError(f"{name}: {problem.steps} steps: received a plan of {plan.skill} with {plan.steps} steps")
    if (plan.eo is None) != (problem.eo_body is None):
        raise ValueError(f"{name}: a plan with{'out' * (plan.eo is None)} an extrinsic object is none of it")
    eo = problem.eo if plan.eo is None else plan.eo
    turned = table_of(problem, plan)[2] if plan.eo is None else 0.0
    angle = problem.angle + se2.wrap(plan.go[:, 2] - eo[:, 2] - turned - problem.angle)
    return replace(
        problem,
        form=Form.CLOSED,
        stiffness=plan.stiffness,
        angle=np.where(problem.free[:, 0], angle, problem.angle),
        contacts=tuple(replace(contact, wish=plan.contact_forces[:, c]) for c, contact in enumerate(problem.contacts)),
        weights=replace(problem.weights, track=weight),
    )


def table_of(problem: Problem, plan: Plan) -> Array:
    """Return X_W_table (3,): where the frame of the problem lies for a plan of it that was anchored (`reanchored`)."""
    if plan.eo is not None:
        return se2.compose(plan.eo[0], se2.inverse(problem.eo[0]))
    return se2.compose(plan.go[0], se2.inverse(place(problem, problem.angle, problem.travel).go[0]))


def closing(contact: ObjectContact, eo: Array, angle: float, travel: float) -> tuple[Array, Array]:
    """Return X_W_go (3,) that closes the go's first contact, and the contact's point (2,) in W.

    ``eo`` (3,) is X_W_eo, ``angle`` [rad] θ_go − θ_eo, ``travel`` [m] along the touched face.
    """
    e, theta = tangent(contact.normal), float(eo[2]) + angle
    p_go, p_eo = np.asarray(contact.p_go), np.asarray(contact.p_eo)
    if contact.touch is Touch.CORNER_ON_FACE:
        p_eo = p_eo + travel * e
    else:
        p_go = p_go + travel * e
    point = se2.transform(eo, p_eo)
    return np.append(point - se2.rotate(theta, p_go), theta), point


def place_on_face(contact: ObjectContact, eo: Array, go: Array) -> float:
    """Return the travel [m] at which the corner of the one body is seen on the face of the other."""
    e = tangent(contact.normal)
    if contact.touch is Touch.CORNER_ON_FACE:
        return float(e @ (se2.transform(se2.between(eo, go), contact.p_go) - contact.p_eo))
    return float(e @ (se2.transform(se2.between(go, eo), contact.p_eo) - contact.p_go))


@dataclass
class Receding:
    """Re-plans windows of ``problem``, ``horizon`` steps at most, with ``iterations`` at most, each started warm."""

    problem: Problem
    horizon: int = 10
    iterations: int = 20
    warm: Warm = field(default_factory=Warm)
    _last: tuple[int, Array] | None = None

    def solve(self, begin: int, seen: Seen, ahead: tuple[float, float] = (0.0, 0.0)) -> Remaining:
        """Return the re-plan from step ``begin`` on, of what was seen.

        ``ahead`` [m]: how far the extrinsic object along the ground, and the go's contact along its face, are beyond
        where step ``begin`` has them, in the direction that they slip: nothing is ever planned back against it.
        Raises InfeasiblePlan where no force in the cones balances the objects, and ValueError where a contact left its
        face.
        """
        cut = held_ahead(as_seen(window(self.problem, begin, self.horizon), seen), *ahead)
        objective = FusedObjective(cut)
        z = self._start(begin, cut, objective)
        found = LevenbergMarquardt(iterations=self.iterations, warm=self.warm).optimise(
            objective, z, np.random.default_rng(0)
        )
        end = objective.evaluate(found.z)
        if not (end.solution.usable.all() and np.isfinite(end.value) and np.isfinite(end.ee).all()):
            raise InfeasiblePlan(begin, cut.contacts[0].name, np.nan, np.nan, reason="no force balances the objects")
        _check_cones(cut, end, begin)
        self._last = begin, found.z
        return Remaining(begin, end.ee, end.go, end.eo, end.wrench, end.go[:, 2] - end.eo[:, 2], end.value)

    def _start(self, begin: int, cut: Problem, objective: FusedObjective) -> Array:
        """z (N, 5) where the last re-plan ended, as far as it can be used; else the nominal values."""
        options = [cut.start]
        if self._last is not None and begin >= self._last[0]:
            z = self._last[1]
            for _ in range(begin - self._last[0]):
                z = shifted(z)
            z = np.concatenate([z, np.repeat(z[-1:], self.horizon, axis=0)])[: cut.steps]
            options.insert(0, np.where(cut.free, z, cut.start))
        for z in options:
            if np.isfinite(objective.values(z[None])[0]):
                return z
        refusal = objective.refusal(cut.start)
        if refusal is not None:
            raise refusal
        raise InfeasiblePlan(begin, cut.contacts[0].name, np.nan, np.nan, reason="the loss is infinite from the start")


def _check_cones(problem: Problem, found: Evaluation, begin: int) -> None:
    """Raise InfeasiblePlan where the first step's force of the go, whose cone is but a loss, has left it."""
    for c, contact in enumerate(problem.contacts):
        force = found.forces[0, c]
        if contact.modes[0] is Mode.STICK and float(cone_margin(force, contact.mu)) < -CONE_MISS:
            raise InfeasiblePlan(begin, contact.name, float(required_friction(force)), contact.mu, by="go")


def held_ahead(problem: Problem, along: float, travel: float) -> Problem:
    """Return the problem with its first step no less far along ground and face than things have slipped already.

    ``along`` and ``travel`` [m] are beyond the first step, positive the way it slips; what follows waits where the
    first step is further on.
    """
    if along > 0 and problem.ground:
        eo = np.array(problem.eo)
        eo[:, 0] = _no_less(eo[:, 0], problem.ground[0].modes[0], along)
        problem = replace(problem, eo=eo)
    if travel > 0:
        problem = replace(problem, travel=_no_less(problem.travel, problem.contacts[0].modes[0], travel))
    return problem


def _no_less(places: Array, mode: Mode, ahead: float) -> Array:
    """``places`` (K,) [m] no less far than ``ahead`` beyond the first, the way a contact of ``mode`` slips."""
    way = -float(mode.slip_sign)  # what slips− travels along +e, or +x on the ground
    if way == 0.0:
        return places
    return way * np.maximum(way * places, way * places[0] + ahead)
