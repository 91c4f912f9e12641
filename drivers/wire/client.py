"""Devices that live in another process: arm, gripper and sensors over the bus."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, DriverError
from drivers.interfaces import Arm, ArmTarget, ForceTorqueSensor, Gripper, R, TactileSensor, TagCamera
from drivers.wire import messages, topics
from drivers.wire.arm_server import holder_id
from drivers.wire.codec import decode_reading
from drivers.wire.lease import RENEWAL, TIME_TO_LIVE
from drivers.wire.link import Link
from drivers.wire.remote import RemoteSensor
from mechanics.readings import GripperReading, ImageReading, PoseReading, TagReading, WrenchReading


class RemoteForceTorque(RemoteSensor[WrenchReading], ForceTorqueSensor):
    """A force/torque sensor on the bus."""

    kind = "force_torque"

    def tare(self) -> None:
        """As `ForceTorqueSensor.tare`."""
        self._command("tare")


class RemoteImaging(RemoteSensor[R]):
    """The half that cameras and tactile fingers on the bus share."""

    def capture(self, timeout: float | None = None) -> R:
        """As `ImagingSensor.capture`; None: as long as the bus waits for any reply.

        A frame that is lost on its way is made up for by the next one of the stream.
        """
        timeout = self._link.bus.timeout if timeout is None else timeout
        deadline = time.monotonic() + timeout
        wanted = json.loads(self._command("capture", timeout=timeout).text)
        with self._holding("capture"):
            while not self._kept or self._kept[-1].sequence < wanted:
                self._need_life("capture")
                if not self._arrived.wait(deadline - time.monotonic()):
                    got = f"its frame did not arrive within {timeout:g} s"
                    raise DeviceTimeout(self.name, "capture", got, "Check the network's load")
            sample = self._kept[-1]
        return self._decode(sample)


class RemoteTagCamera(RemoteImaging[TagReading], TagCamera):
    """A tag camera on the bus. It keeps as many frames as its server does."""

    kind = "tag_camera"
    keeps = 256

    def image(self) -> ImageReading | None:
        """The picture behind the newest `capture`, without loss."""
        reply = self._command("image", asked="send its picture")
        return cast("ImageReading", decode_reading(reply.type, reply.data.tobytes(), 0)) if reply.type else None


class RemoteTactile(RemoteImaging[ImageReading], TactileSensor):
    """A tactile finger on the bus. It keeps fewer readings than others: a picture has up to half a megabyte."""

    kind = "tactile"
    keeps = 64

    def reference(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """As `TactileSensor.reference`."""
        reply = self._command("reference", asked="send its reference picture")
        return cast("ImageReading", decode_reading(reply.type, reply.data.tobytes(), 0)).image


class RemoteGripper(RemoteSensor[GripperReading], Gripper):
    """A gripper on the bus. It speaks seldom: what is kept of it is soon all that is ever kept."""

    kind = "gripper"
    keeps = 512

    def grasp(self, force: float) -> None:
        """As `Gripper.grasp`."""
        if not math.isfinite(force):
            raise CommandRefused(self.name, "grasp", f"a force of {force} N", "Ask for a finite force")
        self._command("grasp", messages.encode(messages.message(messages.FLOAT, data=float(force))))

    def release(self) -> None:
        """As `Gripper.release`."""
        self._command("release")


class RemoteArm(RemoteSensor[PoseReading], Arm):
    """An arm on the bus. The lease is renewed by a thread that `release` joins."""

    kind = "arm"
    _acquired = 0

    def __init__(self, name: str, link: Link, lockstep: bool):
        super().__init__(name, link, lockstep)
        self._holder: str | None = None
        self._withdraw: Callable[[], None] = lambda: None
        self._targets = 0
        self._done = threading.Event()
        self._renewer: threading.Thread | None = None

    def acquire(self, holder: str) -> None:
        """As `Arm.acquire`."""
        self._need_connection("acquire the lease")
        if self._holder is not None:
            raise CommandRefused(self.name, "acquire the lease", "this client has it already", "Release it first")
        self._acquired += 1
        name = holder_id(holder, self._link.bus.zid, self._acquired)
        self._withdraw = self._link.bus.token(topics.lease(self._link.station, self.name, name))
        try:
            self._ask("acquire", _string(name), "acquire the lease")
        except BaseException:
            self._withdraw()
            raise
        self._holder, self._targets = name, 0
        self._done.clear()
        self._renewer = threading.Thread(target=self._renew, args=(name,), name=f"{self.name} lease", daemon=True)
        self._renewer.start()

    def release(self) -> None:
        """As `Arm.release`; a server that has gone is no error, for it held the arm when it lost us."""
        holder, self._holder = self._holder, None
        if holder is None:
            return
        self._done.set()
        if self._renewer is not None:
            self._renewer.join(timeout=2 * TIME_TO_LIVE)
        try:
            self._ask("release", _string(holder), "release the lease")
        except (DeviceFault, DeviceTimeout):
            pass
        finally:
            self._withdraw()

    def command(self, target: ArmTarget) -> None:
        """As `Arm.command`. The sequence number is counted here, whatever the target says."""
        asked = "command a set-point"
        self._need_connection(asked)
        if self._holder is None:
            raise CommandRefused(self.name, asked, "no lease", "Acquire the lease: `with arm.lease(name):`")
        sequence, self._targets = self._targets, self._targets + 1  # a reply that is lost uses its number up
        self._ask(
            "command",
            messages.encode(
                messages.message(
                    messages.TARGET,
                    header=messages.header(self._station_ns(), "world"),
                    holder=self._holder,
                    sequence=sequence,
                    pose=_three(self.name, target.pose),
                    twist=_three(self.name, target.twist),
                    duration=float(target.duration),
                )
            ),
            asked,
        )

    def hold(self) -> None:
        """As `Arm.hold`."""
        self._command("hold")

    def stop(self, reason: str = "") -> None:
        """As `Arm.stop`; ``reason`` is what the next commander is told."""
        self._command("stop", _string(reason))

    def recover(self) -> None:
        """As `Arm.recover`."""
        self._command("recover")

    def lease_holders(self) -> list[str]:
        """Who has the arm's lease; asks the server. Raises DeviceTimeout, DeviceFault."""
        return json.loads(self._ask("holders", asked="name its commander").text)

    def safety(self) -> dict[str, Any]:
        """`drivers.gates.Gates.summary` of the arm's gates; asks the server. Raises DeviceTimeout, DeviceFault."""
        return json.loads(self._ask("safety", asked="tell of its gates").text)

    def _shut(self) -> None:
        self.release()
        super()._shut()

    def _renew(self, holder: str) -> None:
        payload = _string(holder)
        while not self._done.wait(RENEWAL):
            try:
                self._ask("renew", payload, "renew the lease", TIME_TO_LIVE)
            except DeviceTimeout:
                continue
            except DriverError:
                return  # lost: the next command is refused and says so


REMOTES: dict[str, type[RemoteSensor]] = {
    remote.kind: remote for remote in (RemoteArm, RemoteGripper, RemoteForceTorque, RemoteTagCamera, RemoteTactile)
}
"""The remote device of each kind."""


def _string(text: str) -> bytes:
    return messages.encode(messages.message(messages.STRING, data=text))


def _three(device: str, values: Any) -> np.ndarray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != (3,):
        raise CommandRefused(device, "command a set-point", f"an array of shape {array.shape}", "Send (x, y, θ)")
    return array
