"""Whether the plant itself is well: a sick contact solver must not pass for a result."""

from __future__ import annotations

import weakref
from math import cos, hypot, sin
from typing import Any, NamedTuple, Protocol

#: how often the plant is looked at [s]
LOOK = 0.01
#: the end-effector rests when it moves by less than this from one look to the next [m, rad] …
STILL = 1e-8
#: … and contacts have come to rest this long after it [s]; creep is measured this often from then on [s]
SETTLED, CREEP_PERIOD = 0.15, 0.1
#: a contact that takes more than this share of its friction cone may slip, and slip is not creep
STICKING_SHARE = 0.98
#: a contact within this distance [m] of where it was is the same one
SAME_CONTACT = 1e-3

#: what is still well: contact changes in a second of rest, penetration [m], creep of a sticking contact in one rest
#: [m], slip between the fingers [m] and [rad]
MOST_FLICKER, MOST_PENETRATION, MOST_CREEP = 5, 50e-6, 10e-6
MOST_SLIP, MOST_TURN = 100e-6, 2e-3


class Touch(NamedTuple):
    """A contact point in W: the two bodies, place, tangent, and the share of the friction cone that it takes."""

    on: str
    by: str
    x: float
    y: float
    tx: float
    ty: float
    share: float


class Patient(Protocol):
    """What is looked at: the plant."""

    contact_changes: int

    @property
    def ee_pose(self) -> tuple[float, float, float]:
        """X_W_ee."""
        ...

    @property
    def finger_slip(self) -> float:
        """Path of the object between the fingers [m]."""
        ...

    @property
    def finger_turn(self) -> float:
        """Its turning between the fingers [rad]."""
        ...

    def deepest(self) -> float:
        """Penetration [m] of the deepest contact, 0 where there is none."""
        ...

    def touches(self) -> list[Touch]:
        """The contact points that carry load."""
        ...

    def place(self, body: str) -> tuple[float, float, float]:
        """Pose in W of ``go``, ``eo`` or ``ground``."""
        ...


class _Anchor(NamedTuple):
    """A sticking contact as it was when the plant came to rest: the two material points, each in its body's frame."""

    touch: Touch
    p_on: tuple[float, float]
    p_by: tuple[float, float]


class Health:
    """Watches one plant from its reset on. `look` costs a few microseconds per `LOOK`."""

    def __init__(self, patient: Patient):
        # who holds the other: a plant that goes takes its memory along at once, and does not wait for the collector
        self._patient: Patient = weakref.proxy(patient)
        self._ee = patient.ee_pose
        self._still = 0
        self._anchors: list[_Anchor] = []
        self._changes = self._second = self._in_second = 0
        self._looks_per_second = round(1.0 / LOOK)
        self.looks = self.resting = self.flicker = 0
        self.penetration = self.creep = 0.0

    def look(self) -> None:
        """Called once per `LOOK`."""
        patient = self._patient
        self.looks += 1
        depth = patient.deepest()
        # in this order a NaN never enters a result
        self.penetration = max(self.penetration, depth)
        (x, y, angle), (x0, y0, angle0) = patient.ee_pose, self._ee
        self._ee = (x, y, angle)
        if not (abs(x - x0) < STILL and abs(y - y0) < STILL and abs(angle - angle0) < STILL):
            self._still = 0
            return
        self._still += 1
        since = self._still - round(SETTLED / LOOK)
        if since == 0:
            self._changes = patient.contact_changes
            self._anchor()
        elif since > 0:
            self._rest()
            if since % round(CREEP_PERIOD / LOOK) == 0:
                self._measure_creep()

    def _rest(self) -> None:
        self.resting += 1
        changes = self._patient.contact_changes
        self._in_second += changes - self._changes
        self._changes = changes
        self.flicker = max(self.flicker, self._in_second)
        self._second += 1
        if self._second == self._looks_per_second:
            self._second = self._in_second = 0

    def _anchor(self) -> None:
        place = self._patient.place
        self._anchors = [
            _Anchor(touch, _inside(place(touch.on), touch.x, touch.y), _inside(place(touch.by), touch.x, touch.y))
            for touch in self._patient.touches()
            if touch.share < STICKING_SHARE
        ]

    def _measure_creep(self) -> None:
        """The tangential way of the two bodies past each other since the anchor, where they have stuck all the time."""
        place, now, kept = self._patient.place, self._patient.touches(), []
        for anchor in self._anchors:
            touch = anchor.touch
            on, by = _outside(place(touch.on), *anchor.p_on), _outside(place(touch.by), *anchor.p_by)
            if any(
                (other.on, other.by) == (touch.on, touch.by)
                and other.share < STICKING_SHARE
                and hypot(other.x - on[0], other.y - on[1]) < SAME_CONTACT
                for other in now
            ):
                kept.append(anchor)
                way = abs((on[0] - by[0]) * touch.tx + (on[1] - by[1]) * touch.ty)
                self.creep = max(self.creep, way)
        self._anchors = kept

    def summary(self) -> dict[str, Any]:
        """The figures of the run so far for results.json; ``flags`` says in words which of them are not well."""
        slip, turn = self._patient.finger_slip, self._patient.finger_turn
        figures = (
            (
                self.flicker > MOST_FLICKER,
                f"contacts flicker: {self.flicker} changes in a second at rest (well: {MOST_FLICKER})",
            ),
            (
                self.penetration > MOST_PENETRATION,
                f"bodies sank {self.penetration * 1e6:.0f} µm into each other (well: {MOST_PENETRATION * 1e6:.0f} µm)",
            ),
            (
                self.creep > MOST_CREEP,
                f"a sticking contact crept {self.creep * 1e6:.0f} µm at rest (well: {MOST_CREEP * 1e6:.0f} µm)",
            ),
            (
                slip > MOST_SLIP or turn > MOST_TURN,
                f"the object slipped in the fingers: {slip * 1e3:.2f} mm, {turn * 57.29578:.2f} deg",
            ),
        )
        return {
            "seconds": round(self.looks * LOOK, 9),
            "resting_seconds": round(self.resting * LOOK, 9),
            "contact_changes": self._patient.contact_changes,
            "flicker_per_s": self.flicker,
            "penetration_um": self.penetration * 1e6,
            "creep_um": self.creep * 1e6,
            "finger_slip_mm": slip * 1e3,
            "finger_slip_deg": turn * 57.29577951308232,
            "flags": [text for unwell, text in figures if unwell],
        }


def _inside(pose: tuple[float, float, float], x: float, y: float) -> tuple[float, float]:
    c, s = cos(pose[2]), sin(pose[2])
    dx, dy = x - pose[0], y - pose[1]
    return c * dx + s * dy, c * dy - s * dx


def _outside(pose: tuple[float, float, float], x: float, y: float) -> tuple[float, float]:
    c, s = cos(pose[2]), sin(pose[2])
    return pose[0] + c * x - s * y, pose[1] + s * x + c * y
