"""N random kills of the runner and of the sim host, N from KILLS (50): what is left can be read, and goes on.

Prints how many logs could be read, the most that any of them misses, and how many resumed runs have the figures of an
undisturbed one. ``KILLS=10 pytest -m slow tests/experiments/test_kills.py`` takes some five minutes.
"""

import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from drivers.errors import ProtocolError
from drivers.sim.host_thread import HostThread
from drivers.wire.log_reader import LogReader
from experiments.files import load
from experiments.resume import resume

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3 * 3600)]

DOOMED = Path(__file__).with_name("doomed.py")
KILLS = int(os.environ.get("KILLS", "50"))
#: what may be missing from a log [s]: the flush period of the station file
MOST = 0.5
SETS = (
    "world.profile=lab",
    "trial.go_pose=tactile",
    "stages.0.parameters.steps=3",
    "stages.1.trials=2",
)
_TICK = 16


@pytest.fixture
def experiment(tmp_path, monkeypatch):
    """The experiment's file, in a folder of its own, which is the current one."""
    from experiments.files import dump_resolved

    monkeypatch.chdir(tmp_path)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    Path("short.yaml").write_text(dump_resolved(load("grasped_static", None, [*SETS, f"bus.endpoint={endpoint}"])))
    return "short.yaml"


def started(run, experiment, ticks):
    """A run in a process of its own that has begun: it has said its first line."""
    process = subprocess.Popen(
        [sys.executable, DOOMED, run, experiment, "never", ticks], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    assert process.stderr.readline()
    return process


def host_of(process):
    """The process of the station that a run has started, as the kernel knows it; None where there is none."""
    try:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for child in map(int, children):
            if b"drivers.sim.host" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child, os.pidfd_open(child)
    except OSError:
        pass
    return None


def await_end(host):
    """A station ends by itself when its run has died; the port is free then."""
    if host is not None:
        assert select.select([host[1]], [], [], 30)[0], "the station outlived its run"
        os.close(host[1])


def missing(run, ticks):
    """How much of what was done until the kill the log does not have [s], by the control ticks; None before any.

    Each left its wall time and its station time, before and after: what counts is the wall time from the last instant
    that the log reaches to the last one that there was.
    """
    log = run / "log.mcap"
    newest = max((m.publish_ns for m in LogReader(log).messages()), default=0) if log.stat().st_size else 0
    data = Path(ticks).read_bytes() if Path(ticks).exists() else b""
    told = [
        (int.from_bytes(data[i : i + 8], "little"), int.from_bytes(data[i + 8 : i + 16], "little"))
        for i in range(0, len(data) - len(data) % _TICK, _TICK)
    ]
    if not told:
        return None
    reached = max((wall for wall, station in told if station <= newest), default=told[0][0])
    return (told[-1][0] - reached) * 1e-9


def figures(results):
    kept = ("name", "status", "measured", "truth", "contact")
    return [{key: trial[key] for key in kept} for trial in results["trials"]]


@pytest.mark.parametrize("victim", ["runner", "host"])
def test_after_random_kills_every_log_is_readable_and_every_run_goes_on(experiment, victim, capsys):
    draw = random.Random(f"{victim} {KILLS}")
    process = started("undisturbed", experiment, "undisturbed.ticks")
    begin = time.monotonic()
    assert process.stderr is not None
    assert process.wait(300) == 0, process.stderr.read().decode()
    process.stderr.close()
    lasts = time.monotonic() - begin
    expected = figures(json.loads(Path("undisturbed/results.json").read_text()))
    readable, same, losses, codes, said = 0, 0, [], [], []
    for number in range(KILLS):
        run, ticks = Path(f"run-{number}"), f"{number}.ticks"
        process = started(run, experiment, ticks)
        with suppress(subprocess.TimeoutExpired):
            process.wait(draw.uniform(0, lasts))
        host = host_of(process)
        if victim == "runner":
            process.send_signal(signal.SIGKILL)
        elif host is not None:
            os.kill(host[0], signal.SIGKILL)
        codes.append(process.wait(120))
        assert process.stderr is not None
        process.stderr.close()
        await_end(host)
        try:
            losses.append(missing(run, ticks))
            readable += 1
        except ProtocolError as error:
            said.append(f"{run}: {error}")
        if victim == "host" and codes[-1] != 0:
            results = json.loads((run / "results.json").read_text())
            assert codes[-1] == 3 and results["status"] == "device_failed", results["reason"]
        outcome = resume(run, console=Console(quiet=True), host=HostThread)
        same += figures(outcome.results) == expected
    moving = [loss for loss in losses if loss is not None]
    worst = max(moving, default=0.0)
    said.append(
        f"{KILLS} kills of the {victim} within {lasts:.0f} s: {readable} logs readable, {len(moving)} of them of a "
        f"moved arm, at most {worst:.2f} s missing; {same} resumed runs with the same figures; exit codes {codes}"
    )
    with capsys.disabled():
        sys.stdout.write("\n" + "\n".join(said) + "\n")
    assert readable == same == KILLS
    assert worst <= MOST
