"""What the skills on an extrinsic object share: how it lies, how the go touches it, and the problem P1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mechanics import se2
from mechanics.contact import force_in_world
from mechanics.friction import Mode
from mechanics.readings import Array
from planning.problem import Form, GroundContact, Limits, LossWeights, ObjectContact, Problem, Touch
from planning.skills import outline, stance, touch
from planning.skills.base import Angle, Disturbance, Extrinsic, Scene, SkillParameters, SkillTask, Steps
from planning.skills.support import Pushed
from planning.skills.touch import Meeting

Millimetres = Annotated[float, Field(ge=-2000, le=2000)]
Point = tuple[Millimetres, Millimetres]

OBJECT = "object"

CLEARANCE = float(np.deg2rad(5.0))
"""[rad] that an optimiser keeps away from where a face lies flush: a contact there is one of two at the next error."""

LEFT, RIGHT = "ground left", "ground right"


class TouchParameters(SkillParameters):
    """How the go touches the eo.

    ``touch``: a corner of the go on a face of the eo, or a face of the go on a corner of the eo. ``contact_mm`` is the
    point of the eo's outline, in its frame: on a face, or its corner; by default the skill chooses it.
    ``go_contact_mm`` is where on the go's outline, in its frame, the eo's corner lies; by default the middle of its
    lower face. ``ground_x`` [m] is where on the ground the eo's frame has its origin (a pivot: where the pivot is).
    """

    touch: Literal["corner_on_face", "face_on_corner"] = "corner_on_face"
    contact_mm: Point | None = None
    go_contact_mm: Point | None = None
    ground_x: float = 0.0
    steps: Steps = 20

    @property
    def kind(self) -> Touch:
        """``touch`` as problems spell it."""
        return Touch.CORNER_ON_FACE if self.touch == "corner_on_face" else Touch.FACE_ON_CORNER


class LyingParameters(TouchParameters):
    """The eo lies on a face: ``eo_angle_deg`` is its angle, counter-clockwise.

    ``disturbance`` [N] of the go's force, more and less, that the contacts have to bear.
    """

    eo_angle_deg: Angle = 0.0
    disturbance: Disturbance = 2.0


def extrinsic_of(scene: Scene, skill: str) -> Extrinsic:
    """Return the scene's extrinsic object. Raises ValueError where there is none."""
    if scene.extrinsic is None:
        raise ValueError(f"{skill} moves an extrinsic object, but the scene has none: name one")
    return scene.extrinsic


@dataclass(frozen=True, eq=False)
class Lying:
    """An eo on a face: its pose ``eo`` (3,) with the frame's origin at a given x, and the ``ends`` (2, 2) of the face,
    left one first, in its frame."""

    eo: Array
    ends: Array


def lying(vertices: Array, angle: float, ground_x: float, name: str = "eo_angle_deg") -> Lying:
    """Return how the eo lies at ``angle`` [rad]. Raises ValueError naming ``name`` where it stands on a corner."""
    ends = stance.lowest_points(vertices, angle)
    if len(ends) < 2:
        raise ValueError(
            f"{name}: expected the extrinsic object to lie on a face, but at {np.rad2deg(angle):.4g}° it stands on the"
            f" corner {touch.spelled(ends[0])}"
        )
    height = -float(se2.rotate(angle, ends[0])[1])
    return Lying(np.array([ground_x, height, angle]), ends)


def meeting(
    parameters: TouchParameters, scene: Scene, tilt: float, place: outline.Place | None, vertex: int
) -> Meeting:
    """Return the meeting that the parameters ask for, at ``tilt`` [rad].

    ``place`` and ``vertex`` are the skill's choices on the eo where ``contact_mm`` is None: on a face, and the corner.
    """
    eo, go = _outlines(scene)
    given = parameters.contact_mm
    if parameters.kind is Touch.CORNER_ON_FACE:
        if parameters.go_contact_mm is not None:
            raise ValueError("go_contact_mm: expected none: with touch: corner_on_face the tilt says which corner")
        if given is not None:
            place = outline.nearest(eo, given, "contact_mm", "the extrinsic object")
        assert place is not None  # the skill chose one
        return touch.corner_on_face(go, place, tilt)
    if given is not None:
        vertex = outline.corner(eo, given, "contact_mm", "the extrinsic object")
    if parameters.go_contact_mm is None:
        mine = outline.on_face(go, outline.facing(go, np.array([0.0, -1.0])))
    else:
        mine = outline.nearest(go, parameters.go_contact_mm, "go_contact_mm", "the grasped object")
    return touch.face_on_corner(eo, vertex, mine, tilt)


