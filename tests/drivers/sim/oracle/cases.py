"""Tasks whose statics are known: shapes of the catalogue, turned about a vertex by the corner of the held box.

Which corner and which tilt of the go, measured with the grasp centre 45 mm above its centroid: the force should pass
near the grasp centre, or K⁻¹ of its torque turns the end-effector by degrees. The corner is 12° off the go's axis as
the grasp centre sees it, and the force 9–14° off the face's normal. With the go 20° off the normal, on its left
corner where the face is horizontal (tall_box, z) and on its right one, to the other side, on the faces beside an apex,
the torque stays below 48 N·mm and the end-effector within 1° (1.2 mm) of the go; 10° off it is twice to three times
as much. The tilt is constant in the eo's frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivers.scene import Body, Scene
from mechanics.catalogue import load_object, load_sensor

from .statics import Held, Pivot, turn

#: distance of the grasp centre above the go's centroid [m]
GRASP = np.array([0.0, 0.045])


@dataclass(frozen=True)
class PivotTask:
    """An eo that turns clockwise about its bottom-right vertex, which stands at W's origin.

    ``tilt`` is the angle from the face's normal to the go's axis; ``needs`` are the friction coefficients at the
    go's contact and the ground that the notes of the study state, ``mu_ground`` what is given. ``start`` and ``end``
    are how far it has turned when it comes to the go and at the end; it stands on its lower face where ``start`` is 0.
    """

    name: str
    extrinsic: Body
    grasped: Body
    held: Held
    pivot: Pivot
    tilt: float
    mu_ground: float
    needs: tuple[float, float]
    force: float = 3.0
    mu_object: float = 0.33
    start: float = 0.0
    end: float = -float(np.radians(25.0))

    def go_angle(self, angle: float) -> float:
        """θ of the go in W with the eo at ``angle``."""
        n = self.pivot.normal
        return float(np.arctan2(n[0], -n[1])) + angle + self.tilt

    def go(self, angle: float) -> np.ndarray:
        """X_W_go (3,)."""
        return self.held.go(self.go_angle(angle), self.pivot.at(angle))

    def wrench(self, angle: float) -> np.ndarray:
        """Wrench (3,) of the fingers on the go about the grasp centre, axes of W."""
        return self.held.wrench(self.go_angle(angle), -self.pivot.push(angle, self.force))

    def ee(self, angle: float, level: float = 1.0, lean: float = 0.0) -> np.ndarray:
        """X_W_ee (3,); ``level`` is the share of the push, ``lean`` turns the go about its corner."""
        push = -level * self.pivot.push(angle, self.force)
        return self.held.ee(self.go_angle(angle) + lean, self.pivot.at(angle), push)

    def scene(self) -> Scene:
        """The eo as it is at the start, the go hangs 5 mm off its face."""
        start = self.ee(self.start, 0.0)
        start[:2] -= 0.005 * turn(self.start) @ self.pivot.normal
        return Scene(
            grasped=self.grasped,
            extrinsic=self.extrinsic,
            extrinsic_pose=_floats(self.pivot.eo(self.start)),
            grasp=(*_floats(GRASP), 0.0),
            stiffness=soft_bubble(),
            friction={"go-ground": 0.33, "go-eo": self.mu_object, "eo-ground": self.mu_ground},
            start=_floats(start),
        )


def soft_bubble() -> tuple:
    """K of the Soft Bubbles, 3.2 N·m/rad."""
    return tuple(_floats(row) for row in load_sensor("soft_bubble").stiffness)


def shape(name: str) -> Body:
    """The body of a catalogue object."""
    return Body(**load_object(name).body(name))


def box(name: str, width: float, height: float, mass: float) -> Body:
    """A rectangle."""
    w, h = width / 2, height / 2
    return Body(name=name, vertices=((-w, -h), (w, -h), (w, h), (-w, h)), mass=mass)


def _floats(values) -> tuple:
    return tuple(float(v) for v in values)


def _task(eo: Body, go: Body, from_apex: float | None, top_at: float | None, mu: float, needs) -> PivotTask:
    v = np.array(eo.vertices)
    if from_apex is None:
        contact, normal, corner, tilt = np.array([top_at, v[:, 1].max()]), np.array([0.0, -1.0]), 0, 20.0
    else:
        apex = int(np.argmax(v[:, 1]))
        # the outline is counter-clockwise: the face to the left of the apex is the next one
        along = v[(apex + 1) % len(v)] - v[apex]
        along /= np.hypot(*along)
        contact, normal, corner, tilt = v[apex] + from_apex * along, np.array([-along[1], along[0]]), 1, -20.0
    pivot = v[np.lexsort((-v[:, 0], v[:, 1].round(9)))[0]]
    held = Held(go.mass, np.array(go.vertices[corner]), GRASP, np.array(soft_bubble()))
    return PivotTask(eo.name, eo, go, held, Pivot(eo.mass, pivot, contact, normal), float(np.radians(tilt)), mu, needs)


def pivot_task(name: str, **changes) -> PivotTask:
    """A task by the name of its shape; ``study_pentagon`` is the 100 mm wide, 0.3 kg one of the plant's study."""
    go = shape("tall_box")
    if name == "study_pentagon":
        turns = np.pi / 2 + 2 * np.pi / 5 * np.arange(5)
        radius = 0.05 / np.sin(np.radians(72))
        corners = tuple((float(radius * np.cos(a)), float(radius * np.sin(a))) for a in turns)
        eo, go = Body(name=name, vertices=corners, mass=0.3), box("slim", 0.03, 0.1, 0.1)
        task = _task(eo, go, radius * np.sin(np.radians(36)) - 0.02, None, 0.5, (0.11, 0.387))
    else:
        from_apex, top_at, mu, needs = {
            "tall_box": (None, 0.007, 0.33, (0.18, 0.26)),
            "z": (None, 0.0, 0.33, (0.18, 0.26)),
            "heptagon": (0.008, None, 0.33, (0.16, 0.26)),
            "pentagon": (0.008, None, 0.5, (0.21, 0.37)),
            "triangle": (0.015, None, 0.8, (0.25, 0.70)),
        }[name]
        task = _task(shape(name), go, from_apex, top_at, mu, needs)
    return replace(task, **changes)


