"""Whatever ends a run, a closed terminal or a defect of ours, it is closed in order, says how, and can go on."""

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time

import pytest
from rich.console import Console

from drivers.errors import CommandRefused
from drivers.sim.host_thread import HostThread
from drivers.wire.log_reader import LogReader
from experiments import runner, stages
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.resume import resume


@pytest.fixture
def resolved():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    short = ["stages.0.parameters.steps=2", "stages.1.controllers=[open_loop]", "stages.1.trials=2"]
    return load("grasped_static", None, [f"bus.endpoint={endpoint}", *short])


def begin(resolved, folder):
    return runner.run(resolved, folder, Console(quiet=True), HostThread)


def assert_whole(folder, status):
    """Log closed and readable, results with the end, a report."""
    results = json.loads((folder / "results.json").read_text())
    assert results["status"] == status and results["reason"] and results["finished"]
    reader = LogReader(folder / "log.mcap")
    assert sum(1 for _ in reader.messages()) > 0 and reader.complete
    assert (folder / "report.html").is_file()
    return results


def test_sigterm_closes_in_order(command):
    process = command.start_run("grasped_static")
    for line in process.stderr:
        if "open_loop" in line:
            break
    process.send_signal(signal.SIGTERM)
    finished = command.finish(process)
    assert finished.code == 130
    assert_whole(finished.folder, "interrupted")


def test_a_terminal_that_is_closed_ends_the_run_in_order(tmp_path, command):
    """The kernel sends SIGHUP, and whatever is written from then on fails."""
    terminal, theirs = pty.openpty()
    own = (
        "import fcntl, signal, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0);"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL);"  # however these tests were started: `nohup` stays ignored
        "from experiments.cli import main; main()"
    )
    child = [sys.executable, "-c", own, "run", "grasped_static", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(
        # so many trials that a crowded machine does not end them before it closes the terminal
        [*child, "--set", f"bus.endpoint={command.endpoint}", "--set", "stages.1.trials=20"],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=tmp_path,
        start_new_session=True,
    )
    os.close(theirs)
    try:
        said, deadline = b"", time.monotonic() + 90
        while b"open_loop" not in said:
            assert time.monotonic() < deadline, said
            said += os.read(terminal, 4096)
        os.close(terminal)
        assert process.wait(90) != 0
    finally:
        process.kill()
        process.wait()
    assert_whole(tmp_path / "run", "interrupted")


def test_nohup_keeps_a_run_going(resolved, tmp_path):
    """A SIGHUP that is ignored already stays so."""
    from experiments.interrupt import Interrupt

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            interrupt.check()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_defect_in_a_stage_is_told_and_kept_and_the_run_goes_on_once_it_is_mended(resolved, tmp_path, monkeypatch):
    made, number = stages._row, 0

    def defective(*arguments):
        nonlocal number
        number += 1
        return made(*arguments) if number == 1 else {}[number]

    with monkeypatch.context() as patched:
        patched.setattr(stages, "_row", defective)
        outcome = begin(resolved, tmp_path / "run")
    assert outcome.exit_code is ExitCode.FAILED
    results = assert_whole(tmp_path / "run", "failed")
    assert results["reason"].startswith("KeyError: 2. This is a defect")
    assert "in defective" in (tmp_path / "run" / runner.TRACEBACK).read_text()
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert events[-1]["level"] == "error" and events[-1]["text"] == results["reason"]
    assert [trial["trial"] for trial in results["trials"]] == [0]
    outcome = resume(tmp_path / "run", console=Console(quiet=True), host=HostThread)
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    assert [trial["trial"] for trial in outcome.results["trials"]] == [0, 1]
    assert outcome.results["trials"][0] == results["trials"][0]


def test_a_station_that_cannot_be_closed_is_told_and_takes_no_result_with_it(resolved, tmp_path):
    class Stubborn(HostThread):
        def close(self):
            super().close()
            raise CommandRefused("world", "close", "it sticks", "See to it")

    outcome = runner.run(resolved, tmp_path / "run", Console(quiet=True), Stubborn)
    assert outcome.exit_code is ExitCode.DEVICE_FAILED and "it sticks" in outcome.reason
    results = assert_whole(tmp_path / "run", "device_failed")
    assert [trial["status"] for trial in results["trials"]] == ["completed", "completed"]
    again = resume(tmp_path / "run", console=Console(quiet=True), host=HostThread)
    assert again.exit_code is ExitCode.DONE
    assert again.results["trials"] == results["trials"]


def test_a_second_signal_does_not_cut_the_closing_short_even_without_a_terminal(resolved, tmp_path, monkeypatch):
    """It comes while the log is being closed, and its words cannot be written."""
    from drivers.wire.log import LogWriter

    close = LogWriter.close

    class Gone:
        def write(self, _text):
            raise OSError("the terminal has gone")

    def interrupted(log):
        with monkeypatch.context() as patched:
            patched.setattr(sys, "stderr", Gone())
            os.kill(os.getpid(), signal.SIGTERM)
        close(log)

    monkeypatch.setattr(LogWriter, "close", interrupted)
    outcome = begin(resolved, tmp_path / "run")
    assert outcome.exit_code is ExitCode.DONE
    reader = LogReader(tmp_path / "run" / "log.mcap")
    assert sum(1 for _ in reader.messages()) > 0 and reader.complete
