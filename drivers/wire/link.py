"""The commanding end of a station's bus: verbs out, replies and typed errors back."""

from __future__ import annotations

import time
from typing import Any

from drivers.errors import (
    CommandRefused,
    DeviceFault,
    DeviceTimeout,
    DriverError,
    NotConnected,
    ProtocolError,
    SimulationDiverged,
)
from drivers.wire import messages, topics
from drivers.wire.bus import Bus
from drivers.wire.watch import Watch

_ARRIVAL = 2.0  # what was published before a reply arrives with it; this long after, it is lost [s]


class Link:
    """Asks the devices of one station. ``now_ns`` is the time of a lockstep station; its clock keeps it."""

    def __init__(self, bus: Bus, station: str):
        self.bus, self.station = bus, station
        self.now_ns = 0

    def ask(
        self,
        device: str,
        verb: str,
        payload: bytes = b"",
        *,
        asked: str = "",
        timeout: float | None = None,
        watch: Watch | None = None,
    ) -> Any:
        """Ask a verb of a device; returns the reply once everything published before it has arrived here too.

        Raises what the device raised, DeviceTimeout, DeviceFault (its server has died), ProtocolError.
        """
        asked = asked or verb
        key = topics.key(self.station, device, verb)
        raw = self.bus.request(key, payload, device=device, asked=asked, timeout=timeout, watch=watch)
        reply = messages.decode(raw, messages.REPLY)
        deadline = time.monotonic() + _ARRIVAL
        for progress in reply.published:
            subscription = self.bus.subscription(progress.topic)
            if subscription is None or subscription.wait(progress.sequence, watch, deadline):
                continue
            if watch is not None and watch.gone:
                raise DeviceFault(device, asked, "the device's server has died", "Start the station again")
            raise DeviceFault(
                device, asked, f"messages of {progress.topic} were lost on the way", "Check the load of this machine"
            )
        if reply.outcome:
            raise _error(reply)
        return reply


def _error(reply: Any) -> DriverError:
    device, asked, got, remedy = reply.device, reply.asked, reply.got, reply.remedy
    match reply.outcome:
        case 1:
            return CommandRefused(device, asked, got, remedy)
        case 2:
            return DeviceFault(device, asked, got, remedy, reply.recoverable)
        case 3:
            return DeviceTimeout(device, asked, got, remedy)
        case 4:
            return NotConnected(device, asked, got, remedy)
        case 6:
            return SimulationDiverged(device, asked, got, remedy, reply.recoverable)
    return ProtocolError(device, asked, got, remedy)
