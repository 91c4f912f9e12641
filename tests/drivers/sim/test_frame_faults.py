"""Faults of the sensors that are asked for a frame: cameras and tactile fingers."""

import numpy as np
import pytest

from drivers.config import StationConfig, TactileConfig, WorldConfig
from drivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from drivers.fault import Fault
from drivers.interfaces import TactileSensor
from drivers.sim.world import World
from mechanics.readings import Status

SENSORS = ("soft_bubble", "gelslim")


@pytest.fixture(params=SENSORS)
def world(request, make_scene):
    finger = TactileConfig(kind="tactile", sensor=request.param, finger="left", width=112, height=86)
    world = World(StationConfig(name="sim", world=WorldConfig(profile="lab"), devices={"finger": finger}))
    world.devices["finger"].connect()
    world.reset(0, make_scene())
    yield world
    world.devices["finger"].close()


@pytest.fixture
def finger(world):
    finger = world.devices["finger"]
    assert isinstance(finger, TactileSensor)
    return finger


def test_a_stuck_picture_is_stale_and_the_same(world, finger):
    first = finger.capture()
    assert first.stamp.status is Status.OK
    world.inject(Fault(kind="stuck", device="finger"))
    held = finger.capture()
    again = finger.capture()
    assert again.stamp.status is Status.STALE
    assert again.stamp.sequence == held.stamp.sequence + 1
    np.testing.assert_array_equal(again.image, held.image)
    world.clear_faults()
    assert finger.capture().stamp.status is Status.OK


def test_the_first_frame_of_a_repeated_run_is_not_stale(world, finger, make_scene):
    finger.capture()
    world.reset(0, make_scene())
    assert finger.capture().stamp.status is Status.OK


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ({"kind": "freeze"}, DeviceTimeout),
        ({"kind": "drop", "value": 1.0}, DeviceTimeout),
        ({"kind": "delay", "value": 3.0}, DeviceTimeout),
        ({"kind": "garbage"}, ProtocolError),
        ({"kind": "disconnect"}, DeviceFault),
    ],
)
def test_a_frame_that_does_not_come_is_the_promised_error(world, finger, fault, error):
    finger.capture()
    world.inject({"device": "finger", **fault})
    with pytest.raises(error) as caught:
        finger.capture()
    assert caught.value.device == "finger"
    world.clear_faults()
    finger.close()
    finger.connect()
    assert finger.capture().stamp.status is Status.OK


def test_a_late_frame_says_when_it_came(world, finger):
    world.inject({"kind": "delay", "device": "finger", "value": 0.5})
    stamp = finger.capture().stamp
    assert stamp.receive_ns - stamp.capture_ns == 500_000_000
