"""The process under load: an experiment as `extrinsic run` runs it, whose control loop's sleeps are noted.

It reads one line of JSON from standard input (``{"experiment", "sets", "out", "sleeps"}``) and says on standard output
when its host runs (``{"host": pid}``) and when its control loop does (``{"loop": true}``). When standard input ends,
the run is interrupted and ends in order.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable
from math import isclose
from pathlib import Path
from typing import Self

from drivers.hosting import HostProcess
from drivers.wire.clock import RemoteClock
from experiments import runner
from experiments.files import load
from experiments.terminal import terminal

SLEEP = struct.Struct("<ddd")
"""When a sleep began [s, monotonic], how long it was to take, how long it took [s]."""


class _Told(HostProcess):
    def __enter__(self) -> Self:
        super().__enter__()
        _say(host=self.pid)
        return self


def _say(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


def time_sleeps(told: Callable[[float, float, float], None]) -> None:
    """Have every sleep of this process's clocks told: its begin [s, monotonic], what was asked for, what it took [s].

    What lies between two sleeps is the work of a control loop, and what a sleep took too long its lateness.
    """
    sleep = RemoteClock.sleep

    def timed(self: RemoteClock, seconds: float) -> None:
        begin = time.monotonic()
        sleep(self, seconds)
        told(begin, seconds, time.monotonic() - begin)

    RemoteClock.sleep = timed


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
        period = 1.0 / resolved.experiment.trial.control_rate

        def note(begin: float, asked: float, took: float) -> None:
            nonlocal looping
            file.write(SLEEP.pack(begin, asked, took))
            if not looping and isclose(asked, period, rel_tol=1e-6):
                looping = True
                _say(loop=True)

        time_sleeps(note)
        return int(runner.run(resolved, Path(order["out"]), terminal(stderr=True), _Told).exit_code)


if __name__ == "__main__":
    sys.exit(main())
