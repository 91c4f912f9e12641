"""One abstract interface per kind of device. `tests/conformance` is the contract that every backend passes.

A device describes itself before it connects. It is a context manager; closing is idempotent and always leaves the
arm held. Readings are buffered by the device (bounded, oldest dropped) in the order of their sequence numbers.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, Self, TypeVar

from drivers.errors import DeviceTimeout, NotConnected
from mechanics.readings import (
    Array,
    GripperReading,
    ImageReading,
    PoseReading,
    Stamp,
    TagReading,
    TruthReading,
    WrenchReading,
)


class Clock(Protocol):
    """The station's time. In lockstep ``sleep`` advances the simulated world; otherwise it waits."""

    lockstep: bool

    def now_ns(self) -> int:
        """Present instant [ns]: simulated time in lockstep, Unix time otherwise."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` of station time pass. On return every reading captured until then has been received.

        Raises DeviceFault within 2 s when the station has died meanwhile.
        """
        ...


@dataclass(frozen=True)
class Description:
    """What a device says of itself before it is opened.

    ``rate`` [Hz] (0: on request only), ``range`` and ``resolution`` in the units of its reading, ``frame`` of its
    values; ``extra`` is backend-specific and JSON-serialisable.
    """

    name: str
    kind: str
    model: str
    backend: str
    serial: str
    frame: str
    rate: float = 0.0
    range: tuple[float, ...] = ()
    resolution: tuple[float, ...] = ()
    extra: dict = field(default_factory=dict)


class _Stamped(Protocol):
    @property
    def stamp(self) -> Stamp: ...


R = TypeVar("R", bound=_Stamped)


class Device(ABC):
    """A thing that is described, opened, used and closed."""

    def __init__(self, name: str):
        self.name = name
        self._connected = False

    @abstractmethod
    def describe(self) -> Description:
        """What this device is; works before `connect`."""

    def connect(self, timeout: float = 5.0) -> None:
        """Open the device; idempotent. Raises NotConnected or DeviceTimeout within ``timeout`` seconds."""
        if not self._connected:
            self._open(timeout)
            self._connected = True

    def close(self) -> None:
        """Close the device; idempotent, never raises for a device that has gone."""
        if self._connected:
            self._connected = False
            self._shut()

    @property
    def connected(self) -> bool:
        """Whether `connect` succeeded and `close` was not called since."""
        return self._connected

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _need_connection(self, asked: str) -> None:
        if not self._connected:
            raise NotConnected(self.name, asked, "the device is not open", "Open it first: `with device:`")

    @abstractmethod
    def _open(self, timeout: float) -> None: ...

    @abstractmethod
    def _shut(self) -> None: ...


class Sensor(Device, Generic[R]):
    """A device that produces readings. Backends call `_push` for each, from any thread."""

    def __init__(self, name: str, buffer: int = 4096):
        super().__init__(name)
        self._readings: deque[R] = deque(maxlen=buffer)
        self._arrived = threading.Condition()
        self._gaps = 0
        self._last_sequence: int | None = None
        self._listeners: tuple[Callable[[R], None], ...] = ()

    def listen(self, callback: Callable[[R], None]) -> Callable[[], None]:
        """Call ``callback`` with each reading as it arrives, in the thread that delivers it; returns the way to stop.

        A listener only appends or publishes; one that blocks holds up the device.
        """
        with self._arrived:
            self._listeners = (*self._listeners, callback)

        def stop() -> None:
            with self._arrived:
                self._listeners = tuple(c for c in self._listeners if c is not callback)

        return stop

    def _push(self, reading: R) -> None:
        with self._arrived:
            last, sequence = self._last_sequence, reading.stamp.sequence
            if last is not None and sequence > last + 1:
                self._gaps += sequence - last - 1
            self._last_sequence = sequence
            self._readings.append(reading)
            self._arrived.notify_all()
            listeners = self._listeners
        for listener in listeners:
            listener(reading)

    def _forget(self) -> None:
        """Drop what was buffered (a new epoch: the world was reset, or the device reconnected)."""
        with self._arrived:
            self._readings.clear()
            self._last_sequence = None
            self._gaps = 0

    @property
    def gaps(self) -> int:
        """Readings lost between the source and here since connecting, by sequence number."""
        return self._gaps

    def latest(self, timeout: float = 1.0) -> R:
        """The newest reading; waits for the first one. Raises DeviceTimeout after ``timeout`` wall seconds."""
        self._need_connection("read")
        with self._arrived:
            if not self._arrived.wait_for(lambda: len(self._readings) > 0, timeout):
                raise DeviceTimeout(
                    self.name, "read", f"no reading within {timeout:g} s", "Check `extrinsic status STATION`"
                )
            return self._readings[-1]

    def since(self, capture_ns: int) -> list[R]:
        """Buffered readings captured after ``capture_ns``, oldest first."""
        self._need_connection("read")
        with self._arrived:
            out: list[R] = []
            for reading in reversed(self._readings):
                if reading.stamp.capture_ns <= capture_ns:
                    break
                out.append(reading)
        return out[::-1]


