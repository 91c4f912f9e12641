from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Callable

import pytest
import zenoh

from drivers.errors import DeviceFault, DeviceTimeout, NotConnected
from drivers.wire import messages, session, topics
from drivers.wire.bus import Bus, Query, open_buses
from drivers.wire.link import Link
from drivers.wire.server import Desk
from drivers.wire.streams import ATTACHMENT, Sample
from drivers.wire.watch import Watch, wait_matching


def test_what_is_published_arrives_whole_and_in_order(served: Bus, joined: Bus) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    got: list[Sample] = []
    subscription = joined.subscribe("lab/ft/wrench")
    subscription.listen(got.append)
    assert publisher.wait_matched(5.0)
    for i in range(2000):
        publisher.put(bytes([i % 256]) * 80, i, 10 * i, 1)
    assert subscription.wait(1999, None, time.monotonic() + 5)
    assert [s.sequence for s in got] == list(range(2000))
    assert all(s.payload == bytes([s.sequence % 256]) * 80 and s.capture_ns == 10 * s.sequence for s in got)
    assert publisher.count == subscription.count == 2000


def test_a_session_that_both_ends_share_delivers_before_the_publisher_goes_on(endpoint: str) -> None:
    with (
        Bus(endpoint, listen=True, shared_memory=False, at_once=True) as bus,
        Bus(endpoint, shared_memory=False) as far,
    ):
        publisher, subscription = bus.publisher("lab/ft/wrench", messages.WRENCH), bus.subscribe("lab/ft/wrench")
        elsewhere = far.subscribe("lab/ft/wrench")
        got: list[tuple[int, int]] = []
        subscription.listen(lambda sample: got.append((sample.sequence, threading.get_ident())))
        bus.serve("lab/ft/tare", lambda query: query.reply(b"done"))
        far.request("lab/ft/tare", b"", device="ft", asked="tare")  # the subscription has arrived with this
        for i in range(300):
            publisher.put(b"x" * 80, i, i)
            assert got[-1] == (i, threading.get_ident())
        assert len(got) == subscription.count == 300
        publisher.put(b"x", 300, 300)
        assert elsewhere.wait(300, None, time.monotonic() + 5)  # who joined from outside hears it as ever


def test_what_is_published_together_leaves_at_the_end_whole_and_in_order(desk: Desk, joined: Bus) -> None:
    publisher = desk.publisher("ft", "wrench", messages.WRENCH)
    beside = desk.bus.publisher("lab/arm/pose", messages.POSE)
    got: list[Sample] = []
    subscription, other = joined.subscribe("lab/ft/wrench"), joined.subscribe("lab/arm/pose")
    subscription.listen(got.append)
    other.listen(lambda _: None)
    assert publisher.wait_matched(5.0)
    assert beside.wait_matched(5.0)
    with desk.together():
        for i in range(300):
            publisher.put(bytes([i % 256]) * 80, i, 10 * i)
        beside.put(b"x", 0, 0)
        assert other.wait(0, None, time.monotonic() + 5)  # what does leave is not held up
        assert got == []
    assert subscription.wait(299, None, time.monotonic() + 5)
    assert [s.sequence for s in got] == list(range(300))
    publisher.put(b"y", 300, 0)
    assert subscription.wait(300, None, time.monotonic() + 5)


def test_a_reply_in_the_midst_of_much_comes_after_what_was_published_before_it(desk: Desk, link: Link) -> None:
    publisher = desk.publisher("ft", "wrench", messages.WRENCH)
    stop = desk.serve("ft", "tare", lambda _: publisher.put(b"x", 0, 0))
    subscription = link.bus.subscribe("lab/ft/wrench")
    subscription.listen(lambda _: None)
    assert publisher.wait_matched(5.0)
    with desk.together():
        link.ask("ft", "tare")
        assert subscription.newest == 0
    stop()


def test_a_stream_that_is_withdrawn_in_the_midst_has_sent_what_waited(desk: Desk, joined: Bus) -> None:
    publisher = desk.publisher("ft", "wrench", messages.WRENCH)
    subscription = joined.subscribe("lab/ft/wrench")
    subscription.listen(lambda _: None)
    assert publisher.wait_matched(5.0)
    with desk.together():
        publisher.put(b"x", 0, 0)
        publisher.close()
    assert subscription.wait(0, None, time.monotonic() + 5)


