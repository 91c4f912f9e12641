"""What can go wrong with a simulated device, and what the device itself can notice of it.

| kind | what happens | how it shows |
|---|---|---|
| ``drop`` | the share ``value`` of the readings is lost | `gaps`; a `capture` raises DeviceTimeout |
| ``freeze`` | alive, but no reading and no answer | `latest`, `capture` and commands raise DeviceTimeout |
| ``stuck`` | stamps advance, the value does not | `Status.STALE`, as far as the guards can tell |
| ``delay`` | readings come ``value`` seconds late, with true stamps | the age; past `max_age` DeviceTimeout |
| ``bias`` | every number of the reading jumps by ``value`` | `Status.INVALID`, as far as the guards can tell |
| ``saturate`` | numbers beyond ±``value`` are clipped, pictures overexposed | `Status.SATURATED` |
| ``garbage`` | the share ``value`` of the messages is damaged | ProtocolError from `latest`, counted in `corrupt` |
| ``disconnect`` | the device goes; after ``duration`` it is back | DeviceFault until it is closed and connected again |
| ``crash`` | the process behind all devices dies | DeviceFault from all of them |

A picture of which a grey level is beyond ``value`` is taken with so much light that ``value`` is white already; of a
depth image the range ends at ``value`` tenths of a millimetre, and what lies behind is there.

What no device can notice by itself needs a second witness. Undetectable here are: a noise-free stream that is stuck
while nothing asks it to change; a force/torque jump below the guard's limits, or in the plane's own axes alone; a pose
jump that the arm's speed would allow; a stuck picture without pixel noise; a bias that was there from the start.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from math import ceil, erf, log, sqrt
from typing import TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, NotConnected, ProtocolError
from drivers.fault import Fault
from drivers.interfaces import Sensor, _Stamped
from drivers.sim.mismatch import stream
from mechanics.readings import GripperReading, PoseReading, Stamp, Status, WrenchReading

R = TypeVar("R", bound=_Stamped)

#: the next change when there is none [ns]
NEVER = 2**63 - 1
#: the end of a picture's grey levels
WHITE = 255.0
#: equal by chance so rarely that it is none: once in so many readings
RARE = 1e12
#: more equal readings than this are not waited for
PATIENCE = 200
#: equal readings of a device that should move
STILL = 5


class Line:
    """The faults of one device as they are at this instant; `Faults` sets them."""

    def __init__(self, name: str):
        self.name = name
        #: called when the device falls silent
        self.on_silence: Callable[[], None] = lambda: None
        #: whether the device has gone since it was connected; connecting it again mends that
        self.lost = False
        self.restart(np.random.default_rng(0))

    def restart(self, rng: np.random.Generator) -> None:
        """No fault; chance is drawn from ``rng`` from now on."""
        self.begin_trial(rng)
        self.set(())

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Chance is drawn from ``rng`` from now on; what is on stays on."""
        self._rng = rng

    def set(self, faults: Sequence[Fault]) -> None:
        """Let exactly these faults be on."""
        was_silent = getattr(self, "silent", False)
        amounts: dict[str, float] = {}
        for fault in faults:
            amounts[fault.kind] = amounts.get(fault.kind, 0.0) + fault.amount
        self.frozen, self.gone = "freeze" in amounts, "disconnect" in amounts or "crash" in amounts
        self.stuck = "stuck" in amounts
        self.delay, self.bias = amounts.get("delay", 0.0), amounts.get("bias", 0.0)
        self.limit = min((f.amount for f in faults if f.kind == "saturate"), default=None)
        self._drop, self._garbage = amounts.get("drop", 0.0), amounts.get("garbage", 0.0)
        self._alters = self.stuck or bool(self.bias) or self.limit is not None
        self.silent = self.frozen or self.gone
        self.lost = self.lost or self.gone
        if not self.stuck:
            self._held: tuple[float, ...] | None = None
            self._picture: NDArray | None = None
        if self.silent and not was_silent:
            self.on_silence()

    def loses(self) -> bool:
        """Whether this reading is lost."""
        return self._drop > 0 and self._rng.random() < self._drop

    def garbles(self) -> bool:
        """Whether this message is damaged."""
        return self._garbage > 0 and self._rng.random() < self._garbage

    def altered(self, reading: R) -> R:
        """The reading with what the faults make of its numbers."""
        if not self._alters:
            return reading
        values, status = numbers(reading), reading.stamp.status
        if self.stuck:
            self._held = values = self._held or values
        if self.bias:
            shifts = (self.bias, 0.0) if isinstance(reading, GripperReading) else (self.bias,) * len(values)
            values = tuple(value + shift for value, shift in zip(values, shifts, strict=True))
        if self.limit is not None and any(abs(value) > self.limit for value in values):
            values = tuple(min(max(value, -self.limit), self.limit) for value in values)
            status = Status.SATURATED
        return _with(reading, values, status)

    def picture(self, picture: NDArray) -> NDArray:
        """The picture that is taken: the same over and over while it is stuck."""
        if not self.stuck:
            return picture
        if self._picture is None:
            self._picture = picture
        return self._picture

    def saturated(self, picture: NDArray) -> NDArray | None:
        """What comes out of a picture that goes beyond the range; None where it does not."""
        limit = None if self.limit is None else max(self.limit, 1.0)  # a depth of 0 is none
        if limit is None or not (picture > limit).any():
            return None
        if picture.dtype == np.uint16:
            return np.minimum(picture, np.uint16(limit))
        return np.minimum(picture * (WHITE / limit), WHITE).astype(picture.dtype)