def upper_middle(vertices: Array, angle: float) -> tuple[outline.Place, int]:
    """Return the middle of the face that looks up at ``angle`` [rad], and its left corner."""
    up = se2.rotate(-angle, np.array([0.0, 1.0]))
    place = outline.on_face(vertices, outline.facing(vertices, up))
    ends = [place.face, (place.face + 1) % len(vertices)]
    return place, min(ends, key=lambda i: float(se2.rotate(angle, vertices[i])[0]))


def pushed(
    scene: Scene,
    eo: Array,
    met: Meeting,
    ground: Array,
    names: tuple[str, ...],
    mode: Mode,
    travel: Array | None = None,
    angle: Array | None = None,
) -> Pushed:
    """Return the statics of the eo at poses ``eo`` (K, 3), touched as in ``met`` after ``travel`` (K,) [m].

    ``angle`` (K,) [rad] is the go's relative angle, where it is not the meeting's; ``mode`` is that of the ``ground``.
    """
    extrinsic = extrinsic_of(scene, "")
    travel = np.zeros(len(eo)) if travel is None else travel
    normal = np.broadcast_to(met.into_eo, (len(eo), 2))
    if angle is not None and met.touch is Touch.FACE_ON_CORNER:
        normal = se2.rotate(angle, met.normal)
    return Pushed(
        eo=eo,
        mass=extrinsic.mass,
        gravity=scene.held.gravity,
        point=np.array([met.at(float(way))[1] for way in travel]),
        normal=normal,
        ground=ground,
        modes=(mode,) * len(ground),
        names=names,
        mu=extrinsic.mu_ground,
        mu_object=extrinsic.mu_object,
    )


def problem(
    skill: str,
    scene: Scene,
    met: Meeting,
    statics: Pushed,
    *,
    angle: Array,
    travel: Array,
    mode: Mode,
    wish: Array,
    turns: bool,
    form: Form,
    weights: LossWeights,
    limits: Limits,
) -> Problem:
    """Return P1 over the poses of ``statics``, the go's relative ``angle`` (K,) [rad] and ``travel`` (K,) [m].

    ``mode`` is that of the object's contact, ``wish`` (K, 2) its force [N] on the eo; ``turns`` leaves the relative
    angle to the optimiser. Raises ValueError naming the parameter where the contact leaves its face, or where the
    bodies would go into each other or the ground.
    """
    extrinsic, held = extrinsic_of(scene, skill), scene.held
    steps = len(statics.eo)
    _on_its_face(met, travel)
    return Problem(
        skill=skill,
        form=form,
        eo=statics.eo,
        eo_body=extrinsic.body,
        go_body=held.body,
        grasp=held.grasp,
        stiffness=held.stiffness,
        contacts=(
            ObjectContact(
                OBJECT, met.touch, met.p_go, met.p_eo, met.normal, (mode,) * steps, extrinsic.mu_object, wish
            ),
        ),
        ground=tuple(
            GroundContact(name, point, (kind,) * steps, extrinsic.mu_ground)
            for name, point, kind in zip(statics.names, statics.ground, statics.modes, strict=True)
        ),
        angle=angle,
        travel=travel,
        free=variables(steps, form, turns),
        angle_limits=_angle_limits(scene, met, statics.eo, angle, travel, CLEARANCE if turns else 0.0),
        weights=weights,
        limits=limits,
        gravity=held.gravity,
    )


