"""A trajectory solved and weighed at some z, in numpy with any backend, and what makes its loss infinite.

Derivatives are the matter of `planning.objective` and `planning.fused.objective`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from array_api_compat import is_torch_array

from mechanics.friction import Mode
from mechanics.readings import Array
from planning import losses, trajectory
from planning.backends import BACKENDS
from planning.errors import InfeasiblePlan
from planning.problem import VARIABLES, Problem
from planning.program import Backend, ContactProgram, Solution
from planning.trajectory import Posed


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A solved trajectory of K steps and C contacts, in numpy: the object contacts first, then those with the ground.

    Poses (K, 3) X_W_go, X_W_ee, X_W_eo; ``wrench`` (K, 3) of the sensor on the go about the grasp centre, axes of W;
    ``points`` and ``normals`` (K, C, 2) in W, ``forces`` (K, C, 2), ``modes`` K × C and ``mu`` (C,), signs as in
    `mechanics.friction`. ``terms`` is each loss by name, ``value`` their sum, +inf outside a barrier or where a program
    has no solution: ``solution.status`` says which.
    """

    go: Array
    ee: Array
    eo: Array
    wrench: Array
    names: tuple[str, ...]
    points: Array
    normals: Array
    forces: Array
    modes: tuple[tuple[Mode, ...], ...]
    mu: Array
    terms: dict[str, float]
    value: float
    solution: Solution


class OutsideBarrier(InfeasiblePlan):
    """A step lies beyond what a barrier keeps it from, so the loss is infinite and has no gradient.

    ``contact`` is the loss: ``penetration``, ``workspace``, ``joints`` or ``sensor``.
    """

    def __str__(self) -> str:
        return f"{self.contact}, step {self.step}: {self.reason}"


def backend_of(backend: str | Backend) -> Backend:
    """Return a backend by name. Raises ValueError for an unknown one."""
    if callable(backend):
        return backend
    if backend not in BACKENDS:
        raise ValueError(f"objective: backend: expected one of {', '.join(sorted(BACKENDS))}, received {backend!r}")
    return BACKENDS[backend]()


def evaluate(problem: Problem, z: Array, backend: str | Backend = "fused") -> Evaluation:
    """Return everything at ``z`` (K, 5). Nothing is raised where a program has no solution."""
    z = np.asarray(z, dtype=np.float64)
    check_shape(problem, z)
    posed, _, solution = _solved(problem, z, backend)
    parts = trajectory.residuals(problem, posed, solution.forces)
    terms = {name: float((r**2).sum()) for name, r in parts.items()}
    value = sum(terms.values()) if solution.usable.all() else np.inf
    wrench, ee = trajectory.sensor(problem, posed, solution.forces)
    return Evaluation(
        go=posed.placed.go,
        ee=ee,
        eo=np.array(problem.eo),
        wrench=wrench,
        names=trajectory.contact_names(problem),
        points=posed.placed.points,
        normals=posed.placed.normals,
        forces=solution.forces,
        modes=tuple(zip(*(contact.modes for contact in (*problem.contacts, *problem.ground)), strict=True)),
        mu=trajectory.contact_mu(problem),
        terms=terms,
        value=float(value) if not np.isnan(value) else np.inf,
        solution=solution,
    )


def refusal(problem: Problem, z: Array, backend: str | Backend = "fused") -> InfeasiblePlan | None:
    """Return what makes the loss infinite at ``z`` (K, 5), naming step and constraint; None where it is finite.

    Raises ValueError for a z of another shape, or that is not finite.
    """
    z = np.asarray(z, dtype=np.float64)
    check_shape(problem, z)
    check_finite(problem, z)
    posed, asked, solution = _solved(problem, z, backend)
    if not solution.usable.all():
        return _without_solution(asked, solution)
    for name, residual in trajectory.residuals(problem, posed, solution.forces).items():
        infinite = np.argwhere(~np.isfinite(residual))
        if len(infinite):
            k, i = (int(n) for n in infinite[0])
            return _outside(problem, posed, solution.forces, name, k, i)
    return None


