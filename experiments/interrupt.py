"""Ctrl-C, SIGTERM and a terminal that is closed: one orderly end, at any moment, that nothing cuts short."""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupt:
    """While it is entered, the first of `SIGNALS` raises KeyboardInterrupt; later ones only say to wait: ``said``.

    A SIGHUP that is ignored already stays so: that is what nohup asks for.

    A library may swallow the exception where it is raised (in a callback, in a destructor), so the loops call `check`,
    which raises it again. Once `closing` was called nothing raises any more: the arm is being held and the log closed.
    """

    def __init__(self, said: str = "closing: the arm is held and the log is being written") -> None:
        self._said = said
        self._requested = self._closing = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # Python allows handlers nowhere else
            for number in SIGNALS:
                if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self._requested or self._closing:
            with suppress(OSError, ValueError):  # the terminal may have gone
                sys.stderr.write(f"{self._said}\n")
            return
        self._requested = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise KeyboardInterrupt if one was asked for."""
        if self._requested and not self._closing:
            raise KeyboardInterrupt

    def closing(self) -> None:
        """From now on the end is under way and is not interrupted."""
        self._closing = True

    @property
    def requested(self) -> bool:
        """Whether somebody asked for the end."""
        return self._requested
