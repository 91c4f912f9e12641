"""A station with all that needs no picture, and a box in its hand."""

from __future__ import annotations

import socket
from typing import Any

from drivers.config import StationConfig

WIDTH, HEIGHT, MASS = 0.05, 0.1469, 0.1


def station(clock: str = "lockstep", **devices: Any) -> StationConfig:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    kinds = {
        "arm": {"kind": "arm"},
        "wrist_ft": {"kind": "force_torque", "mount": "wrist"},
        "table_ft": {"kind": "force_torque", "mount": "table"},
        "gripper": {"kind": "gripper"},
    }
    return StationConfig.model_validate(
        {
            "name": "sim",
            "world": {"clock": clock},
            "bus": {"endpoint": f"tcp/127.0.0.1:{port}", "timeout": 5.0, "lease": 1.0},
            "devices": kinds | devices,
        }
    )


def scene() -> dict:
    x, y = WIDTH / 2, HEIGHT / 2
    return {
        "grasped": {"name": "go", "vertices": [(-x, -y), (x, -y), (x, y), (-x, y)], "mass": MASS},
        "grasp": (0.0, 0.045, 0.0),
        "stiffness": ((2000.0, 0, 0), (0, 2000.0, 0), (0, 0, 3.0)),
        "friction": {"go-ground": 0.33},
        "start": (0.0, 0.2, 0.0),
    }