class Faults:
    """All faults of a world: which are on, and when that changes next (``next_ns``).

    ``on_crash`` is called when the world crashes; whoever owns the process ends it there.
    """

    def __init__(self, lines: Mapping[str, Line]):
        self._lines = dict(lines)
        self._known: list[tuple[Fault, int, int]] = []
        self.crashed = False
        self.on_crash: Callable[[], None] = lambda: None
        self.next_ns = NEVER

    def restart(self, faults: Iterable[Fault], seed: int, now_ns: int, origin_ns: int | None = None) -> None:
        """Begin a new epoch with these faults alone; equal seeds have equal readings dropped and damaged.

        Their times count from ``origin_ns``, by default from now.
        """
        for name, line in self._lines.items():
            line.restart(np.random.default_rng([seed, crc32(name.encode()), crc32(b"faults")]))
        self._known = [_dated(fault, now_ns if origin_ns is None else origin_ns) for fault in faults]
        self.update(now_ns)

    def begin_trial(self, seed: int, *what: str | int) -> None:
        """Draw which readings are dropped and damaged for ``what`` from now on; faults come and go as they do."""
        for name, line in self._lines.items():
            line.begin_trial(stream(seed, name, "faults", *what))

    def inject(self, fault: Fault, now_ns: int) -> None:
        """Add a fault; its times count from now."""
        self._known.append(_dated(fault, now_ns))
        self.update(now_ns)

    def clear(self, now_ns: int) -> None:
        """End every fault, those of the station file and those to come among them. A crash has no end."""
        self._known = [known for known in self._known if known[0].kind == "crash" and known[1] <= now_ns]
        self.update(now_ns)

    def update(self, now_ns: int) -> None:
        """Switch what is due."""
        on = [fault for fault, begin, end in self._known if begin <= now_ns < end]
        self.next_ns = min((t for _, *times in self._known for t in times if t > now_ns), default=NEVER)
        crashing = any(fault.kind == "crash" for fault in on) and not self.crashed
        self.crashed = self.crashed or crashing
        for name, line in self._lines.items():
            line.set([fault for fault in on if fault.device == name or fault.kind == "crash"])
        if crashing:
            self.on_crash()


def _dated(fault: Fault, now_ns: int) -> tuple[Fault, int, int]:
    begin = now_ns + round(fault.after * 1e9)
    endless = fault.duration is None or fault.kind == "crash"
    return fault, begin, NEVER if endless else begin + round((fault.duration or 0.0) * 1e9)


