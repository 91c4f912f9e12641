"""Whether the other end is there: liveliness tokens that are watched over, and the match of a stream or a request.

All of it waits for news from zenoh; nothing asks again and again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh


class Watch:
    """Whether the holder of a liveliness token is there. Once gone it stays gone."""

    def __init__(self, session: zenoh.Session, token: str):
        self.token = token
        self._seen, self._gone = threading.Event(), threading.Event()
        self._hooks: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._subscriber = session.liveliness().declare_subscriber(token, self._changed, history=True)

    def _changed(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._seen.set()
            return
        with self._lock:
            self._gone.set()
            hooks, self._hooks = self._hooks, []
        for hook in hooks:
            hook()

    @property
    def gone(self) -> bool:
        """Whether the token vanished."""
        return self._gone.is_set()

    def seen(self, timeout: float) -> bool:
        """Wait for the token to appear."""
        return self._seen.wait(timeout)

    def wait(self, timeout: float) -> bool:
        """Wait for the token to vanish; True if it did."""
        return self._gone.wait(max(timeout, 0.0))

    def once_gone(self, hook: Callable[[], None]) -> Callable[[], None]:
        """Call ``hook`` when the token vanishes (at once if it has); returns the way to withdraw it."""
        with self._lock:
            if not self._gone.is_set():
                self._hooks.append(hook)
                return lambda: self._withdraw(hook)
        hook()
        return lambda: None

    def _withdraw(self, hook: Callable[[], None]) -> None:
        with self._lock:
            if hook in self._hooks:
                self._hooks.remove(hook)

    def close(self) -> None:
        """Stop watching; idempotent."""
        undeclare(self._subscriber)


def matching(end: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether the other end is there. The library's stub says bool; what comes is an object that is always true."""
    status: Any = end.matching_status
    return status if isinstance(status, bool) else status.matching


def wait_matching(
    end: zenoh.Publisher | zenoh.Querier, deadline: float, *, wanted: bool = True, watch: Watch | None = None
) -> bool:
    """Wait until the other end is there (``wanted``) or gone; False past ``deadline`` or once ``watch`` is gone."""
    if matching(end) is wanted:
        return True  # nearly always, and far cheaper than to listen
    changed = threading.Event()
    # called by zenoh itself, for it only sets a flag; a thread of its own for each wait would cost more
    news = zenoh.handlers.Callback(lambda _: changed.set(), indirect=False)
    listener = end.declare_matching_listener(news)
    withdraw = watch.once_gone(changed.set) if watch is not None else None
    try:
        while True:
            changed.clear()  # before the look: what changes after it wakes us
            if matching(end) is wanted:
                return True
            left = deadline - time.monotonic()
            if left <= 0 or (watch is not None and watch.gone):
                return False
            changed.wait(left)
    finally:
        if withdraw is not None:
            withdraw()
        undeclare(listener)


def undeclare(
    entity: zenoh.Publisher | zenoh.Subscriber | zenoh.Queryable | zenoh.LivelinessToken | zenoh.MatchingListener,
) -> None:
    """End what was opened on a session; no error where the session was closed before."""
    try:
        entity.undeclare()
    except zenoh.ZError:
        return
