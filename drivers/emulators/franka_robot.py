"""What `franky_sim` lacks of a robot: reflexes, a measured pose, and a clock that keeps up. The child's side.

`python -m drivers.emulators.franka_robot` reads an order (JSON) from standard input; `drivers.emulators.franka_arm`
starts it. It says ``{"ready": address}`` or ``{"error": ...}`` on standard output.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any
from xml.etree.ElementTree import SubElement

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]  # its wheel has a prefix of its own
from franky_sim import BaseRobot, FrankaRobotServer, SimulationServer
from franky_sim import franka_robot_protocol as protocol
from franky_sim.mujoco_simulator import MUJOCO_DEFAULT_KP, FrankaMujocoRobot, MujocoSimulator

from drivers.real.joint_angles import joint_angles

#: joints of a Franka that is ready, its hand down
READY = (0.0, -0.7854, 0.0, -2.3562, 0.0, 1.5708, 0.7854)
#: the robot's time [s] and X_O_F (4, 4), row by row
RECORD = struct.Struct("<17d")
#: of the 41 errors of a libfranka state, the cartesian reflex
CARTESIAN_REFLEX = 7
#: the commanded twist is taken over so long [ms]
_WINDOW = 20
#: who is further behind does not catch up [s]
_BEHIND = 0.05


class CommandedMotion:
    """Twist (6,) of the commanded poses by the robot's clock: the mean over the last `_WINDOW` milliseconds.

    A client that has missed a state plans anew from what the robot tells of the commanded motion. franky_sim's own
    twist is smoothed and its acceleration that of the joints: a planned straight line wandered by 4 mm. After a missed
    state libfranka's low-pass filter catches up in bursts, so that the last difference alone may be ten times too much.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[int, pin.SE3]] = deque()
        self.twist = np.zeros(6)

    def take(self, number: int, pose: Any) -> None:
        """A command that answers the state of this ``number``, one each millisecond."""
        poses = self._poses
        if poses and number <= poses[-1][0]:
            return
        poses.append((number, pin.SE3(np.reshape(pose, (4, 4), order="F"))))
        while len(poses) > 2 and poses[1][0] <= number - _WINDOW:
            poses.popleft()
        (first, before), (_, X) = poses[0], poses[-1]
        if number > first:
            moved = np.concatenate([X.translation - before.translation, pin.log3(X.rotation @ before.rotation.T)])
            self.twist = moved / (max(number - first, _WINDOW) * 1e-3)


class ReflexServer(FrankaRobotServer):
    """The robot's server, with reflexes: a motion ends, and none begins until the errors are recovered from."""

    def __init__(self, robot: BaseRobot, hostname_candidates: Any):
        super().__init__(robot, hostname_candidates)
        self.reflex = False
        self._told: CommandedMotion | None = None
        commands = self._FrankaServer__command_class_map  # type: ignore[attr-defined]
        commands[protocol.RobotCommand.kMove] = _Move
        commands[protocol.RobotCommand.kAutomaticErrorRecovery] = _Recovery

    def inject(self) -> None:
        """As if the robot had felt a collision."""
        motion, self.reflex = self.current_motion_id, True
        self.stop_motion(send_preemption_signal=False)
        if motion and self._tcp_socket is not None:
            protocol.MoveCommand.send_response(
                self._tcp_socket, protocol.RobotCommand.kMove, motion, protocol.MoveStatus.kReflexAborted
            )
            self.reset_current_motion_id()

    def start_motion(self, controller_mode: Any, motion_generator_mode: Any, motion_id: int) -> None:
        """A motion begins, at rest."""
        poses = motion_generator_mode == protocol.MoveCommandMotionGeneratorMode.kCartesianPosition
        self._told = CommandedMotion() if poses else None
        super().start_motion(controller_mode, motion_generator_mode, motion_id)

    def stop_motion(self, send_preemption_signal: bool = True) -> None:
        """A motion ends."""
        self._told = None
        super().stop_motion(send_preemption_signal)

    def _handle_udp_command(self, command_data: bytes) -> None:
        command = protocol.UDPCommand.from_bytes(command_data)
        if self._told is not None and command.message_id > 0 and not command.motion_generation_finished:
            self._told.take(command.message_id, command.O_T_EE_c)
        super()._handle_udp_command(command_data)

    @property
    def robot_state(self) -> Any:
        """The robot's state, its reflex among it."""
        state = super().robot_state
        if (told := self._told) is not None:
            state = state.replace(O_dP_EE_c=tuple(told.twist.tolist()), O_ddP_EE_c=(0.0,) * 6)
        if not self.reflex:
            return state
        errors = tuple(i == CARTESIAN_REFLEX for i in range(41))
        return state.replace(robot_mode=protocol.RobotMode.kReflex, errors=errors, reflex_reason=errors)


class _Move(protocol.MoveCommand):
    def handle(self, server: Any) -> None:
        if server.reflex:
            self.reply(protocol.MoveStatus.kCommandNotPossibleRejected)
        else:
            super().handle(server)


class _Recovery(protocol.AutomaticErrorRecoveryCommand):
    def handle(self, server: Any) -> None:
        server.reflex = False
        super().handle(server)


