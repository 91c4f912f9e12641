"""A host in real time: its readings are as old as they say, and a command waits for one picture at most."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.config import TactileConfig, TagCameraConfig, WorldConfig
from drivers.sim import host as hosts
from drivers.sim import world as worlds
from drivers.sim.host import Host
from drivers.sim.world import World
from drivers.wire import messages, topics
from drivers.wire.bus import Bus
from experiments.ports import free_endpoint
from tests.drivers.by_hand import Time


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> Time:
    clock = Time()
    monkeypatch.setattr(hosts, "time", clock)
    monkeypatch.setattr(worlds, "time", clock)
    return clock


def reset(scene: Any) -> bytes:
    return messages.encode(
        messages.message(messages.RESET, seed=0, scene=scene.model_dump_json(), world="", session="", begin_ns=0)
    )


@contextmanager
def hosted(config: Any) -> Iterator[Host]:
    """A host on a bus of its own that nobody runs; its servers end with it."""
    with Bus(free_endpoint(), listen=True, shared_memory=False) as bus:
        host = Host(config, bus)
        host._truth_stream = host.desk.publisher(topics.WORLD, "truth", messages.TRUTH)
        try:
            yield host
        finally:
            host._withdraw()
            host._truth_stream.close()


@pytest.fixture
def realtime(station: Any) -> Any:
    return station.model_copy(update={"world": WorldConfig(clock="realtime")})


def test_what_a_reset_takes_makes_no_reading_old(
    realtime: Any, make_scene: Any, by_hand: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    restart = World._restart

    def slowly(world: World, *args: Any) -> None:
        by_hand.now += 0.4
        restart(world, *args)

    monkeypatch.setattr(World, "_restart", slowly)
    monkeypatch.setattr(Host, "_heard", lambda _: True)  # somebody takes a stream
    with hosted(realtime) as host:
        host._reset(reset(make_scene()))
        assert host._now_ns() == pytest.approx(by_hand.time_ns(), abs=1000)
        for _ in range(5):
            by_hand.now += 0.003
            host._pace()
        assert abs(host._now_ns() - by_hand.time_ns()) <= 6_000_000, "the few steps that are still to come"


def test_time_that_is_given_up_is_followed_by_readings_before_anybody_is_served(
    realtime: Any, make_scene: Any, by_hand: Time
) -> None:
    with hosted(realtime) as host:
        wrench = host.world.devices["wrist_ft"]
        wrench.connect()
        host._reset(reset(make_scene()))
        by_hand.now += 3.0  # the machine stood still
        host._pace()
        newest = wrench.latest(0.0)  # type: ignore[attr-defined]
        age_ns = by_hand.time_ns() - (newest.stamp.capture_ns + host.skipped_ns)
        assert abs(age_ns) <= 2_000_000, "one piece of the world's time"


def test_a_world_that_nobody_listens_to_steps_by_twenty_milliseconds(
    realtime: Any, make_scene: Any, by_hand: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hosted(realtime) as host:
        host._reset(reset(make_scene()))
        begin = host.world.now_ns()
        by_hand.now += 0.019
        assert host._pace() == pytest.approx(0.001)
        assert host.world.now_ns() == begin
        by_hand.now += 0.0015
        assert host._pace() == 0.0
        assert host.world.now_ns() == begin + 20_000_000
        monkeypatch.setattr(Host, "_heard", lambda _: True)
        by_hand.now += 0.002
        assert host._pace() == 0.0
        assert host.world.now_ns() == begin + 22_000_000


def test_cameras_take_their_frames_one_at_a_time_and_at_their_rates(realtime: Any) -> None:
    finger = TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", width=64, height=48)
    camera = TagCameraConfig(kind="tag_camera", rate=10.0, position=(0, -0.5, 0), look_at=(0, 0, 0))
    devices = {"left": finger, "right": finger.model_copy(update={"finger": "right"}), "camera": camera}
    config = realtime.model_copy(update={"devices": realtime.devices | devices})
    taken: list[str] = []
    with hosted(config) as host:
        host._servers = {  # type: ignore[assignment]
            name: SimpleNamespace(device=host.world.devices[name], capture_if_wanted=lambda n=name: taken.append(n))
            for name in devices
        }
        for step in range(1500):  # three seconds of 2 ms
            before = len(taken)
            host._capture(step * 0.002)
            assert len(taken) - before <= 1
        assert sorted(taken[:3]) == ["camera", "left", "right"], "nobody is passed over"
        assert {name: taken.count(name) for name in devices} == {"left": 90, "right": 90, "camera": 30}
        host._servers.clear()
