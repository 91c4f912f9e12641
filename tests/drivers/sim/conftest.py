"""Scenes of the simulated station, in plain numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from drivers.config import ArmConfig, ForceTorqueConfig, GripperConfig, StationConfig, WorldConfig
from drivers.scene import Body, Scene
from drivers.sim.mismatch import Mismatch
from drivers.sim.world import World

#: the paper's K of the Soft Bubbles, its angle scaled by 44.8 mm
BUBBLE = (
    (2208.96, -143.31, 399.86 * 0.0448),
    (-143.31, 1875.92, -313.57 * 0.0448),
    (399.86 * 0.0448, -313.57 * 0.0448, 1608.49 * 0.0448**2),
)


def rectangle(width: float, height: float) -> tuple[tuple[float, float], ...]:
    w, h = width / 2, height / 2
    return ((-w, -h), (w, -h), (w, h), (-w, h))


@pytest.fixture
def tall_box() -> Body:
    return Body(name="tall_box", vertices=rectangle(0.05, 0.1469), mass=0.1)


@pytest.fixture
def make_scene(tall_box: Body) -> Callable[..., Scene]:
    """A scene with the tall box in hand, high above the table; keywords replace its parts."""

    def make(**parts) -> Scene:
        usual = {
            "grasped": tall_box,
            "grasp": (0.0, 0.045, 0.0),
            "stiffness": BUBBLE,
            "friction": {"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 0.33},
            "start": (0.0, 0.3, 0.0),
        }
        return Scene(**(usual | parts))

    return make


@pytest.fixture
def station() -> StationConfig:
    return StationConfig(
        name="sim",
        world=WorldConfig(),
        devices={
            "arm": ArmConfig(kind="arm"),
            "gripper": GripperConfig(kind="gripper"),
            "wrist_ft": ForceTorqueConfig(kind="force_torque", mount="wrist", pose=(0.01, 0.08, 0.3)),
            "table_ft": ForceTorqueConfig(kind="force_torque", mount="table", pose=(0.05, -0.1, 0.0)),
        },
    )


@pytest.fixture
def world_of(station: StationConfig, make_scene, monkeypatch) -> Callable[..., World]:
    """A world of a profile, every device open, reset to a seed."""

    def make(figures: Mismatch, seed: int = 0, config: StationConfig = station, **scene: Any) -> World:
        monkeypatch.setattr("drivers.sim.world.load_profile", lambda _name: figures)
        world = World(config)
        for device in world.devices.values():
            device.connect()
        world.reset(seed, make_scene(**scene))
        return world

    return make
