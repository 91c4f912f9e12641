"""Views: the decimated siblings of streams, for who looks on. Looking costs a device next to nothing."""

from __future__ import annotations

import queue
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from drivers.config import BusConfig, StationConfig
from drivers.interfaces import Description, TactileSensor
from drivers.wire import messages, streams, topics
from drivers.wire.arm_server import ArmServer
from drivers.wire.bus import Bus
from drivers.wire.codec import decode_reading
from drivers.wire.link import Link
from drivers.wire.server import Desk, DeviceServer
from drivers.wire.streams import Publisher, Sample, Subscription, ViewRates
from mechanics.readings import ImageReading, PoseReading, Stamp
from tests.drivers.by_hand import Time

from .conftest import FakeArm, FakeForceTorque

STREAM, VIEW = "lab/ft/wrench", "lab/ft/wrench/view"
ROOT = Path(__file__).parents[3]
PICTURE = bytes(224 * 171 * 2)


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> Time:
    clock = Time()
    monkeypatch.setattr(streams, "time", clock)
    return clock


def soon() -> float:
    return time.monotonic() + 5.0


def looked_at(publisher: Publisher, bus: Bus, topic: str = VIEW) -> list[Sample]:
    """What comes by a view from now on; when this returns, the publisher knows of it."""
    got: list[Sample] = []
    bus.subscribe(topic).listen(got.append)
    assert publisher.view is not None
    changed = threading.Event()
    listener = publisher.view._publisher.declare_matching_listener(lambda _: changed.set())
    if not streams.matching(publisher.view._publisher):
        assert changed.wait(5.0)
    listener.undeclare()
    return got


def arrived(subscription: Subscription, sequence: int) -> bool:
    """Wait for a message, by the true time."""
    done = threading.Event()

    def take(sample: Sample) -> None:
        if sample.sequence >= sequence:
            done.set()

    stop = subscription.listen(take)
    try:
        return subscription.newest >= sequence or done.wait(20.0)
    finally:
        stop()


def offer(publisher: Publisher, sequence: int, payload: bytes = b"x") -> None:
    """What every source does: nothing where nobody wants it."""
    if publisher.matched:
        publisher.put(payload, sequence, 10 * sequence, 1)


def test_a_view_lies_beside_its_stream_and_is_none_itself() -> None:
    assert topics.view("lab1/finger_left/image") == "lab1/finger_left/image/view"
    config = StationConfig.model_validate(
        {"name": "lab", "devices": {"finger": {"kind": "tactile", "sensor": "gelslim", "finger": "left"}}}
    )
    # what a log and a runner subscribe to, and what a replay publishes
    assert list(topics.streams(config)) == ["lab/finger/image", "lab/finger/reference"]


def test_nothing_is_produced_while_nobody_looks(served: Bus, joined: Bus, by_hand: Time) -> None:
    publisher = served.publisher(STREAM, messages.WRENCH, 20.0)
    assert not publisher.matched
    got = looked_at(publisher, joined)
    by_hand.now += 1.0
    assert publisher.matched
    offer(publisher, 7)
    assert arrived(joined.subscribe(VIEW), 7)
    assert [(s.sequence, s.capture_ns, s.status, s.payload) for s in got] == [(7, 70, 1, b"x")]
    joined.unsubscribe(joined.subscribe(VIEW))
    assert publisher.view is not None
    assert streams.wait_matching(publisher.view._publisher, soon(), wanted=False)
    by_hand.now += 1.0
    assert not publisher.matched


def test_who_takes_the_stream_alone_makes_no_view(served: Bus, joined: Bus, by_hand: Time) -> None:
    publisher = served.publisher(STREAM, messages.WRENCH, 20.0)
    subscription = joined.subscribe(STREAM)
    subscription.listen(lambda _: None)
    assert streams.wait_matching(publisher._publisher, soon())
    for i in range(100):
        by_hand.now += 0.01
        offer(publisher, i)
    assert arrived(subscription, 99)
    assert publisher.view is not None
    assert (publisher.count, publisher.view.count) == (100, 0)


@pytest.mark.parametrize(("rate", "every"), [(1024, 64), (32, 2), (8, 1)])
def test_a_view_has_the_newest_reading_at_its_rate_and_at_most_at_the_streams_own(
    served: Bus, joined: Bus, by_hand: Time, rate: int, every: int
) -> None:
    publisher = served.publisher(STREAM, messages.WRENCH, 16.0)
    got, subscription = looked_at(publisher, joined), joined.subscribe(STREAM)
    subscription.listen(lambda _: None)
    assert streams.wait_matching(publisher._publisher, soon())
    for i in range(2 * rate):
        offer(publisher, i)
        by_hand.now += 1 / rate
    assert arrived(subscription, 2 * rate - 1)
    assert subscription.count == 2 * rate, "who takes the stream misses nothing for the sake of a viewer"
    expected = list(range(0, 2 * rate, every))
    assert arrived(joined.subscribe(VIEW), expected[-1])
    assert [sample.sequence for sample in got] == expected


