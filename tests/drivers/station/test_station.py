"""The whole way: a simulated host in a process of its own, its devices from here, their streams in a log."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.errors import CommandRefused, DeviceFault, NotConnected
from drivers.interfaces import ArmTarget
from drivers.sim.world import World
from drivers.station import Devices, Station
from drivers.wire.log_reader import LogReader
from mechanics.readings import TruthReading, WrenchReading

from .cases import MASS, scene, station


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
        "sim/arm/safety": 1,  # as its commander took it
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


def test_a_second_client_joins_and_sees_the_same(devices: Devices, config: StationConfig) -> None:
    with Station(config).connect() as second:
        devices.clock.sleep(0.05)
        second.clock.sleep(0.05)
        here = [r.stamp.capture_ns for r in devices.force_torque("wrist").since(0)]
        there = [r.stamp.capture_ns for r in second.force_torque("wrist").since(0)]
        assert there == [i * 1_000_000 for i in range(1, 101)]
        assert set(here) <= set(there)
    devices.clock.sleep(0.01)  # the host outlives its guests


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


def test_a_camera_renders_when_asked_and_the_picture_is_logged(tmp_path: Path) -> None:
    camera = {"kind": "tag_camera", "position": (0, -0.55, 0.12), "look_at": (0, 0, 0.12), "width": 640, "height": 480}
    with Station(station(camera=camera)).connect() as devices, devices.log(tmp_path / "log.mcap") as log:
        assert devices.simulation is not None
        tagged = scene()
        tagged["grasped"]["tags"] = [{"id": 10, "size": 0.036, "pose": (0.0, -0.04, 0.0)}]
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
