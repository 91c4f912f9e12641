"""Whether the sensors of an open station can be relied on: age, rate, and what their readings say of themselves.

A value that is stuck and a range that is exceeded are noticed by the device, nearest to the signal, and come as the
status of its readings. Disagreement between witnesses of force is noticed where both are understood: in a trial.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.interfaces import Arm, Description, ImagingSensor
from drivers.station import Devices
from drivers.wire.remote import RemoteSensor
from mechanics.readings import Status

NANO = 1e-9
#: readings in a row that have to be bad, and periods that have to pass in silence
CONFIRMED = 3
#: what a network delays is not lost yet [s]; in lockstep nothing is on its way while time passes
_PATIENCE = 0.1
#: no reading that is older when it arrives is of use here [s]
_LATENCY = 0.1
#: a rate is what comes in this time [s], and less than this share of what was declared is too little
_SPAN, _SHARE = 0.5, 0.9
#: what a reading's status says to a person
WORDS = {
    Status.STALE: "its value is stuck",
    Status.SATURATED: "it is saturated",
    Status.INVALID: "its readings are invalid",
}


@dataclass(frozen=True)
class Ailment:
    """What is wrong with a device: ``kind`` is ``gone``, ``age``, ``rate`` or ``status``."""

    device: str
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.device}: {self.text}"


class StationHealth:
    """Looks at the streams of an open station; asks no device for a reading and disturbs nothing."""

    def __init__(self, devices: Devices):
        self._clock = devices.clock
        self._begin_ns = devices.clock.now_ns()
        #: how old each newest reading usually is: the way through the device takes its time
        self._usual: dict[str, float] = {}
        self._streams: list[tuple[RemoteSensor, Description]] = []
        for device in devices.values():
            # in lockstep a picture is taken when somebody asks, and its stream is silent
            if isinstance(device, RemoteSensor) and not (self._clock.lockstep and isinstance(device, ImagingSensor)):
                described = device.describe()
                if described.rate > 0:
                    self._streams.append((device, described))

    def streams(self) -> dict[str, dict[str, float | None]]:
        """Age of the newest reading [s] (negative where a device's clock is ahead of ours) and rate [Hz], by device."""
        now_ns = self._clock.now_ns()
        found: dict[str, dict[str, float | None]] = {}
        for device, _ in self._streams:
            heard = device.heard(now_ns - round(_SPAN / NANO))
            age = (now_ns - heard[-1][0]) * NANO if heard else None
            span = (heard[-1][0] - heard[0][0]) * NANO if len(heard) > 1 else 0.0
            found[device.name] = {"age_s": age, "rate_Hz": (len(heard) - 1) / span if span > 0 else None}
        return found

    def reopen(self, name: str, timeout: float) -> bool:
        """Open a sensor again whose server has died and may be back; whether it is worth another try.

        An arm is not opened again: it was let go where it was, and a person looks before it moves.
        """
        for device, _ in self._streams:
            if device.name == name and not isinstance(device, Arm):
                device.close()
                with suppress(DriverError):  # not yet
                    device.connect(timeout)
                return True
        return False

    def ailments(self) -> list[Ailment]:
        """What is wrong now, by device; empty where all is well."""
        now_ns = self._clock.now_ns()
        found = [self._look(device, described, now_ns) for device, described in self._streams]
        return [ailment for ailment in found if ailment is not None]

    def _look(self, device: RemoteSensor, described: Description, now_ns: int) -> Ailment | None:
        period = 1.0 / described.rate
        longest = max(CONFIRMED * period, 0.0 if self._clock.lockstep else _PATIENCE)
        span = max(_SPAN, 2 * longest)
        try:
            heard = device.heard(now_ns - round(span / NANO))
        except DriverError as error:
            return Ailment(device.name, "gone", error.got)
        since = self._begin_ns if not heard else heard[-1][0]
        age = (now_ns - since) * NANO
        if age > longest + self._usual.setdefault(device.name, min(age, _LATENCY)):
            return Ailment(device.name, "age", f"no reading for {age:.3g} s; it should speak every {period:.3g} s")
        statuses = {status for _, status in heard[-CONFIRMED:]}
        if len(heard) >= CONFIRMED and len(statuses) == 1 and (words := WORDS.get(statuses.pop())):
            return Ailment(device.name, "status", words)
        if (now_ns - self._begin_ns) * NANO < span or len(heard) >= _SHARE * span / period - 1:
            return None
        return Ailment(device.name, "rate", f"it speaks at {len(heard) / span:.3g} Hz, not at {described.rate:g} Hz")
