"""Runs of the command as a user starts it: a process of its own, on a free port, in an empty folder."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.run_folder import RunFolder
from tests.experiments.chromium import launched, opener

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # a shell has its background jobs ignore Ctrl-C, and the commands under test would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def browser():
    """Chromium, for a page that draws without a graphics processor."""
    with launched("--disable-gpu") as browser:
        yield browser


@pytest.fixture(scope="module")
def open_page(browser):
    """See `tests.experiments.chromium.opener`."""
    with opener(browser) as open_page:
        yield open_page


@pytest.fixture
def run(finished, tmp_path):
    """A copy of the folder of a module's ``finished`` run, to be damaged."""
    return RunFolder(shutil.copytree(finished.folder, tmp_path / "run"))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@dataclass
class Finished:
    code: int
    out: str
    err: str
    folder: Path

    @property
    def results(self):
        return json.loads((self.folder / "results.json").read_text())

    def trial(self, controller):
        return next(trial for trial in self.results["trials"] if trial["controller"] == controller)


class Command:
    """`extrinsic` in ``folder``; every process it starts is stopped by `stop`."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._started: list[subprocess.Popen] = []

    def start(self, *arguments: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments.cli", *arguments],
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "160"},
        )
        self._started.append(process)
        return process

    def run(self, experiment: str, *arguments: str, out: str = "run") -> Finished:
        return self.finish(self.start_run(experiment, *arguments, out=out), out)

    def start_run(self, experiment: str, *arguments: str, out: str = "run") -> subprocess.Popen:
        return self.start("run", experiment, "--out", out, "--set", f"bus.endpoint={self.endpoint}", *arguments)

    def finish(self, process: subprocess.Popen, out: str = "run", timeout: float = 100) -> Finished:
        stdout, stderr = process.communicate(timeout=timeout)
        return Finished(process.returncode, stdout, stderr, self.folder / out)

    def stop(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.communicate(timeout=10)


@pytest.fixture
def command(tmp_path):
    command = Command(tmp_path)
    yield command
    command.stop()


@pytest.fixture(scope="module")
def shared_command(tmp_path_factory):
    command = Command(tmp_path_factory.mktemp("runs"))
    yield command
    command.stop()