def check_shape(problem: Problem, z: Array, batched: bool = False) -> None:
    """Raise ValueError unless ``z`` is (K, 5), or (B, K, 5) where ``batched``."""
    if z.ndim != 2 + batched or z.shape[-2:] != (problem.steps, VARIABLES):
        expected = f"({'B, ' * batched}{problem.steps}, {VARIABLES})"
        raise ValueError(f"objective: z: expected shape {expected}, received {z.shape}")


def check_finite(problem: Problem, z: Array) -> None:
    """Raise ValueError naming the step unless what is free of ``z`` (K, 5) is finite."""
    finite = np.isfinite(np.where(problem.free, z, 0.0)).all(axis=1)
    if not finite.all():
        k = int(np.argmin(finite))
        raise ValueError(f"objective: z: step {k}: expected finite numbers, received {z[k].tolist()}")


def _solved(problem: Problem, z: Array, backend: str | Backend) -> tuple[Posed, ContactProgram, Solution]:
    """The problem at ``z`` (K, 5), its programs and their solution in numpy."""
    posed = trajectory.pose(problem, np.where(problem.free, z, problem.start))
    asked = trajectory.posed_program(problem, posed)
    solution = backend_of(backend)(asked)
    given = {field.name: getattr(solution, field.name) for field in fields(solution)}
    plain = {name: value.detach().cpu().numpy() for name, value in given.items() if is_torch_array(value)}
    return posed, asked, replace(solution, **plain)


def _outside(problem: Problem, posed: Posed, forces: Array, name: str, k: int, i: int) -> OutsideBarrier:
    """The residual ``i`` of the loss ``name`` that is infinite at step ``k``, in figures."""
    wrench, ee = (value[k] for value in trajectory.sensor(problem, posed, forces))
    limits = problem.limits
    reason = "the loss is infinite"
    if name == "penetration":
        angle, (lo, hi) = np.degrees(posed.variables.angle[k]), np.degrees(problem.angle_limits[k])
        reason = f"the relative angle is {angle:.4g}°, admissible are {lo:.4g}° to {hi:.4g}°"
    elif name == "workspace" and limits.workspace is not None:
        which, unit, factor = (("x", "mm", 1e3), ("y", "mm", 1e3), ("angle", "°", 180 / np.pi))[i]
        lo, hi = limits.workspace[i] * factor
        reason = f"the end-effector's {which} is {ee[i] * factor:.4g} {unit}, the workspace {lo:.4g} to {hi:.4g} {unit}"
    elif name == "joints" and limits.arm is not None:
        readings, reachable = losses.joint_readings(limits.arm, ee)
        joint, (lo, hi) = ("shoulder", "elbow", "wrist")[i], np.degrees(limits.arm.limits[i])
        reason = f"the {joint} is at {np.degrees(float(readings[i])):.4g}°, its limits are {lo:.4g}° to {hi:.4g}°"
        if not reachable:
            reason = f"the arm does not reach ({ee[0] * 1e3:.4g}, {ee[1] * 1e3:.4g}) mm at {np.degrees(ee[2]):.4g}°"
    elif name == "sensor" and i == 0 and limits.force is not None:
        reason = f"the sensor takes {limits.force:.4g} N and is to carry {np.hypot(wrench[0], wrench[1]):.4g} N"
    elif name == "sensor" and limits.torque is not None:
        reason = f"the sensor takes {limits.torque * 1e3:.4g} N·mm and is to carry {abs(wrench[2]) * 1e3:.4g} N·mm"
    return OutsideBarrier(k, name, np.nan, np.nan, reason=reason)


def _without_solution(asked: ContactProgram, solution: Solution) -> InfeasiblePlan:
    """The first step whose program has no solution, and why."""
    from planning.feasibility import explain

    k = int(np.argmin(solution.usable))
    found = explain(asked, k, hard=False)
    if found is not None:
        return found.error()
    reason = f"forces exist, but the solver found none ({solution.status[k]})"
    return InfeasiblePlan(k, "', '".join(asked.names), np.nan, np.nan, reason=reason)
