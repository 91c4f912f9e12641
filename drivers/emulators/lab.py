"""The emulated lab: a simulated plant behind devices that speak the real devices' protocols.

The arm's measured pose drives the plant; the plant's wrench goes out as RDT packets and its pictures as MJPEG. On the
bus are the station's *real* backends, which talk to all that over loopback, and the world with its scene and its truth,
for there is nobody to lay out objects. It runs in real time, pictures only where somebody takes them.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from drivers import hosted
from drivers.config import StationConfig
from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.emulators.netft_box import NetFtBox
from drivers.errors import DeviceFault, NotConnected
from drivers.hosting import HostProcess
from drivers.interfaces import Sensor
from drivers.real.arm_frames import ArmFrames
from drivers.scene import Scene
from drivers.sim import host
from drivers.sim.arm import SimArm
from drivers.sim.gelslim import SimGelSlim
from drivers.sim.host import Host
from drivers.sim.tag_camera import SimTagCamera
from drivers.wire.bus import Bus
from drivers.wire.link import Link
from drivers.wire.server import Work
from mechanics.readings import Array, WrenchReading

log = logging.getLogger(__name__)

#: how long a camera waits for its picture: the world is busy, or has ended [s]
_PICTURE = 2.0
_TURN = 0.02
#: the grey of a table on which nothing lies
_EMPTY = 128
#: a world that is late catches up, for the plant has to go the way that the robot went; later than this, it cannot [s]
_LATEST = 2.0
#: how finely it goes that way [ns], and how far behind the robot's newest pose without hurry [s]
_PIECE_NS, _BACKLOG = 4_000_000, 0.03
#: what a wrench takes at most from the plant to its box, by any profile [s]
_LOADED = 0.02
#: how far a robot strays that holds its pose [m, m, rad]; it rests where it keeps within a share of that so long [s]
_WOBBLE, _REST, _CALM = np.array([1e-4, 1e-4, 2e-3]), 0.3, 0.2
#: how long the picture of an untouched finger may take, which is the mean of many [s]
_REFERENCE = 20.0
#: how often the robot's pose leads the plant [Hz], and the planar pose of ee that it begins at
_POSES, _HOME = 125.0, (0.0, 0.3, 0.0)


class EmulatedLab(Host):
    """The world of an emulated lab, and its devices: emulated at one end of their protocols, real at the other."""

    def __init__(self, config: StationConfig, bus: Bus):
        super().__init__(config, bus)
        self._robot: FrankaArmEmulator | None = None
        self._way: _Way | None = None
        self._wrenches: dict[str, Sequence[float]] = {}
        self.longest_lag = _LATEST

    # -- the two ends of the protocols -----------------------------------------------------------------------------

    def _begin(self, stack: ExitStack) -> None:
        for name, device in self.world.devices.items():
            device.connect()
            stack.callback(device.close)
            self._emulate(stack, name, self.config.devices[name], device)
        self._serve_devices(stack)

    def _serve_devices(self, stack: ExitStack) -> None:
        """Have the real backends opened and put on the bus, by a process of their own.

        In this one they would keep the world waiting at each of its thousand steps a second. It takes their pictures
        meanwhile, those of the untouched fingers among them: nothing is in them yet, and later there is.
        """
        devices = HostProcess(self.config, "drivers.device_host")
        fingers = [name for name, device in self.config.devices.items() if device.kind == "tactile"]
        link = Link(self.bus, self.config.name)
        with ThreadPoolExecutor(max(len(fingers), 1), "devices") as pool:
            self._wait_for([pool.submit(stack.enter_context, devices)])
            self._wait_for([pool.submit(link.ask, name, "reference", timeout=_REFERENCE) for name in fingers])

    def _wait_for(self, work: Sequence[Future[Any]]) -> None:
        """Serve the world until the ``work`` of other threads is done; raises what it raised."""
        while not all(one.done() for one in work):
            self.inbox.serve(_TURN)
        for one in work:
            one.result()

    def _emulate(self, stack: ExitStack, name: str, config: Any, device: Any) -> None:
        maker = _EMULATORS.get(config.driver)
        if maker is None:
            wrong = f"{name}: nothing emulates {config.driver}"
            raise NotConnected(name, "emulate it", wrong, f"There are: {', '.join(_EMULATORS)}")
        try:
            maker(self, stack, name, config, device)
        except OSError as error:
            where = getattr(config, "address", "its address")
            raise NotConnected(name, f"emulate it at {where}", str(error), "Give it a port that is free") from error

    def emulate_force_torque(self, stack: ExitStack, name: str, config: Any, device: Sensor[WrenchReading]) -> None:
        """A Net F/T box that measures what the plant's sensor feels."""
        self._wrenches[name] = [0.0] * 6

        def feel(reading: WrenchReading) -> None:
            self._wrenches[name] = reading.wrench.tolist()

        stack.callback(device.listen(feel))
        box = NetFtBox(
            lambda: self._wrenches[name],
            rate=config.rate,
            records=config.records,
            address=str(config.address),
            port=config.port,
            http_port=config.http_port,
            serial=config.serial or "FT00042",
        )
        stack.enter_context(box)

    def emulate_camera(self, stack: ExitStack, name: str, config: Any, device: SimTagCamera | SimGelSlim) -> None:
        """A camera that sends what the plant's takes, while somebody takes it."""
        where = urlsplit(config.address)
        if where.scheme != "http":
            raise NotConnected(name, f"emulate {config.address}", "it is no camera on the network", "http://host:port")

        picture = _Eye(self.inbox.put, lambda: _exposed(device))
        port, path = where.port or 80, where.path or "/"
        stack.enter_context(MjpegCamera(picture, config.rate, host=where.hostname or "", port=port, path=path))
        stack.callback(picture.close)

    def emulate_arm(self, stack: ExitStack, name: str, config: Any, device: SimArm) -> None:
        """A robot that moves the plant's end-effector."""
        frames = ArmFrames(config.plane, config.tool)
        robot = FrankaArmEmulator(frames, np.array(_HOME), self._moved, _POSES, config.host)
        self._robot = stack.enter_context(robot)
        self._way = _Way(*robot.pose())

    def _moved(self, time: float, pose: Array) -> None:
        if self._way is not None:
            self._way.told(time, pose)

    def leave_to_arm(self, stack: ExitStack, name: str, config: Any, device: Any) -> None:
        """The hand is the robot's."""

    # -- the world -------------------------------------------------------------------------------------------------

    def _heard(self) -> bool:
        return True  # the emulators take all of it

    def _attend(self) -> None:
        """Its devices are not on the bus: the real ones are."""

    def _capture(self, now: float) -> None:
        """Cameras ask by themselves."""

    def _begun_with(self, scene: Scene) -> Scene:
        """The scene, with the arm where the robot is: nobody can put that one somewhere else."""
        if self._robot is None:
            return scene
        time, pose = self._robot.pose()
        self._way = _Way(time, pose)  # what it went before is nothing to this scene
        x, y, angle = pose.tolist()
        return scene.model_copy(update={"start": (x, y, angle)})

    def _staged_anew(self) -> None:
        """Who hears of the new scene finds its weight in the box, too, however long a picture takes by then."""
        self.world.advance(_LOADED)
        super()._staged_anew()

    def _step(self, span_ns: int) -> None:
        if self._way is None:
            super()._step(span_ns)
            return
        while span_ns > 0:
            piece = min(span_ns, _PIECE_NS)
            pose, twist = self._way.ahead(piece * 1e-9)
            sets_out = self._way.sets_out(piece * 1e-9)
            x, y, angle = pose.tolist()
            vx, vy, turn = twist.tolist()
            for device in self.world.devices.values():
                if isinstance(device, SimArm):
                    device.follow((x, y, angle), (vx, vy, turn), piece * 1e-9, sets_out=sets_out)
            super()._step(piece)
            span_ns -= piece


