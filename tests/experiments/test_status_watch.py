"""`extrinsic status --watch` as a person meets it: in a terminal of its own, and in a file."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from .conftest import Command

_STYLES = re.compile(r"\x1b\[[0-9;]*m")
ENTER, LEAVE = "\x1b[?1049h", "\x1b[?1049l"


class Screen:
    """A terminal of 70 columns with `extrinsic` in it."""

    def __init__(self, folder: Path, *arguments: str):
        self.ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 70, 0, 0))
        self.before = termios.tcgetattr(self.ours)
        clean = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "experiments.cli", *arguments],
            cwd=folder,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**clean, "TERM": "xterm-256color"},
            start_new_session=True,
            # Ctrl-C is for whom the terminal controls
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509
        )
        os.close(theirs)
        self.text = ""

    def until(self, pattern: str, seconds: float = 40.0) -> str:
        """Read on until ``pattern`` stands in what comes from now on."""
        deadline, begin = time.monotonic() + seconds, len(self.text)
        while not re.search(pattern, self.text[begin:]):
            assert self._read(deadline), self.text[begin:][-3000:]
        return self.text[begin:]

    def end(self, seconds: float = 20.0) -> int:
        """Read to the end; the exit code."""
        deadline = time.monotonic() + seconds
        while self._read(deadline):
            pass
        return self.process.wait(timeout=seconds)

    def _read(self, deadline: float) -> bool:
        ready, _, _ = select.select([self.ours], [], [], max(deadline - time.monotonic(), 0.0))
        try:
            came = os.read(self.ours, 65536) if ready else b""
        except OSError:  # the other end was closed
            came = b""
        self.text += _STYLES.sub("", came.decode(errors="replace"))
        return bool(came)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(timeout=10)
        os.close(self.ours)


@pytest.fixture
def watched(command: Command) -> Iterator[Screen]:
    screen = Screen(command.folder, "status", "sim", "--watch", "--set", f"bus.endpoint={command.endpoint}")
    yield screen
    screen.close()


def test_a_station_is_followed_as_it_comes_and_goes_and_q_leaves_the_terminal_as_it_was(
    watched: Screen, command: Command
) -> None:
    told = watched.until("nothing listens at")
    assert ENTER in told
    assert "extrinsic serve sim" in watched.until("Start it with")
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    watched.until("7 of 7 devices alive")
    host.send_signal(signal.SIGINT)
    watched.until(r"0 of 7 devices alive[\s\S]*gone for \d+ s")
    os.write(watched.ours, b"q")
    assert watched.end() == 0, watched.text[-3000:]
    assert watched.text.count(LEAVE) == 1
    after = watched.text.rpartition(LEAVE)[2]
    assert "0 of 7 devices alive" in after, "the last picture stays behind"
    assert "Traceback" not in watched.text
    assert termios.tcgetattr(watched.ours) == watched.before


def test_ctrl_c_ends_it_as_well(watched: Screen) -> None:
    watched.until("nothing listens at")
    os.write(watched.ours, b"\x03")
    assert watched.end() == 0
    assert watched.text.count(LEAVE) == 1
    assert termios.tcgetattr(watched.ours) == watched.before


def test_in_a_file_each_look_is_a_plain_line_per_device(command: Command) -> None:
    process = command.start(
        "status", "sim", "--watch", "--interval", "0.1", "--set", f"bus.endpoint={command.endpoint}"
    )
    lines = [process.stdout.readline() for _ in range(14)]  # type: ignore[union-attr]
    process.send_signal(signal.SIGINT)
    finished = command.finish(process)
    assert finished.code == 0 and not finished.err
    line = r'20\S+Z arm absent note="nothing listens at tcp/127.0.0.1:\d+"\n'
    assert re.fullmatch(line, lines[7])
    assert [text.split()[1] for text in lines[:7]] == [text.split()[1] for text in lines[7:]]
    assert "\x1b" not in "".join(lines)


def test_a_watched_station_is_no_single_json_file(command: Command) -> None:
    finished = command.finish(command.start("status", "sim", "--watch", "--json", "file.json"))
    assert finished.code == 2
    assert "--json -" in finished.err
