"""A station hosted by a thread of this process: the same messages as from a process, and an end that spoils nothing."""

from __future__ import annotations

import gc
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers import hosting
from drivers.config import StationConfig
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected
from drivers.hosting import HostProcess
from drivers.interfaces import ArmTarget
from drivers.sim import host_thread
from drivers.sim.host import Inbox
from drivers.sim.host_thread import HostThread
from drivers.sim.world import World
from drivers.station import Devices, Hosting, Station
from drivers.wire.log_reader import LogReader
from drivers.wire.session import listening

from .cases import scene, station


def staged(devices: Devices) -> Devices:
    assert devices.simulation is not None
    devices.simulation.reset(3, scene())
    return devices


def drive(devices: Devices, steps: int) -> None:
    with devices.arm.lease("test"):
        for i in range(steps):
            devices.arm.command(ArmTarget(np.array([1e-4 * i, 0.2, 0.0]), np.zeros(3), 0.02))
            devices.clock.sleep(0.02)


def logged(file: Path, host: Hosting) -> tuple[dict[str, list[tuple[int, int, bytes]]], dict[str, int]]:
    """What a short run leaves in its log, by topic, and what its station counted."""
    with Station(station()).connect(host) as devices, devices.log(file) as log:
        drive(staged(devices), 20)
        assert devices.simulation is not None
        counts = devices.simulation.counts()
    assert log.overflows == 0
    assert log.gaps == {}
    by_topic: dict[str, list[tuple[int, int, bytes]]] = {}
    for message in LogReader(file).messages():
        by_topic.setdefault(message.topic, []).append((message.sequence, message.publish_ns, message.payload))
    return by_topic, counts


def test_its_messages_are_those_of_a_host_process(tmp_path: Path) -> None:
    here, counted_here = logged(tmp_path / "thread.mcap", HostThread)
    there, counted_there = logged(tmp_path / "process.mcap", HostProcess)
    assert counted_here == counted_there
    assert {topic: len(messages) for topic, messages in here.items()} == counted_here
    for topic in here.keys() - {"sim/arm/target"}:  # names its commander, which differs
        assert here[topic] == there[topic]


def test_it_listens_at_the_endpoint_and_others_may_join(config: StationConfig) -> None:
    with Station(config).connect(HostThread) as devices:
        staged(devices)
        assert devices.host is not None
        assert devices.host.pid == os.getpid()
        with Station(config).connect() as second:
            assert second.host is None
            second.clock.sleep(0.05)
            stamps = [reading.stamp.capture_ns for reading in second.force_torque("wrist").since(0)]
            assert stamps == [i * 1_000_000 for i in range(1, 51)]
        devices.clock.sleep(0.01)
    assert not listening(config.bus.endpoint)
    with pytest.raises(NotConnected, match="there is none"):
        _ = devices.host.pid


def test_it_leaves_the_signals_of_its_process_alone(config: StationConfig) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    with Station(config).connect(HostThread):
        assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before


def test_a_host_that_cannot_start_says_why() -> None:
    with pytest.raises(NotConnected, match="one arm"), Station(station(other={"kind": "arm"})).connect(HostThread):
        pass


def test_an_endpoint_that_is_taken_is_told(config: StationConfig) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", int(config.bus.endpoint.rsplit(":", 1)[1])))  # and does not listen: nobody joins it
        with pytest.raises(NotConnected, match="listen at"), Station(config).connect(HostThread):
            pass


# -- it fails --------------------------------------------------------------------------------------------------------


def broken_inbox(monkeypatch: pytest.MonkeyPatch, devices: Devices) -> None:
    """The host's loop fails at its next turn, in nobody's service."""

    def serve(*_: object) -> None:
        raise RuntimeError("the inbox is torn")

    monkeypatch.setattr(Inbox, "serve", serve)


def exhausted(monkeypatch: pytest.MonkeyPatch, devices: Devices) -> None:
    """The world fails in mid-service, with what no server turns into a reply."""

    def advance(*_: object) -> None:
        raise SystemExit("the world gives up")

    monkeypatch.setattr(World, "advance", advance)


def crashing(monkeypatch: pytest.MonkeyPatch, devices: Devices) -> None:
    assert devices.simulation is not None
    devices.simulation.inject({"kind": "crash", "after": 0.02})


