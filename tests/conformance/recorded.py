"""The devices of a recording: a simulated station, logged while nothing happened at it, and played at its pace."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from drivers.config import StationConfig
from drivers.device_host import make
from drivers.interfaces import Device
from drivers.sim.host_thread import HostThread
from drivers.station import Station
from experiments.ports import free_endpoint
from tests.conformance.lab import Lab, WallClock, losing_readings, losing_samples
from tests.conformance.served import served
from tests.conformance.simulated import SCENE, station

#: how long the recording is [s], longer than a claim takes on a busy machine; and from a picture to the next
LENGTH, PERIOD = 12.0, 0.1
#: what a device is that plays what another has said
_PLAYED = {"kind", "mount", "sensor", "finger", "width", "height", "focal", "position", "look_at"}


@contextmanager
def recording() -> Iterator[StationConfig]:
    """The station that plays a recording with all that a device of each kind says."""
    with TemporaryDirectory(prefix="extrinsic-recorded-") as folder:
        path, lived = Path(folder) / "log.mcap", station()
        with Station(lived).connect(HostThread) as devices, devices.log(path) as log:
            world = devices.simulation
            assert world is not None
            world.reset(0, SCENE)
            devices.tell_descriptions(log)
            for finger in (devices["bubble"], devices["gel"]):
                finger.reference()  # pyright: ignore[reportAttributeAccessIssue]
            for _ in range(round(LENGTH / PERIOD)):
                devices.clock.sleep(PERIOD)
                for eye in (devices["camera"], devices["bubble"], devices["gel"]):
                    eye.capture()  # pyright: ignore[reportAttributeAccessIssue]
        played = {
            name: {key: value for key, value in device.model_dump(mode="json").items() if key in _PLAYED}
            | {"backend": "replay", "log": str(path)}
            for name, device in lived.devices.items()
        }
        yield StationConfig.model_validate(
            {"name": "bench", "bus": {"endpoint": free_endpoint()}, "devices": played},
        )


def rewind(devices: Mapping[str, Device]) -> None:
    """Play the recording from its begin."""
    for device in devices.values():
        device.close()
    for device in devices.values():
        device.connect()


@contextmanager
def in_process() -> Iterator[Lab]:
    """The devices that play it; a second client shares them."""
    with recording() as config:
        devices = {name: make(name, device) for name, device in config.devices.items()}

        @contextmanager
        def join() -> Iterator[Lab]:
            yield lab

        lab = Lab(devices, WallClock(), None, join, losing_readings, renew=lambda: rewind(devices))
        yield lab
        for device in devices.values():
            device.close()


@contextmanager
def over_zenoh() -> Iterator[Lab]:
    """The same behind their servers, over the bus; a second client is a second session."""
    with recording() as config, served(config) as host:

        @contextmanager
        def join() -> Iterator[Lab]:
            with Station(config).connect() as devices:
                yield Lab(devices, devices.clock, None, join, losing_samples, renew=lambda: rewind(host.devices))

        with join() as lab:
            yield lab
