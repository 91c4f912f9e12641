"""Whether the nominal values of a problem can be: contacts on their faces, modes that agree with motion and each other.

A problem is judged by its geometry alone; whether forces balance is for `planning.feasibility`.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from mechanics.friction import Mode, tangent
from mechanics.readings import Array
from planning.closure import Placement, place
from planning.problem import TRAVEL, Body, GroundContact, ObjectContact, Problem, Touch

NEAR = 1e-6
"""Points this close [m] are the same, and a contact this far from its face is on it."""

STILL = 1e-5
"""What moves less than this [m] from step to step does not move."""

PARALLEL = 1e-6
"""Unit normals that differ by less are the same."""


def check(problem: Problem) -> None:
    """Raise ValueError that names field and step of what cannot be."""
    name, K = f"problem '{problem.skill}'", problem.steps
    contacts = (*problem.contacts, *problem.ground)
    if not 1 <= len(problem.contacts) <= 2:
        raise ValueError(f"{name}: contacts: expected 1 or 2 of the grasped object, received {len(problem.contacts)}")
    if problem.eo_body is None and problem.ground:
        raise ValueError(f"{name}: ground: expected none without an extrinsic object, received {len(problem.ground)}")
    if problem.eo_body is not None and not 1 <= len(problem.ground) <= 2:
        raise ValueError(f"{name}: ground: expected 1 or 2 of the extrinsic object, received {len(problem.ground)}")
    names = [contact.name for contact in contacts]
    if len(set(names)) != len(names):
        raise ValueError(f"{name}: contacts: expected distinct names, received {names}")
    for contact in contacts:
        if len(contact.modes) != K:
            raise ValueError(
                f"{name}: contact '{contact.name}': modes: expected {K}, one per step, received {len(contact.modes)}"
            )
    _check_angles(name, problem)
    _check_outlines(name, problem)
    placed = place(problem, problem.angle, problem.travel)
    n = len(problem.contacts)
    _check_coincidence(name, problem.contacts, placed.points[:, :n])
    _check_coincidence(name, problem.ground, placed.points[:, n:])
    _check_second(name, problem, placed)
    _check_travel(name, problem)
    _check_ground(name, problem, placed.points[:, n:])
    _check_group(name, problem.contacts, "they lie on one face")
    _check_group(name, problem.ground, "they belong to one rigid body on one plane")


def face_range(vertices: Array, point: Array, normal: Array) -> tuple[float, float] | None:
    """Return how far (least ≤ 0, largest ≥ 0) [m] one can go from ``point`` (2,) along the face that it lies on.

    The face is that of the outline ``vertices`` (V, 2) with outward ``normal`` (2,); positive is along the normal
    turned by −90°. None where no such face holds the point.
    """
    v, after = vertices, np.roll(vertices, -1, axis=0)
    if (v[:, 0] * after[:, 1] - v[:, 1] * after[:, 0]).sum() > 0:
        v, after = after, v  # clockwise, a face leads along its outward normal turned by −90°
    along = tangent(normal)
    for a, b in zip(v - point, after - point, strict=True):
        start, end = float(along @ a), float(along @ b)
        if max(abs(normal @ a), abs(normal @ b)) < NEAR and start - NEAR <= 0 <= end + NEAR:
            return start, end
    return None


def travel_range(problem: Problem) -> tuple[float, float]:
    """Return the least and largest travel [m] at which the first contact is on its face; ±inf on an environment."""
    contact = problem.contacts[0]
    owner, point = _face_of(problem, contact)
    found = None if owner is None else face_range(owner.vertices, point, contact.normal)
    return (-np.inf, np.inf) if found is None else found


def _face_of(problem: Problem, contact: ObjectContact) -> tuple[Body | None, Array]:
    """The body that owns the face, None for the environment, and the point on it at zero travel."""
    if contact.touch is Touch.CORNER_ON_FACE:
        return problem.eo_body, contact.p_eo
    return problem.go_body, contact.p_go


def _check_angles(name: str, problem: Problem) -> None:
    """The relative angle is admissible at the start, or the penetration loss would be infinite there."""
    for k, (angle, (lo, hi)) in enumerate(zip(problem.angle, problem.angle_limits, strict=True)):
        limits = f"{np.degrees(lo):.6g}° … {np.degrees(hi):.6g}°"
        if not lo < hi:
            raise ValueError(
                f"{name}: angle_limits: step {k}: expected the least before the largest, received {limits}"
            )
        if not (lo < angle < hi if problem.weights.penetration > 0 else lo <= angle <= hi):
            within = "between" if problem.weights.penetration > 0 else "from"
            raise ValueError(f"{name}: angle: step {k}: expected {within} {limits}, received {np.degrees(angle):.6g}°")


def _check_outlines(name: str, problem: Problem) -> None:
    """Corners are corners, faces are faces, and travel stays on them."""
    for c, contact in enumerate(problem.contacts):
        place = f"{name}: contact '{contact.name}'"
        corner_on_face = contact.touch is Touch.CORNER_ON_FACE
        corner, whose = (contact.p_go, "go") if corner_on_face else (contact.p_eo, "eo")
        body = problem.go_body if corner_on_face else problem.eo_body
        if body is not None and c == 0 and len(problem.contacts) == 1:
            away = np.linalg.norm(body.vertices - corner, axis=1).min()
            if away > NEAR:
                raise ValueError(
                    f"{place}: p_{whose}: expected a corner of the {whose}, received {_mm(corner)} mm,"
                    f" {away * 1e3:.4g} mm from the nearest"
                )
        owner, point = _face_of(problem, contact)
        if owner is None:
            continue
        whose = "eo" if corner_on_face else "go"
        found = face_range(owner.vertices, point, contact.normal)
        if found is None:
            raise ValueError(
                f"{place}: p_{whose}: expected a point on a face of the {whose} with outward normal"
                f" ({contact.normal[0]:.4g}, {contact.normal[1]:.4g}), received {_mm(point)} mm"
            )
        if c > 0:
            continue  # travel is the first contact's
        lo, hi = found
        for k, travel in enumerate(problem.travel):
            if not lo - NEAR <= travel <= hi + NEAR and contact.modes[k] is not Mode.FREE:
                raise ValueError(
                    f"{place}: travel: step {k}: the contact is off the face, which goes from {lo * 1e3:.4g} to"
                    f" {hi * 1e3:.4g} mm; received {travel * 1e3:.4g} mm"
                )
    if problem.eo_body is not None:
        for ground in problem.ground:
            away = np.linalg.norm(problem.eo_body.vertices - ground.p_eo, axis=1).min()
            if away > NEAR:
                raise ValueError(
                    f"{name}: contact '{ground.name}': p_eo: expected a vertex of the eo, received"
                    f" {_mm(ground.p_eo)} mm, {away * 1e3:.4g} mm from the nearest"
                )


def _check_coincidence(name: str, contacts: tuple[Any, ...], points: Array) -> None:
    """Two contacts between the same bodies are two points."""
    for (i, a), (j, b) in combinations(enumerate(contacts), 2):
        for k, gap in enumerate(np.linalg.norm(points[:, i] - points[:, j], axis=-1)):
            if gap < NEAR:
                raise ValueError(
                    f"{name}: contacts: step {k}: '{a.name}' and '{b.name}' coincide: expected points that are"
                    f" apart, received {gap:.3g} m; leave one out"
                )


def _check_second(name: str, problem: Problem, placed: Placement) -> None:
    """Where two contacts touch, the closure of the first must close the second too, now and later."""
    if len(problem.contacts) < 2:
        return
    first, second = problem.contacts
    owner_is_eo = second.touch is Touch.CORNER_ON_FACE
    owner = placed.eo if owner_is_eo else placed.go
    c, s = np.cos(owner[:, 2]), np.sin(owner[:, 2])
    p = second.p_eo if owner_is_eo else second.p_go
    on_face = owner[:, :2] + np.stack([c * p[0] - s * p[1], s * p[0] + c * p[1]], axis=1)
    normals = placed.normals[:, :2]
    gaps = np.abs(((placed.points[:, 1] - on_face) * normals[:, 1]).sum(axis=-1))
    apart = np.linalg.norm(normals[:, 1] - normals[:, 0], axis=-1)
    for k in range(problem.steps):
        if Mode.FREE in (first.modes[k], second.modes[k]):
            continue
        if apart[k] > PARALLEL:
            raise ValueError(
                f"{name}: contact '{second.name}': normal: step {k}: expected the face of '{first.name}', received a"
                f" normal that differs by {apart[k]:.3g}"
            )
        if gaps[k] > NEAR:
            raise ValueError(
                f"{name}: contact '{second.name}': angle: step {k}: the contact does not close: it is"
                f" {gaps[k] * 1e3:.4g} mm off its face at {np.degrees(problem.angle[k]):.6g}°"
            )
        if problem.free[k, 0]:
            raise ValueError(
                f"{name}: free: step {k}: '{first.name}' and '{second.name}' both touch, which fixes the angle:"
                " expected it not to be free"
            )


def _check_travel(name: str, problem: Problem) -> None:
    """Travel as the first contact's mode says; a contact that sticks keeps it for good."""
    contact = problem.contacts[0]
    for k, mode in enumerate(contact.modes):
        if mode is Mode.STICK and problem.free[k, TRAVEL]:
            raise ValueError(
                f"{name}: free: step {k}: contact '{contact.name}' sticks there: expected its travel not to be free"
            )
    for k, moved in enumerate(np.diff(problem.travel)):
        _check_motion(name, contact, k, moved, "travel")


