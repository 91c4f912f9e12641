"""Devices of this process behind their servers, as `extrinsic serve` puts them on the bus."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from drivers.config import StationConfig
from drivers.device_host import DeviceHost
from drivers.wire.station_bus import station_bus


@contextmanager
def served(config: StationConfig) -> Iterator[DeviceHost]:
    """The host that serves the devices of ``config``, in a thread of its own."""
    with station_bus(config, "device") as bus, ThreadPoolExecutor(1) as pool:
        host, ready = DeviceHost(config, bus), threading.Event()
        serving = pool.submit(host.run, ready.set)
        serving.add_done_callback(lambda _: ready.set())
        try:
            assert ready.wait(60), "the devices are not served"
            if serving.done():
                serving.result()
            yield host
        finally:
            host.stop()