class _Simulation(SimulationServer):
    def init(self) -> None:
        (robot,) = self.sim.robots
        server = ReflexServer(robot, self._hostname_candidates)
        server.init()
        self.robot_servers.append(server)
        self.sim.start()


def kinematics(robot: BaseRobot) -> tuple[pin.Model, Callable[[Any], Any], Callable[[Any], Any]]:
    """The robot's model, and its flange's pose (4, 4) and Jacobian (6, 7) in the base, of joint angles."""
    model: pin.Model = robot._BaseRobot__model  # type: ignore[attr-defined]
    data = model.createData()
    flange = model.getFrameId("link8")

    def forward(q: Any) -> Any:
        pin.forwardKinematics(model, data, np.asarray(q, float))
        return pin.updateFramePlacement(model, data, flange).homogeneous.copy()

    def jacobian(q: Any) -> Any:
        return pin.computeFrameJacobian(
            model, data, np.asarray(q, float), flange, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )

    return model, forward, jacobian


def _addresses(host: str) -> Iterator[str]:
    """Loopback addresses that no other emulator is likely to have taken, or the one that is asked for."""
    if host:
        yield host
        return
    pid = os.getpid()
    for last in range(1, 255):
        yield f"127.{64 + (pid >> 8) % 64}.{pid % 256}.{last}"


def _start(robot: FrankaMujocoRobot, goal: Any) -> tuple[float, ...]:
    """Joint angles with the flange at X_O_F ``goal``. Raises ValueError where there are none."""
    model, forward, jacobian = kinematics(robot)
    limits = (np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit))
    q, there = joint_angles(forward, jacobian, np.array(READY), np.asarray(goal, float), limits)
    if not there:
        raise ValueError(f"no joint angles put the flange at {np.round(goal, 4).tolist()}")
    return tuple(q.tolist())


def serve(order: dict[str, Any], pipe: socket.socket, ready: Callable[[str], None]) -> None:
    """Be the robot until SIGTERM, or until the other end of ``pipe`` is closed."""
    ended: list[bool] = []

    def end(_signal: int, _frame: FrameType | None) -> None:
        ended.append(True)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the keyboard's interrupt is its parent's to act on
    pipe.setblocking(False)
    kv = tuple(order["damping"] * kp for kp in MUJOCO_DEFAULT_KP)
    with MujocoSimulator() as sim:
        q = READY if order["start"] is None else _start(FrankaMujocoRobot(), order["start"])
        robot = sim.add_robot(initial_q=q, initial_hand_width=order["opening"], kv=kv)
        # what it returns is otherwise overwritten by the next call: the measured pose would be the desired one
        robot.kinematics = lambda q: BaseRobot.kinematics(robot, q).copy()
        _, forward, _ = kinematics(robot)
        if order["block"]:
            _float_block(sim.worldbody, forward(q), order["block"])
        with _Simulation(sim, _addresses(order["host"])) as simulation:
            (server,) = simulation.robot_servers
            ready(str(server.hostname))
            _run(simulation, server, robot, forward, pipe, round(1000 / order["rate"]), ended)


def _run(simulation: Any, server: Any, robot: Any, forward: Any, pipe: Any, every: int, ended: list[bool]) -> None:
    """One millisecond of the robot's time after another, each when it is due."""
    steps, due = 0, time.monotonic()
    while not ended:
        simulation.run_once(False)
        steps += 1
        if steps % every == 0:
            try:
                pipe.send(RECORD.pack(steps * 1e-3, *forward(robot.inner_state.q).ravel()))
            except BlockingIOError:
                pass  # nobody has looked for a while
            except OSError:
                return  # nobody will look again
            try:
                if pipe.recv(16) == b"reflex":
                    server.inject()
            except BlockingIOError:
                pass
        due += 1e-3
        left = due - time.monotonic()
        if left > 0:
            time.sleep(left)  # the robot's own thousand steps a second, by absolute deadlines
        elif left < -_BEHIND:
            due = time.monotonic()


def _float_block(world: Any, X_O_F: Any, width: float) -> None:
    """A block of ``width`` [m] that floats between the fingertips."""
    X_F_tip = np.eye(4)
    X_F_tip[:2, :2] = np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)  # the hand sits turned by −45°
    X_F_tip[2, 3] = 0.1034
    X = X_O_F @ X_F_tip
    quaternion = pin.Quaternion(X[:3, :3])
    where = " ".join(map(str, X[:3, 3]))
    turned = f"{quaternion.w} {quaternion.x} {quaternion.y} {quaternion.z}"
    body = SubElement(world, "body", name="block", gravcomp="1", pos=where, quat=turned)
    SubElement(body, "freejoint", name="block")
    SubElement(body, "geom", type="box", size=f"0.01 {width / 2} 0.01", mass="0.05")


def main() -> None:
    """Read the order, and be that robot."""
    order = json.loads(sys.stdin.readline())

    def tell(said: dict[str, str]) -> None:
        sys.stdout.write(json.dumps(said) + "\n")
        sys.stdout.flush()

    pipe = socket.socket(fileno=order["pipe"])
    try:
        serve(order, pipe, lambda address: tell({"ready": address}))
    except (OSError, ValueError) as error:
        tell({"error": f"{type(error).__name__}: {error}"})
        raise SystemExit(1) from error


if __name__ == "__main__":
    main()
