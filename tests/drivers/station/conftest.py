"""An open station in a process of its own."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from drivers.config import StationConfig
from drivers.station import Devices, Station
from drivers.wire.bus import open_buses

from .cases import scene, station


@pytest.fixture(autouse=True)
def nothing_is_left_running() -> Iterator[None]:
    yield
    gc.collect()
    left = open_buses()
    for bus in left:
        bus.close()
    assert not left


@pytest.fixture
def config() -> StationConfig:
    return station()


@pytest.fixture
def devices(config: StationConfig) -> Iterator[Devices]:
    with Station(config).connect() as opened:
        assert opened.simulation is not None
        opened.simulation.reset(0, scene())
        yield opened
