"""An emulated Net F/T box with a load that a test sets, and the sensor that reads it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from drivers.emulators.netft_box import NetFtBox
from drivers.real.ati_netft import AtiNetFt, AtiNetFtConfig
from mechanics.readings import WrenchReading


class Load:
    """What hangs on the transducer: (6,) [N, N·m] in its axes."""

    def __init__(self, *values: float):
        self.values: Iterable[float] = values or (0.0,) * 6

    def __call__(self) -> Iterable[float]:
        return self.values


def config_of(box: NetFtBox | None = None, **changed: Any) -> AtiNetFtConfig:
    given: dict[str, Any] = {"kind": "force_torque", "driver": "ati_netft", "mount": "wrist", "timeout": 5.0}
    if box is not None:
        given |= {"address": box.address, "port": box.port, "http_port": box.http_port, "rate": box.rate}
        given |= {"records": box.records}
    return AtiNetFtConfig.model_validate(given | changed)


@contextmanager
def box_and_sensor(wrench: Callable[[], Iterable[float]], sensor: dict | None = None, **box: Any) -> Iterator[tuple]:
    """The box, switched on, and the sensor of the same set-up, open."""
    with NetFtBox(wrench, **box) as emulated, AtiNetFt("wrist_ft", config_of(emulated, **sensor or {})) as opened:
        yield emulated, opened


def wait_until(sensor: AtiNetFt, true: Callable[[], object], timeout: float = 30.0) -> None:
    """Wait, from reading to reading and from trouble to trouble, until something is so."""
    with sensor._arrived:
        assert sensor._arrived.wait_for(true, timeout), "it did not happen"


def next_readings(sensor: AtiNetFt, count: int) -> list[WrenchReading]:
    """The ``count`` readings that come from now on."""
    heard: list[WrenchReading] = []
    stop = sensor.listen(heard.append)
    try:
        wait_until(sensor, lambda: len(heard) > count)  # a listener hears of a reading after who waits
        return heard[:count]
    finally:
        stop()


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


#: for tests of a silence; elsewhere the machine may have other work
IMPATIENT: dict[str, Any] = {"timeout": 0.3}


def mean_wrench(readings: Sequence) -> np.ndarray:
    return np.mean([reading.wrench for reading in readings], axis=0)
