"""Looking on at a station: what is told of it while it is not there, runs, is stopped, dies and comes back."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from drivers import safety
from drivers.config import StationConfig
from drivers.station import Station
from drivers.status import DeviceStatus
from drivers.status_watch import StationWatch

from .cases import scene, station

Rows = dict[str, DeviceStatus]


def seen(looking: StationWatch, wanted: Callable[[Rows], bool], seconds: float = 30.0) -> Rows:
    """The rows once they are as ``wanted``."""
    deadline, pause = time.monotonic() + seconds, threading.Event()
    while True:
        rows = {row.name: row for row in looking.look()}
        if wanted(rows):
            return rows
        assert time.monotonic() < deadline, rows
        pause.wait(0.02)


def all_alive(rows: Rows) -> bool:
    return all(row.alive for row in rows.values())


def none_alive(rows: Rows) -> bool:
    return not any(row.alive for row in rows.values())


@pytest.fixture
def config() -> StationConfig:
    return station("realtime")


def test_a_station_that_is_not_there_is_told_as_such_and_looking_ends_at_once(config: StationConfig) -> None:
    with StationWatch(config) as looking:
        rows = seen(looking, lambda rows: "nothing listens" in rows["arm"].note)
        assert config.bus.endpoint in rows["gripper"].note
        assert none_alive(rows)
        begun = time.monotonic()
    assert time.monotonic() - begun < 2.0


def test_a_watched_station_tells_rates_lease_and_stop_and_loses_no_reading_to_it(config: StationConfig) -> None:
    with StationWatch(config) as looking, Station(config).connect() as devices:
        assert devices.simulation is not None
        rows = seen(looking, all_alive)
        assert "stands still until a run moves it" in rows["wrist_ft"].note
        devices.simulation.reset(0, scene())
        told = {"arm": 100, "wrist_ft": 1000, "table_ft": 1000}  # Hz, as the devices are by default
        rows = seen(looking, lambda rows: all((rows[name].rate or 0) > 0.9 * told[name] for name in told))
        for name, rate in told.items():
            row = rows[name]
            assert row.rate == pytest.approx(rate, rel=0.1)
            assert row.age is not None and 0 <= row.age < 1.0
            assert row.gaps == 0
        assert rows["arm"].arm is not None and rows["arm"].arm.holder is None
        with devices.arm.lease("alice"):
            seen(looking, lambda rows: rows["arm"].arm is not None and rows["arm"].arm.holder == "alice")
        safety.stop(config)
        rows = seen(looking, lambda rows: rows["arm"].arm is not None and bool(rows["arm"].arm.stopped))
        assert "stopped: `extrinsic stop` by" in rows["arm"].note


def test_whoever_watches_takes_views_and_no_stream(config: StationConfig) -> None:
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        devices.force_torque("wrist").close()  # what is open here takes its stream
        devices.simulation.reset(0, scene())
        with StationWatch(config) as looking:
            seen(looking, lambda rows: (rows["wrist_ft"].rate or 0) > 900)
            assert devices.simulation.counts()["sim/wrist_ft/wrench"] == 0


def test_a_station_that_dies_and_comes_back_is_followed(config: StationConfig) -> None:
    with StationWatch(config) as looking:
        for _ in range(2):
            with Station(config).connect():
                seen(looking, all_alive)
            rows = seen(looking, none_alive)
            assert rows["arm"].note.startswith("gone for ")