def test_what_is_made_for_a_view_alone_is_not_among_what_was_published(desk: Desk, joined: Bus, link: Link) -> None:
    publisher = desk.publisher("ft", "wrench", messages.WRENCH)
    got = looked_at(publisher, joined)
    stop = desk.serve("ft", "tare", lambda _: offer(publisher, 0))
    reply = link.ask("ft", "tare")
    assert arrived(joined.subscribe(VIEW), 0)
    assert len(got) == 1
    assert desk.counts() == {STREAM: 0}
    assert reply.published == []
    stop()


def test_a_views_messages_are_dropped_before_anything_waits_and_come_after_all_others(served: Bus, joined: Bus) -> None:
    publisher = served.publisher(STREAM, messages.WRENCH, 20.0)
    got: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    joined.session.declare_subscriber("lab/**", got.put)
    assert streams.wait_matching(publisher._publisher, soon())
    assert publisher.view is not None and publisher.view.wait_matched(5.0)
    publisher.put(b"x", 3, 4)
    samples = {str(sample.key_expr): sample for sample in (got.get(timeout=5), got.get(timeout=5))}
    view, stream = samples[VIEW], samples[STREAM]
    assert view.congestion_control == zenoh.CongestionControl.DROP
    assert stream.congestion_control == zenoh.CongestionControl.BLOCK
    assert view.priority == zenoh.Priority.DATA_LOW
    assert stream.priority == zenoh.Priority.DATA
    assert str(view.encoding) == str(stream.encoding) == "application/cdr;geometry_msgs/msg/WrenchStamped"


def test_a_view_is_announced_to_ros_as_its_stream_is(served: Bus, joined: Bus) -> None:
    publisher = served.publisher(STREAM, messages.WRENCH, 20.0)
    watch = joined.watch(f"@/{served.zid}/@ros2_lv/MP/lab§ft§wrench§view/geometry_msgs§msg§WrenchStamped/:1::0,10")
    assert watch.seen(5.0)
    publisher.close()
    assert watch.wait(5.0)


STANDING_STILL = """
import sys, threading
import zenoh
from drivers.wire.bus import Bus

goes_on, seen = threading.Event(), [0]

def stand_still(sample):
    goes_on.wait(60.0)
    seen[0] += 1
    if sample.payload.to_bytes() == b"newest":
        print(seen[0], flush=True)

with Bus(sys.argv[1], shared_memory=False) as bus:
    # its receiving thread itself stands still, so that nothing more is read from its socket
    bus.session.declare_subscriber(sys.argv[2], zenoh.handlers.Callback(stand_still, indirect=False))
    sys.stdin.readline()
    goes_on.set()
    sys.stdin.readline()
"""