def test_a_stream_that_nobody_hears_is_not_matched(served: Bus, joined: Bus) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    assert not publisher.matched
    assert not publisher.wait_matched(0.05)
    stop = joined.subscribe("lab/ft/wrench").listen(lambda _: None)
    assert publisher.wait_matched(5.0)
    stop()
    assert publisher.wait_matched(5.0, wanted=False)


def test_every_sample_says_its_type(served: Bus, joined: Bus) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    got: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    joined.session.declare_subscriber("lab/**", got.put)
    assert publisher.wait_matched(5.0)
    publisher.put(b"x", 3, 4)
    sample = got.get(timeout=5)
    assert str(sample.encoding) == "application/cdr;geometry_msgs/msg/WrenchStamped"
    assert sample.attachment is not None
    assert ATTACHMENT.unpack(sample.attachment.to_bytes()) == (3, 4, 0)


def test_a_stream_is_announced_as_the_ros_bridge_announces_its_own(served: Bus, joined: Bus) -> None:
    publisher = served.publisher("lab/ft/wrench", messages.WRENCH)
    token = f"@/{served.zid}/@ros2_lv/MP/lab§ft§wrench/geometry_msgs§msg§WrenchStamped/:1::0,10"
    watch = joined.watch(token)
    assert watch.seen(5.0)
    publisher.close()
    assert watch.wait(5.0)


def test_samples_of_others_without_our_attachment_are_counted_not_delivered(served: Bus, joined: Bus) -> None:
    subscription = joined.subscribe("lab/ft/wrench")
    got: list[Sample] = []
    subscription.listen(got.append)
    publisher = served.session.declare_publisher("lab/ft/wrench")
    assert wait_matching(publisher, time.monotonic() + 5)
    publisher.put(b"hello")
    publisher.put(b"ours", attachment=ATTACHMENT.pack(0, 0, 0))  # what came before it has been dealt with
    assert subscription.wait(0, None, time.monotonic() + 5)
    assert [sample.payload for sample in got] == [b"ours"]
    assert subscription.foreign == 1


def test_a_request_is_answered(served: Bus, joined: Bus) -> None:
    served.serve("lab/echo", lambda query: query.reply(query.payload[::-1]))
    assert joined.request("lab/echo", b"abc", device="lab", asked="echo") == b"cba"


def test_a_request_that_nobody_serves_times_out_by_name(joined: Bus) -> None:
    with pytest.raises(DeviceTimeout, match="gripper: open: nobody serves lab/nothing"):
        joined.request("lab/nothing", b"", device="gripper", asked="open", timeout=0.1)


def test_a_server_that_does_not_answer_times_out(served: Bus, joined: Bus) -> None:
    kept: list[Query] = []
    served.serve("lab/slow", kept.append)
    with pytest.raises(DeviceTimeout, match="no answer in time"):
        joined.request("lab/slow", b"", device="lab", asked="wait", timeout=0.3)


def test_an_empty_answer_is_a_fault(served: Bus, joined: Bus) -> None:
    served.session.declare_queryable("lab/fails", lambda query: query.drop())
    with pytest.raises(DeviceFault, match="empty answer"):
        joined.request("lab/fails", b"", device="lab", asked="fail")


def test_a_death_ends_the_request_that_waits_for_it(endpoint: str) -> None:
    with Bus(endpoint, listen=True, shared_memory=False) as server:
        asked = threading.Event()
        kept: list[Query] = []

        def keep(query: Query) -> None:
            kept.append(query)
            asked.set()

        server.serve("lab/slow", keep)
        server.token("lab/slow/alive")
        with Bus(endpoint, shared_memory=False) as client:
            watch = client.watch("lab/slow/alive")
            assert watch.seen(5)
            closer = threading.Thread(target=lambda: (asked.wait(5), server.close()))
            closer.start()
            start = time.monotonic()
            with pytest.raises(DeviceFault, match="died"):
                client.request("lab/slow", b"", device="lab", asked="wait", timeout=30, watch=watch)
            assert time.monotonic() - start < 2.0
            closer.join()
            with pytest.raises(DeviceFault, match="died"):
                client.request("lab/slow", b"", device="lab", asked="wait again", watch=watch)


