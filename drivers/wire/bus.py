"""One zenoh session, and what is opened on it: streams, watches, requests, services.

Scouting and gossip are off: a session listens only at, or connects only to, the endpoint it was given. Callbacks of
this room only append or set a flag, because a slow one starves the whole session.
"""

from __future__ import annotations

import queue
import threading
import time
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self

import zenoh

from drivers.errors import DeviceFault, DeviceTimeout
from drivers.wire import topics
from drivers.wire.security import Identity
from drivers.wire.session import open_session
from drivers.wire.streams import Publisher, Subscription, View
from drivers.wire.watch import Watch, undeclare, wait_matching

_VERDICT = 0.5  # an empty answer and the news of a death come together, in either order [s]

_open: weakref.WeakSet[Bus] = weakref.WeakSet()


def open_buses() -> list[Bus]:
    """The sessions of this process that were not closed; one that is left open keeps the interpreter from ending."""
    return list(_open)


class Query:
    """A request that waits for its reply; reply once, from any thread."""

    def __init__(self, key: str, query: zenoh.Query):
        self._key, self._query = key, query
        self.payload = b"" if query.payload is None else query.payload.to_bytes()

    def reply(self, payload: bytes) -> None:
        """Answer; a requester that has gone is no error."""
        try:
            self._query.reply(self._key, payload)
        except zenoh.ZError:
            pass
        finally:
            self._query.drop()


