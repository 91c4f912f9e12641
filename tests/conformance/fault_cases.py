"""What the claims about faults share: the devices that they befall, and how these are used and read."""

from __future__ import annotations

import time

import numpy as np
import pytest

from drivers.config import WorldConfig
from drivers.errors import DeviceFault
from drivers.interfaces import ArmTarget
from drivers.sim.world import World

NAMES = {
    "arm": "arm",
    "gripper": "gripper",
    "force_torque": "wrist_ft",
    "tag_camera": "camera",
    "soft_bubble": "bubble",
    "gelslim": "gel",
}
STREAMS = ("arm", "gripper", "force_torque")
#: what is asked for a frame
PICTURES = ("tag_camera", "soft_bubble", "gelslim")
#: a membrane that is not pressed anew still moves by this at most from frame to frame [0.1 mm]
LEAST = 1


def befalls(fault: str, *kinds: str):
    """A claim about a fault and each of the kinds of device that it befalls."""
    return pytest.mark.parametrize(("fault", "kind"), [(fault, kind) for kind in kinds])


def inject(lab, fault, kind, **figures):
    lab.simulation.inject({"kind": fault, "device": NAMES[kind], **figures})


def read(device):
    """The way to a reading: the stream's newest, or a frame on request."""
    return getattr(device, "capture", device.latest)()


def move(arm, x):
    arm.command(ArmTarget(np.array([x, 0.25, 0.1]), np.zeros(3), 0.5))


def statuses(device, since_ns):
    return {reading.stamp.status for reading in device.since(since_ns)}


def content(reading):
    """What is in a frame: its pixels, or the corners that were found in it."""
    return reading.image if hasattr(reading, "image") else np.array([tag.corners for tag in reading.detections])


def wait_until_gone(device, within=2.0):
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        try:
            device.since(0)
        except DeviceFault:
            return
    raise AssertionError(f"{device.name} is still there after {within} s")


def become(lab, scene, profile):
    world = WorldConfig(profile=profile)
    if isinstance(lab.simulation, World):
        lab.simulation.reset(0, scene, world)
    else:
        lab.simulation.reset(0, scene, world.model_dump())
