"""Devices of one process used from another session: typed errors, streams, the lease."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, NotConnected
from drivers.interfaces import ArmTarget
from drivers.wire import messages, topics
from drivers.wire.arm_server import ArmServer, belongs_to, holder_id, nickname
from drivers.wire.bus import Bus
from drivers.wire.client import RemoteArm, RemoteForceTorque, RemoteGripper
from drivers.wire.link import Link
from drivers.wire.server import Desk, DeviceServer


@pytest.fixture
def wrench_server(desk: Desk, fake_wrench: Any) -> Iterator[DeviceServer]:
    with DeviceServer(desk, fake_wrench) as server:
        yield server


@pytest.fixture
def wrench(wrench_server: DeviceServer, link: Link) -> Iterator[RemoteForceTorque]:
    with RemoteForceTorque("wrist_ft", link, lockstep=True) as device:
        yield device


@pytest.fixture
def arm_server(desk: Desk, fake_arm: Any) -> Iterator[ArmServer]:
    with ArmServer(desk, fake_arm) as server:
        yield server


@pytest.fixture
def arm(arm_server: ArmServer, link: Link) -> Iterator[RemoteArm]:
    with RemoteArm("arm", link, lockstep=True) as device:
        yield device


def target(x: float = 0.1, duration: float = 0.02) -> ArmTarget:
    return ArmTarget(np.array([x, 0.2, 0.3]), np.array([0.0, 0.01, 0.0]), duration)


def arrived(device: Any, sequence: int) -> None:
    assert device._subscription.wait(sequence, None, time.monotonic() + 5)


def test_a_remote_device_describes_itself_as_the_device_does_before_it_is_open(
    wrench_server: DeviceServer, link: Link, fake_wrench: Any
) -> None:
    assert RemoteForceTorque("wrist_ft", link, lockstep=True).describe() == fake_wrench.describe()


def test_readings_arrive_with_their_stamps(wrench: RemoteForceTorque, fake_wrench: Any) -> None:
    for i in range(100):
        fake_wrench.push(i)
    arrived(wrench, 99)
    got = wrench.since(49_000_000)
    assert [r.stamp.sequence for r in got] == list(range(50, 100))
    assert [r.stamp.capture_ns for r in got] == [i * 1_000_000 for i in range(50, 100)]
    assert np.array_equal(wrench.latest().wrench, np.arange(6.0) + 99)
    assert wrench.latest().stamp.frame == "wrist_ft"


def test_a_gap_is_counted(wrench: RemoteForceTorque, fake_wrench: Any) -> None:
    for i in (0, 1, 5, 6, 9):
        fake_wrench.push(i)
    arrived(wrench, 9)
    assert wrench.gaps == 5


def test_a_reset_of_the_source_begins_anew(wrench: RemoteForceTorque, fake_wrench: Any) -> None:
    for i in range(10):
        fake_wrench.push(i)
    arrived(wrench, 9)
    heard = threading.Semaphore(0)
    wrench.listen(lambda _: heard.release())
    for i in range(3):
        fake_wrench.push(i)
    for _ in range(3):
        assert heard.acquire(timeout=5)
    assert [r.stamp.sequence for r in wrench.since(-1)] == [0, 1, 2]
    assert wrench.gaps == 0


def test_listeners_get_decoded_readings(wrench: RemoteForceTorque, fake_wrench: Any) -> None:
    got: list[float] = []
    stop = wrench.listen(lambda reading: got.append(reading.wrench[0]))
    fake_wrench.push(4)
    arrived(wrench, 4)
    stop()
    fake_wrench.push(5)
    arrived(wrench, 5)
    assert got == [4.0]


def test_no_reading_in_time_is_a_timeout(wrench: RemoteForceTorque) -> None:
    with pytest.raises(DeviceTimeout, match="wrist_ft: read"):
        wrench.latest(timeout=0.05)


def test_garbage_on_a_stream_is_a_protocol_error_for_who_reads_it(wrench: RemoteForceTorque, served: Bus) -> None:
    rogue = served.publisher("lab/wrist_ft/wrench", messages.WRENCH)
    rogue.put(b"nonsense", 0, 1)
    arrived(wrench, 0)
    with pytest.raises(Exception, match="no such message") as raised:
        wrench.latest()
    assert type(raised.value).__name__ == "ProtocolError"


def test_what_was_published_during_a_command_is_here_when_it_returns(
    wrench: RemoteForceTorque, fake_wrench: Any
) -> None:
    def tare() -> None:
        for i in range(500):
            fake_wrench.push(i)

    fake_wrench.tare = tare
    wrench.tare()
    assert wrench.latest(0.0001).stamp.sequence == 499


@pytest.mark.parametrize(
    "error",
    [
        CommandRefused("wrist_ft", "tare", "it moves", "Wait"),
        DeviceFault("wrist_ft", "tare", "broken wire", "Mend it", recoverable=True),
        DeviceTimeout("wrist_ft", "tare", "no reading", "Look"),
        NotConnected("wrist_ft", "tare", "cable out", "Plug it in"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_of_the_device_arrives_with_its_type_and_fields(
    wrench: RemoteForceTorque, fake_wrench: Any, error: Any
) -> None:
    fake_wrench.failure = error
    with pytest.raises(type(error)) as raised:
        wrench.tare()
    assert type(raised.value) is type(error)
    assert str(raised.value) == str(error)
    assert getattr(raised.value, "recoverable", None) == getattr(error, "recoverable", None)


def test_a_defect_in_the_device_is_a_fault_that_names_it(wrench: RemoteForceTorque, fake_wrench: Any) -> None:
    fake_wrench.failure = ZeroDivisionError("scale is 0")
    with pytest.raises(DeviceFault, match="ZeroDivisionError: scale is 0"):
        wrench.tare()


def test_two_clients_see_the_same_readings(
    wrench: RemoteForceTorque, another: Callable[[], Bus], fake_wrench: Any
) -> None:
    with RemoteForceTorque("wrist_ft", Link(another(), "lab"), lockstep=True) as second:
        for i in range(20):
            fake_wrench.push(i)
        arrived(wrench, 19)
        arrived(second, 19)
        assert [r.stamp for r in wrench.since(-1)] == [r.stamp for r in second.since(-1)]


def test_a_closed_client_no_longer_makes_the_server_publish(
    wrench: RemoteForceTorque, wrench_server: DeviceServer, fake_wrench: Any
) -> None:
    wrench.close()
    stream = wrench_server.desk.publishers[0]
    assert stream.wait_matched(5.0, wanted=False)
    fake_wrench.push(0)
    assert stream.count == 0
    with pytest.raises(NotConnected):
        wrench.latest()


def test_a_device_without_a_server_is_not_connected(link: Link) -> None:
    with pytest.raises(NotConnected, match="gripper"):
        RemoteGripper("gripper", link, lockstep=True).connect(timeout=0.1)


def test_a_device_of_another_kind_is_not_connected(wrench_server: DeviceServer, link: Link) -> None:
    with pytest.raises(NotConnected, match="force_torque"):
        RemoteGripper("wrist_ft", link, lockstep=True).connect(timeout=2.0)


def test_a_server_that_goes_makes_every_later_call_a_fault(
    wrench: RemoteForceTorque, wrench_server: DeviceServer, fake_wrench: Any
) -> None:
    fake_wrench.push(0)
    arrived(wrench, 0)
    wrench_server.close()
    assert wrench._watch is not None
    assert wrench._watch.wait(2.0)
    for call in (wrench.latest, wrench.tare, lambda: wrench.since(0)):
        with pytest.raises(DeviceFault, match="wrist_ft"):
            call()


# -- the arm -----------------------------------------------------------------------------------------------------


def test_a_commander_with_the_lease_moves_the_arm(arm: RemoteArm, fake_arm: Any) -> None:
    with arm.lease("me"):
        arm.command(target(0.1))
        arm.command(target(0.1003))
    assert [t.pose[0] for t in fake_arm.targets] == [0.1, 0.1003]
    assert [t.sequence for t in fake_arm.targets] == [0, 1]
    assert np.array_equal(fake_arm.targets[0].twist, [0.0, 0.01, 0.0])
    assert fake_arm.did[-1] == "release"


def test_commands_without_the_lease_are_refused(arm: RemoteArm, fake_arm: Any) -> None:
    with pytest.raises(CommandRefused, match="no lease"):
        arm.command(target())
    assert fake_arm.targets == []


def test_the_server_refuses_a_holder_that_never_acquired(arm: RemoteArm, fake_arm: Any) -> None:
    arm._holder = "forged"
    with pytest.raises(CommandRefused, match="no lease"):
        arm.command(target())
    arm._holder = None
    assert fake_arm.targets == []


def test_a_second_commander_is_refused_by_the_firsts_name_until_it_has_finished(
    arm: RemoteArm, another: Callable[[], Bus]
) -> None:
    with RemoteArm("arm", Link(another(), "lab"), lockstep=True) as second:
        with arm.lease("alice"):
            with pytest.raises(CommandRefused, match="alice"):
                second.acquire("bob")
            assert second.lease_holders() == ["alice"]
        with second.lease("bob"):
            second.command(target())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_target_that_is_not_finite_is_refused_at_the_server(arm: RemoteArm, fake_arm: Any, bad: float) -> None:
    with arm.lease("me"):
        with pytest.raises(CommandRefused, match="finite"):
            arm.command(target(bad))
        with pytest.raises(CommandRefused, match="finite"):
            arm.command(target(0.1, bad))
    assert fake_arm.targets == []


def test_a_replayed_target_is_refused(arm: RemoteArm, fake_arm: Any) -> None:
    with arm.lease("me"):
        arm.command(target())
        arm._targets = 0
        with pytest.raises(CommandRefused, match="target 0 came after 0"):
            arm.command(target())
    assert len(fake_arm.targets) == 1


def test_a_fault_keeps_its_recoverability(arm: RemoteArm) -> None:
    with arm.lease("me"), pytest.raises(DeviceFault, match="joint 3") as raised:
        arm.command(target(duration=13.0))
    assert raised.value.recoverable


def test_a_latched_stop_needs_no_lease(arm: RemoteArm, another: Callable[[], Bus]) -> None:
    with arm.lease("me"), RemoteArm("arm", Link(another(), "lab"), lockstep=True) as bystander:
        bystander.stop()
        with pytest.raises(CommandRefused, match="stopped"):
            arm.command(target())
        bystander.recover()
        arm.command(target())


def test_stop_does_not_wait_behind_a_command_that_hangs(arm: RemoteArm, fake_arm: Any) -> None:
    hanging, go_on = threading.Event(), threading.Event()

    def hang(_: ArmTarget) -> None:
        hanging.set()
        go_on.wait(10)

    fake_arm.command = hang
    with arm.lease("me"):
        commander = threading.Thread(target=lambda: arm.command(target()))
        commander.start()
        try:
            assert hanging.wait(5)
            arm.stop()
            assert fake_arm.stopped
        finally:
            go_on.set()
            commander.join()


def test_a_commander_that_dies_loses_the_arm_at_once(arm_server: ArmServer, endpoint: str, fake_arm: Any) -> None:
    bus = Bus(endpoint, shared_memory=False)
    doomed = RemoteArm("arm", Link(bus, "lab"), lockstep=True)
    doomed.connect()
    doomed.acquire("doomed")
    doomed._done.set()  # its renewals end with it
    start = time.monotonic()
    bus.close()
    assert fake_arm.released.wait(2.0)
    assert time.monotonic() - start < 0.9, "before the lease could lapse by itself"
    doomed.close()


def test_a_commander_that_freezes_loses_the_arm_within_two_seconds(
    arm: RemoteArm, fake_arm: Any, another: Callable[[], Bus]
) -> None:
    arm.acquire("frozen")
    arm._done.set()  # no renewal, but its session lives
    assert fake_arm.released.wait(2.0)
    with pytest.raises(CommandRefused, match="lapsed: nothing was heard of it for 1 s"):
        arm.command(target())
    with RemoteArm("arm", Link(another(), "lab"), lockstep=True) as second, second.lease("bob"):
        second.command(target())


def test_a_slow_commander_keeps_the_arm_for_as_long_as_the_station_says(
    served: Bus, joined: Bus, fake_arm: Any
) -> None:
    with (
        ArmServer(Desk(served, "slow", now_ns=lambda: 7, lease=10.0), fake_arm),
        RemoteArm("arm", Link(joined, "slow"), lockstep=True) as remote,
        remote.lease("busy"),
    ):
        remote._done.set()  # too busy to renew
        assert not fake_arm.released.wait(1.5)
        remote.command(target())


def test_renewal_outlives_the_time_to_live(arm: RemoteArm, fake_arm: Any) -> None:
    with arm.lease("patient"):
        assert not fake_arm.released.wait(1.3)
        arm.command(target())


def test_a_closed_client_leaves_the_arm_released(arm: RemoteArm, fake_arm: Any) -> None:
    arm.acquire("me")
    arm.close()
    arm.close()
    assert fake_arm.released.is_set()


def test_a_closed_server_leaves_the_arm_held(arm_server: ArmServer, fake_arm: Any) -> None:
    arm_server.close()
    arm_server.close()
    assert "hold" in fake_arm.did
    assert not fake_arm.connected


def test_accepted_targets_are_a_stream(arm: RemoteArm, joined: Bus) -> None:
    subscription = joined.subscribe(topics.key("lab", "arm", "target"))
    got: list[Any] = []
    subscription.listen(lambda sample: got.append(messages.decode(sample.payload, messages.TARGET)))
    with arm.lease("me"):
        arm.command(target(0.1003))
        arm.command(target(0.1006))
    assert [value.pose[0] for value in got] == [0.1003, 0.1006]


def test_holders_of_one_name_are_told_apart() -> None:
    a, b = holder_id("run", "1f", 1), holder_id("run", "2e", 1)
    assert a != b
    assert nickname(a) == nickname(b) == "run"
    assert belongs_to(a, "1f") and not belongs_to(b, "1f")
    assert "/" not in holder_id("a/b*?", "1f", 1)
