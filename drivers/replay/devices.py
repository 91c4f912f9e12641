"""Devices of each kind whose readings come from a recording, as they were recorded. Nothing moves."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from numpy.typing import NDArray

from drivers.config import DeviceConfig
from drivers.errors import CommandRefused, DeviceFault, ProtocolError
from drivers.interfaces import Arm, ArmTarget, ForceTorqueSensor, Gripper, TactileSensor, TagCamera
from drivers.replay.reel import Reel
from drivers.replay.sensor import ReplayImager, ReplaySensor, Take
from drivers.wire.codec import decode_reading
from drivers.wire.log_reader import Logged
from mechanics.readings import Array, GripperReading, ImageReading, PoseReading, Stamp, TagReading, WrenchReading

if TYPE_CHECKING:
    from drivers.replay.recording import Recording

#: readings that a tare averages
TARE_READINGS = 100
#: how long after a frame its picture is looked for [s]
_PICTURE = 0.5
_STILL = "a recording does not move"


class ReplayTagCamera(ReplayImager[TagReading], TagCamera):
    """A tag camera of a recording."""

    kind = "tag_camera"
    keeps = 256
    _reading = TagReading

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, recording, source, config)
        self._pictures: OrderedDict[int, tuple[Logged, int]] = OrderedDict()
        self._captured: Stamp | None = None

    def capture(self, timeout: float = 2.0) -> TagReading:
        """As `ImagingSensor.capture`."""
        reading = super().capture(timeout)
        self._captured = reading.stamp
        return reading

    def image(self) -> ImageReading | None:
        """The picture behind the newest `capture`, as the log has it; None where it has none."""
        self._need_connection("send its picture")
        stamp = self._captured
        if stamp is None:
            return None
        before = stamp.receive_ns + round(_PICTURE * 1e9)

        def found() -> tuple[Logged, int] | bool | None:
            with self._arrived:
                here = self._pictures.get(stamp.sequence)
            return here or (self.recording.now_ns() > before or self.recording.ended or None)

        here = self._until(found, "send its picture", 2 * _PICTURE)
        if isinstance(here, bool):
            return None
        logged, shift = here
        receive = logged.log_ns + shift
        picture = decode_reading(logged.type_name, logged.payload, logged.sequence, logged.status, receive)
        if not isinstance(picture, ImageReading):
            raise ProtocolError(self.name, "send its picture", f"a {logged.type_name} in its place", "")
        moved = replace(picture.stamp, capture_ns=picture.stamp.capture_ns + shift)
        return replace(picture, stamp=moved)

    def _streams(self) -> dict[str, Take]:
        return {**super()._streams(), self._topic("image"): self._take_picture}

    def _take_picture(self, logged: Logged, moved: Callable[[int], int]) -> None:
        with self._arrived:
            self._pictures.pop(logged.sequence, None)
            self._pictures[logged.sequence] = logged, moved(logged.log_ns) - logged.log_ns
            while len(self._pictures) > 8:
                self._pictures.popitem(last=False)
            self._arrived.notify_all()

    def _drop(self) -> None:
        super()._drop()
        self._captured = None
        self._pictures.clear()


class ReplayTactile(ReplayImager[ImageReading], TactileSensor):
    """A tactile finger of a recording."""

    kind = "tactile"
    _reading = ImageReading

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, recording, source, config)
        self._untouched: Logged | None = None

    def reference(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """The picture of the untouched finger that was taken last, or else first in what has not been played yet.

        Raises DeviceFault where the log has none.
        """
        asked = "send its reference picture"
        self._need_connection(asked)
        logged = self._untouched or self._sought()
        if logged is None:
            raise DeviceFault(
                self.name,
                asked,
                f"{self.recording.path} has none",
                "It was recorded by an older version, or nobody asked for it: its pictures can be played, not read",
            )
        self._untouched = logged
        value = logged.value()
        if not isinstance(value, ImageReading):
            raise ProtocolError(self.name, asked, f"a {logged.type_name} in its place", "")
        return value.image

    def _streams(self) -> dict[str, Take]:
        return {**super()._streams(), self._topic("reference"): self._take_reference}

    def _take_reference(self, logged: Logged, moved: Callable[[int], int]) -> None:
        del moved
        self._untouched = logged

    def _sought(self) -> Logged | None:
        topic = self._topic("reference")
        frames = Reel(self.recording.contents.files).frames()
        return next((frame.logged for frame in frames if frame.logged.topic == topic), None)


class ReplayForceTorque(ReplaySensor[WrenchReading], ForceTorqueSensor):
    """A force/torque sensor of a recording."""

    kind = "force_torque"
    _reading = WrenchReading

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, recording, source, config)
        self._zero = np.zeros(6)
        self._weighed: list[Array] | None = None

    def tare(self) -> None:
        """Make the load of the readings that follow the zero: the mean of a hundred. Opening it anew undoes that."""
        self._need_connection("tare")
        with self._arrived:
            self._weighed = []
        try:
            rate = self.describe().rate
            self._until(lambda: self._weighed is None or None, "tare", 1.0 + (TARE_READINGS / rate if rate > 0 else 0))
        finally:
            with self._arrived:
                self._weighed = None

    def _open(self, timeout: float) -> None:
        self._zero = np.zeros(6)
        super()._open(timeout)

    def _adjusted(self, reading: WrenchReading) -> WrenchReading:
        with self._arrived:
            if self._weighed is not None:
                self._weighed.append(reading.wrench)
                if len(self._weighed) >= TARE_READINGS:
                    self._zero, self._weighed = np.mean(self._weighed, axis=0), None
        return replace(reading, wrench=reading.wrench - self._zero) if self._zero.any() else reading


class ReplayGripper(ReplaySensor[GripperReading], Gripper):
    """A gripper of a recording: it neither closes nor opens."""

    kind = "gripper"
    keeps = 512
    _reading = GripperReading

    def grasp(self, force: float) -> None:
        """Raises CommandRefused."""
        self._refuse(f"grasp with {force:g} N")

    def release(self) -> None:
        """Raises CommandRefused."""
        self._refuse("release")

    def _refuse(self, asked: str) -> NoReturn:
        self._need_connection(asked)
        raise CommandRefused(self.name, asked, _STILL, "Use a station whose gripper is there")


class ReplayArm(ReplaySensor[PoseReading], Arm):
    """An arm of a recording: it takes a lease, a stop and a hold, and no set-point."""

    kind = "arm"
    _reading = PoseReading

    def __init__(self, name: str, recording: Recording, source: str, config: DeviceConfig | None = None):
        super().__init__(name, recording, source, config)
        self._holder: str | None = None
        self._stopped = False

    def acquire(self, holder: str) -> None:
        """As `Arm.acquire`; the holder itself may ask again."""
        self._need_connection("acquire the lease")
        if self._holder not in (None, holder):
            raise CommandRefused(
                self.name, "acquire the lease", f"'{self._holder}' holds the lease", "Wait until it has finished"
            )
        self._holder = holder

    def release(self) -> None:
        """As `Arm.release`."""
        self._holder = None

    def command(self, target: ArmTarget) -> None:
        """Raises CommandRefused."""
        del target
        self._need_connection("command")
        if self._holder is None:
            raise CommandRefused(self.name, "command", "no lease", "Command within `with arm.lease(name):`")
        if self._stopped:
            raise CommandRefused(self.name, "command", "the arm is stopped", "Recover it first")
        raise CommandRefused(self.name, "command", _STILL, "Use a station whose arm is there")

    def hold(self) -> None:
        """As `Arm.hold`: it is held."""
        self._need_connection("hold")

    def stop(self) -> None:
        """As `Arm.stop`."""
        self._need_connection("stop")
        self._stopped = True

    def recover(self) -> None:
        """As `Arm.recover`."""
        self._need_connection("recover")
        self._stopped = False

    def _shut(self) -> None:
        self._holder = None
        super()._shut()


REPLAYS: dict[str, type[ReplaySensor]] = {
    replay.kind: replay for replay in (ReplayArm, ReplayGripper, ReplayForceTorque, ReplayTagCamera, ReplayTactile)
}
"""The device of each kind that plays a recording."""
