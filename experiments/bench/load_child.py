"""A process of `extrinsic bench load`: a Python module that is told lines and says lines of JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, Self

from drivers.errors import NotConnected

#: how long a process may take to start or to end, compilers and the closing of a log of gigabytes included [s]
PATIENCE = 180.0
_LAST = 20.0  # and to end, once nothing of it is wanted any more [s]
_HERE = str(Path(__file__).resolve().parents[2])


class Child:
    """A Python module as a process that takes lines and says lines of JSON; a context manager that ends and reaps it.

    Closing its standard input asks it to end. What it writes to standard error goes to a file in ``folder``.
    """

    def __init__(self, module: str, name: str, folder: Path):
        self.name, self._module = name, module
        self._errors = folder / f"{name}.txt"
        self._said: SimpleQueue[dict[str, Any] | None] = SimpleQueue()

    def __enter__(self) -> Self:
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", self._module],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (_HERE, os.environ.get("PYTHONPATH"))))},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                encoding="utf-8",
                start_new_session=True,  # an interrupt from the keyboard is for this process, which then ends that one
            )
        assert self._process.stdout is not None
        self._listener = threading.Thread(target=self._hear, args=(self._process.stdout,), daemon=True, name=self.name)
        self._listener.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ask_to_end()
        try:
            self._process.wait(_LAST)
        except subprocess.TimeoutExpired:
            self.kill()
        self._listener.join(1.0)
        assert self._process.stdout is not None
        self._process.stdout.close()

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def wait(self, timeout: float) -> bool:
        """Wait until it has ended, so many seconds at most; whether it has."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def tell(self, line: str) -> None:
        """Send it a line; one that has ended hears nothing."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except OSError:
            return

    def heard(self, key: str, timeout: float = PATIENCE) -> Any:
        """Wait for what it says under ``key``. Raises NotConnected where it ends or stays silent instead."""
        try:
            while (said := self._said.get(timeout=timeout)) is not None:
                if key in said:
                    return said[key]
        except Empty:
            pass
        raise NotConnected(self.name, f"hear its {key}", self.last_words() or "nothing came", "See what it says")

    def last_words(self) -> str:
        """The end of what it wrote to standard error."""
        lines = self._errors.read_text(encoding="utf-8", errors="replace").splitlines()
        return " ".join(line.strip() for line in lines if line.strip())[-400:]

    def ask_to_end(self) -> None:
        """Close its standard input; idempotent."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError:
            return

    def kill(self) -> None:
        """End it, and wait until it has ended."""
        self._process.kill()
        self._process.wait()

    def _hear(self, stdout: IO[str]) -> None:
        for line in stdout:
            try:
                self._said.put(json.loads(line))
            except ValueError:
                continue
        self._said.put(None)
