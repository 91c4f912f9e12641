"""When a frame was exposed, in Unix time, by the clock of a camera."""

from __future__ import annotations

from collections import deque

#: a time of exposure in Unix time is believed where it lies so far before the arrival, or after it [ns]
_OLDEST, _AHEAD = 1_000_000_000, 20_000_000
#: where a camera's clock steps by so much against ours, it was set anew [ns]
_STEP = 500_000_000
#: frames among which the quickest arrival is sought: clocks of two crystals drift apart by a millisecond in a minute
_FRAMES = 300


class FrameClock:
    """Puts a camera's times into ours.

    A camera whose library tells Unix time is believed where that is plausible. Any other clock, and that of a
    recording, counts from an unknown instant: the frame that came soonest, among the last three hundred, is taken to
    have been ``delay`` [s] on its way, and the others have the camera's own distances from it. So what they wait for on
    their way does not tell in their times.
    """

    def __init__(self, delay: float = 0.0):
        self._delay = round(delay * 1e9)
        self._offsets: deque[int] = deque(maxlen=_FRAMES)
        self._last: int | None = None

    def restart(self) -> None:
        """The camera's clock begins anew; ours goes on."""
        self._offsets.clear()

    def capture_ns(self, told_ns: int, arrival_ns: int, unix: bool) -> int:
        """When the frame was exposed [ns, Unix time] that came at ``arrival_ns``; later than every one before.

        ``told_ns`` is the camera's time of it, in Unix time where ``unix``.
        """
        if unix and -_AHEAD <= arrival_ns - told_ns <= _OLDEST:
            capture = min(told_ns, arrival_ns)
        else:
            offset = arrival_ns - told_ns
            if self._offsets and abs(offset - self._offsets[-1]) > _STEP:
                self._offsets.clear()
            self._offsets.append(offset)
            capture = told_ns + min(self._offsets) - self._delay
        if self._last is not None:
            capture = max(capture, self._last + 1)
        self._last = capture
        return capture