@contextmanager
def standing_still(endpoint: str, topic: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process that takes nothing in until it is sent a line."""
    command = [sys.executable, "-c", STANDING_STILL, endpoint, topic]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT) as process:
        try:
            yield process
        finally:
            process.kill()


def go_on(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin is not None
    process.stdin.write(b"\n")
    process.stdin.flush()


def said(process: subprocess.Popen[bytes], timeout: float) -> int | None:
    """How many messages it has had, once it has had the newest; None where it does not say so in time."""
    assert process.stdout is not None
    return int(process.stdout.readline() or -1) if select.select([process.stdout], [], [], timeout)[0] else None


def test_a_viewer_that_stands_still_holds_nobody_up(served: Bus, joined: Bus, by_hand: Time) -> None:
    """Far more than queues and sockets hold is put for it; it goes without, and is still a viewer afterwards."""
    publisher = served.publisher("lab/finger/image", messages.IMAGE, 20.0)
    subscription = joined.subscribe("lab/finger/image")
    subscription.listen(lambda _: None)
    assert streams.wait_matching(publisher._publisher, soon())
    count, had = 1500, None
    with standing_still(served.endpoint, "lab/finger/image/view") as viewer:
        assert publisher.view is not None
        assert streams.wait_matching(publisher.view._publisher, time.monotonic() + 20.0)
        for i in range(count):
            by_hand.now += 1.0
            offer(publisher, i, PICTURE)
        assert arrived(subscription, count - 1)
        assert subscription.count == publisher.view.count == count
        go_on(viewer)
        for i in range(count, count + 1000):  # until its queue has room again
            by_hand.now += 1.0
            offer(publisher, i, b"newest")
            if (had := said(viewer, 0.02)) is not None:
                break
    assert had is not None and had > 0, "it was cut off"
    assert had < count, "it went without what it could not take"


def test_who_takes_the_stream_itself_misses_no_picture_for_faltering(served: Bus) -> None:
    """More than queues and sockets hold is put while the reader is away, for less than the lease: its source waits."""
    publisher = served.publisher("lab/finger/image", messages.IMAGE, 5.0)

    def put() -> None:
        for i in range(300):
            publisher.put(PICTURE, i, i)
        publisher.put(b"newest", 300, 300)

    source = threading.Thread(target=put, name="source")
    with standing_still(served.endpoint, "lab/finger/image") as reader:
        assert publisher.wait_matched(20.0)
        source.start()
        source.join(0.3)
        waited = source.is_alive()
        go_on(reader)
        source.join(20.0)
        assert waited, "it is to wait for its reader"
        assert said(reader, 20.0) == 301


# -- devices ----------------------------------------------------------------------------------------------------------


class FakeFinger(TactileSensor):
    def __init__(self) -> None:
        super().__init__("finger")
        self.taken = 0

    def describe(self) -> Description:
        return Description("finger", "tactile", "fake", "fake", "0", "finger", extra={"sensor": "soft_bubble"})

    def capture(self, timeout: float = 2.0) -> ImageReading:
        reading = ImageReading(
            Stamp(self.taken, self.taken, self.taken, "finger"), np.zeros((4, 6), np.uint16), "16UC1"
        )
        self.taken += 1
        self._push(reading)
        return reading

    def reference(self) -> np.ndarray:
        return np.zeros((4, 6), np.uint16)

    def _open(self, timeout: float) -> None: ...

    def _shut(self) -> None: ...


def test_every_device_has_views_of_readings_and_pictures_at_their_rates(served: Bus, joined: Bus) -> None:
    desk = Desk(served, "lab", now_ns=lambda: 7, views=ViewRates(readings=50.0, images=4.0))
    arm, wrench, finger = FakeArm(), FakeForceTorque(), FakeFinger()
    with ArmServer(desk, arm) as a, DeviceServer(desk, wrench) as w, DeviceServer(desk, finger) as f:
        found = {p.view.topic: 1 / p.view._period for s in (a, w, f) for p in s._streams.values() if p.view is not None}
        assert found == {
            "lab/arm/pose/view": 50.0,
            "lab/arm/target/view": 50.0,
            "lab/arm/safety/view": 50.0,
            "lab/wrist_ft/wrench/view": 50.0,
            "lab/finger/image/view": 4.0,
            "lab/finger/reference/view": 4.0,
        }
        got = looked_at(a._streams["pose"], joined, "lab/arm/pose/view")
        a._streams["pose"].view._next = 0.0  # type: ignore[union-attr]
        arm.push(5)
        assert arrived(joined.subscribe("lab/arm/pose/view"), 5)
        reading = decode_reading(messages.POSE, got[0].payload, got[0].sequence)
        assert isinstance(reading, PoseReading)
        np.testing.assert_allclose(reading.pose, [0.1, 0.2, 0.3], atol=1e-12)


def test_a_camera_without_a_thread_takes_frames_for_viewers_at_their_rate_only(
    desk: Desk, joined: Bus, by_hand: Time
) -> None:
    finger = FakeFinger()
    with DeviceServer(desk, finger) as server:
        server.capture_if_wanted()
        assert finger.taken == 0
        looked_at(server._streams["image"], joined, "lab/finger/image/view")
        for _ in range(60):  # two seconds of a 30 Hz camera
            by_hand.now += 1 / 30
            server.capture_if_wanted()
        assert finger.taken == pytest.approx(10, abs=1)


def test_a_stations_file_states_the_rates_and_viewers_get_20_and_5_hz_by_default() -> None:
    assert (BusConfig().view_rate, BusConfig().image_view_rate) == tuple(ViewRates())
    assert tuple(ViewRates()) == (20.0, 5.0)
    with pytest.raises(ValueError, match="greater than 0"):
        BusConfig(view_rate=0.0)


def test_a_sensor_beside_the_arm_is_as_old_as_its_stream_says_however_the_stations_time_was_shifted(
    served: Bus, fake_wrench: FakeForceTorque
) -> None:
    """A world that has given up seconds of lost time goes on: what its sensors tell is not old for that."""
    shift = 5_000_000_000
    desk = Desk(served, "lab", now_ns=lambda: 40_000_000 + shift, shift_ns=lambda: shift)
    with ArmServer(desk, FakeArm(), sensors={"wrist_ft": fake_wrench}) as server, DeviceServer(desk, fake_wrench):
        fake_wrench.push(39)  # taken at 39 ms
        server.gates._witnessed(desk.steady_ns(), desk.now_ns())
