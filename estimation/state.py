"""The state that a trial acts on, from readings that come at their own rates, late, and out of order.

In: the arm's poses, the wrist's wrenches, tactile poses, tag poses. Out: one time-stamped `State`. Everything is put
in its place by the time of its capture; when it arrived plays no part. A stream's known delay is taken off first.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimation.contact_location import ContactEstimate
from estimation.contact_tracking import ContactTracker
from estimation.contact_wrench import EnvironmentWrench, from_force_torque, wrist_covariance
from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.grasp_filter import GraspFilter
from estimation.tactile_pose import GraspPrior, PoseStatus, TactilePose
from estimation.tag_pose import TagPose
from estimation.wrench_errors import ForceTorqueErrors, Zero
from mechanics import se2, wrench
from mechanics.elasticity import Elasticity
from mechanics.readings import Array, PoseReading, Status, WrenchReading
from mechanics.task_plane import TaskPlane

#: systematic error of a tag's pose: how it sits, what is left of the lens [m, m, rad]
TAG_FLOOR = (1e-4, 1e-4, np.radians(0.1))
_PLANAR = TaskPlane().wrench_to_planar(np.eye(6)).T  # (3, 6)


@dataclass(frozen=True, eq=False)
class State:
    """What is known at ``capture_ns``. Poses (3,) in W; None where nothing is known.

    ``go_covariance`` (3, 3) is of a left perturbation of X_ee_go about ee's origin, in ee; ``wrench`` (3,) of the
    sensor on the go about ``centre`` (2,) in W, axes of W, with its covariance. That is where the fingers are, x⁻¹ from
    the end-effector: the go's grasp centre only if it lies in them as planned. ``contact`` where the environment
    touches the go, in its frame. ``ages`` [s] of each source at ``capture_ns``; ``status`` of the go's pose and its
    ``reason``.
    """

    capture_ns: int
    ee: Array
    go: Array
    go_covariance: Array
    wrench: Array
    wrench_covariance: Array
    centre: Array
    eo: Array | None = None
    eo_covariance: Array | None = None
    contact: ContactEstimate | None = None
    ages: Mapping[str, float] = field(default_factory=dict)
    status: PoseStatus = PoseStatus.OK
    reason: str = ""

    def told(self) -> dict[str, Any]:
        """What the log is to have of it beside the records: the poses, the wrench, and how sure they are, for JSON."""
        names = ("ee", "go", "go_covariance", "wrench", "wrench_covariance", "centre", "eo", "eo_covariance")
        values = {name: getattr(self, name) for name in names}
        return {name: np.asarray(value).tolist() for name, value in values.items() if value is not None}


class NoState(ValueError):
    """There is no state yet: a source that it cannot do without has said nothing. The message names it."""


class _Series:
    """Vectors by the time of their capture, those of the last ``memory`` [ns]."""

    def __init__(self, memory: int):
        self._memory = memory
        self._times: list[int] = []
        self._values: dict[int, Array] = {}

    def put(self, capture_ns: int, value: Array) -> None:
        if capture_ns in self._values or (self._times and capture_ns < self._times[-1] - self._memory):
            return
        insort(self._times, capture_ns)
        self._values[capture_ns] = value
        while self._times[0] < self._times[-1] - self._memory:
            del self._values[self._times.pop(0)]

    @property
    def newest(self) -> int | None:
        return self._times[-1] if self._times else None

    def at(self, capture_ns: int) -> Array:
        """Between the readings before and after; beyond the ends, the end."""
        i = bisect_left(self._times, capture_ns)
        if i == 0:
            return self._values[self._times[0]]
        if i == len(self._times):
            return self._values[self._times[-1]]
        before, after = self._times[i - 1], self._times[i]
        a, b = self._values[before], self._values[after]
        return a + (b - a) * ((capture_ns - before) / (after - before))

    def within(self, begin: int, end: int) -> Array:
        """The values captured in (begin, end], (n, d); at least the nearest one."""
        times = self._times[bisect_left(self._times, begin + 1) : bisect_left(self._times, end + 1)]
        return np.array([self._values[t] for t in times] or [self.at(end)])


@dataclass
class StateEstimator:
    """Joins the readings of one grasp.

    ``grasp`` holds the belief about where the object lies in the fingers; ``elasticity`` and ``wrist`` turn readings
    into displacements; ``window`` [s] is how far back wrenches are averaged, ``errors`` what is wrong with them and
    ``zero`` when and where the wrist was zeroed (None: just now). ``delays`` [s] by source (``arm``, ``wrist``,
    ``camera``, ``tactile``) are taken off the capture times. ``contact`` follows the contact from state to state. Not
    thread-safe.
    """

    grasp: GraspFilter
    elasticity: Elasticity
    wrist: WristSensor
    load: FreeAirLoad
    window: float = 0.1
    errors: ForceTorqueErrors = field(default_factory=ForceTorqueErrors)
    zero: Zero | None = None
    delays: Mapping[str, float] = field(default_factory=dict)
    contact: ContactTracker | None = None
    memory: float = 2.0

    def __post_init__(self) -> None:
        memory = round(self.memory * 1e9)
        self._ee, self._wrench = _Series(memory), _Series(memory)
        self._eo: tuple[int, TagPose] | None = None
        self._seen: dict[str, int] = {}
        self._told: tuple[int, PoseStatus, str] | None = None

    # -- in ----------------------------------------------------------------------------------------------------------

    def push_pose(self, reading: PoseReading) -> None:
        """X_W_ee from the arm. A reading that is not OK, or not finite, is left out."""
        if reading.stamp.status is Status.OK and np.isfinite(reading.pose).all():
            pose, newest = np.array(reading.pose, float), self._ee.newest
            if newest is not None:
                around = self._ee.at(newest)[2]
                pose[2] = around + se2.wrap(pose[2] - around)
            self._ee.put(self._time("arm", reading.stamp.capture_ns), pose)

    def push_wrench(self, reading: WrenchReading) -> None:
        """A wrist reading. One that is not OK, or not finite, is left out."""
        if reading.stamp.status is Status.OK and np.isfinite(reading.wrench).all():
            self._wrench.put(self._time("wrist", reading.stamp.capture_ns), np.asarray(reading.wrench, float))

    def expected(self, capture_ns: int) -> GraspPrior:
        """X_ee_go where a tactile image of this instant should find it. Raises NoState."""
        at = self._time("tactile", capture_ns)
        return self.grasp.predicted(at, self._displacement(at)[0])

    def push_tactile(self, capture_ns: int, prior: GraspPrior, found: TactilePose) -> None:
        """What a tactile image of ``capture_ns`` showed, read under ``prior`` (of `expected`), of all fingers fused."""
        at = self._time("tactile", capture_ns)
        if self._told is None or at >= self._told[0]:
            self._told = at, found.status, found.reason
        if found.status is PoseStatus.OK:
            x = self._displacement(at)[0]
            self.grasp.measured_through(at, x, prior, found.pose, found.information)
            self._note("tactile", at)

    def push_tag(self, body: str, capture_ns: int, found: TagPose) -> None:
        """A body's tag pose in W: ``go`` or ``eo``."""
        at = self._time("camera", capture_ns)
        if body == "eo" and (self._eo is None or at >= self._eo[0]):
            self._eo = at, found
        elif body == "go":
            x, ee, _ = self._displacement(at)
            X_ee_go = se2.between(ee, found.pose)
            # Δ about ee's origin, in ee, from the pose's error about the go's origin, in W
            R = np.eye(3)
            R[:2, :2] = se2.rotation(-ee[2])
            lever = np.eye(3)
            lever[:2, 2] = X_ee_go[1], -X_ee_go[0]
            error = found.covariance + np.diag(TAG_FLOOR) ** 2
            A = lever @ R
            self.grasp.measure(at, x, X_ee_go, np.asarray(np.linalg.inv(A @ error @ A.T), np.float64))
        self._note(f"{body} tag", at)

    # -- out -----------------------------------------------------------------------------------------------------------

    def state(self, capture_ns: int | None = None) -> State:
        """The state at an instant, by default the newest of which pose and wrench, an image or the go's tag tell.

        The contact is followed from one call to the next. Raises NoState.
        """
        if capture_ns is None:
            at = max(min(self._newest()), *(self._seen.get(source, 0) for source in ("tactile", "go tag")))
        else:
            at = capture_ns
        x, ee, w = self._displacement(at)
        prior = self.grasp.predicted(at, x)
        go = se2.compose(ee, prior.pose)
        p_W = se2.compose(ee, se2.inverse(x))[:2]
        covariance = self._wrench_covariance(at, ee, p_W, w)
        status, reason = self._status()
        eo = self._eo
        return State(
            at,
            ee,
            go,
            prior.covariance,
            w,
            covariance,
            p_W,
            None if eo is None else eo[1].pose,
            None if eo is None else eo[1].covariance,
            self._contact(at, ee, go, prior.covariance, from_force_torque(w, covariance, go, p_W, self.load)),
            {name: (at - seen) * 1e-9 for name, seen in {**self._seen, **self._streams()}.items()},
            status,
            reason,
        )

    def _status(self) -> tuple[PoseStatus, str]:
        if self.grasp.slips:
            return PoseStatus.SLIPPED, f"the object slipped in the fingers {self.grasp.slips} times since the grasp"
        return (PoseStatus.OK, "") if self._told is None else self._told[1:]

    def _contact(
        self, at: int, ee: Array, go: Array, go_covariance: Array, on_go: EnvironmentWrench
    ) -> ContactEstimate | None:
        if self.contact is None:
            return None
        # ee's origin and the fingers' centre are millimetres apart: one point for the pose's error
        R = np.eye(3)
        R[:2, :2] = se2.rotation(ee[2] - go[2])
        eo = None if self._eo is None else self._eo[1].pose
        return self.contact.at(at, go, R @ go_covariance @ R.T, eo, on_go)

    def _displacement(self, at: int) -> tuple[Array, Array, Array]:
        """x (3,) in gocf, X_W_ee (3,), and the wrench (3,) about ee ∘ x⁻¹ in axes of W, at an instant."""
        self._newest()
        ee = self._ee.at(at)
        reading = self._wrench.within(at - round(self.window * 1e9), at).mean(axis=0)
        gocf, x, w = ee, np.zeros(3), np.zeros(3)
        for _ in range(3):  # the lever of a sagging object: each time a hundredth of the last
            w = self.wrist.wrench_on_go(reading, ee, gocf[:2])
            x = self.elasticity.displacement(wrench.rotated(w, -gocf[2]))
            gocf = se2.compose(ee, se2.inverse(x))
        return x, ee, w

    def _wrench_covariance(self, at: int, ee: Array, p_W: Array, w: Array) -> Array:
        count = len(self._wrench.within(at - round(self.window * 1e9), at))
        X_W_s = se2.compose(ee, self.wrist.X_ee_s)
        load = wrench.rotated(wrench.about(w, p_W, X_W_s[:2]), -X_W_s[2])
        zero = Zero(at, ee) if self.zero is None else self.zero
        return wrist_covariance(zero.covariance(self.errors, self.wrist, at, ee, load, count), X_W_s, p_W)

    def _newest(self) -> tuple[int, int]:
        ee, force = self._ee.newest, self._wrench.newest
        if ee is None or force is None:
            silent = "the arm" if ee is None else "the wrist force/torque sensor"
            raise NoState(f"state: no reading of {silent} that can be trusted has come yet; check its stream")
        return ee, force

    def _streams(self) -> dict[str, int]:
        ee, force = self._newest()
        return {"arm": ee, "wrist": force}

    def _time(self, source: str, capture_ns: int) -> int:
        return capture_ns - round(self.delays.get(source, 0.0) * 1e9)

    def _note(self, source: str, at: int) -> None:
        self._seen[source] = max(at, self._seen.get(source, at))
