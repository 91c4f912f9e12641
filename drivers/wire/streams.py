"""The two ends of a stream: what publishes it, what receives it, and what travels beside each message.

Who needs a stream (the log, control) gets all of it, and its source waits for who is slow. Who looks on gets its view:
the newest message now and then, or none at all where they are slow.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import zenoh

from drivers.wire.watch import Watch, matching, undeclare, wait_matching

ATTACHMENT = struct.Struct("<qqq")
"""Sequence number, capture time [ns], status: travels beside every sample."""

Handler = Callable[["Sample"], None]


class Sample:
    """One received message: its bytes as sent, what travelled beside them, and room for what they mean."""

    __slots__ = ("capture_ns", "payload", "reading", "receive_ns", "sequence", "status", "topic")

    def __init__(self, topic: str, payload: bytes, sequence: int, capture_ns: int, status: int, receive_ns: int):
        self.topic, self.payload, self.sequence = topic, payload, sequence
        self.capture_ns, self.status, self.receive_ns = capture_ns, status, receive_ns
        self.reading: object = None  # decoded by who reads it first


class Outbox:
    """Keeps back what several streams put, and sends it at once and in its order: one wake-up for many messages.

    One thread puts and sends. While it is `open`, whether anybody listens is asked once for each stream.
    """

    def __init__(self) -> None:
        self.open = False
        self._waiting: list[tuple[zenoh.Publisher, bytes, bytes]] = []
        self._matched: dict[Publisher, bool] = {}

    def put(self, publisher: zenoh.Publisher, payload: bytes, beside: bytes) -> None:
        """Keep a message until `send`."""
        self._waiting.append((publisher, payload, beside))

    def matched(self, publisher: Publisher) -> bool:
        """Whether somebody listened when this was asked first since the last `send`."""
        found = self._matched.get(publisher)
        if found is None:
            found = self._matched[publisher] = publisher.heard()
        return found

    def send(self) -> None:
        """Send what waits."""
        self._matched.clear()
        waiting, self._waiting = self._waiting, []
        for publisher, payload, beside in waiting:
            publisher.put(payload, attachment=beside)


class ViewRates(NamedTuple):
    """How often the views of a station's streams are sent at most [Hz of real time]."""

    readings: float = 20.0
    images: float = 5.0


class View:
    """A stream's decimated sibling for viewers: the newest message, at most ``rate`` times a second of real time.

    It has a low priority, and a viewer who cannot take a message goes without it: neither who publishes nor who takes
    the whole stream waits for them. One thread asks and puts.
    """

    def __init__(self, session: zenoh.Session, topic: str, type_name: str, rate: float, withdraw: Callable[[], None]):
        self.topic = topic
        self.count = 0
        self._period = 1.0 / rate
        self._next = 0.0  # when it is time for a message, or to look for a viewer [s, monotonic]
        self._wanted = False
        self._publisher = session.declare_publisher(
            topic,
            encoding=zenoh.Encoding.APPLICATION_CDR.with_schema(type_name),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )
        self._withdraw = withdraw

    def wanted(self) -> bool:
        """Whether the next message is for the view, too: it is time for one, and somebody looks on."""
        now = time.monotonic()
        if now >= self._next:
            # looked up once in a period, for a stream may have a thousand messages a second
            due = self._next + self._period
            self._next = due if due > now else now + self._period
            self._wanted = matching(self._publisher)
        return self._wanted

    def wait_matched(self, timeout: float, wanted: bool = True) -> bool:
        """As `Publisher.wait_matched`, of those who look on."""
        return wait_matching(self._publisher, time.monotonic() + timeout, wanted=wanted)

    def put(self, payload: bytes, beside: bytes) -> None:
        """Send the message that was `wanted`."""
        self._wanted = False
        self.count += 1
        self._publisher.put(payload, attachment=beside)

    def close(self) -> None:
        """Withdraw the view; idempotent."""
        self._withdraw()
        undeclare(self._publisher)