class Bus:
    """A zenoh session as a context manager. ``endpoint`` is listened at (``listen``) or connected to.

    ``mode``: ``peer`` on one machine, ``client`` toward a router, to whom an ``identity`` shows its certificate;
    ``router`` hands on what others send each other, too.
    ``lease`` [s] is how long a peer may be silent, or not take what it is sent, before it counts as dead; zenoh's own
    ten seconds are too many beside an arm. ``at_once`` is for a session that both ends of a stream share: who publishes
    delivers, too, in its own thread. Raises NotConnected when the session cannot be opened within ``timeout`` seconds.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        listen: bool = False,
        mode: Literal["peer", "client", "router"] = "peer",
        timeout: float = 5.0,
        shared_memory: bool = True,
        lease: float = 1.0,
        at_once: bool = False,
        identity: Identity | None = None,
    ):
        self.endpoint, self.timeout, self.identity = endpoint, timeout, identity
        self._at_once = at_once
        self._subscriptions: dict[str, Subscription] = {}
        self._queriers: dict[str, zenoh.Querier] = {}
        self._tokens: set[zenoh.LivelinessToken] = set()
        self._lock = threading.Lock()
        self._closed = False
        self.session = open_session(
            mode,
            endpoint,
            listen=listen,
            timeout=timeout,
            lease=lease,
            identity=identity,
            settings={"transport/shared_memory/enabled": shared_memory},
        )
        self.zid = str(self.session.zid())
        _open.add(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the session and all that was opened on it; idempotent."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        _open.discard(self)
        self.session.close()  # an open session with a callback would keep the interpreter from ending

    def publisher(self, topic: str, type_name: str, view_rate: float | None = None) -> Publisher:
        """Announce a stream, and with a ``view_rate`` [Hz] its view, the decimated topic for who looks on."""
        view = None
        if view_rate is not None:
            seen = topics.view(topic)
            withdraw = self.token(topics.discovery(self.zid, seen, type_name))
            view = View(self.session, seen, type_name, view_rate, withdraw)
        withdraw = self.token(topics.discovery(self.zid, topic, type_name))
        return Publisher(self.session, topic, type_name, withdraw, view)

    def subscribe(self, topic: str) -> Subscription:
        """The stream of a topic; one subscription per topic, shared by all its listeners."""
        with self._lock:
            found = self._subscriptions.get(topic)
            if found is None:
                found = Subscription(self.session, topic, self.unsubscribe, at_once=self._at_once)
                self._subscriptions[topic] = found
            return found

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription; idempotent."""
        with self._lock:
            if self._subscriptions.get(subscription.topic) is subscription:
                del self._subscriptions[subscription.topic]
        subscription.close()

    def subscription(self, topic: str) -> Subscription | None:
        """The subscription to a topic, if there is one."""
        return self._subscriptions.get(topic)

    def subscriptions(self) -> list[Subscription]:
        """Every subscription of this session."""
        with self._lock:
            return list(self._subscriptions.values())

    def serve(self, key: str, handler: Callable[[Query], None]) -> Callable[[], None]:
        """Answer requests at ``key``; returns the way to stop. Each key has a thread of its own."""
        queryable = self.session.declare_queryable(key, lambda query: handler(Query(key, query)))
        return lambda: undeclare(queryable)

    def token(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token; returns the way to withdraw it, as closing the bus does."""
        token = self.session.liveliness().declare_token(key)
        self._tokens.add(token)  # one that nobody refers to would vanish

        def withdraw() -> None:
            self._tokens.discard(token)
            undeclare(token)

        return withdraw

    def watch(self, token: str) -> Watch:
        """Watch over a liveliness token."""
        return Watch(self.session, token)

    def watch_all(self, pattern: str, gone: Callable[[str], None]) -> Callable[[], None]:
        """Call ``gone`` with each token of a pattern that vanishes; returns the way to stop."""

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                gone(str(sample.key_expr))

        subscriber = self.session.liveliness().declare_subscriber(pattern, changed, history=True)
        return lambda: undeclare(subscriber)

    def request(
        self,
        key: str,
        payload: bytes,
        *,
        device: str,
        asked: str,
        timeout: float | None = None,
        watch: Watch | None = None,
    ) -> bytes:
        """Ask the service at ``key`` and return its answer.

        Raises DeviceTimeout when none comes within ``timeout`` seconds (the bus's own where None), DeviceFault when
        the server of ``watch`` has died or when nobody answered (in zenoh an absent service, a failed handler and a
        death in mid-query look the same: no reply at all).
        """
        deadline = time.monotonic() + (self.timeout if timeout is None else timeout)
        dead = DeviceFault(
            device,
            asked,
            "the device's server has died",
            "Start the station again; `extrinsic status STATION` tells more",
        )
        if watch is not None and watch.gone:
            raise dead
        answers: queue.SimpleQueue[zenoh.Reply | str] = queue.SimpleQueue()
        withdraw = watch.once_gone(lambda: answers.put("dead")) if watch is not None else None
        try:
            querier = self._querier(key)
            if not wait_matching(querier, deadline, watch=watch):
                if watch is not None and watch.gone:
                    raise dead
                raise DeviceTimeout(device, asked, f"nobody serves {key}", self._unserved())
            handler = zenoh.handlers.Callback(answers.put, lambda: answers.put("end"), indirect=False)
            querier.get(handler, payload=payload)
            answer = answers.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            raise DeviceTimeout(
                device, asked, "no answer in time", "The device is busy or frozen; check `extrinsic status STATION`"
            ) from None
        except zenoh.ZError as error:
            raise DeviceFault(device, asked, f"the bus failed: {error}", "Start the station again") from error
        finally:
            if withdraw is not None:
                withdraw()
        if isinstance(answer, zenoh.Reply):
            if answer.ok is not None:
                return answer.ok.payload.to_bytes()
            problem = answer.err.payload.to_bytes().decode(errors="replace") if answer.err is not None else "nothing"
            raise DeviceFault(device, asked, f"the server failed: {problem}", "Read the server's log")
        if answer == "dead" or (watch is not None and watch.wait(_VERDICT)):
            raise dead
        raise DeviceFault(device, asked, "an empty answer", "The server failed while it worked; read its log")

    def _unserved(self) -> str:
        remedy = "Check `extrinsic status STATION`"
        return remedy if self.identity is None else f"{remedy}, and whether {self.identity.name} may ask for this"

    def _querier(self, key: str) -> zenoh.Querier:
        with self._lock:
            found = self._queriers.get(key)
            if found is None:
                # The bus waits by itself; zenoh's own time-out only bounds what is left behind.
                found = self._queriers[key] = self.session.declare_querier(key, timeout=60.0)
            return found
