"""Random strokes of a held object over a face, and the contact forces that they make: what friction is found from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.errors import CommandRefused
from experiments.calibrate.rig import Rig
from mechanics import se2
from mechanics.contact import gravity_wrench
from mechanics.elasticity import Elasticity
from mechanics.readings import Array, Status
from mechanics.task_plane import TaskPlane
from planning.skills.stance import lowest_points, standing_pose

#: how far above the face a stroke begins and ends [m]
CLEARANCE = 0.008
#: contact forces are means over this long [s]
BIN = 0.02
#: a force below this is no contact [N]
TOUCHED = 0.5
#: how often the normal force is corrected before a stroke, and the largest step of it [m]
CORRECTIONS, STEP = 3, 0.001


@dataclass(frozen=True, eq=False)
class Dragged:
    """An object in the fingers that is dragged over a face.

    ``vertices`` (V, 2) and ``grasp`` (3,) X_go_gocf in its frame (origin: centre of mass), ``mass`` [kg], ``stiffness``
    (3, 3) of the fingers, ``X_W_face`` (3,) a frame on the face: y is its outward normal, and it reaches ``half``
    [m] to either side.
    """

    vertices: Array
    grasp: Array
    mass: float
    stiffness: Array
    X_W_face: Array
    half: float
    gravity: float = 9.81

    def poses(self, tilt: float, along: Array, force: Array) -> Array:
        """X_W_ee (n, 3) that has the object's lowest point at ``along`` (n,) [m] on the face, pressed with ``force``.

        ``force`` (n,) [N] is normal to the face; what friction adds is left to the fingers' compliance.
        """
        corner = lowest_points(self.vertices, tilt)[0]
        X_face_go = standing_pose(corner, np.full(len(along), tilt), 0.0)
        X_face_go[:, 0] += along
        X_W_go = se2.compose(self.X_W_face, X_face_go)
        normal = se2.rotate(self.X_W_face[2], np.array([0.0, 1.0]))
        at_grasp = se2.compose(X_W_go, self.grasp)[:, :2]
        contact = se2.transform(X_W_go, corner) - at_grasp
        pushed = force[:, None] * normal
        torque = contact[:, 0] * pushed[:, 1] - contact[:, 1] * pushed[:, 0]
        environment = np.column_stack([pushed, torque]) + gravity_wrench(
            np.full(len(along), self.mass), X_W_go[:, :2] - at_grasp, np.full(len(along), self.gravity)
        )
        return Elasticity(self.stiffness).ee_pose(X_W_go, self.grasp, -environment)


@dataclass(frozen=True)
class Stroke:
    """One stroke: the object's ``tilt`` [rad] to the face, normal ``force`` [N], from ``begin`` to ``end`` [m]."""

    tilt: float
    force: float
    begin: float
    end: float


def drawn(
    rng: np.random.Generator, count: int, tilt: tuple[float, float], force: tuple[float, float], length: float
) -> list[Stroke]:
    """Random strokes, every other one to the other side.

    The object trails: its grasp leans to where the motion goes, so that friction lifts the contact and does not jam it.
    """
    strokes = []
    for i in range(count):
        direction = 1.0 if i % 2 else -1.0
        lean = -direction * float(rng.uniform(*tilt))
        strokes.append(Stroke(lean, float(rng.uniform(*force)), -0.5 * direction * length, 0.5 * direction * length))
    return strokes


def stroked(rig: Rig, dragged: Dragged, stroke: Stroke, speed: float) -> Array:
    """Contact forces (n, 2) = (f_n, f_t) [N] on the dragged object during one stroke, in the face's axes.

    From the sensor under the table: t is the normal turned by −90°. Its zero is taken before touch-down and after the
    stroke, and drifts evenly in between. Before the stroke the normal force is brought to what is asked, since nobody
    knows the grasp to the last tenth.
    """
    length = abs(stroke.end - stroke.begin)
    along = np.linspace(stroke.begin, stroke.end, max(2, int(length / 0.001)))
    pressed = dragged.poses(stroke.tilt, along, np.full(len(along), stroke.force))
    loading = dragged.poses(stroke.tilt, np.full(10, along[0]), np.linspace(0.0, stroke.force, 10))
    normal = se2.rotate(dragged.X_W_face[2], np.array([0.0, 1.0]))
    up = np.array([*(CLEARANCE * normal), 0.0])
    mover, table = rig.mover, rig.devices.force_torque("table")
    above = loading[0] + up
    rig.lift_to(above[1] + 0.01)
    mover.travel(np.array([above[0], mover.pose[1], above[2]]))
    mover.travel(above)
    rig.rest(0.3)
    before = _zero(rig)
    mover.ramp(loading[0], 0.5)
    mover.through(loading, 0.5)
    angle = table.describe().extra["pose"][2] - dragged.X_W_face[2]
    deeper = np.zeros(3)
    softness = float(normal @ np.linalg.inv(dragged.stiffness[:2, :2]) @ normal)
    for _ in range(CORRECTIONS):
        missing = stroke.force - _contact_force(rig.table_samples(0.1)[0] - before.reading, angle)[0]
        deeper[:2] -= np.clip(missing * softness, -STEP, STEP) * normal
        mover.ramp(loading[-1] + deeper, 0.2)
    begin = rig.devices.clock.now_ns()
    mover.through(pressed + deeper, length / speed)
    readings = [r for r in table.since(begin) if r.stamp.status is Status.OK]
    mover.ramp(pressed[-1] + up, 0.5)
    rig.rest(0.3)
    after = _zero(rig)
    if not readings:
        raise CommandRefused(
            table.name, "measure the contact force", "no reading that can be trusted", "See to the sensor"
        )
    times = np.array([r.stamp.capture_ns for r in readings])
    share = ((times - before.at_ns) / (after.at_ns - before.at_ns))[:, None]
    zeros = before.reading + share * (after.reading - before.reading)
    forces = _contact_force(np.array([r.wrench for r in readings]) - zeros, angle)
    bins = ((times - times[0]) * 1e-9 / BIN).astype(int)
    means = np.array([forces[bins == b].mean(axis=0) for b in np.unique(bins)])
    return means[means[:, 0] > TOUCHED]


@dataclass(frozen=True, eq=False)
class _Zero:
    """What the sensor under the table reads (6,) without contact, at an instant."""

    reading: Array
    at_ns: int


def _zero(rig: Rig) -> _Zero:
    reading, _ = rig.table_samples(0.4)
    return _Zero(reading, rig.devices.clock.now_ns() - 200_000_000)


def _contact_force(load: Array, angle: float) -> Array:
    """(f_n, f_t) (..., 2) on the object from the table sensor's load (..., 6), turned by ``angle`` to the face."""
    on_object = -se2.rotate(angle, TaskPlane().wrench_to_planar(load)[..., :2])
    return np.stack([on_object[..., 1], on_object[..., 0]], axis=-1)
