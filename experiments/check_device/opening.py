"""Opens one device for its check: where a server has it already, over the bus; else its backend, in this process.

In this process, too, it is behind a server of its own, on a bus that nobody else finds: an arm moves through its gates
here as everywhere. A simulated device comes with its world, in real time.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

from drivers.config import StationConfig
from drivers.device_host import DeviceHost, make
from drivers.errors import DeviceFault, NotConnected, SimulationDiverged
from drivers.interfaces import Clock, Device
from drivers.station import Station
from drivers.wire import topics
from drivers.wire.bus import Bus
from drivers.wire.client import REMOTES
from drivers.wire.clock import RemoteClock, RemoteSimulation
from drivers.wire.link import Link
from drivers.wire.remote import RemoteSensor
from drivers.wire.security import role_of
from drivers.wire.session import listening
from drivers.wire.station_bus import station_bus
from experiments.ports import own_bus

#: so long after a server's start the news that it lives has come round [s]
_NEWS = 1.0


@dataclass(frozen=True)
class Opened:
    """The open ``device`` ``name`` of a station, and ``how`` it was opened.

    ``backend`` is the device itself, where it is in this process. Others may use a ``shared`` one at the same time.
    ``commands`` says whether the keys of this machine may more than look.
    """

    config: StationConfig
    name: str
    how: str
    device: RemoteSensor
    clock: Clock
    backend: Device | None = None
    shared: bool = False
    commands: bool = True


@contextmanager
def opened(config: StationConfig, name: str) -> Iterator[Opened]:
    """Open the device ``name`` for a check. Raises DriverError where it cannot be, and what `station_bus` raises."""
    with ExitStack() as stack:
        yield (
            _joined(stack, config, name)
            or (_in_a_world(stack, config, name) if config.world is not None else _alone(stack, config, name))
        )


def _joined(stack: ExitStack, config: StationConfig, name: str) -> Opened | None:
    """Over the bus; None where no server has it."""
    endpoint = config.bus.endpoint
    if not listening(endpoint):
        return None
    with ExitStack() as joining:
        bus = joining.enter_context(_visiting(config))
        if not bus.watch(topics.alive(config.name, name)).seen(_NEWS):
            if config.world is None:
                return None
            got = f"whatever listens there does not serve {name}"
            raise NotConnected(name, f"join station {config.name} at {endpoint}", got, "End it, or change bus.endpoint")
        if config.world is not None:
            _refuse_lockstep(config, name, bus)
        found = _over(joining, config, name, bus, f"over the bus, at {endpoint}")
        if config.world is not None:
            _see_to_a_scene(config, bus, found.device)
        stack.push(joining.pop_all())
        commands = bus.identity is None or role_of(bus.identity.name) == "runner"
        return replace(found, shared=True, commands=commands)


def _visiting(config: StationConfig) -> Bus:
    """Onto the bus as a runner; where this machine has no such keys, as who may only look."""
    try:
        return station_bus(config, "runner")
    except NotConnected:
        if config.bus.tls is None:
            raise
        return station_bus(config, "viewer")


def _refuse_lockstep(config: StationConfig, name: str, bus: Bus) -> None:
    said = json.loads(Link(bus, config.name).ask(topics.WORLD, "describe").text)["config"]
    if said["world"]["clock"] == "lockstep":
        got = "its time stands still while somebody waits: nothing streams"
        raise NotConnected(name, f"check it at {config.bus.endpoint}", got, "Serve it with --set world.clock=realtime")


def _see_to_a_scene(config: StationConfig, bus: Bus, device: RemoteSensor) -> None:
    """Give a world its first scene: until then its devices are silent, and nobody works there."""
    watch = bus.watch(topics.alive(config.name, topics.WORLD))
    world = RemoteSimulation(Link(bus, config.name), watch, [device])
    try:
        world.truth()
    except SimulationDiverged:
        raise
    except DeviceFault:
        world.reset(0, _scene())
    finally:
        watch.close()


def _scene() -> dict:
    """A box in the fingers, above an empty table."""
    from experiments import setup
    from experiments.files import load

    return setup.scene(load("grasped_static")).model_dump(mode="json")


def _in_a_world(stack: ExitStack, config: StationConfig, name: str) -> Opened:
    """In a world of its own that begins with a box in the fingers."""
    assert config.world is not None
    faults = tuple(fault for fault in config.world.faults if fault.device == name)
    own = config.model_copy(
        update={
            "world": config.world.model_copy(update={"clock": "realtime", "faults": faults}),
            "bus": own_bus(config.bus),
            "devices": {name: config.devices[name]},
        }
    )
    devices = stack.enter_context(Station(own).connect())
    assert devices.simulation is not None
    devices.simulation.reset(0, _scene())
    device = devices[name]
    assert isinstance(device, RemoteSensor)
    return Opened(config, name, "in a world that was started for it", device, devices.clock)


def _alone(stack: ExitStack, config: StationConfig, name: str) -> Opened:
    """Its backend, in this process. Raises what the device raises that cannot be opened."""
    own = config.model_copy(update={"bus": own_bus(config.bus), "devices": {name: config.devices[name]}})
    backend = make(name, own.devices[name])
    bus = stack.enter_context(station_bus(own, "device"))
    host, ready = DeviceHost(own, bus, {name: backend}), threading.Event()
    serving = stack.enter_context(ThreadPoolExecutor(1, f"serve {name}")).submit(host.run, ready.set)
    stack.callback(host.stop)
    serving.add_done_callback(lambda _: ready.set())
    ready.wait()
    if serving.done():
        try:
            serving.result()
        except NotConnected as error:
            raise (error.children[0] if error.children else error) from None
    found = _over(stack, own, name, bus, "alone, in this process")
    return replace(found, config=config, backend=backend)


def _over(stack: ExitStack, config: StationConfig, name: str, bus: Bus, how: str) -> Opened:
    link = Link(bus, config.name)
    device = REMOTES[config.devices[name].kind](name, link, False)
    stack.callback(device.close)
    device.connect(config.bus.timeout)
    watch = bus.watch(topics.alive(config.name, name))
    stack.callback(watch.close)
    if not watch.seen(config.bus.timeout):
        raise NotConnected(name, "connect", "its server has gone", "Start it again")
    return Opened(config, name, how, device, RemoteClock(link, watch, False))