@pytest.mark.parametrize(
    ("fail", "words"),
    [(broken_inbox, "the inbox is torn"), (exhausted, "the world gives up"), (crashing, "world has crashed")],
)
def test_a_host_that_fails_is_noticed_by_every_call_and_the_next_one_works(
    config: StationConfig,
    fail: Callable[[pytest.MonkeyPatch, Devices], None],
    words: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pytest.MonkeyPatch.context() as patch, Station(config).connect(HostThread) as devices:
        staged(devices)
        devices.arm.acquire("test")
        devices.clock.sleep(0.01)
        fail(patch, devices)
        begin = time.monotonic()
        with pytest.raises(DeviceFault, match="died"):
            for _ in range(3):
                devices.clock.sleep(0.05)
        calls: dict[str, Callable[[], object]] = {
            "arm": lambda: devices.arm.command(ArmTarget(np.zeros(3), np.zeros(3), 0.1)),
            "wrist_ft": devices.force_torque("wrist").latest,
            "gripper": lambda: devices.gripper.grasp(10.0),
        }
        for name, call in calls.items():
            with pytest.raises(DeviceFault, match=name):
                while time.monotonic() - begin < 2.0:  # each device vanishes by itself, a little after the world
                    call()
        assert devices.host is not None
        assert words in devices.host.last_words()
        closing = time.monotonic()
    assert time.monotonic() - closing < 5.0
    assert words in caplog.text
    with Station(config).connect(HostThread) as devices:
        staged(devices).clock.sleep(0.05)
        assert devices.host is not None
        assert devices.host.last_words() == ""


def test_a_log_keeps_what_came_before_a_crash(config: StationConfig, tmp_path: Path) -> None:
    with Station(config).connect(HostThread) as devices, devices.log(tmp_path / "log.mcap") as log:
        staged(devices).clock.sleep(0.5)
        crashing(pytest.MonkeyPatch(), devices)
        with pytest.raises(DriverError):
            devices.clock.sleep(0.5)
    reader = LogReader(tmp_path / "log.mcap")
    assert reader.counts()["sim/wrist_ft/wrench"] == log.counts["sim/wrist_ft/wrench"] >= 500
    assert reader.complete


def test_a_killed_host_answers_no_more(config: StationConfig) -> None:
    with Station(config).connect(HostThread) as devices:
        staged(devices)
        assert devices.host is not None
        devices.host.kill()
        assert not listening(config.bus.endpoint)
        begin = time.monotonic()
        with pytest.raises(DeviceFault):
            devices.clock.sleep(0.05)
        assert time.monotonic() - begin < 2.0


def test_a_host_that_hangs_is_cut_off_and_told_of_and_the_next_one_works(
    config: StationConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    go_on, hanging = threading.Event(), threading.Event()
    advance = World.advance

    def hang(world: World, seconds: float) -> int:
        hanging.set()
        go_on.wait(60.0)
        return advance(world, seconds)

    monkeypatch.setattr(hosting, "HOST_STOP", 0.3)
    config = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": 0.5})})
    try:
        with Station(config).connect(HostThread) as devices:
            staged(devices)
            monkeypatch.setattr(World, "advance", hang)
            with pytest.raises(DeviceTimeout, match="no answer in time"):
                devices.clock.sleep(0.01)
            assert hanging.is_set()
            assert not host_thread.stuck()
        assert host_thread.stuck()
        assert "left behind" in caplog.text
        assert not listening(config.bus.endpoint)
        monkeypatch.undo()
        with Station(config).connect(HostThread) as devices:
            staged(devices).clock.sleep(0.05)
    finally:
        go_on.set()
        for thread in host_thread._stuck:
            thread.join(5.0)
    assert not host_thread.stuck()


# -- one after the other ---------------------------------------------------------------------------------------------


def held() -> tuple[int, ...]:
    """Threads of the interpreter and of the process, and open files."""
    gc.collect()
    return threading.active_count(), *(len(list(Path("/proc/self", kind).iterdir())) for kind in ("task", "fd"))


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="counts what the kernel tells of a process")
def test_stations_one_after_the_other_leave_nothing_behind(tmp_path: Path) -> None:
    counts = []
    for i in range(8):
        with Station(station()).connect(HostThread) as devices, devices.log(tmp_path / f"{i}.mcap"):
            drive(staged(devices), 3)
        counts.append(held())
    # the library closes a little after it says so; what each station left would be in every later count
    for kind in range(3):
        assert min(now[kind] for now in counts[4:]) <= max(now[kind] for now in counts[:4])
