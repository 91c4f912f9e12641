"""A clock that a test turns by hand, in the place of `time`."""

from __future__ import annotations


class Time:
    """``now`` [s] is the monotonic time; the time of the day goes with it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        """As `time.monotonic`."""
        return self.now

    def time_ns(self) -> int:
        """As `time.time_ns`."""
        return 1_700_000_000_000_000_000 + round(self.now * 1e9)
