"""Where the go touches the object that it pivots, and at which tilt, when the user leaves it open: by statics alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mechanics import se2
from mechanics.contact import force_in_world
from mechanics.readings import Array
from planning.problem import Touch
from planning.skills import on_object, outline, touch
from planning.skills.base import Scene
from planning.skills.support import Pushed
from planning.skills.touch import Meeting

if TYPE_CHECKING:
    from planning.skills.extrinsic_pivoting import ExtrinsicPivotingParameters

#: tilts [deg] that are tried: 10° to 30° to either side of square
TILTS = (*range(10, 31), *range(-10, -31, -1))
#: tilts that are tried of a go whose face lies on a corner, as far as they turn it to neither face of the eo
SQUARE_TILTS = tuple(range(-40, 41))
#: contacts are tried at this spacing, and not closer than `OFF_ENDS` to the end of a face [m]
SPACING, OFF_ENDS = 1e-3, 5e-3
#: faces are tried that look up by at least this: the sine of their slope
LOOKS_UP = 0.1
#: room [rad] that is left to where the go lies flush
FLUSH = np.deg2rad(3.0)

Statics = Callable[[Meeting], Pushed]


def choose(
    parameters: ExtrinsicPivotingParameters, scene: Scene, flat: float, right: bool, f_n: Array, statics_of: Statics
) -> Meeting:
    """Return the meeting that the parameters ask for, with what they leave open chosen.

    ``flat`` [rad] is the eo's angle when it lies, ``right`` whether its right corner is the pivot, ``f_n`` (K,) [N].
    Raises ValueError naming the parameter where no tilt keeps the bodies apart.
    """
    eo = outline.straightened(on_object.extrinsic_of(scene, "").vertices)
    vertex = _highest(eo, flat, right)
    if parameters.kind is Touch.FACE_ON_CORNER:
        if parameters.tilt_deg is not None:
            return on_object.meeting(parameters, scene, np.deg2rad(parameters.tilt_deg), None, vertex)
        tried = _apart(parameters, scene, None, vertex, SQUARE_TILTS, statics_of)
        return min(tried, key=lambda met: float(_strain(statics_of(met), f_n, parameters.disturbance).max()))
    place = None
    if parameters.contact_mm is None:
        place = (
            _most_room(parameters, eo, flat, f_n, statics_of)
            if parameters.from_apex_mm is None
            else _from_apex(eo, flat, vertex, right, parameters.from_apex_mm * 1e-3)
        )
    if parameters.tilt_deg is not None:
        return on_object.meeting(parameters, scene, np.deg2rad(parameters.tilt_deg), place, vertex)
    tried = _apart(parameters, scene, place, vertex, TILTS, statics_of)
    return min(tried, key=lambda met: _torque(scene, met, statics_of(met), f_n))


def _highest(eo: Array, flat: float, right: bool) -> int:
    """The highest corner of the eo; of several, the one farthest from the pivot."""
    turned = se2.rotate(flat, eo)
    top = np.flatnonzero(turned[:, 1] > turned[:, 1].max() - 1e-6)
    return int(top[(turned[top, 0] if right else -turned[top, 0]).argmin()])


def _from_apex(eo: Array, flat: float, apex: int, right: bool, distance: float) -> outline.Place:
    """The place at ``distance`` [m] from the highest corner: on the upper face, or else on the one away from the pivot.

    The outline runs counter-clockwise, so that the face to the left of the apex begins there.
    """
    height = se2.rotate(flat, eo)[:, 1]
    level = abs(float(height[apex] - height[apex - 1 if right else (apex + 1) % len(eo)])) < 1e-6
    begins = right != level
    face = apex if begins else (apex - 1) % len(eo)
    length = float(np.linalg.norm(eo[(face + 1) % len(eo)] - eo[face]))
    if not outline.CORNER < distance < length - outline.CORNER:
        raise ValueError(
            f"from_apex_mm: expected a point on the face of {length * 1e3:.4g} mm beside the highest corner, received"
            f" {distance * 1e3:g} mm"
        )
    share = distance / length
    return outline.on_face(eo, face, 1 - share if begins else share)


def _most_room(
    parameters: ExtrinsicPivotingParameters, eo: Array, flat: float, f_n: Array, statics_of: Statics
) -> outline.Place:
    """The place on a face that looks up where the cones are strained least, the disturbance included."""
    places = []
    for face, normal in enumerate(outline.normals(eo)):
        length = float(np.linalg.norm(eo[(face + 1) % len(eo)] - eo[face]))
        if se2.rotate(flat, normal)[1] >= LOOKS_UP:
            places += [
                outline.on_face(eo, face, distance / length)
                for distance in np.arange(OFF_ENDS, length - OFF_ENDS, SPACING)
            ]
    if not places:
        raise ValueError("contact_mm: expected a face of the extrinsic object that looks up: name the contact")
    first = Meeting(Touch.CORNER_ON_FACE, np.zeros(2), places[0].point, places[0].normal, 0.0, 0.0, 0.0)
    one = statics_of(first)
    K, N = len(one.eo), len(places)
    every = replace(
        one,
        eo=np.tile(one.eo, (N, 1)),
        point=np.repeat([place.point for place in places], K, axis=0),
        normal=np.repeat([-place.normal for place in places], K, axis=0),
    )
    strain = _strain(every, np.tile(f_n, N), parameters.disturbance)
    return places[int(strain.reshape(N, K).max(axis=1).argmin())]


def _strain(statics: Pushed, f_n: Array, disturbance: float) -> Array:
    """The largest share (K,) of the friction that is needed, the disturbance included; ∞ where a contact pulls."""
    f_t = statics.tangential(f_n)
    stuck = ~np.isfinite(f_t)
    wish = np.column_stack([f_n, np.where(stuck, 0.0, f_t)])
    n, t = statics.axes()
    way = on_object.toward(statics)
    change = disturbance * np.column_stack([(way * n).sum(axis=1), (way * t).sum(axis=1)])
    shares = [np.where(stuck, np.inf, 0.0)]
    for force in (wish, wish + change, wish - change):
        at_object, at_ground = statics.needs(force)
        shares += [at_object / max(statics.mu_object, 1e-9), at_ground / max(statics.mu, 1e-9)]
    return np.max(shares, axis=0)


def _apart(parameters, scene: Scene, place, vertex: int, tilts, statics_of: Statics) -> list[Meeting]:
    """The meetings at those ``tilts`` [deg] that leave both bodies apart, and the go above the ground."""
    mine = outline.straightened(scene.held.vertices)
    theirs = outline.straightened(on_object.extrinsic_of(scene, "").vertices)
    found, refusal = [], None
    for tilt in tilts:
        try:
            met = on_object.meeting(parameters, scene, np.deg2rad(tilt), place, vertex)
            lo, hi = touch.room(mine, theirs, met)
            if met.angle - lo < FLUSH or hi - met.angle < FLUSH:
                continue
            for eo in statics_of(met).eo[[0, -1]]:
                height = float(se2.transform(eo, met.p_eo)[1])
                touch.room_above_ground(mine, met.p_go, height, float(eo[2]) + met.angle)
        except ValueError as error:
            if not str(error).startswith("tilt_deg"):
                raise
            refusal = error
            continue
        found.append(met)
    if not found:
        why = "" if refusal is None else f" ({refusal})"
        raise ValueError(f"tilt_deg: no tilt keeps the bodies apart at this contact: name another contact{why}")
    return found


def _torque(scene: Scene, met: Meeting, statics: Pushed, f_n: Array) -> float:
    """The largest torque [N·m] of the contact and the weight on the go about the grasp centre."""
    held = scene.held
    push = -force_in_world(statics.axes()[0], statics.balancing(f_n))
    theta = statics.eo[:, 2] + met.angle
    arm = se2.rotate(theta, np.broadcast_to(met.p_go - held.grasp[:2], (len(theta), 2)))
    com = se2.rotate(theta, np.broadcast_to(-held.grasp[:2], (len(theta), 2)))
    torque = arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0] - com[:, 0] * held.mass * held.gravity
    return float(np.abs(torque).max())
