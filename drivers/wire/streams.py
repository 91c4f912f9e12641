"""The two ends of a stream: what publishes it, what receives it, and what travels beside each message."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

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


class Publisher:
    """A stream on the bus. ``count`` messages were put on it, the newest with sequence number ``newest``.

    With an ``outbox`` that is open messages leave when that sends them.
    """

    def __init__(self, session: zenoh.Session, topic: str, type_name: str, lossy: bool, withdraw: Callable[[], None]):
        self.topic, self.type_name = topic, type_name
        self.count, self.newest = 0, -1
        self.outbox = Outbox()
        control = zenoh.CongestionControl.DROP if lossy else zenoh.CongestionControl.BLOCK
        self._publisher = session.declare_publisher(
            topic,
            encoding=zenoh.Encoding.APPLICATION_CDR.with_schema(type_name),
            congestion_control=control,
        )
        self._withdraw = withdraw

    @property
    def matched(self) -> bool:
        """Whether anybody listens; a stream that nobody hears need not be encoded."""
        return self.outbox.matched(self) if self.outbox.open else self.heard()

    def heard(self) -> bool:
        """Whether anybody listens at this moment."""
        return matching(self._publisher)

    def wait_matched(self, timeout: float, wanted: bool = True) -> bool:
        """Wait at most ``timeout`` seconds until somebody listens (``wanted``) or nobody does; whether it came so."""
        return wait_matching(self._publisher, time.monotonic() + timeout, wanted=wanted)

    def put(self, payload: bytes, sequence: int, capture_ns: int, status: int = 0) -> None:
        """Publish one message."""
        beside = ATTACHMENT.pack(sequence, capture_ns, status)
        if self.outbox.open:
            self.outbox.put(self._publisher, payload, beside)
        else:
            self._publisher.put(payload, attachment=beside)
        self.count += 1
        self.newest = sequence

    def close(self) -> None:
        """Withdraw the stream; idempotent."""
        if self.outbox.open:
            self.outbox.send()
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
