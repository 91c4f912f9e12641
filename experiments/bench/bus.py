"""`extrinsic bench bus`: how long readings are under way between processes, and what is lost, beside bare zenoh.

One process sends a wrench 1000 times a second and a depth picture 30 times, on our bus and on a bare zenoh session at
the same time; this one takes both. On the bus a message begins and ends as a reading, a bare one as bytes. Once
directly, once through a router. And what a station costs to which nobody listens.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from drivers.errors import NotConnected
from drivers.hosting import HostProcess
from drivers.station import Station
from drivers.wire.bus import Bus
from drivers.wire.codec import decode_reading
from drivers.wire.streams import ATTACHMENT, Sample
from experiments import setup
from experiments.bench import bus_idle
from experiments.bench.bus_source import DEPTH, RATES, TYPES, WRENCH, bare_session
from experiments.bench.figures import Figure, figure_of
from experiments.bench.load_child import PATIENCE, Child
from experiments.files import load
from experiments.ports import free_endpoint

#: how long each way is measured, in pieces of which each gives a median; and how long an idle station is watched [s]
SECONDS, PIECES, IDLE = 60.0, 6, 10.0
#: what processes take to come up, and the idle station, beside what is measured [s]
AROUND = 45.0
_ARRIVAL = 2.0  # what has not come by then is lost [s]
_SETTLE = 2.0  # what it costs a station to begin is over by then [s]
NAMES = {WRENCH: "wrench, 1 kHz", DEPTH: "depth 640×480, 30 Hz"}


class _Taken:
    """What has come of one topic on one session: (sequence, age [ns]) of each message."""

    def __init__(self) -> None:
        self.ages: list[tuple[int, int]] = []
        self._wanted = 1 << 62
        self._here = threading.Event()

    def _came(self, sequence: int, age: int) -> None:
        self.ages.append((sequence, age))
        if len(self.ages) >= self._wanted:
            self._here.set()

    def ours(self, type_name: str) -> Callable[[Sample], None]:
        """Takes a sample of our bus: it has arrived when it is a reading."""

        def take(sample: Sample) -> None:
            decode_reading(type_name, sample.payload, sample.sequence, sample.status, sample.receive_ns)
            self._came(sample.sequence, time.time_ns() - sample.capture_ns)

        return take

    def bare(self, sample: zenoh.Sample) -> None:
        """Takes a sample of the bare session: it has arrived when its bytes are here."""
        sample.payload.to_bytes()
        now = time.time_ns()
        beside = sample.attachment
        if beside is not None:
            sequence, at, _ = ATTACHMENT.unpack(beside.to_bytes())
            self._came(sequence, now - at)

    def take(self, count: int) -> tuple[NDArray[np.float64], int]:
        """The ages [ms] of ``count`` messages that were sent, and how many of them never came; begins anew."""
        self._wanted = count
        if len(self.ages) < count:
            self._here.wait(_ARRIVAL)
        came, self.ages, self._wanted = dict(self.ages), [], 1 << 62
        self._here.clear()
        return np.array(list(came.values())) * 1e-6, count - len(came)


def run(seconds: float = SECONDS) -> Iterator[Figure]:
    """Measure each way for so many ``seconds``. Raises NotConnected where a process does not come up."""
    for way in ("direct", "routed"):
        yield from _measured(way, seconds)
    yield from _idle()


def _measured(way: str, seconds: float) -> Iterator[Figure]:
    direct = way == "direct"
    ends = {"ours": free_endpoint(), "bare": free_endpoint()}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="extrinsic-bus-")))

        def child(name: str, **order: Any) -> Child:
            started = stack.enter_context(Child("experiments.bench.bus_source", name, folder))
            started.tell(json.dumps(order))
            started.heard("ready")
            return started

        if not direct:
            for name, endpoint in ends.items():
                child(f"router {name}", role="router", endpoint=endpoint)
        source = child("source", role="source", listen=direct, **ends)
        mode = "peer" if direct else "client"
        bus = stack.enter_context(Bus(ends["ours"], mode=mode, shared_memory=False))
        bare = stack.enter_context(bare_session(ends["bare"], mode, listen=False))
        taken = {(name, topic): _Taken() for name in ends for topic in RATES}
        for topic in RATES:
            stack.callback(bus.subscribe(topic).listen(taken["ours", topic].ours(TYPES[topic])))
            bare.declare_subscriber(topic, taken["bare", topic].bare)
        source.tell("send 1")  # what runs for the first time has run by then
        for topic, count in source.heard("sent").items():
            for name in ends:
                taken[name, topic].take(count)
        medians: dict[tuple[str, str], list[float]] = {key: [] for key in taken}
        lost, all_sent = dict.fromkeys(taken, 0), dict.fromkeys(RATES, 0)
        worst = dict.fromkeys(taken, 0.0)
        for _ in range(PIECES):
            source.tell(f"send {seconds / PIECES}")
            sent = source.heard("sent", seconds + PATIENCE)
            for (name, topic), each in taken.items():
                ages, missing = each.take(sent[topic])
                lost[name, topic] += missing
                medians[name, topic].append(float(np.median(ages)))
                worst[name, topic] = max(worst[name, topic], float(np.quantile(ages, 0.99)))
            for topic in RATES:
                all_sent[topic] += sent[topic]
    for topic, name in NAMES.items():
        ours, theirs = medians["ours", topic], medians["bare", topic]
        yield figure_of(f"{name}, {way}: p50", ours, "ms")
        yield figure_of(f"{name}, {way}: p50 of bare zenoh", theirs, "ms")
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        yield figure_of(f"{name}, {way}: p50 over bare zenoh's", ratios, "×", "each piece by itself")
        yield figure_of(f"{name}, {way}: p99", [worst["ours", topic]], "ms", "of the worst piece")
        yield figure_of(f"{name}, {way}: p99 of bare zenoh", [worst["bare", topic]], "ms", "of the worst piece")
        yield figure_of(f"{name}, {way}: lost", [lost["ours", topic]], f"of {all_sent[topic]}")
        yield figure_of(f"{name}, {way}: lost by bare zenoh", [lost["bare", topic]], f"of {all_sent[topic]}")


# -- a station to which nobody listens ---------------------------------------------------------------------------------


def _idle() -> Iterator[Figure]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="extrinsic-bus-")))
        emulators = stack.enter_context(Child("experiments.bench.bus_idle", "emulators", folder))
        emulators.tell(json.dumps({"role": "emulators"}))
        config = bus_idle.station(emulators.heard("ports"), free_endpoint())
        devices = stack.enter_context(Child("experiments.bench.bus_idle", "devices", folder))
        devices.tell(json.dumps({"role": "devices", "station": config.model_dump(mode="json")}))
        devices.heard("serving")
        yield _watched("idle station, real backends: of one core", devices.pid)
        if not devices.running:
            raise NotConnected("devices", "stay idle", devices.last_words(), "`extrinsic serve` tells more")
    resolved = load("grasped_static", None, ["world.clock=realtime", f"bus.endpoint={free_endpoint()}"])
    with HostProcess(resolved.station) as host:
        with Station(resolved.station).connect() as joined:
            assert joined.simulation is not None
            joined.simulation.reset(0, setup.scene(resolved).model_dump())
        yield _watched("idle station, simulated in real time: of one core", host.pid)


def _watched(name: str, pid: int) -> Figure:
    """What a process takes of the processor while nothing is asked of it."""
    time.sleep(_SETTLE)  # nobody tells when a process has done with its beginning
    before, begin = _cpu(pid), time.monotonic()
    time.sleep(IDLE)  # the span of time that is measured
    return figure_of(name, [100 * (_cpu(pid) - before) / (time.monotonic() - begin)], "%", "nobody listens")


def _cpu(pid: int) -> float:
    """Processor time of a process until now [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