class Faulty(Sensor[R]):
    """A simulated sensor that faults can befall."""

    def __init__(self, name: str, buffer: int = 4096):
        super().__init__(name, buffer)
        self.line = Line(name)
        self._shown: NDArray | None = None

    def connect(self, timeout: float = 5.0) -> None:
        """As `Device.connect`; a device that has gone is not there to be connected."""
        if not self._connected:
            if self.line.gone:
                raise NotConnected(self.name, "connect", "it does not answer", "See to its power and its cable")
            self.line.lost = False
        super().connect(timeout)

    def _need_connection(self, asked: str) -> None:
        super()._need_connection(asked)
        if self.line.lost:
            raise DeviceFault(
                self.name,
                asked,
                "the device has gone",
                "See to its power and its cable, then close it and connect again",
                recoverable=True,
            )
        if self.line.frozen and asked != "read":  # what is read tells by its age
            raise DeviceTimeout(self.name, asked, "no answer", "The device is alive but silent: restart it")

    def _forget(self) -> None:
        super()._forget()
        self._shown = None  # equal seeds begin with equal noise

    def _deliver_or_damage(self, reading: R) -> None:
        """Hand a reading on, or the ruins of its message."""
        if self.line.garbles():
            self._push_damaged(reading.stamp)
        else:
            self._push(reading)

    # -- for sensors that are asked for a frame ------------------------------------------------------------------

    def _developed(self, picture: NDArray, noisy: bool) -> tuple[NDArray, Status]:
        """The picture that comes out, and its status.

        SATURATED: some of it is at the end of the range. STALE: noise would have made it another than the one before.
        """
        picture = self.line.picture(picture)
        before, self._shown = self._shown, picture
        saturated = self.line.saturated(picture)
        if saturated is not None:
            return saturated, Status.SATURATED
        same = noisy and before is not None and (picture is before or np.array_equal(picture, before))
        return picture, Status.STALE if same else Status.OK

    def _hand_out(self, reading: R, timeout: float) -> R:
        """Push a frame that was asked for and return it. Raises DeviceTimeout, ProtocolError."""
        line = self.line
        if line.loses() or line.delay > timeout:
            raise DeviceTimeout(
                self.name, "capture", f"no frame within {timeout:g} s", "Check `extrinsic status STATION`"
            )
        if line.delay:
            reading = received(reading, reading.stamp.capture_ns + round(line.delay * 1e9))
        if line.garbles():
            self._push_damaged(reading.stamp)
            raise ProtocolError(self.name, "capture", "a damaged frame", "See to its cable; the next may be whole")
        self._push(reading)
        return reading


# -- guards: what a device notices of its own readings -------------------------------------------------------------


class Guard:
    """Looks at every reading of a device and at nothing else but what the device was told to do."""

    def restart(self) -> None:
        """Forget what came before."""

    def check(self, values: tuple[float, ...], capture_ns: int) -> Status:
        """What becomes of a reading's status."""
        return Status.OK


class WrenchGuard(Guard):
    """Knows that noise never repeats itself and that a planar station hardly loads fy, tx and tz.

    STALE: all six digits equal for longer than noise and resolution let happen once in `RARE` readings. INVALID: an
    out-of-plane axis away from its own recent mean (from zero, for a sensor without any figure) by more than 8 sigma,
    two digits and 0.02 N or 0.002 N·m; the mean follows drift within half a second, and nothing that is INVALID.
    """

    MEMORY = 500

    def __init__(self, noise: Sequence[float], resolution: Sequence[float], perfect: bool):
        self._patience = _patience(noise, resolution)
        floor = (0.02, 0.02, 0.02, 0.002, 0.002, 0.002)
        limits = [8 * s + 2 * q + f for s, q, f in zip(noise, resolution, floor, strict=True)]
        self._limits = limits[1], limits[3], limits[5]
        self._perfect = perfect
        self.restart()

    def restart(self) -> None:
        """Forget what came before, as after a tare."""
        self._last: tuple[float, ...] = ()
        self._same = self._count = 0
        self._mean = (0.0, 0.0, 0.0)

    def check(self, values: tuple[float, ...], capture_ns: int) -> Status:
        """The status of a wrench (fx, fy, fz, tx, ty, tz)."""
        self._same = self._same + 1 if values == self._last else 0
        self._last = values
        if self._patience and self._same >= self._patience:
            return Status.STALE
        (a, b, c), (la, lb, lc) = self._mean, self._limits
        if self._count == 0 and not self._perfect:
            self._mean = a, b, c = values[1], values[3], values[5]
        da, db, dc = values[1] - a, values[3] - b, values[5] - c
        if abs(da) > la or abs(db) > lb or abs(dc) > lc:
            return Status.INVALID
        if not self._perfect:
            self._count += 1
            share = 1.0 / min(self._count, self.MEMORY)
            self._mean = a + share * da, b + share * db, c + share * dc
        return Status.OK


def _patience(noise: Sequence[float], resolution: Sequence[float]) -> int:
    """How many readings in a row equal to the one before mean that it is stuck; 0 where nothing can tell.

    Whatever the load, a digit is the likeliest one with probability erf(q / (2 √2 σ)) at most.
    """
    likely = 0.0
    for sigma, step in zip(noise, resolution, strict=True):
        if sigma > 0:
            likely += log(max(erf(step / (2 * sqrt(2) * sigma)), 1e-12)) if step > 0 else log(1e-12)
    count = ceil(-log(RARE) / likely) if likely < 0 else 0
    return max(count, 2) if 0 < count <= PATIENCE else 0


