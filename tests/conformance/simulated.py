"""The simulated devices, in this process and over the bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from drivers.config import (
    ArmConfig,
    BusConfig,
    ForceTorqueConfig,
    GripperConfig,
    StationConfig,
    TactileConfig,
    TagCameraConfig,
    WorldConfig,
)
from drivers.scene import Body, Scene, TagMount
from drivers.sim.soft_bubble import view_of
from drivers.sim.world import World
from drivers.station import Station
from experiments.ports import free_endpoint
from tests.conformance.lab import Lab, losing_readings, losing_samples

START = (0.0, 0.25, 0.1)

SCENE = Scene(
    grasped=Body(
        name="tall_box",
        vertices=((-0.025, -0.07345), (0.025, -0.07345), (0.025, 0.07345), (-0.025, 0.07345)),
        mass=0.1,
        tags=(TagMount(id=3, size=0.036, pose=(0.0, -0.04, 0.0), height=0.01),),  # below the fingers
    ),
    grasp=(0.0, 0.045, 0.0),
    stiffness=((2209.0, 0.0, 0.0), (0.0, 1876.0, 0.0), (0.0, 0.0, 3.2)),
    friction={"go-ground": 0.33},
    start=START,
).model_dump(mode="json")


@contextmanager
def in_process(config: StationConfig) -> Iterator[Lab]:
    """The simulated devices themselves; a second client shares them."""
    world = World(config)

    @contextmanager
    def join() -> Iterator[Lab]:
        yield lab

    lab = Lab(world.devices, world, world, join, losing_readings)
    for device in world.devices.values():
        device.connect()
    yield lab
    for device in world.devices.values():
        device.close()


@contextmanager
def over_zenoh(config: StationConfig) -> Iterator[Lab]:
    """The simulated devices in a host process, over the bus; a second client is a second session."""
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        yield Lab(devices, devices.clock, devices.simulation, lambda: over_zenoh(config), losing_samples)


SIMULATED: dict[str, Callable[[StationConfig], AbstractContextManager[Lab]]] = {
    "sim in process": in_process,
    "sim over zenoh": over_zenoh,
}


def station() -> StationConfig:
    """A simulated station with a device of every kind."""
    config = StationConfig(
        name="bench",
        world=WorldConfig(),
        bus=BusConfig(endpoint=free_endpoint()),
        devices={
            "arm": ArmConfig(kind="arm"),
            "gripper": GripperConfig(kind="gripper"),
            "wrist_ft": ForceTorqueConfig(kind="force_torque", mount="wrist"),
            "camera": TagCameraConfig(
                kind="tag_camera", width=640, height=480, focal=600.0, position=(0, -0.5, 0.2), look_at=(0, 0, 0.2)
            ),
            "bubble": TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", indentation=0.016),
            "gel": TactileConfig(kind="tactile", sensor="gelslim", finger="right", width=160, height=120),
        },
    )
    bubble = config.devices["bubble"]
    assert isinstance(bubble, TactileConfig)
    view_of(bubble)  # compiled once per installation, which takes longer than a frame may
    return config
