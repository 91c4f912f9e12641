"""A part of a run in the simulated world: as after a reset, whatever was done before, and time goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers.config import TactileConfig, TagCameraConfig
from drivers.errors import CommandRefused, DeviceFault
from drivers.fault import Fault
from drivers.interfaces import ArmTarget
from drivers.sim.mismatch import load_profile
from drivers.sim.world import World


@pytest.fixture
def lab(world_of, station, monkeypatch):
    """Makes a world of profile `lab` at a seed, with every device there is."""
    figures = load_profile("lab")
    camera = TagCameraConfig(kind="tag_camera", position=(0, -0.55, 0.1), look_at=(0, 0, 0.1))
    finger = TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", width=56, height=43)
    config = station.model_copy(update={"devices": {**station.devices, "camera": camera, "finger": finger}})
    return lambda seed=0: world_of(figures, seed, config)


def device(world: World, name: str) -> Any:
    return world.devices[name]


def disturb(world: World, seconds: float) -> None:
    """Let much happen: motions, pictures, a taking into the fingers, a tare, and time."""
    arm = world._arm
    assert arm is not None
    arm.acquire("test")
    for i in range(3):
        arm.command(ArmTarget(np.array([0.01 * i, 0.3 - 0.02 * i, 0.05]), np.zeros(3), 0.1, i))
        world.advance(seconds / 4)
        device(world, "camera").capture()
        device(world, "finger").capture(30.0)
    arm.release()
    world.regrasp(5)
    world.advance(seconds / 4)
    device(world, "wrist_ft").tare()


def readings(world: World) -> list[bytes]:
    """What every device says in half a second after a motion has begun, without when."""
    arm = world._arm
    assert arm is not None
    seen: list[bytes] = []
    begin = world.now_ns()
    arm.acquire("test")
    arm.command(ArmTarget(np.array([0.004, 0.298, 0.02]), np.zeros(3), 0.2, 0))
    world.advance(0.25)
    arm.release()
    for name in ("wrist_ft", "table_ft"):
        for reading in device(world, name).since(begin):
            stamp = reading.stamp
            seen.append(reading.wrench.tobytes() + f"{stamp.sequence} {stamp.capture_ns - begin}".encode())
    seen += [reading.pose.tobytes() for reading in device(world, "arm").since(begin)]
    device(world, "camera").capture()
    seen.append(device(world, "camera").image().image.tobytes())
    seen += [device(world, "finger").capture(30.0).image.tobytes() for _ in range(2)]
    truth = world.truth()
    return [*seen, truth.ee.tobytes(), truth.go.tobytes(), truth.wrench.tobytes()]


def test_a_part_is_the_same_to_the_bit_whatever_was_done_before_it(lab, make_scene):
    one, other = lab(), lab()
    one.advance(0.1)
    disturb(other, 1.3)
    found = []
    for world in (one, other):
        world.restage(make_scene())
        world.regrasp(2)
        found.append(readings(world))
    assert found[0] == found[1]


def test_a_part_without_a_trial_has_noise_of_its_own(lab, make_scene):
    world = lab()
    found = []
    for part in (1, 2, 1):
        world.restage(make_scene(), part)
        found.append(readings(world))
    assert found[0] == found[2] != found[1]


def test_time_and_faults_go_on(lab, make_scene):
    world = lab()
    world.inject(Fault(kind="freeze", device="wrist_ft", after=0.5, duration=0.5))
    world.advance(0.3)
    world.restage(make_scene())
    assert world.now_ns() == 300_000_000
    assert not device(world, "wrist_ft").line.frozen
    world.advance(0.3)
    assert device(world, "wrist_ft").line.frozen
    world.restage(make_scene())
    assert device(world, "wrist_ft").line.frozen
    world.advance(0.5)
    assert not device(world, "wrist_ft").line.frozen


def test_the_arm_rests_at_the_scene_s_start_and_keeps_its_commander(lab, make_scene):
    world = lab()
    disturb(world, 0.5)
    world._arm.acquire("run")
    world.restage(make_scene(start=(0.02, 0.35, 0.0)))
    world.advance(0.05)
    assert device(world, "arm").latest().pose.tolist() == [0.02, 0.35, 0.0]
    assert world._arm.holder == "run"


def test_a_scene_that_cannot_be_changes_nothing(lab, make_scene):
    world = lab()
    world.advance(0.1)
    before, scene = world.truth(), world.scene
    with pytest.raises(CommandRefused, match="overlap"):
        world.restage(make_scene(start=(0.0, 0.05, 0.0)))
    assert world.scene is scene and world.truth().go.tolist() == before.go.tolist()


def test_there_has_to_be_a_reset_first(station, make_scene):
    with pytest.raises(DeviceFault, match="no scene"):
        World(station).restage(make_scene())


def test_time_begins_where_it_is_told_and_the_file_s_faults_count_from_0(lab, make_scene, station):
    world = lab()
    fault = Fault(kind="freeze", device="wrist_ft", after=10.0, duration=2.0)
    changed = world.config.world.model_copy(update={"faults": (fault,)})
    world.reset(0, make_scene(), changed, begin_ns=9_000_000_000)
    assert world.now_ns() == 9_000_000_000 and not device(world, "wrist_ft").line.frozen
    world.advance(1.1)
    assert device(world, "wrist_ft").line.frozen
    world.reset(0, make_scene(), changed, begin_ns=13_000_000_000)
    world.advance(1.0)
    assert not device(world, "wrist_ft").line.frozen