class _Way:
    """The way that the robot tells, walked behind it in the world's own time, never in a jump.

    The robot and the world both run late now and then: whoever leads the plant by the newest pose would tear at what it
    holds. The walk is as fast as the robot's time goes, a half faster while there is more than `_BACKLOG` left of it.
    """

    def __init__(self, time: float, pose: Array):
        self._poses: deque[tuple[float, Array]] = deque([(time, pose)])
        self._at, self._pose = time, pose
        self._stood, self._calm = pose, _CALM

    def told(self, time: float, pose: Array) -> None:
        """The robot is at ``pose`` (3,) at its own ``time`` [s]; from any thread."""
        self._poses.append((time, pose))

    def ahead(self, span: float) -> tuple[Array, Array]:
        """Pose and twist (3,) that are reached after ``span`` [s] more of the world's time."""
        newest = self._poses[-1][0]
        fast = newest - self._at > _BACKLOG
        self._at = min(self._at + (1.5 if fast else 1.0) * span, newest)
        while len(self._poses) > 2 and self._poses[1][0] <= self._at:
            self._poses.popleft()
        before, pose = self._pose, self._poses[0][1]
        if len(self._poses) > 1:
            (t0, p0), (t1, p1) = self._poses[0], self._poses[1]
            share = min(max((self._at - t0) / (t1 - t0), 0.0), 1.0) if t1 > t0 else 1.0
            pose = p0 + share * (p1 - p0)
        self._pose = pose
        return pose, (pose - before) / span

    def sets_out(self, span: float) -> bool:
        """Whether the last ``span`` seconds began a motion: it has left where it stood, by more than a robot wobbles.

        A robot that holds its pose is never quite still. Each of its micrometres taken for a motion, with an error of
        repeatability of its own, would have the plant shake by tenths of a newton.
        """
        stood = self._calm >= _CALM
        if (np.abs(self._pose - self._stood) < _WOBBLE * (1.0 if stood else _REST)).all():
            self._calm += span
            return False
        self._stood, self._calm = self._pose, 0.0
        return stood


