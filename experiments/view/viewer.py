"""Rerun's viewer as a process of ours: in a window, or as a server for a browser on this machine.

Its reports of use are off: it gets settings of its own, in which they are switched off, and is told what a build
machine tells it, which switches them off by itself. The user's own settings of Rerun are not touched.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from experiments.ports import free_port
from experiments.view import package
from experiments.view.page import HOST, Page
from mechanics.yaml_input import InputError, Problem

PORT = 9090
"""Of the web page; its data go over the next one."""

_START, _END = 30.0, 5.0

# the program ends with this process, even where this one is killed: the kernel's signal outlives an exec
_BIND = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
BOUND = [sys.executable, "-I", "-S", "-c", _BIND] if sys.platform == "linux" else []
"""What stands before a command that is to end with this process."""
_STEP = 0.05


class Viewer:
    """The viewer as a context manager. ``data`` is where a recording is sent to, ``url`` the page of a web viewer.

    Raises InputError where it cannot be started: no package, no screen, a port that is taken.
    """

    def __init__(self, *, web: bool, port: int = PORT):
        self.web, self._port = web, port
        self.url = self.data = ""
        self._stack = ExitStack()
        self._process: subprocess.Popen[bytes] | None = None
        self._said: list[str] = []

    def __enter__(self) -> Self:
        program = package.viewer()
        with ExitStack() as stack:
            settings = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="extrinsic-view-")))
            environment = quiet(settings)
            switch_off(program, environment)
            data = _wanted(self._port + 1) if self.web else free_port()
            command = [str(program), "--bind", HOST, "--port", str(data)]
            source = free_port()
            if self.web:
                command += ["--serve-web", "--web-viewer-port", str(source), "--server-memory-limit", "50%"]
            else:
                command += ["--hide-welcome-screen", "--expect-data-soon"]
            page = stack.enter_context(Page(self._port, source, data)) if self.web else None
            stack.callback(self._stop)
            self._process = subprocess.Popen(
                [*BOUND, *command],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=sys.platform != "win32",  # Ctrl-C is for us; we end it
            )
            listener = threading.Thread(target=self._listen, name="viewer", daemon=True)
            listener.start()
            stack.callback(listener.join, _END)
            stack.callback(self._stop)
            for port in (data, source) if self.web else (data,):
                self._wait_for(port)
            self.data = f"rerun+http://{HOST}:{data}/proxy"
            self.url = "" if page is None else page.url
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def open(self) -> bool:
        """Whether it still runs; a window may have been closed."""
        return self._process is not None and self._process.poll() is None

    def wait(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds for its end; whether it has ended."""
        try:
            return self._process is None or self._process.wait(timeout) is not None
        except subprocess.TimeoutExpired:
            return False

    def _listen(self) -> None:
        process = self._process
        if process is not None and process.stderr is not None:
            for line in process.stderr:
                self._said = [*self._said[-20:], line.decode(errors="replace").rstrip()]

    def _wait_for(self, port: int) -> None:
        """Until it listens at a port. Raises InputError where it ends instead, or takes too long."""
        deadline = time.monotonic() + _START
        while time.monotonic() < deadline:
            try:
                with socket.create_connection((HOST, port), timeout=1.0):
                    return
            except OSError:
                if self.wait(_STEP):
                    break
        said = "; ".join(line for line in self._said if "ERROR" in line or "panicked" in line) or "it says nothing"
        wrong = f"Rerun's viewer did not start: {said}"
        raise InputError([Problem("view", None, "", wrong, "a screen; without one --web, or --save FILE")])

    def _stop(self) -> None:
        process = self._process
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(_END)


def quiet(settings: Path) -> dict[str, str]:
    """The environment of a viewer that reports nothing, with its settings in a folder of our own."""
    without = ("FORCE_RERUN_ANALYTICS", "TELEMETRY_ENABLED", "RERUN_TELEMETRY_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
    kept = {name: value for name, value in os.environ.items() if name not in without}
    own = {"XDG_CONFIG_HOME": str(settings / "config"), "XDG_DATA_HOME": str(settings / "data")}
    if sys.platform == "darwin":
        own = {"HOME": str(settings)}
    return {**kept, **own, "CI": "1", "TELEMETRY_ENABLED": "false"}


def switch_off(program: Path, environment: dict[str, str]) -> None:
    """Switch the viewer's reports off in the settings that it has in ``environment``, by its own command.

    Raises InputError.
    """
    command, quietly = [program, "analytics", "disable"], subprocess.DEVNULL
    try:
        subprocess.run(command, env=environment, stdout=quietly, stderr=quietly, timeout=_START, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        wrong = f"its reports of use cannot be switched off, so it is not started: {error}"
        raise InputError([Problem("view", None, "", wrong, "--save FILE, or another rerun-sdk")]) from None


def _wanted(port: int) -> int:
    """The port, if it can be had. Raises InputError."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
    except (OSError, OverflowError) as error:
        wrong = f"port {port} of {HOST}, over which the page's data go, cannot be had: {error}"
        raise InputError(
            [Problem("view", None, "--port", wrong, "another port; the next one is needed, too")]
        ) from None
    return port
