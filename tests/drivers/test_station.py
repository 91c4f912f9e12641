"""The whole way: a simulated host in a process of its own, its devices from here, their streams in a log."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.errors import CommandRefused, DeviceFault, DriverError, NotConnected
from drivers.interfaces import ArmTarget
from drivers.sim.world import World
from drivers.station import Devices, Station, listening
from drivers.wire.bus import Bus, open_buses
from drivers.wire.log_reader import LogReader
from mechanics.readings import TruthReading, WrenchReading

ROOT = Path(__file__).parents[2]
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
            "bus": {"endpoint": f"tcp/127.0.0.1:{port}", "timeout": 5.0},
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


def gone(pid: int, timeout: float = 5.0) -> bool:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.01)
    return False


def drive(devices: Devices, steps: int) -> None:
    with devices.arm.lease("test"):
        for i in range(steps):
            devices.arm.command(ArmTarget(np.array([1e-4 * i, 0.2, 0.0]), np.zeros(3), 0.02))
            devices.clock.sleep(0.02)


def test_in_lockstep_every_reading_is_here_when_sleep_returns(devices: Devices) -> None:
    wrist, arm = devices.force_torque("wrist"), devices.arm
    seen = 0
    for i in range(1, 51):
        devices.clock.sleep(0.02)
        assert devices.clock.now_ns() == i * 20_000_000
        assert [r.stamp.sequence for r in wrist.since((i - 1) * 20_000_000)] == list(range(20 * (i - 1), 20 * i))
        assert arm.latest().stamp.capture_ns == i * 20_000_000
        seen += 20
    assert wrist.gaps == arm.gaps == 0


def test_the_arm_is_where_it_was_told_to_be(devices: Devices) -> None:
    with devices.arm.lease("test"):
        devices.arm.command(ArmTarget(np.array([0.01, 0.21, 0.1]), np.zeros(3), 0.1))
        devices.clock.sleep(0.2)
    assert np.allclose(devices.arm.latest().pose, [0.01, 0.21, 0.1], atol=1e-12)
    assert devices.simulation is not None
    assert np.allclose(devices.simulation.truth().ee, [0.01, 0.21, 0.1], atol=1e-9)


def test_the_wrist_carries_the_weight_across_the_wire(devices: Devices) -> None:
    devices.clock.sleep(0.5)
    assert devices.force_torque("wrist").latest().wrench[2] == pytest.approx(-MASS * 9.81, abs=1e-3)


def test_the_log_holds_as_many_messages_as_were_published(config: StationConfig, tmp_path: Path) -> None:
    with Station(config).connect() as devices:
        simulation = devices.simulation
        assert simulation is not None
        with devices.log(tmp_path / "log.mcap") as log:
            simulation.reset(0, scene())
            drive(devices, 100)
            published = simulation.counts()
        assert log.counts == published
        assert log.overflows == 0
        assert log.gaps == {}
    expected = {
        "sim/arm/pose": 200,
        "sim/arm/target": 100,
        "sim/wrist_ft/wrench": 2000,
        "sim/table_ft/wrench": 2000,
        "sim/gripper/state": 40,
        "sim/world/truth": 101,
    }
    assert published == expected
    reader = LogReader(tmp_path / "log.mcap")
    assert reader.counts() == expected
    assert reader.complete
    truths = [value for _, value in reader.values({"sim/world/truth"})]
    assert all(isinstance(value, TruthReading) for value in truths)
    wrenches = [value for _, value in reader.values({"sim/wrist_ft/wrench"})]
    assert [v.stamp.capture_ns for v in wrenches if isinstance(v, WrenchReading)] == [
        i * 1_000_000 for i in range(1, 2001)
    ]


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    logs = []
    for name in ("a.mcap", "b.mcap"):
        with Station(station()).connect() as devices, devices.log(tmp_path / name) as log:
            assert devices.simulation is not None
            devices.simulation.reset(3, scene())
            drive(devices, 20)
        assert log.overflows == 0
        by_topic: dict[str, list[bytes]] = {}
        for message in LogReader(tmp_path / name).messages():
            if not message.topic.endswith("target"):  # names its commander, which differs
                by_topic.setdefault(message.topic, []).append(message.payload)
        logs.append(by_topic)
    assert logs[0] == logs[1]


def test_streams_named_in_the_station_file_are_left_out(config: StationConfig, tmp_path: Path) -> None:
    config = config.model_copy(update={"log": config.log.model_copy(update={"omit": ("table_ft/wrench",)})})
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        with devices.log(tmp_path / "log.mcap") as log:
            devices.simulation.reset(0, scene())
            devices.clock.sleep(0.1)
    assert log.counts["sim/wrist_ft/wrench"] == 100
    assert "sim/table_ft/wrench" not in log.counts


def test_a_reset_begins_a_new_time(devices: Devices) -> None:
    devices.clock.sleep(0.1)
    assert devices.simulation is not None
    devices.simulation.reset(1, scene())
    assert devices.clock.now_ns() == 0
    assert devices.force_torque("wrist").since(-1) == []
    devices.clock.sleep(0.01)
    assert [r.stamp.sequence for r in devices.force_torque("wrist").since(-1)] == list(range(10))
    assert devices.force_torque("wrist").gaps == 0


def test_a_reset_is_refused_while_another_client_commands(devices: Devices, config: StationConfig) -> None:
    with Station(config).connect() as second:
        assert second.host is None
        assert second.simulation is not None
        with devices.arm.lease("first"):
            with pytest.raises(CommandRefused, match="first commands arm"):
                second.simulation.reset(0, scene())
            assert devices.simulation is not None
            devices.simulation.reset(0, scene())  # its own lease is no obstacle
        second.simulation.reset(0, scene())


def test_a_scene_that_cannot_be_is_refused_with_the_reason(devices: Devices) -> None:
    assert devices.simulation is not None
    bad = scene()
    bad["grasped"]["mass"] = -1.0
    with pytest.raises(CommandRefused, match="mass"):
        devices.simulation.reset(0, bad)
    devices.clock.sleep(0.01)  # the world is as it was


def test_before_the_first_reset_devices_describe_themselves_and_time_cannot_pass(config: StationConfig) -> None:
    with Station(config).connect() as devices:
        assert devices.arm.describe().kind == "arm"
        assert devices.force_torque("table").describe().extra["mount"] == "table"
        with pytest.raises(DeviceFault, match="no scene"):
            devices.clock.sleep(0.1)


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

        def strike() -> None:
            struck.append(time.monotonic())
            os.kill(pid, how)

        timer = threading.Timer(0.1, strike)
        timer.start()
        with pytest.raises(DeviceFault, match="world"):
            while True:
                devices.clock.sleep(0.5)
        assert time.monotonic() - struck[0] < bound
        timer.join()
        calls: dict[str, Callable[[], object]] = {
            "arm": lambda: devices.arm.command(ArmTarget(np.zeros(3), np.zeros(3), 0.1)),
            "wrist_ft": devices.force_torque("wrist").latest,
            "gripper": lambda: devices.gripper.grasp(10.0),
        }
        for name, call in calls.items():
            start = time.monotonic()
            with pytest.raises(DeviceFault, match=name):
                while time.monotonic() - start < 2.0:  # the news of each device's death travels by itself
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


def test_a_second_client_joins_and_sees_the_same(devices: Devices, config: StationConfig) -> None:
    with Station(config).connect() as second:
        devices.clock.sleep(0.05)
        second.clock.sleep(0.05)
        here = [r.stamp.capture_ns for r in devices.force_torque("wrist").since(0)]
        there = [r.stamp.capture_ns for r in second.force_torque("wrist").since(0)]
        assert there == [i * 1_000_000 for i in range(1, 101)]
        assert set(here) <= set(there)
    devices.clock.sleep(0.01)  # the host outlives its guests


def test_a_host_of_another_station_file_is_refused(devices: Devices, config: StationConfig) -> None:
    other = config.model_copy(update={"world": config.world.model_copy(update={"timestep": 0.0005})})  # type: ignore
    with pytest.raises(NotConnected, match=r"another world\.timestep"), Station(other).connect():
        pass


def test_a_host_takes_profile_and_stiffness_from_the_run_that_joins(devices: Devices, config: StationConfig) -> None:
    softer = config.model_copy(update={"world": config.world.model_copy(update={"stiffness_scale": 0.5})})  # type: ignore
    with Station(softer).connect() as joined:
        assert joined.simulation is not None and softer.world is not None
        sags = []
        for world in (config.world, softer.world):
            joined.simulation.reset(0, scene(), world.model_dump())  # type: ignore[union-attr]
            truth = joined.simulation.truth()
            sags.append(truth.ee[1] - truth.go[1])
        assert sags[1] - sags[0] == pytest.approx(MASS * 9.81 / 2000.0, rel=1e-3)  # half the stiffness, twice the sag


def test_a_new_grasp_over_the_bus_is_that_of_the_seed_and_the_trial(devices: Devices, config: StationConfig) -> None:
    simulation = devices.simulation
    assert simulation is not None and config.world is not None
    lab = config.world.model_copy(update={"profile": "lab"})
    here = World(config.model_copy(update={"world": lab}))
    for trial in (5, 6):
        simulation.reset(3, scene(), lab.model_dump())
        simulation.regrasp(trial)
        here.reset(3, scene())
        here.regrasp(trial)
        assert devices.clock.now_ns() == 0
        np.testing.assert_array_equal(simulation.truth().go, here.truth().go)
    with pytest.raises(CommandRefused, match="Trials count from 0"):
        simulation.regrasp(-1)


def test_dropouts_are_counted_by_who_receives_over_the_bus(devices: Devices, tmp_path: Path) -> None:
    profile = tmp_path / "lossy.yaml"
    profile.write_text("force_torque: {dropout: 0.02}\n")
    assert devices.simulation is not None
    devices.simulation.reset(0, scene(), {"profile": str(profile)})
    devices.clock.sleep(2.0)
    wrist = devices.force_torque("wrist")
    received = [reading.stamp.sequence for reading in wrist.since(-1)]
    assert wrist.gaps == received[-1] - received[0] + 1 - len(received) > 10
    assert devices.arm.gaps == 0


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


def test_all_devices_that_fail_to_open_are_told_in_one_tree(devices: Devices, config: StationConfig) -> None:
    """A host serves a station file's devices; from a client's side two of them are missing."""
    from drivers.wire.client import REMOTES

    class Broken(REMOTES["force_torque"]):  # type: ignore[misc]
        def _open(self, timeout: float) -> None:
            raise NotConnected(self.name, "connect", "cable out", "Plug it in")

    original = REMOTES["force_torque"]
    REMOTES["force_torque"] = Broken
    try:
        with pytest.raises(NotConnected) as raised, Station(config).connect():
            pass
    finally:
        REMOTES["force_torque"] = original
    assert [child.device for child in raised.value.children] == ["wrist_ft", "table_ft"]
    assert "wrist_ft: connect: cable out" in str(raised.value)


def test_a_role_that_the_station_lacks_is_told(devices: Devices) -> None:
    with pytest.raises(NotConnected, match="tag_camera"):
        _ = devices.camera


def test_in_real_time_the_world_keeps_the_pace_of_the_wall() -> None:
    with Station(station("realtime")).connect() as devices:
        assert devices.simulation is not None
        assert not devices.clock.lockstep
        devices.simulation.reset(0, scene())
        wrist = devices.force_torque("wrist")
        first = wrist.latest(2.0).stamp
        start = time.monotonic()
        devices.clock.sleep(1.0)
        last, waited = wrist.latest().stamp, time.monotonic() - start
        assert abs(last.capture_ns - time.time_ns()) < 1e9, "stamps are Unix time"
        assert (last.capture_ns - first.capture_ns) * 1e-9 == pytest.approx(waited, abs=0.4)
        assert wrist.gaps == 0
        with pytest.raises(CommandRefused, match="real time"):
            devices.clock.lockstep = True
            devices.clock.sleep(0.1)
        with devices.arm.lease("test"):
            devices.arm.command(ArmTarget(np.array([0.0, 0.21, 0.0]), np.zeros(3), 0.1))


def test_in_real_time_a_sleep_ends_when_the_host_dies() -> None:
    with Station(station("realtime")).connect() as devices:
        assert devices.host is not None
        os.kill(devices.host.pid, signal.SIGKILL)
        with pytest.raises(DeviceFault, match="died"):
            devices.clock.sleep(20.0)


def test_a_camera_renders_when_asked_and_the_picture_is_logged(tmp_path: Path) -> None:
    camera = {"kind": "tag_camera", "position": (0, -0.55, 0.12), "look_at": (0, 0, 0.12), "width": 640, "height": 480}
    with Station(station(camera=camera)).connect() as devices, devices.log(tmp_path / "log.mcap") as log:
        assert devices.simulation is not None
        tagged = scene()
        tagged["grasped"]["tag"] = {"id": 10, "size": 0.036, "pose": (0.0, -0.04, 0.0)}
        devices.simulation.reset(0, tagged)
        devices.clock.sleep(0.5)
        assert devices.simulation.counts()["sim/camera/detections"] == 0, "nothing is rendered unasked in lockstep"
        reading = devices.camera.capture()
        assert [d.id for d in reading.detections] == [10]
        assert reading.stamp.capture_ns == devices.clock.now_ns() == 500_000_000
        picture = devices.camera.image()
        assert picture is not None
        assert picture.image.shape == (480, 640)
        published = devices.simulation.counts()
        assert published["sim/camera/image"] == 1
        log.drain()
        assert log.counts == {topic: count for topic, count in published.items() if count}