class Publisher:
    """A stream on the bus. ``count`` messages were put on it, the newest with sequence number ``newest``.

    With an ``outbox`` that is open messages leave when that sends them. What is put for the ``view`` alone, because
    nobody takes the stream itself, is not counted.
    """

    def __init__(
        self,
        session: zenoh.Session,
        topic: str,
        type_name: str,
        withdraw: Callable[[], None],
        view: View | None = None,
    ):
        self.topic, self.type_name, self.view = topic, type_name, view
        self.count, self.newest = 0, -1
        self.outbox = Outbox()
        self._publisher = session.declare_publisher(
            topic,
            encoding=zenoh.Encoding.APPLICATION_CDR.with_schema(type_name),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        self._withdraw = withdraw

    @property
    def matched(self) -> bool:
        """Whether anybody wants the next message; one that nobody hears need not be encoded."""
        return self._heard() or (self.view is not None and self.view.wanted())

    def _heard(self) -> bool:
        return self.outbox.matched(self) if self.outbox.open else self.heard()

    def heard(self) -> bool:
        """Whether anybody takes the stream itself at this moment."""
        return matching(self._publisher)

    def wait_matched(self, timeout: float, wanted: bool = True) -> bool:
        """Wait at most ``timeout`` seconds until somebody listens (``wanted``) or nobody does; whether it came so."""
        return wait_matching(self._publisher, time.monotonic() + timeout, wanted=wanted)

    def put(self, payload: bytes, sequence: int, capture_ns: int, status: int = 0) -> None:
        """Publish one message."""
        beside = ATTACHMENT.pack(sequence, capture_ns, status)
        self.newest = sequence
        if self.view is not None and self.view.wanted():
            self.view.put(payload, beside)
            if not self._heard():
                return
        if self.outbox.open:
            self.outbox.put(self._publisher, payload, beside)
        else:
            self._publisher.put(payload, attachment=beside)
        self.count += 1

    def close(self) -> None:
        """Withdraw the stream; idempotent."""
        if self.outbox.open:
            self.outbox.send()
        if self.view is not None:
            self.view.close()
        self._withdraw()
        undeclare(self._publisher)


class Subscription:
    """A stream from the bus, delivered to any number of listeners within this process.

    ``newest`` is the sequence number of the newest sample that every listener has been given, −1 before the first.
    Samples without our attachment are counted in ``foreign`` and not delivered. With ``at_once`` the thread that
    publishes within this process delivers, too, without one of the subscription's own between.
    """

    def __init__(
        self, session: zenoh.Session, topic: str, idle: Callable[[Subscription], None], *, at_once: bool = False
    ):
        self.topic, self._idle = topic, idle
        self.count, self.newest, self.foreign = 0, -1, 0
        self._handlers: tuple[Handler, ...] = ()
        self._arrived = threading.Condition()
        self._subscriber = session.declare_subscriber(
            topic, zenoh.handlers.Callback(self._receive, indirect=not at_once)
        )

    def listen(self, handler: Handler) -> Callable[[], None]:
        """Give every sample to ``handler`` too; returns the way to stop."""
        with self._arrived:
            self._handlers = (*self._handlers, handler)

        def stop() -> None:
            with self._arrived:
                self._handlers = tuple(h for h in self._handlers if h is not handler)
                idle = not self._handlers
            if idle:
                self._idle(self)  # so that its source need not produce it

        return stop

    def rewind(self) -> None:
        """Forget what has arrived: the source starts to count anew."""
        with self._arrived:
            self.newest = -1

    def wait(self, sequence: int, watch: Watch | None, deadline: float) -> bool:
        """Wait until ``newest`` is at least ``sequence``; False past ``deadline`` or once ``watch`` is gone."""
        if self.newest >= sequence:
            return True
        withdraw = watch.once_gone(self._wake) if watch is not None else None
        try:
            with self._arrived:
                while self.newest < sequence:
                    left = deadline - time.monotonic()
                    if left <= 0 or (watch is not None and watch.gone):
                        return False
                    self._arrived.wait(left)
                return True
        finally:
            if withdraw is not None:
                withdraw()

    def _wake(self) -> None:
        with self._arrived:
            self._arrived.notify_all()

    def _receive(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        beside = b"" if attachment is None else attachment.to_bytes()
        if len(beside) != ATTACHMENT.size:
            self.foreign += 1
            return
        sequence, capture_ns, status = ATTACHMENT.unpack(beside)
        payload = sample.payload.to_bytes()
        done = Sample(self.topic, payload, sequence, capture_ns, status, time.time_ns())
        for handler in self._handlers:
            handler(done)
        with self._arrived:
            self.count += 1
            self.newest = sequence
            self._arrived.notify_all()

    def close(self) -> None:
        """Stop listening; idempotent."""
        undeclare(self._subscriber)
