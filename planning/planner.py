"""From a task to a plan: P2 over all steps and both ramps, after a check that the desired forces can be had."""

from __future__ import annotations

import time

import numpy as np

from mechanics import se2
from mechanics.friction import Mode, project_to_mode, required_friction
from mechanics.readings import Array
from planning import p2
from planning.errors import InfeasiblePlan
from planning.plan import Plan
from planning.task import ContactRequest, Task

RAMP_LEVELS = 11
"""Levels of a force ramp, both ends included."""


def plan(
    task: Task,
    name: str,
    *,
    backend: str | p2.Backend = "projection",
    levels: int = RAMP_LEVELS,
    tolerance: float = 1e-6,
) -> Plan:
    """Solve all steps of ``task`` and the ramps before and after; return the plan called ``name``.

    ``backend`` is a name of `BACKENDS` or a function that solves a `P2`; ``levels`` ≥ 2 counts a ramp's points;
    ``tolerance`` is how far, relative to its size, a desired force may lie outside what its mode admits. Raises
    InfeasiblePlan naming step and contact when one lies farther outside, or when the solver fails.
    """
    if levels < 2:
        raise ValueError(f"plan '{name}': levels: expected at least 2, received {levels}")
    solve, planner = _backend(backend)
    check_desired(task, tolerance)

    began = time.perf_counter()
    last = task.steps - 1
    steps = [*range(task.steps), *[0] * levels, *[last] * levels]
    rise = np.linspace(0.0, 1.0, levels)
    program = p2.pose(task, steps=steps, level=np.concatenate([np.ones(task.steps), rise, rise[::-1]]))
    solution = solve(program)
    for k, status in zip(steps, solution.status, strict=True):
        if status == "failed":
            names = "', '".join(contact.name for contact in task.contacts)
            raise InfeasiblePlan(k, names, np.nan, np.nan, reason=f"the {planner} solver found no force")
    wrench = program.wrench(solution.forces)
    ee, go = program.ee(wrench), program.go
    took = time.perf_counter() - began

    parts = np.split(np.arange(len(steps)), [task.steps, task.steps + levels])
    body, preload, unload = parts
    contacts = task.contacts
    return Plan(
        name=name,
        skill=task.skill,
        planner=planner,
        X_go_gocf=task.X_go_gocf,
        stiffness=task.stiffness,
        mass=task.mass,
        com=task.com,
        gravity=task.gravity,
        ee=ee[body],
        go=task.go,
        eo=None,
        wrench=wrench[body],
        contact_names=tuple(contact.name for contact in contacts),
        contact_points=_points(task),
        contact_normals=program.normals[body],
        contact_forces=solution.forces[body],
        contact_modes=program.modes[: task.steps],
        contact_mu=np.array([contact.mu for contact in contacts]),
        preload_ee=ee[preload],
        preload_go=go[preload],
        preload_wrench=wrench[preload],
        unload_ee=ee[unload],
        unload_go=go[unload],
        unload_wrench=wrench[unload],
        status="inaccurate" if "inaccurate" in solution.status else "solved",
        loss=float(np.mean(program.objective(solution.forces)[body])),
        queries=len(steps),
        time_s=took,
    )


def check_desired(task: Task, tolerance: float = 1e-6) -> None:
    """Raise InfeasiblePlan at the first step and contact whose desired force its mode does not admit."""
    for k in range(task.steps):
        for contact in task.contacts:
            mode, force = contact.modes[k], contact.force[k]
            away = float(np.linalg.norm(force - project_to_mode(force, mode, contact.mu)))
            if away > tolerance * max(float(np.linalg.norm(force)), 1e-9):
                raise _refusal(contact, k)


def _refusal(contact: ContactRequest, k: int) -> InfeasiblePlan:
    mode, (normal, tangential) = contact.modes[k], contact.force[k]
    need, reason = float(required_friction(contact.force[k])), None
    if mode is Mode.FREE:
        reason = f"is free, so it carries no force; desired was ({normal:.3g}, {tangential:.3g}) N"
    elif mode.slip_sign and normal > 0:
        needed = mode.slip_sign * contact.mu * normal
        reason = (
            f"slips ({mode}), so f_t must be {needed:.3g} N at f_n = {normal:.3g} N with µ = {contact.mu:.3g};"
            f" desired was {tangential:.3g} N"
        )
    return InfeasiblePlan(k, contact.name, need, contact.mu, contact.by, reason)


def _points(task: Task) -> Array:
    if not task.contacts:
        return np.empty((task.steps, 0, 2))
    return np.stack([se2.transform(task.go, contact.p_goC) for contact in task.contacts], axis=1)


def _reference(problem: p2.P2) -> p2.Solution:
    from planning import qp_reference

    return qp_reference.solve(problem)


BACKENDS: dict[str, p2.Backend] = {"projection": p2.solve_by_projection, "cvxpylayers": _reference}
"""Ways to solve P2: the exact closed form, and cvxpylayers (`planning.qp_reference`)."""


def _backend(backend: str | p2.Backend) -> tuple[p2.Backend, str]:
    if callable(backend):
        return backend, getattr(backend, "__name__", "custom")
    if backend not in BACKENDS:
        raise ValueError(f"plan: backend: expected one of {', '.join(sorted(BACKENDS))}, received {backend!r}")
    return BACKENDS[backend], backend
