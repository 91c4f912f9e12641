"""A process of `extrinsic bench bus`: a router, or the source of the streams whose way is measured.

The first line of standard input is its order, as JSON: ``{"role": "router", "endpoint": …}``, or ``{"role": "source",
"ours": …, "bare": …, "listen": …}`` with the endpoints of our bus and of the bare session. A source sends on both, one
straight after the other and each first every other time, from when it is told ``send SECONDS``; then it says how many
messages left.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh

from drivers.wire import messages
from drivers.wire.bus import Bus
from drivers.wire.codec import encode_reading
from drivers.wire.session import open_session, settings_of
from drivers.wire.streams import ATTACHMENT
from mechanics.readings import ImageReading, Stamp, WrenchReading

#: what is sent: a wrist's wrench, and depth as the lab's camera gives it
WRENCH, DEPTH = "bench/wrist_ft/wrench", "bench/depth/image"
RATES = {WRENCH: 1000.0, DEPTH: 30.0}
TYPES = {WRENCH: messages.WRENCH, DEPTH: messages.IMAGE}
SIZE = (480, 640)


def bare_session(endpoint: str, mode: str, *, listen: bool) -> zenoh.Session:
    """A session with zenoh's own settings, at the same kind of endpoint as ours."""
    config = zenoh.Config()
    for path, value in settings_of(mode, endpoint, listen=listen, keys=None).items():  # type: ignore[arg-type]
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _reading(topic: str, at: int, sequence: int) -> WrenchReading | ImageReading:
    stamp = Stamp(at, at, sequence, "wrist_ft")
    return WrenchReading(stamp, _LOAD) if topic == WRENCH else ImageReading(stamp, _PICTURE, "16UC1")


_LOAD = np.array([0.1, 0.2, -3.0, 0.01, 0.02, 0.03])
_PICTURE = np.random.default_rng(0).integers(500, 600, SIZE, dtype=np.uint16)


class _Stream:
    """One topic, on our bus and on the bare session."""

    def __init__(self, topic: str, bus: Bus, bare: zenoh.Session):
        self.topic, self.period, self.sequence = topic, 1.0 / RATES[topic], 0
        self.ours = bus.publisher(topic, TYPES[topic])
        self.bare = bare.declare_publisher(topic, congestion_control=zenoh.CongestionControl.BLOCK)
        self.payload = encode_reading(_reading(topic, 0, 0))
        self.due = 0.0

    def send(self) -> None:
        """One message on either; which is first takes turns."""
        ways: tuple[Callable[[], None], ...] = (self._send_ours, self._send_bare)
        for way in ways if self.sequence % 2 else ways[::-1]:
            way()
        self.sequence += 1

    def _send_ours(self) -> None:
        at = time.time_ns()
        self.ours.put(encode_reading(_reading(self.topic, at, self.sequence)), self.sequence, at)

    def _send_bare(self) -> None:
        at = time.time_ns()
        self.bare.put(self.payload, attachment=ATTACHMENT.pack(self.sequence, at, 0))


def _send(streams: list[_Stream], seconds: float) -> None:
    begin = time.monotonic()
    for stream in streams:
        stream.due, stream.sequence = begin, 0
    while (now := time.monotonic()) < begin + seconds:
        stream = min(streams, key=lambda each: each.due)
        if stream.due > now:
            time.sleep(stream.due - now)  # the pace of a source
        stream.send()
        stream.due += stream.period


def _source(order: dict[str, Any]) -> None:
    mode, listen = ("peer" if order["listen"] else "client"), order["listen"]
    with (
        Bus(order["ours"], listen=listen, mode=mode, shared_memory=False) as bus,
        bare_session(order["bare"], mode, listen=listen) as bare,
    ):
        streams = [_Stream(topic, bus, bare) for topic in RATES]
        _tell(ready=True)
        for line in sys.stdin:
            _send(streams, float(line.split()[1]))
            _tell(sent={stream.topic: stream.sequence for stream in streams})
        for stream in streams:
            stream.ours.close()


def _router(order: dict[str, Any]) -> None:
    settings = {"transport/shared_memory/enabled": False, "scouting/delay": 0}
    endpoint = order["endpoint"]
    router = open_session("router", endpoint, listen=True, timeout=5.0, lease=1.0, identity=None, settings=settings)
    with router:
        _tell(ready=True)
        sys.stdin.read()


def main() -> None:
    """Entry of the process."""
    order = json.loads(sys.stdin.readline())
    {"source": _source, "router": _router}[order["role"]](order)


def _tell(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
