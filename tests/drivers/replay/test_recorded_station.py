"""What a station gave its client, and what the log of it gives: the same readings, of every kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.replay import Recording
from drivers.sim.host_thread import HostThread
from drivers.station import Station
from tests.drivers.replay.test_lockstep import same
from tests.drivers.station.cases import scene, station

CAMERA = {
    "kind": "tag_camera",
    "width": 320,
    "height": 240,
    "focal": 300.0,
    "position": (0, -0.5, 0.2),
    "look_at": (0, 0, 0.2),
}
GEL = {"kind": "tactile", "sensor": "gelslim", "finger": "left", "width": 160, "height": 120}


@pytest.fixture(scope="module")
def lived(tmp_path_factory) -> tuple[Path, dict[str, list], dict[str, Any], Any]:
    """A second at a simulated lab: the log, what each device gave, what it said of itself, the untouched gel."""
    path = tmp_path_factory.mktemp("lived") / "log.mcap"
    config = station(camera=CAMERA, gel=GEL)
    with Station(config).connect(HostThread) as devices:
        world: Any = devices.simulation
        with devices.log(path) as log:
            world.reset(3, scene(), {"profile": "lab"})
            devices.tell_descriptions(log)
            for _ in range(5):
                devices.clock.sleep(0.2)
                devices.camera.capture()
                devices.tactile("left").capture()
            untouched = devices.tactile("left").reference()
            given = {name: device.since(0) for name, device in devices.items()}  # type: ignore[attr-defined]
        said = {name: device.describe() for name, device in devices.items()}
    return path, given, said, untouched


def test_every_reading_of_every_kind_is_played_as_the_client_had_it(lived) -> None:
    path, given, said, untouched = lived
    with Recording(path).devices() as devices:
        devices.clock.sleep(2.0)
        assert set(devices) == set(given) and all(given.values())
        for name, readings in given.items():
            played: Any = devices[name]
            found = {reading.stamp.sequence: reading for reading in played.since(0)}
            assert found.keys() >= {reading.stamp.sequence for reading in readings}, name
            assert all(same(found[reading.stamp.sequence], reading) for reading in readings), name
            assert played.describe().extra == said[name].extra and played.describe().serial == said[name].serial
        gel: Any = devices["gel"]
        np.testing.assert_array_equal(gel.reference(), untouched)


def test_by_the_station_file_of_the_run_they_are_found_by_their_roles(lived) -> None:
    path = lived[0]
    config = station(camera=CAMERA, gel=GEL, elsewhere={"kind": "tag_camera", **CAMERA})
    with Recording(path).devices(config) as devices:
        assert "elsewhere" not in devices
        devices.clock.sleep(0.5)
        assert devices.arm.latest().stamp.capture_ns <= devices.clock.now_ns()
        assert devices.force_torque("wrist") is devices["wrist_ft"] and devices.tactile("left") is devices["gel"]
