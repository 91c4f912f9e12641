"""A disk that is full, or fills up in the midst of a run: found before the start, or ended in order."""

import errno
import json
import os
import shutil
import socket
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import pytest
from rich.console import Console

from drivers.sim.host_thread import HostThread
from drivers.wire.log_reader import LogReader
from experiments import context as context_module
from experiments import disk, runner
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.resume import resume
from experiments.run_folder import write_atomic
from mechanics.yaml_input import InputError

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def resolved():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    short = ["stages.0.parameters.steps=2", "stages.1.controllers=[open_loop]", "stages.1.trials=2"]
    return load("grasped_static", None, [f"bus.endpoint={endpoint}", *short])


def begin(resolved, folder):
    return runner.run(resolved, folder, Console(quiet=True), HostThread)


def free(monkeypatch, bytes_):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: Usage(10**12, 0, bytes_))


def test_a_disk_with_too_little_room_is_bad_input_and_nothing_is_written(resolved, tmp_path, monkeypatch):
    free(monkeypatch, disk.FLOOR)
    with pytest.raises(InputError, match=r"200 MB are free there, and the run may need 210 MB"):
        begin(resolved, tmp_path / "deep" / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_calibration_that_could_not_be_kept_is_bad_input_before_it_is_made(tmp_path):
    (tmp_path / "notes.txt").write_text("a file")
    for source in (tmp_path / "notes.txt", tmp_path / "notes.txt" / "deep"):
        asked = load("calibrate", None, [f"calibration.source={source}"])
        with pytest.raises(InputError, match=r"notes.txt is a file|it is a file") as caught:
            disk.require_store(asked)
        assert caught.value.problems[0].key == "calibration.source"
    disk.require_store(load("calibrate", None, [f"calibration.source={tmp_path / 'new' / 'deep'}"]))
    disk.require_store(load("grasped_static", None, [f"calibration.source={tmp_path / 'notes.txt'}"]))  # makes none
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_run_is_expected_to_log_more_under_a_law_that_feels(resolved):
    felt = load("grasped_static", None, ["stages.1.controllers=[closed_loop]", "stages.1.trials=8"])
    assert disk.expected(felt) == 8 * disk.FELT
    assert disk.expected(resolved) == 2 * disk.BLIND


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_bad_input(resolved, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="cannot be written"):
        begin(resolved, tmp_path / "run")


def test_a_file_in_the_place_of_the_folder_is_bad_input(resolved, tmp_path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        begin(resolved, tmp_path / "runs" / "run")


def test_an_atomic_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    write_atomic(path, "old")

    def full(_file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomic(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_results_that_cannot_be_written_end_the_run_and_the_old_ones_stay(resolved, tmp_path, monkeypatch):
    """The disk is full for results.json from the end of the first trial on; then there is room again."""
    write_json, full = context_module.write_json, False

    def filling(path, data):
        nonlocal full
        full = full or bool(data["trials"])
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write_json(path, data)

    with monkeypatch.context() as patched:
        patched.setattr(context_module, "write_json", filling)
        patched.setattr(runner, "write_json", filling)
        outcome = begin(resolved, tmp_path / "run")
    assert outcome.exit_code is ExitCode.DEVICE_FAILED
    assert str(tmp_path / "run" / "results.json") in outcome.reason and "--resume" in outcome.reason
    kept = json.loads((tmp_path / "run" / "results.json").read_text())
    assert kept["status"] == "running" and kept["trials"] == []
    outcome = resume(tmp_path / "run", console=Console(quiet=True), host=HostThread)
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    assert [trial["trial"] for trial in outcome.results["trials"]] == [0, 1]


#: the run of a process whose files may be so large only: the log's chunks come to that in the first trial or the second
LIMITED = """
import resource, signal, sys
from pathlib import Path
from rich.console import Console
from drivers.sim.host_thread import HostThread
from experiments import runner
from experiments.files import load
from experiments.context import RunContext

limit = int(sys.argv[2])
begin = RunContext.begin

def begin_limited(context, *arguments, **options):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    begin(context, *arguments, **options)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

RunContext.begin = begin_limited
outcome = runner.run(load(sys.argv[3]), Path(sys.argv[1]), Console(stderr=True), HostThread)
sys.exit(int(outcome.exit_code))
"""


def test_a_log_that_can_grow_no_more_ends_the_run_in_order(resolved, tmp_path):
    """By a limit of the kernel, as near to a full disk as one comes without a disk of one's own."""
    from experiments.files import dump_resolved

    (tmp_path / "experiment.yaml").write_text(dump_resolved(resolved))
    run = tmp_path / "run"
    limit = 400_000
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, run, str(limit), tmp_path / "experiment.yaml"],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    results = json.loads((run / "results.json").read_text())
    assert ended.returncode == ExitCode.DEVICE_FAILED, ended.stderr
    assert results["status"] == "device_failed"
    assert str(run / "log.mcap") in results["reason"] and f"--resume {run}" in results["reason"]
    reader = LogReader(run / "log.mcap")
    kept = sum(1 for _ in reader.messages())
    assert kept > 1000 and not reader.complete
    assert (run / "log.mcap").stat().st_size <= limit
    assert "error" in (run / "events.jsonl").read_text()
    outcome = resume(run, console=Console(quiet=True), host=HostThread)
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    assert [trial["status"] for trial in outcome.results["trials"]] == ["completed", "completed"]
    assert Path(run / "log.1.mcap").is_file()
