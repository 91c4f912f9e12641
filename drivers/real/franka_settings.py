"""What a Franka is set to, and how its state reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from drivers.real.arm_frames import ArmFrames
from drivers.real.franka_config import FrankaConfig
from mechanics.readings import Array


def settings(
    robot: Any, state: Any, config: FrankaConfig, frames: ArmFrames
) -> Iterator[tuple[str, Callable[[], object]]]:
    """What is asked of the robot between two motions, and the calls that ask it; ``state`` tells its tool's frame."""
    X_NE_EE = np.linalg.inv(state.F_T_NE.matrix) @ frames.X_F_ee
    yield "set its end-effector", partial(robot.set_ee, _columns(X_NE_EE))
    thresholds = (config.collision_torque, config.collision_force)
    yield "set its reflexes", partial(robot.set_collision_behavior, *thresholds)
    if config.joint_stiffness is not None:
        yield "set its joint stiffness", partial(robot.set_joint_impedance, list(config.joint_stiffness))
    if config.cartesian_stiffness is not None:
        yield "set its stiffness frame", partial(robot.set_k, _columns(np.eye(4)))
        yield "set its Cartesian stiffness", partial(robot.set_cartesian_impedance, list(config.cartesian_stiffness))
    if (load := config.load) is not None:
        inertia = np.diag(load.inertia).ravel().tolist()
        yield "set its load", partial(robot.set_load, load.mass, list(load.centre), inertia)


def mode(state: Any) -> str:
    """What the robot does: Idle, Move, Guiding, Reflex, UserStopped, AutomaticErrorRecovery or Other."""
    return state.robot_mode.name


def errors(state: Any) -> str:
    """The robot's present errors by name, as libfranka prints them; "" where there are none."""
    said = str(state.current_errors).strip("[]")
    return said.replace('"', "").replace(",", ", ")


def _columns(X: Array) -> list[float]:
    """A homogeneous matrix as libfranka takes it."""
    return X.ravel(order="F").tolist()
