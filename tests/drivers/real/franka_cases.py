"""An emulated Franka and what the tests of its driver ask of it. Time is the robot's own: a busy machine slows it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from time import monotonic

import numpy as np

from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.real.arm_frames import ArmFrames, PlaneInBase, ToolMount
from drivers.real.franka import FrankaArm
from drivers.real.franka_config import FrankaConfig
from mechanics.readings import Array

HOME = np.array([0.0, 0.3, 0.0])
FRAMES = ArmFrames(PlaneInBase(), ToolMount())
#: longest wait for anything, in wall time [s]
PATIENCE = 30.0


def config(host: str, **given: object) -> FrankaConfig:
    return FrankaConfig.model_validate(
        {"kind": "arm", "backend": "real", "driver": "franka", "realtime": "ignore", "host": host, **given}
    )


@contextmanager
def connected(host: str, **given: object) -> Iterator[FrankaArm]:
    arm = FrankaArm("arm", config(host, **given))
    arm.connect()
    try:
        yield arm
    finally:
        arm.close()


class Witness:
    """Where the emulated robot really was, by its joints: robot's time (N,) [s] and poses (N, 3)."""

    def __init__(self, host: str = "") -> None:
        self.rows: list[tuple[float, Array]] = []
        self.emulator = FrankaArmEmulator(FRAMES, HOME, lambda time, pose: self.rows.append((time, pose)), host=host)

    @property
    def now(self) -> float:
        return self.emulator.pose()[0]

    def await_time(self, instant: float) -> None:
        await_that(lambda: self.now >= instant, "the robot's time goes on")

    def since(self, instant: float) -> tuple[Array, Array]:
        rows = [row for row in self.rows if row[0] >= instant]
        return np.array([time for time, _ in rows]), np.array([pose for _, pose in rows])

    def await_rest(self, span: float = 0.2) -> Array:
        """The pose at which it has rested for ``span`` seconds."""

        def rests() -> bool:
            now = self.now
            times, poses = self.since(now - span)
            return len(times) > 2 and times[-1] - times[0] > 0.9 * span and np.ptp(poses, axis=0).max() < 2e-5

        start = self.now
        await_that(lambda: self.now > start + span and rests(), "the robot rests")
        return self.emulator.pose()[1]


def await_that(true: Callable[[], object], what: str, timeout: float = PATIENCE) -> None:
    deadline, pause = monotonic() + timeout, Event()
    while not true():
        assert monotonic() < deadline, f"not within {timeout:g} s: {what}"
        pause.wait(0.01)
