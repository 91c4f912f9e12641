"""The process under load: an experiment as `extrinsic run` runs it, whose control loop's sleeps are noted.

It reads one line of JSON from standard input (``{"experiment", "sets", "out", "sleeps"}``) and says on standard output
when its host runs (``{"host": pid}``). When standard input ends, the run is interrupted and ends in order.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import threading
from pathlib import Path
from typing import Self

from rich.console import Console

from drivers.hosting import HostProcess
from drivers.wire.clock import tell_sleeps
from experiments import runner
from experiments.files import load

SLEEP = struct.Struct("<ddd")
"""When a sleep began [s, monotonic], how long it was to take, how long it took [s]."""


class _Told(HostProcess):
    def __enter__(self) -> Self:
        super().__enter__()
        sys.stdout.write(json.dumps({"host": self.pid}) + "\n")
        sys.stdout.flush()
        return self


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

        def note(begin: float, asked: float, took: float) -> None:
            file.write(SLEEP.pack(begin, asked, took))

        tell_sleeps(note)
        resolved = load(order["experiment"], None, order["sets"])
        return int(runner.run(resolved, Path(order["out"]), Console(stderr=True), _Told).exit_code)


if __name__ == "__main__":
    sys.exit(main())
