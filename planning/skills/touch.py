"""How the grasped object touches the extrinsic one: corner on face or face on corner, and how far it may turn there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from mechanics import se2
from mechanics.readings import Array
from planning.problem import Touch
from planning.skills import outline, stance

#: two events this close [rad] are one
SAME = 1e-7
#: bodies may overlap by this much [m²]: rounding
OVERLAP = 1e-10


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where two outlines meet: ``p_go`` and ``p_eo`` (2,) [m] each in its body's frame.

    ``normal`` (2,) is the touched face's outward unit normal in its owner's frame, ``angle`` [rad] = θ_go − θ_eo.
    ``before`` and ``after`` [m] are how far the contact may travel along −e and +e on the touched face.
    """

    touch: Touch
    p_go: Array
    p_eo: Array
    normal: Array
    angle: float
    before: float
    after: float

    @property
    def into_eo(self) -> Array:
        """The contact's unit normal (2,) into the extrinsic object, in its frame."""
        if self.touch is Touch.CORNER_ON_FACE:
            return -self.normal
        return se2.rotate(self.angle, self.normal)

    def at(self, travel: float) -> tuple[Array, Array]:
        """``p_go`` and ``p_eo`` (2,) that meet after ``travel`` [m]."""
        moved = travel * np.array([self.normal[1], -self.normal[0]])
        if self.touch is Touch.CORNER_ON_FACE:
            return self.p_go, self.p_eo + moved
        return self.p_go + moved, self.p_eo


def upright_on(normal: Array) -> float:
    """Return the angle [rad] at which a body's +y axis points along ``normal`` (2,)."""
    return float(np.arctan2(-normal[0], normal[1]))


def corner_on_face(go: Array, place: outline.Place, tilt: float) -> Meeting:
    """Return how the go's corner (the lowest at this tilt) stands on a place of the eo.

    ``tilt`` [rad] is the angle of the go's y axis from the face's outward normal. Raises ValueError naming
    ``tilt_deg`` where a whole face of the go would lie on it.
    """
    points = stance.lowest_points(go, tilt)
    if len(points) > 1:
        raise ValueError(
            f"tilt_deg: expected the grasped object to stand on one corner, but at {np.rad2deg(tilt):.4g}° a face of"
            " it lies on the other's: tilt it"
        )
    angle = upright_on(place.normal) + tilt
    return Meeting(Touch.CORNER_ON_FACE, points[0], place.point, place.normal, angle, place.before, place.after)


def face_on_corner(eo: Array, vertex: int, place: outline.Place, tilt: float) -> Meeting:
    """Return how a place on the go's outline lies on the eo's corner number ``vertex``.

    ``tilt`` [rad] turns the go from where its face is square to the bisector of the corner. Raises ValueError naming
    ``contact_mm`` where the corner points inward.
    """
    if not outline.is_convex_corner(eo, vertex):
        raise ValueError(
            f"contact_mm: expected a corner that points outward, but the outline turns inward at {spelled(eo[vertex])}"
        )
    faces = outline.normals(eo)
    bisector = faces[vertex] + faces[vertex - 1]
    opposite = np.arctan2(-bisector[1], -bisector[0]) - np.arctan2(place.normal[1], place.normal[0])
    angle = float(se2.wrap(opposite + tilt))
    return Meeting(Touch.FACE_ON_CORNER, place.point, eo[vertex], place.normal, angle, place.before, place.after)


def room(go: Array, eo: Array, meeting: Meeting, travel: float = 0.0) -> tuple[float, float]:
    """Return the least and largest relative angle [rad] that turn the go about the contact without penetration.

    ``go`` and ``eo`` are outlines. A turn ends where a corner of either body comes to lie on a face of the other.
    Raises ValueError naming ``tilt_deg`` where they overlap at the meeting's angle, or touch elsewhere too.
    """
    p_go, p_eo = meeting.at(travel)
    mine, other = se2.rotate(meeting.angle, go - p_go), eo - p_eo
    if shapely.Polygon(mine).intersection(shapely.Polygon(other)).area > OVERLAP:
        raise ValueError(
            f"tilt_deg: expected the bodies to touch in one point at {spelled(p_eo)} of the extrinsic object,"
            " but they would overlap: choose another tilt or contact"
        )
    events = np.concatenate([_meets(mine, other), -_meets(other, mine)])
    if (np.abs(events) < SAME).any():
        raise ValueError(
            f"tilt_deg: expected the bodies to touch in one point at {spelled(p_eo)} of the extrinsic object,"
            " but they touch elsewhere too: choose another tilt or contact"
        )
    ahead = np.mod(events, 2 * np.pi)
    least, most = (-np.pi, np.pi) if not len(ahead) else (ahead.max() - 2 * np.pi, ahead.min())
    return meeting.angle + float(least), meeting.angle + float(most)


def room_above_ground(body: Array, at: Array, height: float, theta: float) -> tuple[float, float]:
    """Return the least and largest angle [rad] at which ``body`` (V, 2), turned about its point ``at``, is above y = 0.

    The point stands ``height`` [m] above it, and ``theta`` is the angle from which the turn begins. Raises ValueError
    naming ``tilt_deg`` where the body is below the ground there.
    """
    arms = body - at
    radius = np.linalg.norm(arms, axis=1)
    now = np.arctan2(arms[:, 1], arms[:, 0]) + theta
    lowest = height + float((radius * np.sin(now)).min())
    if lowest < -1e-6:
        raise ValueError(
            f"tilt_deg: expected the grasped object above the ground, but a corner is {-lowest * 1e3:.3g} mm below it:"
            " choose another tilt, or a higher contact"
        )
    reach = (radius > height) & (radius > 1e-9)
    if not reach.any():
        return theta - np.pi, theta + np.pi
    # a corner meets the ground on the right of the point at the angle ``right``, on its left at π − right
    right = np.arcsin(np.clip(-height / radius[reach], -1.0, 1.0))
    ahead, behind = np.mod(np.pi - right - now[reach], 2 * np.pi), np.mod(now[reach] - right, 2 * np.pi)
    # where it is there already, rounding must not give it a whole turn
    ahead, behind = (np.where(turn > 2 * np.pi - SAME, 0.0, turn) for turn in (ahead, behind))
    return theta - float(behind.min()), theta + float(ahead.min())


def spelled(point: Array) -> str:
    """A point [m] in millimetres, for a person."""
    return f"({point[0] * 1e3:.4g}, {point[1] * 1e3:.4g}) mm"


def _meets(turning: Array, still: Array) -> Array:
    """Return the turns (E,) in (−π, π] about the origin that bring a corner of ``turning`` onto a face of ``still``."""
    radius = np.linalg.norm(turning, axis=1)
    start, edge = still, np.roll(still, -1, axis=0) - still
    # |start + s edge| = radius
    a = (edge * edge).sum(axis=1)
    b = (start * edge).sum(axis=1)
    c = (start * start).sum(axis=1) - radius[:, None] ** 2
    root = b * b - a * c
    turns = []
    for sign in (-1.0, 1.0):
        share = (-b + sign * np.sqrt(np.maximum(root, 0.0))) / a
        i, j = np.nonzero((root >= 0) & (share >= -1e-9) & (share <= 1 + 1e-9) & (radius > 1e-9)[:, None])
        there = start[j] + share[i, j][:, None] * edge[j]
        turns.append(np.arctan2(there[:, 1], there[:, 0]) - np.arctan2(turning[i, 1], turning[i, 0]))
    return np.asarray(se2.wrap(np.concatenate(turns)))