def _check_ground(name: str, problem: Problem, points: Array) -> None:
    """What touches the ground is at one height, and moves as its mode says."""
    for c, contact in enumerate(problem.ground):
        touches = np.array([mode is not Mode.FREE for mode in contact.modes])
        for k, (dx, dy) in enumerate(np.diff(points[:, c], axis=0)):
            if touches[k] and touches[k + 1] and abs(dy) > STILL:
                raise ValueError(
                    f"{name}: eo: step {k + 1}: contact '{contact.name}' leaves the ground by {dy * 1e3:.4g} mm, but it"
                    f" is to {contact.modes[k + 1]}"
                )
            _check_motion(name, contact, k, dx, "eo")
    for k in range(problem.steps):
        heights = [points[k, c, 1] for c, g in enumerate(problem.ground) if g.modes[k] is not Mode.FREE]
        if len(heights) > 1 and np.ptp(heights) > STILL:
            raise ValueError(
                f"{name}: eo: step {k}: its contacts with the ground differ in height by"
                f" {np.ptp(heights) * 1e3:.4g} mm: expected it to lie flat, or one of them to be free"
            )


def _check_motion(name: str, contact: ObjectContact | GroundContact, k: int, moved: float, field: str) -> None:
    """``moved`` [m] from step k to k+1, where a positive one means slip−; the mode of either step may allow it."""
    modes = contact.modes[k : k + 2]
    if any(_allows(mode, moved) for mode in modes):
        return
    slips = Mode.SLIP_NEGATIVE if moved > 0 else Mode.SLIP_POSITIVE
    raise ValueError(
        f"{name}: {field}: step {k + 1}: contact '{contact.name}' moves by {moved * 1e3:.4g} mm, which is {slips}, but"
        f" its modes there are {modes[0]}, {modes[1]}"
    )


def _allows(mode: Mode, moved: float) -> bool:
    return {
        Mode.FREE: True,
        Mode.STICK: abs(moved) <= STILL,
        Mode.SLIP_NEGATIVE: moved >= -STILL,
        Mode.SLIP_POSITIVE: moved <= STILL,
    }[mode]


def _check_group(name: str, contacts: tuple[Any, ...], why: str) -> None:
    """Contacts of the same two rigid bodies that touch at a step do the same."""
    for a, b in combinations(contacts, 2):
        for k, pair in enumerate(zip(a.modes, b.modes, strict=True)):
            if Mode.FREE not in pair and pair[0] is not pair[1]:
                raise ValueError(
                    f"{name}: modes: step {k}: contact '{a.name}' is to {pair[0]} and '{b.name}' to {pair[1]}, but"
                    f" {why}: expected the same mode, or one of them free"
                )


def _mm(point: Array) -> str:
    return f"({point[0] * 1e3:.4g}, {point[1] * 1e3:.4g})"