class MotionGuard(Guard):
    """Knows how fast the device can move and what it was told to do.

    INVALID: a change beyond ``speed`` (per second) and one and a half times what was demanded in a step lately, until
    a jump takes it back. STALE: `STILL` equal readings while the demand went further than ``tolerance``.
    """

    def __init__(self, speed: Sequence[float], tolerance: Sequence[float], demand: Callable[[], Sequence[float]]):
        self._speed, self._tolerance, self._demand = tuple(speed), tuple(tolerance), demand
        self.restart()

    def restart(self) -> None:
        """Forget what came before."""
        self._last: tuple[float, ...] | None = None
        self._steps: deque[list[float]] = deque(maxlen=20)
        self._shift = [0.0] * len(self._speed)
        self._same, self._missed = 0, [0.0] * len(self._speed)
        self._stale = False

    def check(self, values: tuple[float, ...], capture_ns: int) -> Status:
        """The status of a reading with these numbers."""
        demand, last = tuple(self._demand()), self._last
        if last is None:
            self._last, self._told, self._then = values, demand, capture_ns
            return Status.OK
        step = [abs(new - old) for new, old in zip(demand, self._told, strict=True)]
        self._steps.append(step)
        dt = (capture_ns - self._then) * 1e-9
        self._last, self._told, self._then = values, demand, capture_ns
        if values == last:
            self._same += 1
            self._missed = [missed + moved for missed, moved in zip(self._missed, step, strict=True)]
            self._stale = self._same >= STILL and any(
                missed > tolerance for missed, tolerance in zip(self._missed, self._tolerance, strict=True)
            )
        else:
            if not self._stale:  # a value that moves again is where it is, however far that is
                self._follow(values, last, dt)
            self._same, self._missed, self._stale = 0, [0.0] * len(step), False
        if any(self._shift):
            return Status.INVALID
        return Status.STALE if self._stale else Status.OK

    def _follow(self, values: tuple[float, ...], last: tuple[float, ...], dt: float) -> None:
        for i, (new, old) in enumerate(zip(values, last, strict=True)):
            allowed = self._speed[i] * dt + 1.5 * max(step[i] for step in self._steps) + 1e-9
            if abs(new - old) > allowed:
                shift = self._shift[i] + new - old
                self._shift[i] = shift if abs(shift) > allowed else 0.0


def guarded(guard: Guard, reading: R) -> R:
    """The reading with the status that the guard gives it; what is marked already stays so."""
    if reading.stamp.status is not Status.OK:
        return reading
    status = guard.check(numbers(reading), reading.stamp.capture_ns)
    return reading if status is Status.OK else _marked(reading, status)


def numbers(reading: object) -> tuple[float, ...]:
    """The numbers of a reading that has few: a wrench, a pose, a gripper's width and force."""
    if isinstance(reading, WrenchReading):
        return tuple(reading.wrench.tolist())
    if isinstance(reading, PoseReading):
        return tuple(reading.pose.tolist())
    if isinstance(reading, GripperReading):
        return reading.width, reading.force
    return ()


def _with(reading: R, values: tuple[float, ...], status: Status) -> R:
    reading = reading if status is reading.stamp.status else _marked(reading, status)
    if isinstance(reading, WrenchReading):
        return replace(reading, wrench=np.array(values))
    if isinstance(reading, PoseReading):
        return replace(reading, pose=np.array(values))
    if isinstance(reading, GripperReading):
        return replace(reading, width=values[0], force=values[1])
    return reading


def _marked(reading: R, status: Status) -> R:
    return replace(reading, stamp=replace(reading.stamp, status=status))  # pyright: ignore[reportArgumentType]


def received(reading: R, now_ns: int) -> R:
    """The reading with the instant of its arrival in its stamp."""
    old = reading.stamp
    stamp = Stamp(old.capture_ns, now_ns, old.sequence, old.frame, old.status)
    if isinstance(reading, WrenchReading):  # by the thousand, and `replace` takes its time
        return WrenchReading(stamp, reading.wrench)  # pyright: ignore[reportReturnType]
    return replace(reading, stamp=stamp)  # pyright: ignore[reportArgumentType]
