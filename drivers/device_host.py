"""Puts the real and the recorded devices of this machine on the bus, each with a server of its own."""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial

from drivers import hosted
from drivers.config import DeviceConfig, RealDevice, ReplayDevice, StationConfig
from drivers.errors import DriverError, NotConnected
from drivers.interfaces import Arm, Device, ForceTorqueSensor
from drivers.registry import driver
from drivers.wire.arm_server import ArmServer
from drivers.wire.bus import Bus
from drivers.wire.server import Answer, Desk, DeviceServer
from drivers.wire.station_bus import station_bus, warn_unheard
from drivers.wire.streams import ViewRates

log = logging.getLogger(__name__)

#: how long a device may take to answer when its server starts [s]
OPENING = 10.0


def make(name: str, config: DeviceConfig) -> Device:
    """The device that a station file describes, closed. Raises ValueError for one that only a world can have."""
    if isinstance(config, RealDevice):
        return driver(config.driver).make(name, config)
    if isinstance(config, ReplayDevice):
        from drivers.replay import replayed

        return replayed(name, config)
    raise ValueError(f"{name} is simulated: its world makes it")


class DeviceHost:
    """The devices named ``served`` (all that are not simulated by default) on a bus, until `stop`.

    Each device has a desk, and so a turn, of its own: a camera that takes its time holds up no arm.
    """

    def __init__(self, config: StationConfig, bus: Bus, served: Mapping[str, Device] | None = None):
        self.config, self.bus = config, bus
        if served is None:
            served = {name: make(name, d) for name, d in config.devices.items() if d.backend != "sim"}
        self.devices = dict(served)
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End `run`; safe in a signal handler and from any thread."""
        self._stopped.set()

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Open every device, serve them until `stop`, and close them in order, the arm held.

        Raises NotConnected with the failure of each device that could not be opened; then none is served.
        """
        with ExitStack() as stack:
            self._connect(stack)
            for name, device in self.devices.items():
                desk = self._desk()
                stack.callback(desk.serve(name, "settings", lambda _, name=name: self._settings(name), direct=True))
                stack.enter_context(self._server(desk, device))
            ready()
            self._stopped.wait()

    def _connect(self, stack: ExitStack) -> None:
        """Open the devices at the same time: one that does not answer costs its time-out once."""
        failures: dict[str, DriverError] = {}

        def connect(device: Device) -> None:
            try:
                device.connect(OPENING)
            except DriverError as error:
                failures[device.name] = error
            except Exception as error:
                log.exception("%s cannot be opened", device.name)
                got = f"{type(error).__name__}: {error}"
                failures[device.name] = NotConnected(device.name, "connect", got, "This is a defect; report it")

        threads = [threading.Thread(target=connect, args=(d,), name=f"open {d.name}") for d in self.devices.values()]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for device in self.devices.values():
            stack.callback(device.close)
        if failures:
            raise NotConnected(
                self.config.name,
                "open its devices",
                f"{len(failures)} of {len(self.devices)} failed",
                "Mend each of these:",
                children=tuple(failures[name] for name in self.devices if name in failures),
            )

    def _desk(self) -> Desk:
        bus = self.config.bus
        views = ViewRates(bus.view_rate, bus.image_view_rate)
        return Desk(
            self.bus,
            self.config.name,
            now_ns=time.time_ns,
            steady_ns=time.monotonic_ns,
            lease=self.config.lease,
            views=views,
        )

    def _server(self, desk: Desk, device: Device) -> DeviceServer:
        if not isinstance(device, Arm):
            return DeviceServer(desk, device)
        sensors: dict[str, ForceTorqueSensor | float] = {}
        for name, known in self.config.devices.items():
            if known.kind == "force_torque" and getattr(known, "mount", "") == "wrist":
                here = self.devices.get(name)
                sensors[name] = here if isinstance(here, ForceTorqueSensor) else known.rate
        return ArmServer(desk, device, getattr(self.config.devices[device.name], "limits", None), sensors)

    def _settings(self, name: str) -> Answer:
        """What the station file of this process says of a device: whoever joins is to have the same."""
        return Answer(json.dumps(self.config.devices[name].model_dump(mode="json")))


def serve(config: StationConfig, ready: Callable[[DeviceHost], None] = lambda _: None, *, joining: bool = False) -> int:
    """Serve the devices of ``config`` in this process until SIGTERM or SIGINT; returns 0.

    With ``joining`` another process of this machine listens at the endpoint, and routes. Raises NotConnected, and
    InputError where it would listen to strangers.
    """
    with station_bus(config, "device", joining=joining) as bus:
        host = DeviceHost(config, bus)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: host.stop())

        def serving() -> None:
            warn_unheard(config, list(host.devices))
            ready(host)

        host.run(serving)
    return 0


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    sys.exit(hosted.main(partial(serve, joining=True)))
