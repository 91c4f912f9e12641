"""The real backends, each at something that speaks its device's protocol back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.device_host import make
from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.emulators.netft_box import NetFtBox
from drivers.real.arm_frames import ArmFrames, PlaneInBase, ToolMount
from drivers.station import Station
from drivers.tags import tag_bitmap
from experiments.ports import free_endpoint
from tests.conformance.lab import Lab, WallClock, losing_readings, losing_samples
from tests.conformance.served import served
from tests.drivers.real.bubbles import bubble_playback

NAMES = {"arm": "arm", "gripper": "gripper", "force_torque": "wrist_ft", "tag_camera": "camera", "tactile": "gel"}
#: where the arm is at first, what hangs on the wrist [N, N·m], and the width of the block between the fingers [m]
START, LOAD, BLOCK = (0.0, 0.25, 0.1), (0.3, 0.0, -1.0, 0.01, 0.02, 0.0), 0.03
#: what a Franka in its simulator reaches a set-point to [m, m, rad]
ACCURACY = (5e-4, 5e-4, 2e-3)
TAG = 3


def tag_picture() -> np.ndarray:
    """A tag on a grey wall, 480 × 640."""
    picture = np.full((480, 640), 128, np.uint8)
    tag = cv2.resize(tag_bitmap(TAG), (200, 200), interpolation=cv2.INTER_NEAREST)
    picture[140:340, 220:420] = tag
    return picture


def gel_picture() -> np.ndarray:
    """Something in colour, 120 × 160."""
    rows, columns = np.mgrid[:120, :160]
    return np.stack([rows + 40, columns + 40, np.full_like(rows, 90)], axis=-1).astype(np.uint8)


def bubble(folder: Path) -> dict[str, dict]:
    """A Soft Bubble whose camera is a recording, where the camera's SDK is at hand."""
    try:
        return {"bubble": bubble_playback(folder)}
    except pytest.skip.Exception:
        return {}


@contextmanager
def emulators() -> Iterator[tuple[StationConfig, Callable[[str], float]]]:
    """Something that speaks back for a device of every kind, and the station of real backends that finds them.

    With it comes the time that a device of a kind lives by (`Lab.own_time`).
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="extrinsic-playback-")))
        box = stack.enter_context(NetFtBox(lambda: LOAD))
        seen = stack.enter_context(MjpegCamera(tag_picture, 10.0))
        felt = stack.enter_context(MjpegCamera(gel_picture, 30.0))
        frames = ArmFrames(PlaneInBase(), ToolMount())
        robot = stack.enter_context(FrankaArmEmulator(frames, np.array(START), block=BLOCK))
        franka = {"backend": "real", "host": robot.host}

        def own_time(kind: str) -> float:
            return robot.pose()[0] if kind in ("arm", "gripper") else time.monotonic()

        config = StationConfig.model_validate(
            {
                "name": "bench",
                "bus": {"endpoint": free_endpoint()},
                "devices": {
                    "arm": franka | {"kind": "arm", "driver": "franka", "realtime": "ignore"},
                    "gripper": franka | {"kind": "gripper", "driver": "franka_hand"},
                    "wrist_ft": {
                        "kind": "force_torque",
                        "backend": "real",
                        "driver": "ati_netft",
                        "mount": "wrist",
                        "address": box.address,
                        "port": box.port,
                        "http_port": box.http_port,
                    },
                    "camera": {
                        "kind": "tag_camera",
                        "backend": "real",
                        "driver": "tag_camera",
                        "address": seen.address,
                        "rate": 10,
                        "width": 640,
                        "height": 480,
                        "focal": 600,
                        "position": [0, -0.5, 0.2],
                        "look_at": [0, 0, 0.2],
                    },
                    "gel": {
                        "kind": "tactile",
                        "backend": "real",
                        "driver": "gelslim_stream",
                        "sensor": "gelslim",
                        "finger": "right",
                        "address": felt.address,
                        "width": 160,
                        "height": 120,
                        "reference": "take",
                    },
                    **bubble(folder),
                },
            }
        )
        yield config, own_time


@contextmanager
def in_process() -> Iterator[Lab]:
    """The backends themselves; a second client shares them."""
    with emulators() as (config, own_time), ExitStack() as stack:
        devices = {name: make(name, device) for name, device in config.devices.items()}
        for device in devices.values():
            device.connect(10.0)
            stack.callback(device.close)

        @contextmanager
        def join() -> Iterator[Lab]:
            yield lab

        lab = Lab(devices, WallClock(), None, join, losing_readings, NAMES, ACCURACY, own_time)
        yield lab


@contextmanager
def over_zenoh() -> Iterator[Lab]:
    """The backends behind their servers, over the bus; a second client is a second session."""
    with emulators() as (config, own_time), served(config):

        @contextmanager
        def join() -> Iterator[Lab]:
            with Station(config).connect() as devices:
                yield Lab(devices, devices.clock, None, join, losing_samples, NAMES, ACCURACY, own_time)

        with join() as lab:
            yield lab
