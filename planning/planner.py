"""From a skill's task to a plan: feasible? robust? optimise, verify, and add the ramps before and after."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from mechanics import se2
from mechanics.elasticity import Elasticity
from mechanics.friction import cone_margin, project_to_mode, required_friction
from mechanics.readings import Array
from planning import closure, evaluation, feasibility
from planning.errors import InfeasiblePlan
from planning.evaluation import Evaluation
from planning.fused.objective import FusedObjective
from planning.optimisers.base import Optimiser, Optimum
from planning.plan import Plan
from planning.problem import ANGLE, TRAVEL, Problem
from planning.skills.base import SkillTask
from planning.trajectory import program
from planning.verification import verify

RAMP_LEVELS = 11
"""Levels of a force ramp, both ends included."""

EXACT = 1e-6
"""What a wish, a balance or a cone may miss, relative to the forces of its step."""


@dataclass(frozen=True)
class Margins:
    """By how much the cones hold: the least over steps and contacts of their distance to the edge.

    ``force`` [N] under ± ``disturbance`` [N], at ``step`` and ``contact``; ``nominal_force`` [N] without; ``mu`` what
    the sticking contacts could spare of their friction. Where a contact slips it is its normal force that counts.
    """

    disturbance: float
    force: float
    mu: float
    step: int
    contact: str
    nominal_force: float


def plan(
    task: SkillTask,
    name: str,
    *,
    optimiser: Optimiser | None = None,
    objective: Callable[[Problem], Any] = FusedObjective,
    start: Callable[[Problem, Any, np.random.Generator], Array] | None = None,
    rng: np.random.Generator | None = None,
    levels: int = RAMP_LEVELS,
    provenance: dict[str, Any] | None = None,
) -> Plan:
    """Return the plan called ``name``: the best that ``optimiser`` finds from the nominal trajectory (None: that one).

    ``start`` makes another z (K, 5) to set out from, of the problem, its loss and ``rng``, before the optimiser draws.
    ``objective`` makes the loss of a problem: an `Objective` that can also `evaluate`; ``levels`` ≥ 2 counts a ramp's
    points; ``provenance`` is added to the plan's own. Raises InfeasiblePlan, see `check`. A result that misses cones,
    balance or wish by more than `planning.verification` allows is ``inaccurate``, and its provenance says how.
    """
    if levels < 2:
        raise ValueError(f"plan '{name}': levels: expected at least 2, received {levels}")
    problem, margins = task.problem, check(task)
    began = time.perf_counter()
    loss = objective(problem)
    optimum, queries = None, 1
    if optimiser is not None:
        rng = np.random.default_rng(0) if rng is None else rng
        optimum = optimiser.optimise(loss, problem.start if start is None else start(problem, loss, rng), rng)
        queries = optimum.queries
    z = problem.start if optimum is None else optimum.z
    found = loss.evaluate(z)
    took = time.perf_counter() - began
    for k, status in enumerate(found.solution.status):
        if status not in ("solved", "inaccurate"):
            reason = f"no force balances the objects at what the optimiser chose ({status})"
            raise InfeasiblePlan(k, problem.contacts[0].name, np.nan, np.nan, reason=reason)
    shortfalls = verify(problem, z, found)
    preload, unload = _ramps(task, z, found, levels)
    ground = len(problem.ground)
    between = ("go", "ground") if problem.eo_body is None else ("eo", "go")
    return Plan(
        name=name,
        skill=problem.skill,
        planner="nominal" if optimiser is None else optimiser.name,
        X_go_gocf=problem.grasp,
        stiffness=problem.stiffness,
        mass=problem.go_body.mass,
        com=np.zeros(2),
        gravity=problem.gravity,
        ee=found.ee,
        go=found.go,
        eo=None if problem.eo_body is None else found.eo,
        wrench=found.wrench,
        contact_names=found.names,
        contact_points=found.points,
        contact_normals=found.normals,
        contact_forces=found.forces,
        contact_modes=found.modes,
        contact_mu=found.mu,
        contact_bodies=(between,) * len(problem.contacts) + (("eo", "ground"),) * ground,
        **{f"preload_{key}": value for key, value in preload.items()},
        **{f"unload_{key}": value for key, value in unload.items()},
        supported=task.supported,
        status="inaccurate" if shortfalls or "inaccurate" in found.solution.status else "solved",
        loss=found.value,
        queries=queries,
        time_s=took,
        provenance={
            **(provenance or {}),
            "optimiser": _settings(optimiser),
            "ended": None if optimum is None else optimum.status,
            "optimising_s": 0.0 if optimum is None else optimum.time_s,
            "objective": type(loss).__name__,
            "form": problem.form.value,
            "weights": {item.name: getattr(problem.weights, item.name) for item in fields(problem.weights)},
            "terms": found.terms,
            "curve": _curve(optimum, found.value),
            "curve_queries": [1] if optimum is None else list(optimum.asked),
            "margins": {item.name: getattr(margins, item.name) for item in fields(margins)},
            "shortfalls": shortfalls,
        },
    )


def check(task: SkillTask) -> Margins:
    """Return by how much the cones of a task hold, after everything that can be said before it is optimised.

    Raises InfeasiblePlan naming step and contact where a wish is none that its mode admits, where no force balances the
    extrinsic object, where the cones do not hold under the task's disturbance, or where a limit excludes the nominal
    trajectory.
    """
    problem = task.problem
    check_wish(problem)
    feasibility.check(program(problem, problem.start))
    margins = robustness(task)
    refusal = evaluation.refusal(problem, problem.start)
    if refusal is not None:
        raise refusal
    return margins


def check_wish(problem: Problem) -> None:
    """Raise InfeasiblePlan at the first step and contact of the go whose wished force its mode does not admit."""
    by = "ground" if problem.eo_body is None else "go"
    for k in range(problem.steps):
        for contact in problem.contacts:
            mode, wish = contact.modes[k], contact.wish[k]
            away = float(np.linalg.norm(wish - project_to_mode(wish, mode, contact.mu)))
            if away <= EXACT * max(float(np.linalg.norm(wish)), 1e-9):
                continue
            need, reason = float(required_friction(wish)), None
            if mode.slip_sign and wish[0] > 0:
                reason = (
                    f"slips ({mode}), so f_t must be {mode.slip_sign * contact.mu * wish[0]:.3g} N at"
                    f" f_n = {wish[0]:.3g} N with µ = {contact.mu:.3g}; desired was {wish[1]:.3g} N"
                )
            raise InfeasiblePlan(k, contact.name, need, contact.mu, by=by, reason=reason)


def robustness(task: SkillTask) -> Margins:
    """Return by how much the cones hold at the nominal trajectory under ± the task's disturbance.

    The go's force changes by ± the disturbance along ``task.push``, and the ground answers. Raises InfeasiblePlan at
    the step and contact where a cone does not hold.
    """
    problem = task.problem
    if problem.eo_body is None:
        return _grounded_margins(task)
    asked = program(problem, problem.start)
    forces = np.zeros(asked.desired.shape)
    for c, contact in enumerate(problem.contacts):
        forces[:, c] = contact.wish
    placed = closure.place(problem, problem.angle, problem.travel)
    arm = placed.points[:, 0] - placed.eo[:, :2]
    push = np.column_stack([task.push, arm[:, 0] * task.push[:, 1] - arm[:, 1] * task.push[:, 0]])
    sizes = (0.0, -task.disturbance, task.disturbance)
    found = feasibility.margins(asked, push, sizes, forces)
    s, k, c = found.worst
    name, by = found.names[c], "go" if c < len(problem.contacts) else "ground"
    if not found.holds:
        raise _not_robust(k, name, float(found.needs[s, k, c]), float(found.has[k, c]), by, task.disturbance)
    spare = np.where(found.margin < np.inf, found.has - found.needs, np.inf)
    slips = np.array(
        [[mode.slip_sign != 0 for mode in contact.modes] for contact in (*problem.contacts, *problem.ground)]
    )
    spare = np.where(slips.T, np.inf, spare)
    least = float(spare.min())
    return Margins(
        disturbance=task.disturbance,
        force=float(found.margin.min()),
        mu=least if np.isfinite(least) else 0.0,
        step=k,
        contact=name,
        nominal_force=float(found.margin[0].min()),
    )


def _grounded_margins(task: SkillTask) -> Margins:
    """`robustness` of a go on the ground, whose contacts share the force: nothing else answers."""
    contact = task.problem.contacts[0]
    wish = np.sum([c.wish for c in task.problem.contacts], axis=0)
    mu, slips = contact.mu, np.array([mode.slip_sign != 0 for mode in contact.modes])
    worst = []
    for change in (-task.disturbance, task.disturbance, 0.0):
        force = wish + change * task.push[:, ::-1]  # n is +y, t is +x
        worst.append(np.where(slips, force[:, 0], cone_margin(force, mu)))
        if (worst[-1] < -EXACT).any() and change:
            k = int((worst[-1] < -EXACT).argmax())
            raise _not_robust(k, contact.name, float(required_friction(force[k])), mu, "ground", task.disturbance)
    least = np.minimum(worst[0], worst[1])
    k = int(least.argmin())
    force = wish[k] + np.array([[-1.0], [1.0]]) * task.disturbance * task.push[k, ::-1]
    spare = 0.0 if slips[k] else mu - float(np.max(required_friction(force)))
    return Margins(task.disturbance, float(least[k]), spare, k, contact.name, float(worst[2].min()))


def _not_robust(k: int, contact: str, need: float, have: float, by: str, disturbance: float) -> InfeasiblePlan:
    needs = f"needs µ ≥ {need:.3g}, has {have:.3g}" if np.isfinite(need) else "lifts off"
    reason = (
        f"does not bear ± {disturbance:.3g} N more or less of the go's force: {needs};"
        " choose a lighter object, another contact, or a smaller disturbance"
    )
    return InfeasiblePlan(k, contact, need, have, by=by, reason=reason)


def _ramps(task: SkillTask, z: Array, found: Evaluation, levels: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """The ramps before the first and after the last step: ee, go, eo and wrench of each, in closed form.

    At fixed poses the sensor's wrench goes straight from carrying the go's weight to balancing the contact's force.
    """
    problem = task.problem
    rise = np.linspace(0.0, 1.0, levels)
    if task.rest is None:
        begin = _ramp(problem, found.go[0], found.eo[0], found.wrench[0], rise)
    else:
        rest, y = task.rest, z[:1] * problem.scale
        placed = closure.place(rest, y[:, ANGLE], y[:, TRAVEL])
        forces = np.zeros(placed.points.shape)
        for c, contact in enumerate(rest.contacts):
            forces[:, c] = contact.wish
        weight, J = closure.go_weight(rest, placed), closure.go_jacobian(rest, placed)
        begin = _ramp(rest, placed.go[0], placed.eo[0], closure.sensor_wrench(weight, J, forces)[0], rise)
    if not task.back:
        return begin, _ramp(problem, found.go[-1], found.eo[-1], found.wrench[-1], rise[::-1])
    body = {"ee": found.ee, "go": found.go, "eo": found.eo, "wrench": found.wrench}
    return begin, {key: np.concatenate([body[key][::-1], begin[key][::-1]]) for key in body}


def _ramp(problem: Problem, go: Array, eo: Array, wrench: Array, rise: Array) -> dict[str, Any]:
    """The poses and wrenches (M, 3) at the shares ``rise`` (M,) of the contact's force."""
    poses = np.tile(go, (len(rise), 1))
    arm = se2.rotate(go[2], -problem.grasp[:2])
    weight = problem.go_body.mass * problem.gravity
    carried = np.array([0.0, weight, arm[0] * weight])
    wrenches = carried + rise[:, None] * (wrench - carried)
    return {
        "ee": Elasticity(problem.stiffness).ee_pose(poses, problem.grasp, wrenches),
        "go": poses,
        "eo": None if problem.eo_body is None else np.tile(eo, (len(rise), 1)),
        "wrench": wrenches,
    }


def _settings(optimiser: Optimiser | None) -> dict[str, Any] | None:
    """An optimiser's name and what of its settings JSON can hold."""
    if optimiser is None:
        return None
    plain = (bool, int, float, str, tuple, type(None))
    found = {item.name: getattr(optimiser, item.name) for item in fields(optimiser)} if is_dataclass(optimiser) else {}
    return {"name": optimiser.name, **{key: value for key, value in found.items() if isinstance(value, plain)}}


def _curve(optimum: Optimum | None, value: float) -> list[float | None]:
    """The loss per iteration; None where it was infinite."""
    curve = [value] if optimum is None else optimum.curve.tolist()
    return [figure if np.isfinite(figure) else None for figure in curve]