class EarlyRequest:
    """A request, in a thread of its own, whose service is not there yet; ``waiting`` once it waits for it."""

    def __init__(self, bus: Bus, watch: Watch):
        self._bus, self._watch = bus, watch
        assert watch.seen(5)
        self.outcome: queue.SimpleQueue[bytes | DeviceFault | DeviceTimeout] = queue.SimpleQueue()
        hooks, once_gone = threading.Semaphore(0), watch.once_gone

        def told(hook: Callable[[], None]) -> Callable[[], None]:
            withdraw = once_gone(hook)
            hooks.release()
            return withdraw

        watch.once_gone = told  # type: ignore[method-assign]
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()
        self.waiting = hooks.acquire(timeout=5) and hooks.acquire(timeout=5)  # for the answer, then for the service

    def _ask(self) -> None:
        try:
            answer = self._bus.request("lab/late", b"", device="lab", asked="x", timeout=30, watch=self._watch)
            self.outcome.put(answer)
        except (DeviceFault, DeviceTimeout) as error:
            self.outcome.put(error)

    def end(self) -> bytes | DeviceFault | DeviceTimeout:
        """What came of it, within the two seconds that a wait without news would outlast."""
        try:
            return self.outcome.get(timeout=2)
        finally:
            self._thread.join()


def test_a_request_that_comes_before_its_service_is_answered_once_that_is_there(served: Bus, joined: Bus) -> None:
    served.token("lab/late/alive")
    request = EarlyRequest(joined, joined.watch("lab/late/alive"))
    assert request.waiting
    served.serve("lab/late", lambda query: query.reply(b"here"))
    assert request.end() == b"here"


def test_a_death_ends_the_wait_for_a_service(served: Bus, joined: Bus) -> None:
    die = served.token("lab/late/alive")
    request = EarlyRequest(joined, joined.watch("lab/late/alive"))
    assert request.waiting
    die()
    assert "died" in str(request.end())


def test_the_first_request_after_opening_is_answered(served: Bus, another: Callable[[], Bus]) -> None:
    served.serve("lab/echo", lambda query: query.reply(b"here"))
    for _ in range(5):
        assert another().request("lab/echo", b"", device="lab", asked="echo") == b"here"


def test_closing_twice_is_harmless(endpoint: str) -> None:
    bus = Bus(endpoint, listen=True, shared_memory=False)
    publisher, subscription = bus.publisher("a/b/c", messages.STRING), bus.subscribe("a/b/d")
    bus.close()
    bus.close()
    publisher.close()
    subscription.close()


def test_an_abandoned_session_is_told() -> None:
    with Bus("tcp/127.0.0.1:0", listen=True, shared_memory=False) as bus:
        assert bus in open_buses()
    assert bus not in open_buses()


def test_nobody_at_the_endpoint_is_told_within_the_timeout(endpoint: str) -> None:
    start = time.monotonic()
    with pytest.raises(NotConnected, match=endpoint):
        Bus(endpoint, timeout=0.5, shared_memory=False)
    assert time.monotonic() - start < 3


def test_a_port_in_use_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(NotConnected, match="another program"):
            Bus(f"tcp/127.0.0.1:{taken.getsockname()[1]}", listen=True, shared_memory=False)


def test_the_bus_listens_nowhere_but_at_its_endpoint(served: Bus, joined: Bus) -> None:
    peers = {str(link.src) for link in served.session.info.links()}
    assert peers == {served.endpoint}
    assert joined.session.info.peers_zid()


def test_keys_are_topic_names() -> None:
    assert topics.key("lab1", "arm", "pose") == "lab1/arm/pose"
    assert topics.holder_of(topics.lease("lab1", "arm", "me~1~2")) == "me~1~2"


def test_before_the_process_ends_no_callback_is_left_to_a_thread_that_nobody_waits_for(endpoint: str) -> None:
    """A bus that a daemon thread opens has callbacks in daemon threads; ended with the interpreter, they abort it."""
    called_back: list[threading.Thread] = []

    def look_on() -> None:
        before = set(threading.enumerate())
        with Bus(endpoint, listen=True, shared_memory=False) as bus:
            watch = bus.watch(topics.alive("lab", "arm"))
            called_back.extend(thread for thread in set(threading.enumerate()) - before if "closure" in thread.name)
            watch.close()

    onlooker = threading.Thread(target=look_on, daemon=True)
    onlooker.start()
    onlooker.join(10)
    assert called_back and all(thread.daemon for thread in called_back)
    session._await_callbacks()
    assert not any(thread.is_alive() for thread in called_back)
