"""A process of `extrinsic bench bus`: emulated devices, or the server of the real backends that talk to them.

The first line of standard input is its order, as JSON: ``{"role": "emulators"}`` says at which ports they are, and
``{"role": "devices", "station": …}`` serves a station; either ends with standard input.
"""

from __future__ import annotations

import json
import sys
import threading
from contextlib import ExitStack

import numpy as np

from drivers.config import StationConfig
from drivers.device_host import DeviceHost
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.emulators.netft_box import NetFtBox
from drivers.wire.station_bus import station_bus

#: width, height and rate of each camera's pictures
CAMERAS = {"camera": (1280, 720, 10.0), "finger_left": (320, 240, 30.0), "finger_right": (320, 240, 30.0)}


def station(ports: dict[str, int], endpoint: str) -> StationConfig:
    """A station of real backends at emulated devices: a force/torque sensor, a tag camera and two fingers."""
    wrist = {"kind": "force_torque", "backend": "real", "driver": "ati_netft", "mount": "wrist", "address": "127.0.0.1"}
    wrist |= {"port": ports["rdt"], "http_port": ports["page"]}  # type: ignore[dict-item]
    devices = {"wrist_ft": wrist}
    for name, (width, height, rate) in CAMERAS.items():
        address = f"http://127.0.0.1:{ports[name]}/stream"
        common = {"backend": "real", "address": address, "width": width, "height": height, "rate": rate}
        if name == "camera":
            own = {"kind": "tag_camera", "driver": "tag_camera", "position": [0, -0.55, 0.07], "look_at": [0, 0, 0.07]}
        else:
            finger = name.removeprefix("finger_")
            own = {"kind": "tactile", "driver": "gelslim_stream", "sensor": "gelslim", "finger": finger}
        devices[name] = common | own  # type: ignore[assignment]
    return StationConfig.model_validate({"name": "idle", "bus": {"endpoint": endpoint}, "devices": devices})


def _emulators() -> None:
    with ExitStack() as stack:
        box = stack.enter_context(NetFtBox(lambda: (0.0, 0.0, -3.0, 0.0, 0.0, 0.0)))
        ports = {"rdt": box.port, "page": box.http_port}
        for name, (width, height, rate) in CAMERAS.items():
            picture = np.random.default_rng(0).integers(0, 255, (height // 16, width // 16, 3), dtype=np.uint8)
            large = np.repeat(np.repeat(picture, 16, 0), 16, 1)
            camera = stack.enter_context(MjpegCamera(lambda large=large: large, rate))
            ports[name] = int(camera.address.rsplit(":", 1)[1].split("/")[0])
        _tell(ports=ports)
        sys.stdin.read()


def _devices(config: StationConfig) -> None:
    with station_bus(config, "device") as bus:
        host = DeviceHost(config, bus)
        threading.Thread(target=lambda: (sys.stdin.read(), host.stop()), name="input", daemon=True).start()
        host.run(lambda: _tell(serving=True))


def main() -> None:
    """Entry of the process."""
    order = json.loads(sys.stdin.readline())
    if order["role"] == "emulators":
        _emulators()
    else:
        _devices(StationConfig.model_validate(order["station"]))


def _tell(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
