"""What a decoder may take for one case: a second of the processor, and 200 MB of memory."""

from __future__ import annotations

import resource
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

SECONDS = 1.0
ROOM_MB = 200.0

_PEAK, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Hang(BaseException):
    """The watchdog has barked. No Exception: what a decoder catches must not hide it."""


class Hog(Exception):
    """A case took more memory than it may."""


@dataclass
class Watch:
    """The dearest of the cases so far."""

    cases: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Watch one case. Raises Hang within it, Hog behind it."""
        before = _rss_peak_mb(reset=True)
        signal.signal(signal.SIGPROF, _bark)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: a crowded machine hangs nothing
        begin = time.process_time()
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            self.cases += 1
            self.seconds = max(self.seconds, time.process_time() - begin)
            grown = _rss_peak_mb() - before
            self.megabytes = max(self.megabytes, grown)
        if grown > ROOM_MB:
            raise Hog(f"{grown:.0f} MB for one case")


def _bark(_signal: int, _frame: object) -> None:
    raise Hang(f"more than {SECONDS:g} s of the processor for one case")


def _rss_peak_mb(reset: bool = False) -> float:
    """Most memory that this process had [MB] since the last ``reset``."""
    try:
        if reset:
            _RESET.write_text("5")
        text = _PEAK.read_text()
        return int(text.partition("VmHWM:")[2].split(maxsplit=1)[0]) / 1024
    except (OSError, ValueError, IndexError):  # another system than Linux keeps the peak, but not since when
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
