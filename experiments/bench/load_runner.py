"""The process under load: an experiment as `extrinsic run` runs it, whose control loop's sleeps are noted.

It reads one line of JSON from standard input (``{"experiment", "sets", "out", "sleeps"}``) and says on standard output
when its host runs (``{"host": pid}``) and when its control loop does (``{"loop": true}``). When standard input ends,
the run is interrupted and ends in order.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from control.motion import Mover
from drivers.hosting import HostProcess
from drivers.interfaces import Clock
from drivers.wire.clock import RemoteClock
from experiments import runner
from experiments.bench.load_ticks import SLEEP
from experiments.files import load
from experiments.terminal import terminal


class _Told(HostProcess):
    def __enter__(self) -> Self:
        super().__enter__()
        _say(host=self.pid)
        return self


def _say(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


class _LoopClock:
    """A clock as a control loop has it: the sleep that is under way is the loop's."""

    def __init__(self, clock: Clock):
        self._clock, self.lockstep, self.now_ns = clock, clock.lockstep, clock.now_ns
        self.asleep = False

    def sleep(self, seconds: float) -> None:
        """As the clock's."""
        self.asleep = True
        try:
            self._clock.sleep(seconds)
        finally:
            self.asleep = False


def time_sleeps(told: Callable[[float, float, float, bool], None]) -> None:
    """Have every sleep of this process's clocks told: its begin [s, monotonic], what was asked for, what it took [s].

    And whether it is one between two set-points: what lies between two of those is the work of the control loop, and
    what such a sleep took too long its lateness.
    """
    sleep, begin_motion, loops = RemoteClock.sleep, Mover.__init__, []

    def moves(self: Mover, arm: Any, clock: Clock, *rest: Any, **named: Any) -> None:
        loops[:] = [_LoopClock(clock)]
        begin_motion(self, arm, loops[0], *rest, **named)

    def timed(self: RemoteClock, seconds: float) -> None:
        own, begin = any(loop.asleep for loop in loops), time.monotonic()
        sleep(self, seconds)
        told(begin, seconds, time.monotonic() - begin, own)

    Mover.__init__, RemoteClock.sleep = moves, timed


def _interrupt_with_input() -> None:
    while sys.stdin.read(1):
        pass
    os.kill(os.getpid(), signal.SIGINT)


def main() -> int:
    """Entry of the process; returns the run's exit code."""
    order = json.loads(sys.stdin.readline())
    threading.Thread(target=_interrupt_with_input, name="order", daemon=True).start()
    # into a file, not a list: the process's own memory is among what is measured
    with Path(order["sleeps"]).open("wb") as file:
        resolved, looping = load(order["experiment"], None, order["sets"]), False

        def note(begin: float, asked: float, took: float, own: bool) -> None:
            nonlocal looping
            file.write(SLEEP.pack(begin, asked, took, own))
            if own and not looping:
                looping = True
                _say(loop=True)

        time_sleeps(note)
        return int(runner.run(resolved, Path(order["out"]), terminal(stderr=True), _Told).exit_code)


if __name__ == "__main__":
    sys.exit(main())
