"""A problem as the flat arrays that the kernels read; built once."""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mechanics.friction import Mode
from mechanics.readings import Array
from planning.fused import layout
from planning.problem import Form, Problem, Touch
from planning.program import ContactProgram, codes
from planning.qp_fused import kinds_of

LENGTH = next(field.default for field in ContactProgram.__dataclass_fields__.values() if field.name == "length")

_CODES = {mode: int(codes([mode])[0]) for mode in Mode}


class Packed(NamedTuple):
    """See `planning.fused.layout`: ``kinds`` (K, C), ``steps`` (K, STEP), ``fixed`` (FIXED,), ``flags`` (FLAGS,),
    ``free`` (K, 5) as 0 and 1, ``start`` (K, 5)."""

    kinds: NDArray[np.int8]
    steps: NDArray[np.float64]
    fixed: NDArray[np.float64]
    flags: NDArray[np.int64]
    free: NDArray[np.int8]
    start: NDArray[np.float64]


def pack(problem: Problem) -> Packed:
    """Return a problem's arrays. Raises ValueError where it has more contacts than a kernel takes.

    A re-plan begins with it, and it takes a good part of its time: few array operations, and no checks twice.
    """
    n, m = len(problem.contacts), len(problem.ground)
    if n > 2 or m > 2:
        raise ValueError(
            f"problem '{problem.skill}': contacts: expected at most 2 of the grasped object and 2 with the ground,"
            f" received {n} and {m}"
        )
    two = problem.eo_body is not None
    relaxed = (two,) * n + (False,) * m
    contacts = (*problem.contacts, *problem.ground)
    modes = np.array([[_CODES[mode] for mode in contact.modes] for contact in contacts], np.int8).T
    kinds, slope = kinds_of(modes, np.array([contact.mu for contact in contacts]), relaxed)
    return Packed(
        np.ascontiguousarray(kinds),
        _steps(problem, slope),
        _fixed(problem),
        _flags(problem),
        np.ascontiguousarray(problem.free, dtype=np.int8),
        _start(problem),
    )


def _start(problem: Problem) -> NDArray[np.float64]:
    """Return z (K, 5) of which what is not free is right: where the paper form's v is free, it need not be found."""
    if problem.form is Form.CLOSED or not problem.free[:, 2:].all():
        return np.array(problem.start)
    start = np.zeros(problem.free.shape)
    start[:, 0], start[:, 1] = problem.angle / problem.scale[0], problem.travel / problem.scale[1]
    return start


def _steps(problem: Problem, slope: NDArray[np.float64]) -> NDArray[np.float64]:
    steps = np.zeros((problem.steps, layout.STEP))
    eo = np.asarray(problem.eo)
    co, si = np.cos(eo[:, 2]), np.sin(eo[:, 2])

    def put(at: int, vector: Array | tuple[float, float]) -> None:
        """Enter a vector of the eo's frame, in W. The checks of `mechanics.se2` take longer than all the rest here."""
        x, y = vector
        steps[:, at], steps[:, at + 1] = co * x - si * y, si * x + co * y

    steps[:, layout.THETA_EO] = eo[:, 2]
    steps[:, layout.EO_X], steps[:, layout.EO_Y] = eo[:, 0], eo[:, 1]
    steps[:, layout.ANGLE], steps[:, layout.TRAVEL] = problem.angle, problem.travel
    steps[:, layout.LOWEST], steps[:, layout.HIGHEST] = problem.angle_limits.T
    steps[:, layout.WISH : layout.WISH + 2] = sum(contact.wish for contact in problem.contacts)
    for c, contact in enumerate(problem.contacts):
        at = layout.OBJECT + 6 * c
        eo_owns_face = contact.touch is Touch.CORNER_ON_FACE
        into = -contact.normal if eo_owns_face == (problem.eo_body is not None) else contact.normal
        put(at, contact.p_eo)
        steps[:, at : at + 2] += eo[:, :2]
        if eo_owns_face:
            put(at + 2, _tangent(contact.normal))
            put(at + 4, into)
        else:
            steps[:, at + 4 : at + 6] = into
    for g, ground in enumerate(problem.ground):
        put(layout.GROUND + 2 * g, ground.p_eo)
    steps[:, layout.SLOPE : layout.SLOPE + slope.shape[1]] = slope
    return steps


