"""What a run writes down of itself, as frozen values: waypoints, the plan of each trial, its phases, events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics.readings import Array


@dataclass(frozen=True, slots=True)
class PlanarState:
    """Poses (3,) in W of end-effector, grasped and extrinsic object, and the wrench (3,) of the sensor on the go.

    The wrench is about the grasp centre, axes of W [N, N, N·m]. None stands for what is not there or was not seen.
    """

    ee: Array
    go: Array | None
    eo: Array | None
    wrench: Array

    @property
    def is_finite(self) -> bool:
        """Whether all that is there is numbers."""
        there = [value for value in (self.ee, self.go, self.eo, self.wrench) if value is not None]
        return bool(np.isfinite(np.concatenate(there)).all())


@dataclass(frozen=True, slots=True)
class ContactBelief:
    """Where the environment is believed to touch the go, in its frame.

    ``points`` (H, 2) [m] are the places that explain the wrench, the likeliest first, and ``weights`` (H,) how likely.
    ``status`` is ``ok`` where they are one answer, else why the place is not known.
    """

    status: str
    points: Array
    weights: Array

    @property
    def point(self) -> Array | None:
        """The place (2,) [m], where it is known."""
        return self.points[0] if self.status == "ok" else None


@dataclass(frozen=True, slots=True)
class WaypointRecord:
    """One settled waypoint of a trial: planned (anchored to the table), commanded ee pose, measured, and true.

    ``estimated`` is the whole state as estimated at this instant: from the fingers, as the controller was told, where
    it feels; else from arm, wrist, tags and elasticity, and a controller was told what is ``measured``. ``contact`` is
    where the go was believed to be touched. ``truth`` is the plant's own state, filled in by the runner in simulation
    only.
    """

    capture_ns: int
    trial: str
    step: int
    planned: PlanarState
    commanded: Array
    measured: PlanarState
    truth: PlanarState | None = None
    estimated: PlanarState | None = None
    contact: ContactBelief | None = None


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """The begin (``status`` empty) or the end of a trial. ``plan`` is the anchored plan as JSON, at the end only."""

    capture_ns: int
    trial: str
    skill: str
    controller: str
    status: str = ""
    reason: str = ""
    plan: str = ""


@dataclass(frozen=True, slots=True)
class PhaseRecord:
    """A trial enters ``phase``."""

    capture_ns: int
    trial: str
    phase: str


@dataclass(frozen=True, slots=True)
class EventRecord:
    """Something a person should know: ``level`` is ``info``, ``warning`` or ``error``."""

    capture_ns: int
    level: str
    text: str


@dataclass(frozen=True, slots=True)
class LookRecord:
    """Somebody has looked at the devices: what it was (``act``), for whom, and the readings that it went by.

    ``sources`` are the devices that were read, in their order, with ``stamps`` [ns], the capture time of the newest
    reading that was taken from each, and ``sequences``, its sequence number. ``told`` is JSON: what the look was given,
    and what came of it that no other record has. With it the look can be taken again (`experiments.replay`).
    """

    capture_ns: int
    trial: str
    act: str
    told: str = "{}"
    sources: tuple[str, ...] = ()
    stamps: tuple[int, ...] = ()
    sequences: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class StatusRecord:
    """From its message ``sequence`` on a stream's readings have another ``status`` (`mechanics.readings.Status`).

    A stream begins as OK; in a log this stands before the message.
    """

    capture_ns: int
    stream: str
    sequence: int
    status: int
