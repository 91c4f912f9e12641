"""One abstract interface per kind of device. `tests/conformance` is the contract that every backend passes.

A device describes itself before it connects. It is a context manager; closing is idempotent and always leaves the
arm held. Readings are buffered by the device (bounded, oldest dropped) in the order of their sequence numbers.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceTimeout, NotConnected, ProtocolError
from drivers.fault import Fault
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
        """Let ``seconds`` of station time pass. On return every reading that a device gave out until then is here.

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


def freshness(rate: float) -> float | None:
    """How old the newest reading of a stream of ``rate`` [Hz] may be [s]; None where readings come on request only."""
    return max(5.0 / rate, 0.1) if rate > 0 else None


class Sensor(Device, Generic[R]):
    """A device that produces readings. Backends call `_push` for each, from any thread.

    ``max_age`` [s] is how old, in station time, a reading may be that `latest` returns; connecting sets it to the
    `freshness` of the described rate. None: any age.
    """

    max_age: float | None = None

    def __init__(self, name: str, buffer: int = 4096):
        super().__init__(name)
        self._readings: deque[R] = deque(maxlen=buffer)
        self._arrived = threading.Condition()
        self._gaps = self._corrupt = 0
        self._last_sequence: int | None = None
        self._damaged: Stamp | None = None  # of the newest message, where it could not be read
        self._listeners: tuple[Callable[[R], None], ...] = ()
        self._mourners: tuple[Callable[[Stamp], None], ...] = ()

    def listen(
        self, callback: Callable[[R], None], damaged: Callable[[Stamp], None] | None = None
    ) -> Callable[[], None]:
        """Call ``callback`` with each reading as it arrives, in the thread that delivers it; returns the way to stop.

        ``damaged`` is called with the stamp of each message that could not be read. A listener only appends or
        publishes; one that blocks holds up the device.
        """
        with self._arrived:
            self._listeners = (*self._listeners, callback)
            if damaged is not None:
                self._mourners = (*self._mourners, damaged)

        def stop() -> None:
            with self._arrived:
                self._listeners = tuple(c for c in self._listeners if c is not callback)
                self._mourners = tuple(c for c in self._mourners if c is not damaged)

        return stop

    def heard_beside(self, callback: Callable[[R], None]) -> bool:
        """Whether anybody else than ``callback`` listens in this process."""
        return any(listener != callback for listener in self._listeners)

    def _push(self, reading: R) -> None:
        with self._arrived:
            self._arrive(reading.stamp)
            self._damaged = None
            self._readings.append(reading)
            self._arrived.notify_all()
            listeners = self._listeners
        for listener in listeners:
            listener(reading)

    def _push_damaged(self, stamp: Stamp) -> None:
        """A message came that cannot be read; ``stamp`` is what is known of it."""
        with self._arrived:
            self._arrive(stamp)
            self._damaged = stamp
            self._corrupt += 1
            self._arrived.notify_all()
            mourners = self._mourners
        for mourner in mourners:
            mourner(stamp)

    def _arrive(self, stamp: Stamp) -> None:
        last = self._last_sequence
        if last is not None and stamp.sequence > last + 1:
            self._gaps += stamp.sequence - last - 1
        self._last_sequence = stamp.sequence

    def _forget(self) -> None:
        """Drop what was buffered (a new epoch: the world was reset, or the device reconnected)."""
        with self._arrived:
            self._readings.clear()
            self._last_sequence = self._damaged = None
            self._gaps = self._corrupt = 0

    @property
    def gaps(self) -> int:
        """Readings lost between the source and here since connecting, by sequence number."""
        return self._gaps

    @property
    def corrupt(self) -> int:
        """Messages that arrived since connecting and could not be read."""
        return self._corrupt

    def latest(self, timeout: float = 1.0) -> R:
        """The newest reading; waits for one that is not older than `max_age`.

        Raises DeviceTimeout after ``timeout`` wall seconds (at once in lockstep, where a silent device stays silent
        while somebody waits), ProtocolError when the newest message could not be read.
        """
        self._need_connection("read")

        def newest() -> int | None:
            if self._damaged is not None:
                return self._damaged.capture_ns
            return self._readings[-1].stamp.capture_ns if self._readings else None

        with self._arrived:
            self._await(newest, timeout)
            if self._damaged is not None:
                raise ProtocolError(self.name, "read", "the newest message is damaged", "See to its cable")
            return self._readings[-1]

    def _station_ns(self) -> int | None:
        """The station's time, by which readings age; None for a device that knows none."""
        return None

    #: whether station time stands still while somebody waits
    _still = False

    def _await(
        self, newest: Callable[[], int | None], timeout: float, check: Callable[[], object] = lambda: None
    ) -> None:
        """Wait, holding `_arrived`, until what is ``newest`` [ns] is fresh; ``check`` may raise instead."""
        deadline = time.monotonic() + timeout
        while True:
            capture_ns, now_ns = newest(), self._station_ns()
            age = 0.0 if capture_ns is None or now_ns is None else (now_ns - capture_ns) * 1e-9
            if capture_ns is not None and (self.max_age is None or age <= self.max_age):
                return
            left = deadline - time.monotonic()
            if left <= 0 or (self._still and capture_ns is not None):
                got = f"no reading within {timeout:g} s" if capture_ns is None else f"no reading for {age:.3g} s"
                raise DeviceTimeout(self.name, "read", got, "Check `extrinsic status STATION`")
            self._arrived.wait(left)
            check()

    def since(self, capture_ns: int) -> list[R]:
        """Buffered readings captured after ``capture_ns``, oldest first; what could not be read is not among them."""
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
    """One tactile finger: Soft Bubble (depth) or GelSlim (colour). ``describe().extra["sensor"]`` says which."""

    @abstractmethod
    def reference(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """The picture of the untouched finger, as the mean of many frames; encoded as its readings are."""


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

    def reachable(self, pose: Array) -> str:
        """Why the arm cannot be at planar ``pose`` (3,): a joint's limit, say; "" where it can, or nobody knows."""
        del pose
        return ""

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

    def restage(self, scene: dict, part: int = 0) -> None:
        """Begin part ``part`` of a run with another `drivers.scene.Scene`: all is as after a reset, but time goes on.

        So do faults, seed and lab. The arm rests at the scene's start, streams count from 0, and what is drawn at
        random follows from the seed and ``part`` alone, whatever ran before. Raises CommandRefused, and changes
        nothing, for a scene that cannot be.
        """
        ...

    def regrasp(self, trial: int) -> None:
        """Between trials: take the grasped object into the fingers anew, as trial ``trial`` (from 0) has it.

        The same seed and trial give the same grasp, whatever ran before. No time passes.
        """
        ...

    def rearrange(self, scene: dict) -> None:
        """Another `drivers.scene.Scene` on the same table while time runs on, as when a person changes the object.

        The arm stays where it is (the scene's start is not looked at), the new object hangs in the fingers, nothing
        is clamped; sensors, seed and lab stay. Raises CommandRefused, and changes nothing, for one that cannot be.
        """
        ...

    def clamp(self, body: str | None) -> None:
        """Fix ``go`` or ``eo`` to the environment where it is now; None frees whatever was fixed.

        Raises CommandRefused for a body that is not here.
        """
        ...

    def show_board(self, board: dict | None, X_W_B: Array) -> None:
        """Hold a board before the tag cameras at ``X_W_B`` (4, 4); None puts it away, as a reset does.

        ``board`` is a `mechanics.tag_board.TagBoard` as a dict. It hides what is behind it, and nothing stands in
        front of it. Raises CommandRefused for what is no board or no pose.
        """
        ...

    def inject(self, fault: Fault | dict) -> None:
        """Let a fault happen; its times count from now. A reset or `clear_faults` ends it.

        Raises CommandRefused for one that cannot befall this station.
        """
        ...

    def clear_faults(self) -> None:
        """End every fault. What has gone is back, and has to be closed and connected again."""
        ...

    def truth(self) -> TruthReading:
        """The plant's own state at this instant."""
        ...

    def health(self) -> dict[str, Any]:
        """How well the simulation itself was since the reset; ``flags`` says in words what was not well."""
        ...

    def counts(self) -> dict[str, int]:
        """Messages published per topic since the reset."""
        ...
