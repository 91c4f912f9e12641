"""The process that serves a station: how it starts, who may join it, and what its death looks like from here."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.errors import DeviceFault, DriverError, NotConnected
from drivers.interfaces import ArmTarget
from drivers.station import Devices, Station
from drivers.wire.bus import Bus
from drivers.wire.log_reader import LogReader
from drivers.wire.remote import RemoteSensor
from drivers.wire.session import listening

from .cases import MASS, scene, station

ROOT = Path(__file__).parents[3]


def gone(pid: int, timeout: float = 5.0) -> bool:
    """Wait for a process to end, whoever's child it is."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([process], [], [], timeout)[0])  # readable once it has ended, reaped or not
    finally:
        os.close(process)


@pytest.mark.parametrize(("how", "bound"), [(signal.SIGKILL, 1.0), (signal.SIGSTOP, 2.0)], ids=["killed", "frozen"])
def test_a_dead_host_is_noticed_by_every_call(config: StationConfig, how: signal.Signals, bound: float) -> None:
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        assert devices.host is not None
        devices.simulation.reset(0, scene())
        devices.arm.acquire("test")
        devices.clock.sleep(0.1)
        pid = devices.host.pid
        struck: list[float] = []

        def strike(_: object) -> None:
            if not struck:
                struck.append(time.monotonic())
                os.kill(pid, how)

        devices.force_torque("wrist").listen(strike)  # so that it dies while it advances the world
        with pytest.raises(DeviceFault, match="world"):
            while True:
                devices.clock.sleep(0.5)
        assert time.monotonic() - struck[0] < bound
        calls: dict[str, Callable[[], object]] = {
            "arm": lambda: devices.arm.command(ArmTarget(np.zeros(3), np.zeros(3), 0.1)),
            "wrist_ft": devices.force_torque("wrist").latest,
            "gripper": lambda: devices.gripper.grasp(10.0),
        }
        for device in (devices.arm, devices.force_torque("wrist"), devices.gripper):
            assert isinstance(device, RemoteSensor) and device._watch is not None
            assert device._watch.wait(2.0), "the news of each device's death travels by itself"
        for name, call in calls.items():
            with pytest.raises(DeviceFault, match=name):
                call()
        closing = time.monotonic()
    assert time.monotonic() - closing < 5.0
    assert gone(pid)


def test_a_log_survives_the_death_of_the_host(config: StationConfig, tmp_path: Path) -> None:
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        assert devices.host is not None
        with devices.log(tmp_path / "log.mcap") as log:
            devices.simulation.reset(0, scene())
            devices.clock.sleep(0.5)
            os.kill(devices.host.pid, signal.SIGKILL)
            with pytest.raises(DriverError):
                devices.clock.sleep(0.5)
    reader = LogReader(tmp_path / "log.mcap")
    assert reader.counts()["sim/wrist_ft/wrench"] == log.counts["sim/wrist_ft/wrench"] >= 500
    assert reader.complete


def test_in_real_time_a_sleep_ends_when_the_host_dies() -> None:
    with Station(station("realtime")).connect() as devices:
        assert devices.host is not None
        os.kill(devices.host.pid, signal.SIGKILL)
        with pytest.raises(DeviceFault, match="died"):
            devices.clock.sleep(20.0)


def test_closing_ends_and_reaps_the_host(config: StationConfig) -> None:
    with Station(config).connect() as devices:
        assert devices.host is not None
        pid = devices.host.pid
        assert listening(config.bus.endpoint)
    assert not Path(f"/proc/{pid}").exists()
    assert not listening(config.bus.endpoint)


_RUNNER = """
import json, sys
from drivers.config import StationConfig
from drivers.station import Station
with Station(StationConfig.model_validate_json(sys.argv[1])).connect() as devices:
    sys.stdout.write(f"{devices.host.pid}\\n"); sys.stdout.flush()
    sys.stdin.read()
"""


def test_the_host_ends_when_its_starter_is_killed(config: StationConfig) -> None:
    runner = subprocess.Popen(
        [sys.executable, "-c", _RUNNER, config.model_dump_json()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
    )
    assert runner.stdin is not None and runner.stdout is not None
    with runner.stdin, runner.stdout:
        pid = int(runner.stdout.readline())
        runner.kill()
        runner.wait(10)
        assert gone(pid)


def test_an_interrupt_from_the_keyboard_does_not_reach_the_host(config: StationConfig) -> None:
    with Station(config).connect() as devices:
        assert devices.host is not None
        assert os.getpgid(devices.host.pid) != os.getpgid(0)


def test_a_host_of_another_station_file_is_refused(devices: Devices, config: StationConfig) -> None:
    assert config.world is not None
    other = config.model_copy(update={"world": config.world.model_copy(update={"timestep": 0.0005})})
    with pytest.raises(NotConnected, match=r"another world\.timestep"), Station(other).connect():
        pass


def test_a_host_takes_profile_and_stiffness_from_the_run_that_joins(devices: Devices, config: StationConfig) -> None:
    assert config.world is not None
    half = config.world.model_copy(update={"stiffness_scale": 0.5})
    softer = config.model_copy(update={"world": half})
    with Station(softer).connect() as joined:
        assert joined.simulation is not None
        sags = []
        for world in (config.world, half):
            joined.simulation.reset(0, scene(), world.model_dump())
            truth = joined.simulation.truth()
            sags.append(truth.ee[1] - truth.go[1])
        assert sags[1] - sags[0] == pytest.approx(MASS * 9.81 / 2000.0, rel=1e-3)  # half the stiffness, twice the sag


def test_a_foreign_program_at_the_endpoint_is_told(config: StationConfig) -> None:
    port = int(config.bus.endpoint.rsplit(":", 1)[1])
    config = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": 1.0})})
    with socket.socket() as mute:
        mute.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        mute.bind(("127.0.0.1", port))
        mute.listen()
        start = time.monotonic()
        with pytest.raises(NotConnected, match="another program"), Station(config).connect():
            pass
        assert time.monotonic() - start < 5.0


def test_a_bus_without_the_station_is_told(config: StationConfig) -> None:
    config = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": 1.0})})
    with (
        Bus(config.bus.endpoint, listen=True, shared_memory=False),
        pytest.raises(NotConnected, match="does not serve station 'sim'"),
        Station(config).connect(),
    ):
        pass


def test_a_host_that_cannot_start_says_why(config: StationConfig) -> None:
    second_arm = station(other_arm={"kind": "arm"})
    with pytest.raises(NotConnected, match="one arm"), Station(second_arm).connect():
        pass


def test_a_lab_station_is_not_started_from_here() -> None:
    config = station().model_copy(update={"world": None})
    with pytest.raises(NotConnected, match="extrinsic serve"), Station(config).connect():
        pass
