"""One commander at a time: the rules of the arm's lease, without a clock or a bus of their own.

A holder is a string that no two commanders share. A lease is lost when its holder gives it back, lets it lapse, or
goes (its liveliness token vanishes). Times are seconds of any steady clock.
"""

from __future__ import annotations

from dataclasses import dataclass

TIME_TO_LIVE = 1.0
"""How long a lease lasts without renewal [s] where nobody says otherwise: the reach of a frozen commander."""

RENEWAL = 0.25
"""How often a holder renews [s]: three renewals may be lost before the lease lapses."""


@dataclass
class LeaseTable:
    """Who may command. Not thread-safe; the server locks."""

    time_to_live: float = TIME_TO_LIVE
    _holder: str | None = None
    _until: float = 0.0
    _lapsed: str | None = None

    def holder(self, now: float) -> str | None:
        """Who has the lease at ``now``, or None."""
        return self._holder if self._holder is not None and now < self._until else None

    def acquire(self, holder: str, now: float) -> bool:
        """Take the lease if it is free or already one's own."""
        if self.holder(now) not in (None, holder):
            return False
        self._holder, self._until, self._lapsed = holder, now + self.time_to_live, None
        return True

    def renew(self, holder: str, now: float) -> bool:
        """Keep the lease for another time to live. A lease that lapsed cannot be renewed, only acquired anew."""
        if self.holder(now) != holder:
            return False
        self._until = now + self.time_to_live
        return True

    def release(self, holder: str) -> bool:
        """Give the lease back; True if ``holder`` had it, lapsed or not."""
        if self._holder != holder:
            return False
        self._holder = None
        return True

    def lapse(self, now: float) -> str | None:
        """Free a lease that ran out; returns who lost it, once."""
        if self._holder is None or now < self._until:
            return None
        self._lapsed, self._holder = self._holder, None
        return self._lapsed

    def has_lapsed(self, holder: str, now: float) -> bool:
        """Whether ``holder`` was the last to lose a lease by letting it run out."""
        return holder in (self._lapsed, self._holder) and self.holder(now) != holder
