"""The host of a simulated station as whoever starts it sees it, and the usual one: a child process."""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from drivers.config import StationConfig
from drivers.errors import NotConnected
from drivers.wire.bus import Bus

HOST_START = 20.0
"""How long a simulated host may take to begin [s]; it takes about one."""

HOST_READY = 120.0
"""How long it may then take to serve [s]. It takes about one, and in a fresh installation ten, on a crowded machine
forty: what the simulated devices compute with is compiled once."""

HOST_STOP = 10.0
"""How long a host that was asked to end may take [s]."""

_HERE = str(Path(__file__).resolve().parent.parent)

log = logging.getLogger(__name__)


class StationHost(ABC):
    """A simulated station that serves while it is entered, whatever it runs in."""

    @property
    @abstractmethod
    def pid(self) -> int:
        """The id of the process that it runs in. Raises NotConnected when it does not run."""

    @property
    @abstractmethod
    def bus(self) -> Bus | None:
        """The session that it serves on, where that is in this process."""

    @abstractmethod
    def __enter__(self) -> Self:
        """Serve; raises NotConnected, with the host's own failure as a child."""

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def kill(self) -> None:
        """End it at once, as far as that is possible; it answers no more."""

    @abstractmethod
    def last_words(self) -> str:
        """What it said last, its failure among it."""

    @abstractmethod
    def close(self) -> None:
        """Ask it to end, and see that it does; idempotent."""


def _server(config: StationConfig) -> str:
    """The module that serves a station with a world: simulated devices, or real ones in an emulated lab."""
    return "drivers.sim.host" if config.simulated else "drivers.emulators.lab"


class HostProcess(StationHost):
    """The simulated station as a child process; started by `__enter__`, ended and reaped by `close`.

    It is in a process group of its own, so that an interrupt from the keyboard reaches only this process, which then
    closes in order. It ends by itself when this process dies.
    """

    def __init__(self, config: StationConfig, module: str = ""):
        """``module`` is what the process runs (`drivers.hosted`); by default what the station asks for."""
        self._process: subprocess.Popen[bytes] | None = None
        self._config, self._module = config, module or _server(config)
        self._said: deque[str] = deque(maxlen=50)
        self._listener: threading.Thread | None = None

    @property
    def pid(self) -> int:
        """The process id. Raises NotConnected when it is not running."""
        if self._process is None:
            raise NotConnected(self._config.name, "name its host's process", "there is none", "")
        return self._process.pid

    @property
    def bus(self) -> None:
        """None: its session is in its process."""
        return None

    def __enter__(self) -> Self:
        order = {
            "config": self._config.model_dump(mode="json"),
            # the kernel's signal follows the *thread* that starts the host; one that may end first must not set it
            "bound": threading.current_thread() is threading.main_thread(),
        }
        self._process = process = subprocess.Popen(
            [sys.executable, "-P", "-m", self._module],  # -P: a folder that happens to lie here is no package
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (_HERE, os.environ.get("PYTHONPATH"))))},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            assert process.stdin is not None and process.stdout is not None and process.stderr is not None
            self._listener = threading.Thread(target=self._hear, args=(process.stderr,), name="host", daemon=True)
            self._listener.start()
            try:
                process.stdin.write(json.dumps(order).encode() + b"\n")
                process.stdin.flush()
            except OSError:
                pass  # it ended at once; its last words tell why
            self._await(process.stdout)
        except BaseException:
            self.close()
            raise
        return self

    def _await(self, stdout: IO[bytes]) -> None:
        asked, remedy = "start its simulated host", "Run `extrinsic serve STATION` to see what it says"
        said: dict[str, Any] = {}
        rest = b""
        for patience in (HOST_START, HOST_READY):
            while b"\n" not in rest:  # from the pipe itself: what a buffer holds no select would tell of
                if not select.select([stdout], [], [], patience)[0]:
                    raise NotConnected(self._config.name, asked, f"not ready within {patience:g} s", remedy)
                if not (heard := os.read(stdout.fileno(), 65536)):
                    break
                rest += heard
            line, _, rest = rest.partition(b"\n")
            try:
                said = json.loads(line)
            except ValueError:
                said = {"error": "it ended before it was ready. " + self.last_words()}
            if "begun" not in said:
                break
        if "ready" not in said:
            child = NotConnected(
                said.get("device", "host"),
                said.get("asked", "serve"),
                said.get("error", "?"),
                said.get("remedy", ""),
                children=tuple(NotConnected(*one) for one in said.get("children", [])),
            )
            raise NotConnected(self._config.name, asked, "it failed", remedy, children=(child,))

    def kill(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._process.kill()

    def last_words(self) -> str:
        """The newest lines that the host wrote to its standard error."""
        if self._listener is not None and self._process is not None and self._process.poll() is not None:
            self._listener.join(timeout=1.0)
        return "\n".join(self._said)

    def _hear(self, stderr: IO[bytes]) -> None:
        for line in stderr:
            text = line.decode(errors="replace").rstrip()
            self._said.append(text)
            log.warning("host: %s", text)

    def close(self) -> None:
        """Ask the host to end, insist, and reap it; idempotent."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(HOST_STOP)
            except subprocess.TimeoutExpired:
                log.warning("the simulated host did not end within %g s and was killed", HOST_STOP)
                process.kill()
                process.wait()
        if self._listener is not None:
            self._listener.join(timeout=1.0)
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue  # the other end is gone
