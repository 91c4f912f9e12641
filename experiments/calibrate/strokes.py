"""Random strokes of a held object over a face, and the contact forces that they make: what friction is found from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CommandRefused
from drivers.interfaces import ForceTorqueSensor
from estimation.errors import FitError
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
#: share of a stroke in which it gets up to its speed, and of it that it takes to stop
GETTING_UP = 0.2
#: and what the object swings in the fingers after it has [s]
SWINGING = 0.1
#: it slips where the ratio of its forces has come to this share of the last
SLIPS = 0.97
#: a stroke that moves evenly for less than this shows too little [s]
LEAST_EVEN = 0.1
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

    @property
    def normal(self) -> Array:
        """The face's outward normal (2,) in W."""
        return se2.rotate(self.X_W_face[2], np.array([0.0, 1.0]))

    def poses(self, tilt: float, along: Array, force: Array) -> Array:
        """X_W_ee (n, 3) that has the object's lowest point at ``along`` (n,) [m] on the face, pressed with ``force``.

        ``force`` (n,) [N] is normal to the face; what friction adds is left to the fingers' compliance.
        """
        corner = lowest_points(self.vertices, tilt)[0]
        X_face_go = standing_pose(corner, np.full(len(along), tilt), 0.0)
        X_face_go[:, 0] += along
        X_W_go = se2.compose(self.X_W_face, X_face_go)
        at_grasp = se2.compose(X_W_go, self.grasp)[:, :2]
        contact = se2.transform(X_W_go, corner) - at_grasp
        pushed = force[:, None] * self.normal
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
    """Random strokes, each followed by its like to the other side.

    What turns the forces, such as a sensor that sits askew, adds to the ratio on one side what it takes on the other.
    The object leans back, as far as friction turns the contact force or less: that runs then along an axis of the wrist
    sensor, where its gains turn it least. Leaning to where the motion goes they would turn it by half as much again as
    the gains differ.
    """
    strokes: list[Stroke] = []
    lean = pressed = 0.0
    for i in range(count):
        direction = 1.0 if i % 2 else -1.0
        if i % 2 == 0:
            lean, pressed = float(rng.uniform(*tilt)), float(rng.uniform(*force))
        strokes.append(Stroke(direction * lean, pressed, -0.5 * direction * length, 0.5 * direction * length))
    return strokes


@dataclass(frozen=True, eq=False)
class Dragging:
    """What a stroke showed: ``forces`` (w, n, 2) = (f_n, f_t) [N] on the object by each of the `witnesses`.

    ``angles`` (w,) [rad] are those of the sensors' axes in the face's (t, n), t being the normal turned by −90°.
    """

    forces: Array
    angles: Array


def stroked(rig: Rig, dragged: Dragged, stroke: Stroke, speed: float) -> Dragging:
    """Contact forces on the object while it moves evenly in a stroke, in the face's axes.

    Each witness's zero is taken before touch-down and after the stroke, and drifts evenly in between. Before the stroke
    the normal force is brought to what is asked, since nobody knows the grasp to the last tenth. Raises FitError for a
    stroke too short to tell anything.
    """
    length = abs(stroke.end - stroke.begin)
    even = (1 - 2 * GETTING_UP) * length / speed - SWINGING
    if even < LEAST_EVEN:
        raise FitError(
            "a stroke",
            f"{LEAST_EVEN:g} s of even motion",
            f"{max(even, 0.0):.2g} s: {length * 1e3:.3g} mm at {speed * 1e3:.3g} mm/s",
            "Make it longer, or slower: `stroke_mm`, `speed`.",
        )
    along = np.linspace(stroke.begin, stroke.end, max(2, int(length / 0.001)))
    pressed = dragged.poses(stroke.tilt, along, np.full(len(along), stroke.force))
    loading = dragged.poses(stroke.tilt, np.full(10, along[0]), np.linspace(0.0, stroke.force, 10))
    normal = dragged.normal
    mover, seen_by = rig.mover, witnesses(rig)
    above, cleared = clear(dragged, stroke.tilt, along[[0, -1]], pressed[[0, -1], 2])
    rig.lift_to(above[1] + 0.01)
    mover.travel(np.array([above[0], mover.pose[1], above[2]]))
    mover.travel(above)
    rig.rest(0.3)
    before = _Rest.taken(rig, seen_by, 0.4)
    mover.ramp(loading[0], 0.5)
    mover.through(loading, 0.5)
    deeper = np.zeros(3)
    softness = float(normal @ np.linalg.inv(dragged.stiffness[:2, :2]) @ normal)
    for _ in range(CORRECTIONS):
        pushed = np.mean(_Rest.taken(rig, seen_by, 0.1).forces - before.forces, axis=0)
        deeper[:2] -= np.clip((stroke.force - normal @ pushed) * softness, -STEP, STEP) * normal
        mover.ramp(loading[-1] + deeper, 0.2)
    begin, end = _dragged(rig, pressed + deeper, length / speed)
    moving = [witness.between(begin, end) for witness in seen_by]
    mover.ramp(cleared, 0.5)
    rig.rest(0.3)
    after = _Rest.taken(rig, seen_by, 0.4)
    share = (begin + (np.arange(len(moving[0])) + 0.5) * BIN * 1e9 - before.at_ns) / (after.at_ns - before.at_ns)
    on_object = np.array(
        [
            force - zero - share[:, None] * (later - zero)
            for force, zero, later in zip(moving, before.forces, after.forces, strict=True)
        ]
    )
    tangent = np.array([normal[1], -normal[0]])
    forces = np.stack([on_object @ normal, on_object @ tangent], axis=-1)
    forces = forces[:, np.mean(forces[:, :, 0], axis=0) > TOUCHED]
    angles = np.array([witness.angle(mover.pose) for witness in seen_by]) - dragged.X_W_face[2]
    return Dragging(forces[:, steady(forces[0])], angles)


