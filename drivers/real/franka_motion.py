"""Set-points as motions of a Franka, and where its joints let it go."""

from __future__ import annotations

from functools import cached_property
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np
from defusedxml import DefusedXmlException, ElementTree

from drivers.cubic import cubic
from drivers.errors import ProtocolError
from drivers.interfaces import ArmTarget
from drivers.real.arm_frames import ArmFrames
from drivers.real.joint_angles import joint_angles
from mechanics import se2
from mechanics.readings import Array

#: how long a leg of a way is [s]
LEG = 0.02
#: after coming to rest it goes on holding its pose actively for so long, and a next set-point follows seamlessly [s]
LINGER = 0.5

#: planar pose (3,) and twist (3,) at its end, and its duration [s]
Leg = tuple[Array, Array, float]


def motion(franky: Any, frames: ArmFrames, leg: Leg, dynamics: float, braking: float) -> Any:
    """The motion along a ``leg``, and to rest beyond it.

    It arrives with the leg's pose and twist after its time, or later where ``dynamics``, the share of the robot's own
    limits, does not allow for it. Unless another motion replaces it there, it brakes evenly for ``braking`` [s],
    whoever commands it: this is the dead man's switch. The robot's own EE frame is ee.
    """

    def milliseconds(seconds: float) -> Any:
        return franky.Duration(max(1, round(seconds * 1e3)))

    pose, twist, time = leg
    velocity = franky.RobotVelocity(franky.Twist(*frames.twist_in_base(twist)))
    there = franky.CartesianState(franky.RobotPose(franky.Affine(frames.ee_in_base(pose))), velocity)
    linger = milliseconds(LINGER)
    if twist.any():
        rest = franky.Affine(frames.ee_in_base(pose + twist * braking / 2))
        points = [
            franky.CartesianWaypoint(there, minimum_time=milliseconds(time)),
            franky.CartesianWaypoint(rest, minimum_time=milliseconds(braking), hold_target_duration=linger),
        ]
    else:
        points = [franky.CartesianWaypoint(there, minimum_time=milliseconds(time), hold_target_duration=linger)]
    return franky.CartesianWaypointMotion(points, relative_dynamics_factor=dynamics)


def to_rest(franky: Any, frames: ArmFrames, pose: Array, dynamics: float) -> Any:
    """The motion to ``pose`` (3,), and no further, as fast as ``dynamics`` allows."""
    return franky.CartesianMotion(franky.Affine(frames.ee_in_base(pose)), relative_dynamics_factor=dynamics)


class Way:
    """The way from planar ``pose`` and ``twist`` (3,) to a set-point: the cubic in time, handed out leg by leg.

    libfranka plans a motion anew, with its whole time, when a packet was lost. Legs of `LEG` seconds that follow the
    robot's own clock lose nothing by that.
    """

    def __init__(self, begun: float, pose: Array, twist: Array, target: ArmTarget):
        """``begun`` is the robot's time at the start [s]."""
        self.begun, self.T = begun, float(target.duration)
        goal, arriving = np.asarray(target.pose, float).copy(), np.asarray(target.twist, float)
        goal[2] = pose[2] + se2.wrap(goal[2] - pose[2])  # the nearest turn, so that the arm never unwinds
        self._ends = pose, twist, goal, arriving
        self._next = begun

    def leg(self, now: float) -> tuple[Leg | None, bool]:
        """The leg that is due at ``now`` by the robot's clock [s], if any, and whether it is the last one."""
        left = self.begun + self.T - now
        if left < 1.5 * LEG:
            _, _, goal, arriving = self._ends
            return (goal, arriving, max(left, LEG / 2)), True
        if now < self._next:
            return None, False
        self._next = now + LEG
        return (*self.at(1 - (left - LEG) / self.T), LEG), False

    def at(self, s: float) -> tuple[Array, Array]:
        """Pose and twist (3,) at the share ``s`` of its time."""
        pose, twist, goal, arriving = self._ends
        return cubic((pose, twist), (goal, arriving), self.T, s)


class Joints:
    """A Franka's joints by the model that the robot itself gives out (URDF)."""

    def __init__(self, franky: Any, device: str, robot: Any, q: Array):
        self._franky, self._model = franky, robot.model
        self._none = franky.Affine(np.eye(4))
        self.limits = joint_limits(device, robot.model_urdf)
        self._near: Array = np.asarray(q, float)

    def unreachable(self, goal: Array) -> str:
        """Why the flange cannot be at X_O_F (4, 4); "" where it can. Sought from the last pose that it could be at."""
        for start in (self._near, self._middle):
            q, there = joint_angles(self._forward, self._jacobian, start, goal, self.limits)
            if there:
                self._near = q
                return ""
        low, high = self.limits
        stuck = [str(i + 1) for i in range(q.size) if q[i] <= low[i] or q[i] >= high[i]]
        why = f"joint {' and '.join(stuck)} would be beyond its limit" if stuck else "it is beyond the arm's reach"
        return f"the arm cannot be there: {why}"

    @cached_property
    def _middle(self) -> Array:
        low, high = self.limits
        return (low + high) / 2

    def _forward(self, q: Array) -> Array:
        return self._model.pose(self._franky.Frame.Flange, q, self._none, self._none).matrix

    def _jacobian(self, q: Array) -> Array:
        return self._model.zero_jacobian(self._franky.Frame.Flange, q, self._none, self._none)


def joint_limits(device: str, urdf: str) -> tuple[Array, Array]:
    """The lowest and highest angle (7,) [rad] of each revolute joint, in their order. Raises ProtocolError."""
    asked = "read the joints' limits"
    try:
        root = ElementTree.fromstring(urdf)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ProtocolError(device, asked, f"the robot's model is no URDF: {error}") from error
    found: list[tuple[float, float]] = []
    for joint in root.iter("joint"):
        limit = joint.find("limit")
        if joint.get("type") == "revolute" and limit is not None:
            try:
                found.append((float(limit.get("lower", "nan")), float(limit.get("upper", "nan"))))
            except ValueError as error:
                raise ProtocolError(device, asked, f"{joint.get('name')}: {error}") from error
    spans = np.array(found).reshape(-1, 2)
    if spans.shape != (7, 2) or not np.isfinite(spans).all() or not (spans[:, 0] < spans[:, 1]).all():
        raise ProtocolError(device, asked, f"its model has {len(found)} usable revolute joints, not 7")
    return spans[:, 0], spans[:, 1]
