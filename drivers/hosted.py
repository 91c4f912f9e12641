"""The child's side of `drivers.hosting`: a process that serves a station for whoever started it.

It reads one line of JSON from standard input (``{"config": …, "bound": bool}``), says that it begins
(``{"begun": pid}``), answers with one line (``{"ready": pid}`` or ``{"error": …}``) and ends when standard input does,
at SIGTERM or SIGINT: with exit code 0.
"""

from __future__ import annotations

import ctypes
import gc
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Protocol

from drivers.config import StationConfig
from drivers.errors import DriverError, NotConnected

log = logging.getLogger(__name__)


class Stoppable(Protocol):
    """What serves until it is told to stop."""

    def stop(self) -> None:
        """End; safe in a signal handler and from any thread."""
        ...


Serve = Callable[[StationConfig, Callable[[Stoppable], None]], int]
"""What serves a station in this process, and says when it does."""


def main(serve: Serve) -> int:
    """Entry of the process; the exit code is 0, 2 without an order, 3 where it could not be carried out."""
    line = bytearray()
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            return 2
        line += byte
    try:
        order = json.loads(line)
        config = StationConfig.model_validate(order["config"])
        _tell(begun=os.getpid())
        if order.get("bound", False):
            _die_with_parent()

        def ready(host: Stoppable) -> None:
            gc.collect()
            gc.freeze()  # what is here now stays: looking through it again and again costs pauses in mid-step
            threading.Thread(target=_end_with_input, args=(host,), name="parent", daemon=True).start()
            _tell(ready=os.getpid())

        serve(config, ready)
    except NotConnected as error:
        children = [[c.device, c.asked, c.got, c.remedy] for c in error.children]
        _tell(error=error.got, device=error.device, asked=error.asked, remedy=error.remedy, children=children)
        return 3
    except (DriverError, ValueError, KeyError) as error:
        log.exception("the host failed")
        _tell(error=str(error), device="world", asked="serve", remedy="")
        return 3
    return 0


def _tell(**said: object) -> None:
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


def _end_with_input(host: Stoppable) -> None:
    """Stop the host when the parent has gone and standard input with it."""
    while os.read(0, 1):
        pass
    host.stop()


def _die_with_parent() -> None:
    """Have the kernel send SIGTERM when the parent dies: covers a pipe that a third process keeps open."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGTERM, 0, 0, 0)