class _Eye:
    """Looks at the world for a thread that does not own it: `look` is done in the owner's turn.

    Where the owner has no turn left, because the world ends, the last picture stands.
    """

    def __init__(self, run: Callable[[Work, bool], None], look: Callable[[], NDArray[np.uint8]]):
        self._run, self._look = run, look
        self._newest: NDArray[np.uint8] | None = None
        self._news = threading.Condition()
        self._count, self._closed = 0, False

    def __call__(self) -> NDArray[np.uint8]:
        with self._news:
            before = self._count
            self._run(self._work, False)
            self._news.wait_for(lambda: self._count > before or self._closed, _PICTURE)
            return np.zeros((1, 1), np.uint8) if self._newest is None else self._newest

    def _work(self) -> None:
        picture = self._look()
        with self._news:
            self._newest, self._count = picture, self._count + 1
            self._news.notify_all()

    def close(self) -> None:
        """Wait for no further picture; idempotent."""
        with self._news:
            self._closed = True
            self._news.notify_all()


_EMULATORS: dict[str, Callable[[EmulatedLab, ExitStack, str, Any, Any], None]] = {
    "ati_netft": EmulatedLab.emulate_force_torque,
    "franka": EmulatedLab.emulate_arm,
    "franka_hand": EmulatedLab.leave_to_arm,
    "gelslim_stream": EmulatedLab.emulate_camera,
    "tag_camera": EmulatedLab.emulate_camera,
}


def _exposed(device: SimTagCamera | SimGelSlim) -> NDArray[np.uint8]:
    """What the camera sees at this instant; an empty scene where nothing was laid out yet."""
    try:
        found = device.expose()[0] if isinstance(device, SimTagCamera) else device.capture().image
    except DeviceFault:
        if isinstance(device, SimTagCamera):
            return np.full((device.camera.height, device.camera.width), _EMPTY, np.uint8)
        return device.reference()
    return found.astype(np.uint8, copy=False)


def serve(config: StationConfig, ready: Callable[[Host], None] = lambda _: None) -> int:
    """Serve an emulated lab in this process until SIGTERM or SIGINT; returns 0. Raises as `drivers.sim.host.serve`."""
    return host.serve(config, ready, EmulatedLab, routing=True)


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    sys.exit(hosted.main(serve))