def clear(dragged: Dragged, tilt: float, along: Array, angles: Array) -> Array:
    """Poses X_W_ee (n, 3) that hold the object free of the face above ``along`` (n,), the end-effector at ``angles``.

    They are those at which it is pressed: the tool, which weighs more than what is sought and is known only as well as
    the sensor's gains are, then hangs as it does in the stroke, and the tare takes its weight out. An object that is
    not pressed turns with the end-effector, and no corner of it may get as low as the face for that.
    """
    poses = dragged.poses(tilt, along, np.zeros(len(along)))
    reach = float(np.linalg.norm(dragged.vertices - dragged.grasp[:2], axis=1).max())
    up = CLEARANCE + reach * np.abs(se2.wrap(angles - poses[:, 2]))
    return np.column_stack([poses[:, :2] + up[:, None] * dragged.normal, angles])


def steady(forces: Array) -> NDArray[np.bool_]:
    """Which bins (n,) of ``forces`` (n, 2) = (f_n, f_t) by the sensor under the table are not those of getting going.

    Where the object stuck until well into the even motion, it catches up with the fingers at once when it slips: the
    wrist pulls harder than friction holds while it does. It slips from where the ratio of the forces is as at last.
    """
    steady = np.ones(len(forces), bool)
    if len(forces):
        ratio = np.abs(forces[:, 1]) / forces[:, 0]
        slips = int(np.argmax(ratio >= SLIPS * np.median(ratio[-max(1, len(ratio) // 3) :])))
        steady[slips : slips + round(SWINGING / BIN) if slips else 0] = False
    return steady


def _dragged(rig: Rig, path: Array, seconds: float) -> tuple[int, int]:
    """Move along ``path`` (M, 3), evenly but for the `GETTING_UP` at both ends.

    Returns from when to when everything moved evenly [ns]: a wrist sensor feels what it takes to speed up the tool as
    well, and that is no friction.
    """
    mover, a = rig.mover, GETTING_UP
    ticks = max(10, round(seconds * rig.context.settings.control_rate))
    u = np.arange(1, ticks + 1) / ticks
    speed = np.minimum(1.0, np.minimum(u, 1 - u) / a) / (1 - a)
    share = np.where(u < a, u**2 / (2 * a), np.where(u > 1 - a, 1 - a - (1 - u) ** 2 / (2 * a), u - a / 2)) / (1 - a)
    points = np.column_stack([np.interp(share, np.linspace(0, 1, len(path)), column) for column in path.T])
    slopes = np.column_stack(
        [np.interp(share, np.linspace(0, 1, len(path)), np.gradient(column, 1 / (len(path) - 1))) for column in path.T]
    )
    begin = end = rig.devices.clock.now_ns()
    for at, point, slope in zip(u, points, slopes * speed[:, None] / seconds, strict=True):
        mover.follow(point, slope)
        if at * seconds <= a * seconds + SWINGING:
            begin = rig.devices.clock.now_ns()
        if at <= 1 - a:
            end = rig.devices.clock.now_ns()
    return begin, end


class Witness(ABC):
    """A sensor that tells the contact force on the held object, up to a zero that drifts."""

    def __init__(self, rig: Rig, sensor: ForceTorqueSensor):
        self.rig, self.sensor = rig, sensor

    @abstractmethod
    def force(self, reading: Array, X_W_ee: Array) -> Array:
        """Force (2,) [N] on the object, axes of W, by a reading (6,) with the end-effector at ``X_W_ee`` (3,)."""

    @abstractmethod
    def angle(self, X_W_ee: Array) -> float:
        """That of the sensor's axes in W [rad] with the end-effector at ``X_W_ee`` (3,)."""

    def between(self, begin: int, end: int) -> Array:
        """Forces (n, 2), each of a `BIN` from ``begin`` to ``end`` [ns]; NaN where a bin has no reading."""
        readings = [r for r in self.sensor.since(begin) if r.stamp.status is Status.OK and r.stamp.capture_ns <= end]
        poses = [p for p in self.rig.devices.arm.since(begin) if p.stamp.status is Status.OK]
        if not readings or not poses:
            silent = self.sensor.name if not readings else self.rig.devices.arm.name
            raise CommandRefused(silent, "measure the contact force", "no reading that can be trusted", "See to it")
        times = np.array([p.stamp.capture_ns for p in poses])
        path = np.array([p.pose for p in poses])
        bins = np.array([(r.stamp.capture_ns - begin) * 1e-9 / BIN for r in readings]).astype(int)
        values = np.array([r.wrench for r in readings])
        forces = np.full((int((end - begin) * 1e-9 / BIN), 2), np.nan)
        for b in range(len(forces)):
            at = begin + (b + 0.5) * BIN * 1e9
            ee = np.array([np.interp(at, times, path[:, k]) for k in range(3)])
            if (bins == b).any():
                forces[b] = self.force(values[bins == b].mean(axis=0), ee)
        return forces


class _Table(Witness):
    """The sensor under the table carries what the object presses on it, as long as nothing is added or taken away."""

    def __init__(self, rig: Rig, sensor: ForceTorqueSensor):
        super().__init__(rig, sensor)
        self._angle = float(sensor.describe().extra["pose"][2])

    def force(self, reading: Array, X_W_ee: Array) -> Array:
        return -se2.rotate(self.angle(X_W_ee), TaskPlane().wrench_to_planar(reading)[:2])

    def angle(self, X_W_ee: Array) -> float:
        return self._angle


class _Wrist(Witness):
    """The fingers push the object down, which the contact pushes up; they also carry its weight, which is constant."""

    def force(self, reading: Array, X_W_ee: Array) -> Array:
        return -self.rig.observer.wrist_sensor.wrench_on_go(reading, X_W_ee, X_W_ee[:2])[:2]

    def angle(self, X_W_ee: Array) -> float:
        return float(X_W_ee[2] + self.rig.observer.wrist_sensor.X_ee_s[2])


def witnesses(rig: Rig) -> list[Witness]:
    """Who tells the contact force: the sensor under the table, and the wrist's where the tool on it has been weighed.

    Each sensor's gain is off on its own, and no sample shows it (`estimation.friction_gain`).
    """
    found: list[Witness] = [_Table(rig, rig.devices.force_torque("table"))]
    if rig.context.believed.tool is not None:
        found.append(_Wrist(rig, rig.devices.force_torque("wrist")))
    return found


@dataclass(frozen=True, eq=False)
class _Rest:
    """What every witness says (w, 2) [N] while the arm rests, and the middle of that time."""

    forces: Array
    at_ns: int

    @classmethod
    def taken(cls, rig: Rig, seen_by: list[Witness], seconds: float) -> _Rest:
        """Rest for ``seconds`` and look."""
        begin = rig.devices.clock.now_ns()
        rig.rest(seconds)
        ee = rig.observer.arm_pose()
        forces = [witness.force(rig.mean_since(witness.sensor, begin), ee) for witness in seen_by]
        return cls(np.array(forces), begin + round(seconds * 0.5e9))