def standing_still(
    skill: str,
    parameters: LyingParameters,
    scene: Scene,
    tilt: Array,
    wish: Array,
    form: Form,
    weights: LossWeights,
    limits: Limits,
    travel: Array | None = None,
    mode: Mode = Mode.STICK,
) -> SkillTask:
    """Return the task of a go on an eo that lies and stays.

    ``tilt`` (K,) [rad] is the go's, ``wish`` (K, 2) [N] its force, ``travel`` (K,) [m] along the touched face. Raises
    ValueError naming the parameter that the geometry does not allow, and InfeasiblePlan where the cones do not admit
    the wish.
    """
    extrinsic = extrinsic_of(scene, skill)
    lies = lying(outline.straightened(extrinsic.vertices), np.deg2rad(parameters.eo_angle_deg), parameters.ground_x)
    steps = len(tilt)
    travel = np.zeros(steps) if travel is None else travel
    met = meeting(
        parameters, scene, float(tilt[0]), *upper_middle(outline.straightened(extrinsic.vertices), lies.eo[2])
    )
    angle = met.angle + tilt - tilt[0]
    statics = pushed(scene, np.tile(lies.eo, (steps, 1)), met, lies.ends, (LEFT, RIGHT), Mode.STICK, travel, angle)
    made = problem(
        skill,
        scene,
        met,
        statics,
        angle=angle,
        travel=travel,
        mode=mode,
        wish=wish,
        turns=False,
        form=form,
        weights=weights,
        limits=limits,
    )
    statics.check(wish, mode)
    if mode is Mode.STICK:
        push = toward(statics)
    else:  # a slipping contact's force only changes along the edge of its cone
        edge = force_in_world(statics.axes()[0], wish)
        push = edge / np.linalg.norm(edge, axis=1, keepdims=True)
    return SkillTask(made, parameters.disturbance, push)


def slip_of_travel(travel: float) -> Mode:
    """Return the mode of a contact that travels along e: the body acted on sees the other move along −t, slip−, for +e.

    So it is for either touch: t is −e where the eo owns the face, and e where the go does and moves along −e.
    """
    return Mode.SLIP_NEGATIVE if travel >= 0 else Mode.SLIP_POSITIVE


def variables(steps: int, form: Form, turns: bool = False) -> NDArray[np.bool_]:
    """Return which variables (K, 5) are free: those of the force, and the relative angle if it ``turns``."""
    return np.tile(np.array([turns, False, True, True, form is Form.PAPER]), (steps, 1))


def toward(statics: Pushed) -> Array:
    """Return the unit directions (K, 2) in W from the object's contact to the middle of what the eo stands on."""
    way = se2.rotate(statics.eo[:, 2], statics.ground.mean(axis=0) - statics.point)
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def _outlines(scene: Scene) -> tuple[Array, Array]:
    """The outlines of eo and go, without corners that are none."""
    return outline.straightened(extrinsic_of(scene, "").vertices), outline.straightened(scene.held.vertices)


def _on_its_face(met: Meeting, travel: Array) -> None:
    over = np.maximum(travel - met.after, -met.before - travel)
    if over.max() > -outline.CORNER:
        k = int((over > -outline.CORNER).argmax())
        raise ValueError(
            f"travel_mm: step {k}: expected the contact to stay on its face, which goes on for"
            f" {met.before * 1e3:.3g} mm one way and {met.after * 1e3:.3g} mm the other, received"
            f" {travel[k] * 1e3:+.4g} mm: shorten the travel, or begin elsewhere"
        )


def _angle_limits(scene: Scene, met: Meeting, eo: Array, angle: Array, travel: Array, clearance: float) -> Array:
    """Admissible relative angles (K, 2): what outlines and ground leave, less ``clearance`` [rad] where it can."""
    theirs, mine = _outlines(scene)
    rooms = {way: touch.room(mine, theirs, met, way) for way in dict.fromkeys(travel.tolist())}
    limits = np.array([rooms[way] for way in travel.tolist()])
    above = np.array([_above(mine, met, *row) for row in zip(eo, angle.tolist(), travel.tolist(), strict=True)])
    limits = np.column_stack([np.maximum(limits[:, 0], above[:, 0]), np.minimum(limits[:, 1], above[:, 1])])
    out = (angle <= limits[:, 0]) | (angle >= limits[:, 1])
    if out.any():
        k = int(out.argmax())
        lo, hi = np.rad2deg(limits[k] - met.angle)
        raise ValueError(
            f"tilt_deg: step {k}: the bodies would go into each other, or the go into the ground: from its first tilt"
            f" the go may turn by {lo:+.3g}° to {hi:+.3g}°, and is asked for {np.rad2deg(angle[k] - met.angle):+.3g}°"
        )
    if clearance:
        lo, hi = limits.T
        nearest = np.minimum(lo + clearance, (lo + angle) / 2), np.maximum(hi - clearance, (hi + angle) / 2)
        limits = np.column_stack(nearest)
    return limits


def _above(go: Array, met: Meeting, eo: Array, angle: float, travel: float) -> tuple[float, float]:
    """Relative angles at which the go is above the ground."""
    p_go, p_eo = met.at(travel)
    theta = float(eo[2])
    lo, hi = touch.room_above_ground(go, p_go, float(se2.transform(eo, p_eo)[1]), theta + angle)
    return lo - theta, hi - theta
