"""Fits of small matrices run on one thread: on several they wait for each other longer than they work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra inside the block uses one thread."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield
