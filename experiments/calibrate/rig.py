"""The station while it is being calibrated: the arm under lease, motions, and what is measured at rest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from control.motion import Mover
from control.observe import Observer
from drivers.errors import CommandRefused
from drivers.interfaces import ForceTorqueSensor
from drivers.scene import Scene
from drivers.station import Devices
from experiments import setup
from experiments.context import RunContext
from mechanics import se2
from mechanics.elasticity import Elasticity
from mechanics.readings import Array, Status
from mechanics.tag_board import TagBoard

#: calibrations take grasps of their own, so that no trial meets the one that was calibrated
FIRST_GRASP = 10_000


class Rig:
    """A station in the hands of one calibration. Make it with `at_hand`."""

    def __init__(self, context: RunContext, devices: Devices, observer: Observer, mover: Mover):
        self.context, self.devices, self.observer, self.mover = context, devices, observer, mover
        self.start = mover.pose.copy()

    # -- motions -----------------------------------------------------------------------------------------------------

    def rest(self, seconds: float) -> None:
        """Hold still for ``seconds``."""
        self.mover.rest(seconds)

    def lift_to(self, height: float) -> None:
        """Raise the end-effector to at least ``height`` [m] in W, straight up."""
        here = self.mover.pose
        if here[1] < height:
            self.mover.travel(np.array([here[0], height, here[2]]))

    def home(self) -> None:
        """Back to where the calibration began: up, across, down."""
        here, goal = self.mover.pose, self.start
        height = max(here[1], goal[1])
        for pose in ([here[0], height, here[2]], [goal[0], height, goal[2]], goal):
            self.mover.travel(np.asarray(pose, float))
        self.rest(0.2)

    # -- what a person does, or the simulated world ------------------------------------------------------------------

    def regrasp(self, number: int) -> None:
        """Take the object into the fingers anew; a person is asked to."""
        if self.devices.simulation is not None:
            self.devices.simulation.regrasp(FIRST_GRASP + number)
            self.rest(0.5)
        else:
            self._person("Grasp the object anew, hanging free")

    def clamp(self, body: str, what: str) -> None:
        """Fix ``body`` (``go``, ``eo``), called ``what``, to the table. Raises CommandRefused where nobody does."""
        if self.devices.simulation is not None:
            self.devices.simulation.clamp(body)
        else:
            self._person(f"Fix {what} to the table")

    def free(self, what: str) -> None:
        """Undo `clamp`."""
        if self.devices.simulation is not None:
            self.devices.simulation.clamp(None)
        else:
            self._person(f"Free {what} from the table")

    def rearrange(self, scene: Scene, what: str) -> None:
        """Put other objects into place, as ``what`` tells a person."""
        if self.devices.simulation is not None:
            self.devices.simulation.rearrange(scene.model_dump())
        else:
            self._person(what)
        self.rest(0.5)

    def show_board(self, board: TagBoard, X_W_B: Array, what: str) -> None:
        """Hold the tag board before the camera at ``X_W_B`` (4, 4), or as ``what`` tells a person, who may differ."""
        if self.devices.simulation is not None:
            self.devices.simulation.show_board(board.as_dict(), X_W_B)
        else:
            self._person(what)

    def put_board_away(self) -> None:
        """Take the tag board out of the picture."""
        if self.devices.simulation is not None:
            self.devices.simulation.show_board(None, np.eye(4))
        else:
            self._person("Take the tag board away")

    def _person(self, what: str) -> None:
        if not self.context.ask(what):
            raise CommandRefused("station", "calibrate", f"nobody did: {what}", "Run it at a terminal, and confirm")

    def hanging(self, X_W_ee: Array) -> Array:
        """X_W_go (3,) of the object that hangs free in the fingers, as the grasp and the stiffness have it."""
        known, resolved = self.context.believed, self.context.resolved
        load = setup.free_air_load(resolved)
        X_W_go = se2.compose(X_W_ee, se2.inverse(resolved.grasp))
        for _ in range(5):  # the weight's lever changes with the sag, by little
            carried = load.wrench_on_go(X_W_go, se2.compose(X_W_go, resolved.grasp)[:2])
            X_W_go = Elasticity(known.stiffness).go_pose(X_W_ee, resolved.grasp, carried)
        return X_W_go

    # -- measurements --------------------------------------------------------------------------------------------------

    def wrist_samples(self, seconds: float) -> tuple[Array, Array]:
        """Mean (6,) of the wrist's readings while resting for ``seconds``, and the covariance (6, 6) of that mean.

        The covariance comes from the means of twenty pieces, so that slow noise counts as well.
        """
        wrist = self.devices.force_torque("wrist")
        return self._averaged(wrist, seconds)

    def table_samples(self, seconds: float) -> tuple[Array, Array]:
        """As `wrist_samples`, of the sensor under the table."""
        return self._averaged(self.devices.force_torque("table"), seconds)

    def mean_since(self, sensor: ForceTorqueSensor, begin: int) -> Array:
        """Mean (6,) of a sensor's readings since ``begin`` [ns]."""
        return self._since(sensor, begin).mean(axis=0)

    def _averaged(self, sensor: ForceTorqueSensor, seconds: float) -> tuple[Array, Array]:
        begin = self.devices.clock.now_ns()
        self.rest(seconds)
        values = self._since(sensor, begin)
        pieces = np.array([piece.mean(axis=0) for piece in np.array_split(values, 20)])
        return values.mean(axis=0), np.cov(pieces.T) / len(pieces)

    def _since(self, sensor: ForceTorqueSensor, begin: int) -> Array:
        values = np.array([r.wrench for r in sensor.since(begin) if r.stamp.status is Status.OK])
        if len(values) < 20:
            raise CommandRefused(
                sensor.name,
                "average its readings",
                f"{len(values)} that can be trusted in {(self.devices.clock.now_ns() - begin) * 1e-9:.2g} s",
                "Average for longer, or see to the sensor",
            )
        return values


@contextmanager
def at_hand(context: RunContext, what: str) -> Iterator[Rig]:
    """The rig of a calibration called ``what``: the lease is held, and in the end the arm is back where it began."""
    devices = context.devices()
    with devices.arm.lease(context.holder), context.timed(devices):
        context.event("info", f"calibrate {what}")
        context.begin(setup.scene(context.resolved), part=1 + context.results["progress"]["stage"])
        observer = setup.observer(context.resolved, devices, context.settings, context.believed)
        mover = Mover.of(devices.arm, devices.clock, observer.arm_pose(), context.settings, context.heed, context.event)
        yield Rig(context, devices, observer, mover)