class ImagingSensor(Sensor[R]):
    """A sensor that can be asked for a frame."""

    @abstractmethod
    def capture(self, timeout: float = 2.0) -> R:
        """A frame exposed at or after this call. In lockstep it is rendered now, and the world stands still.

        Raises DeviceTimeout.
        """


class ForceTorqueSensor(Sensor[WrenchReading]):
    """A six-axis force/torque sensor. `mechanics.readings.WrenchReading` states the sign."""

    @abstractmethod
    def tare(self) -> None:
        """Make the present load the zero, by averaging the next readings at the device. Raises DeviceTimeout."""


class TactileSensor(ImagingSensor[ImageReading]):
    """One tactile finger: Soft Bubble (depth) or GelSlim (colour)."""


class TagCamera(ImagingSensor[TagReading]):
    """A camera that reports AprilTag detections. ``describe().extra["camera"]`` is its CameraModel as a dict."""

    @abstractmethod
    def image(self) -> ImageReading | None:
        """The picture behind the newest `capture`, where the backend keeps one."""


@dataclass(frozen=True, slots=True)
class ArmTarget:
    """Be at planar ``pose`` (x, y, θ) of ee in W with ``twist`` (ẋ, ẏ, θ̇) ``duration`` seconds from now."""

    pose: Array
    twist: Array
    duration: float
    sequence: int = 0


class Arm(Sensor[PoseReading]):
    """A position-controlled arm, seen in the task plane: its readings are X_W_ee.

    One commander at a time: commands need the lease, which `lease()` holds and renews.
    """

    @abstractmethod
    def acquire(self, holder: str) -> None:
        """Take the lease and keep it renewed. Raises CommandRefused when somebody else has it."""

    @abstractmethod
    def release(self) -> None:
        """Hold the arm and give the lease back; idempotent."""

    @contextmanager
    def lease(self, holder: str) -> Iterator[None]:
        """Hold the lease for the block; the arm is held when it ends, however it ends."""
        self.acquire(holder)
        try:
            yield
        finally:
            self.release()

    @abstractmethod
    def command(self, target: ArmTarget) -> None:
        """Send one set-point. Raises CommandRefused (no lease, not finite, stopped …), DeviceFault."""

    @abstractmethod
    def hold(self) -> None:
        """Stay where the arm is now. Needs no lease."""

    @abstractmethod
    def stop(self) -> None:
        """Stop and stay stopped until `recover`. Needs no lease."""

    @abstractmethod
    def recover(self) -> None:
        """Release a latched stop. Needs no lease."""


class Gripper(Sensor[GripperReading]):
    """A two-finger gripper."""

    @abstractmethod
    def grasp(self, force: float) -> None:
        """Close until ``force`` [N] is reached; returns once they rest. Raises DeviceTimeout, DeviceFault."""

    @abstractmethod
    def release(self) -> None:
        """Open the fingers."""


class Simulation(Protocol):
    """What only a simulated station offers. Truth goes to metrics and log, never to an estimator or controller."""

    def reset(self, seed: int, scene: dict) -> None:
        """Put the world into its initial state: a `drivers.scene.Scene` as a dict. Stamps start again at 0."""
        ...

    def truth(self) -> TruthReading:
        """The plant's own state at this instant."""
        ...

    def counts(self) -> dict[str, int]:
        """Messages published per topic since the reset."""
        ...