def tilted_pivot_task(name: str) -> PivotTask:
    """Of those shapes that µ = 0.33 cannot turn from flat: the turn from a tilt at which something else holds it."""
    from_apex, mass, start, end, needs = {
        "pentagon": (0.012, 0.1, 10.0, 35.0, (0.22, 0.24)),
        "triangle": (0.032, 0.1, 30.0, 55.0, (0.27, 0.27)),
    }[name]
    eo = shape(name).model_copy(update={"mass": mass})
    task = _task(eo, shape("tall_box"), from_apex, None, 0.33, needs)
    return replace(task, name=f"tilted {name}", start=-float(np.radians(start)), end=-float(np.radians(end)))


PIVOTS = ("tall_box", "z", "heptagon", "pentagon", "triangle")


@dataclass(frozen=True)
class GroundTask:
    """A shape in hand, on one of its corners at W's origin."""

    grasped: Body
    held: Held

    def ee(self, angle: float, push, at=(0.0, 0.0)) -> np.ndarray:
        """X_W_ee (3,) with the go at ``angle`` and the ground pushing with ``push`` (2,)."""
        return self.held.ee(angle, np.asarray(at), np.asarray(push))

    def scene(self, angle: float, friction: float = 0.33) -> Scene:
        """The go at ``angle``, 5 mm above the ground."""
        return Scene(
            grasped=self.grasped,
            grasp=(*_floats(self.held.grasp), 0.0),
            stiffness=soft_bubble(),
            friction={"go-ground": friction},
            start=_floats(self.ee(angle, (0.0, 0.0), (0.0, 0.005))),
        )


def ground_task(name: str) -> GroundTask:
    """A shape on its bottom-left corner, held 45 mm above its centroid; the flat hbox 15 mm above it."""
    body = shape(name)
    v = np.array(body.vertices)
    corner = v[np.lexsort((v[:, 0], v[:, 1].round(9)))[0]]
    grasp = np.array([0.0, 0.015]) if name == "hbox" else GRASP
    return GroundTask(body, Held(body.mass, corner, grasp, np.array(soft_bubble())))


@dataclass(frozen=True)
class BlockTask:
    """The held box on its left corner on top of hbox, at ``at`` (2,) in W; hbox lies about x = 0."""

    held: Held
    at: np.ndarray

    def ee(self, angle: float, push, shift: float = 0.0) -> np.ndarray:
        """X_W_ee (3,) with the go at ``angle`` and the block pushing with ``push`` (2,)."""
        return self.held.ee(angle, self.at + np.array([shift, 0.0]), np.asarray(push))

    def scene(self, angle: float, mass: float = 0.5, mu_object: float = 0.33, mu_ground: float = 0.33) -> Scene:
        """The go at ``angle``, 5 mm above the block."""
        start = self.ee(angle, (0.0, 0.0))
        start[1] += 0.005
        return Scene(
            grasped=shape("tall_box"),
            extrinsic=shape("hbox").model_copy(update={"mass": mass}),
            extrinsic_pose=(0.0, 0.03, 0.0),
            grasp=(*_floats(GRASP), 0.0),
            stiffness=soft_bubble(),
            friction={"go-ground": 0.33, "go-eo": mu_object, "eo-ground": mu_ground},
            start=_floats(start),
        )


def block_task(x: float = 0.0) -> BlockTask:
    """The corner at ``x`` on the block's top."""
    go = shape("tall_box")
    return BlockTask(Held(go.mass, np.array(go.vertices[0]), GRASP, np.array(soft_bubble())), np.array([x, 0.06]))


def corner_of(pose, held: Held) -> np.ndarray:
    """Where (2,) the go's corner is in W, from X_W_go (3,)."""
    return np.asarray(pose)[:2] + turn(pose[2]) @ held.corner