def _fixed(problem: Problem) -> NDArray[np.float64]:
    fixed, K = np.zeros(layout.FIXED), problem.steps

    def put(at: int, *values: float) -> None:
        fixed[at : at + len(values)] = values

    rho, grasp = problem.go_body.rho, problem.grasp.tolist()
    put(layout.SCALE, *problem.scale)
    fixed[layout.GO_WEIGHT] = problem.go_body.mass * problem.gravity
    fixed[layout.EO_WEIGHT] = problem.eo_body.mass * problem.gravity if problem.eo_body else 0.0
    fixed[layout.RHO], fixed[layout.LENGTH], fixed[layout.U_OBJECT] = rho, LENGTH, problem.force_weight
    put(layout.GRASP, *grasp)
    put(layout.GRASP_TURN, cos(grasp[2]), sin(grasp[2]))
    put(layout.STIFFNESS, *problem.stiffness.ravel())
    put(layout.COMPLIANCE, *np.linalg.inv(problem.stiffness).ravel().tolist())
    for c, contact in enumerate(problem.contacts):
        put(layout.P_GO + 2 * c, *contact.p_go)
    put(layout.FACE_GO, *_tangent(problem.contacts[0].normal))
    weight = problem.slack_weight
    put(layout.SLACK, weight, weight, weight * rho**-2)
    names = ("cone", "pull", "smooth", "force", "penetration", "slack", "track", "workspace", "joints", "sensor")
    weights = [getattr(problem.weights, name) / (max(K - 1, 1) if name == "smooth" else K) for name in names]
    put(layout.W_CONE, *(weight**0.5 for weight in weights))
    limits = problem.limits
    if limits.workspace is not None:
        put(layout.WORK_MIDDLE, *limits.workspace.mean(axis=1))
        put(layout.WORK_HALF, *(np.diff(limits.workspace, axis=1) / 2).ravel())
    if limits.arm is not None:
        arm = limits.arm
        put(layout.BASE, *arm.base, arm.upper, arm.fore, *arm.tool, arm.elbow, *arm.zero)
        put(layout.JOINT_MIDDLE, *arm.limits.mean(axis=1))
        put(layout.JOINT_HALF, *(np.diff(arm.limits, axis=1) / 2).ravel())
    fixed[layout.MOST_FORCE], fixed[layout.MOST_TORQUE] = limits.force or 0.0, limits.torque or 0.0
    return fixed


def _tangent(normal: Array) -> tuple[float, float]:
    """`mechanics.friction.tangent` of one normal that the problem has checked."""
    return float(normal[1]), -float(normal[0])


def _flags(problem: Problem) -> NDArray[np.int64]:
    flags = np.zeros(layout.FLAGS, np.int64)
    weights, limits = problem.weights, problem.limits
    flags[layout.PAPER] = problem.form is Form.PAPER
    flags[layout.TWO_BODIES] = problem.eo_body is not None
    flags[layout.OBJECTS], flags[layout.GROUNDS] = len(problem.contacts), len(problem.ground)
    flags[layout.CORNERS] = sum(
        1 << c for c, contact in enumerate(problem.contacts) if contact.touch is Touch.CORNER_ON_FACE
    )
    flags[layout.WORKSPACE] = limits.workspace is not None and weights.workspace > 0
    flags[layout.JOINTS] = limits.arm is not None and weights.joints > 0
    flags[layout.MOST_F] = limits.force is not None and weights.sensor > 0
    flags[layout.MOST_T] = limits.torque is not None and weights.sensor > 0
    return flags
