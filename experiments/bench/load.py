"""`extrinsic bench load`: the lab's real rates for minutes on end, logged, while viewers come and go.

A run as `extrinsic run` makes it, in a process of its own, on a simulated station in real time in another: two Soft
Bubbles, camera, two force/torque sensors at 1 kHz, arm. What was lost, how the memory of every process went, and what
viewers on the decimated topics cost the run's control loop.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from drivers.config import StationConfig, TactileConfig, TagCameraConfig
from drivers.errors import NotConnected
from experiments.bench import load_ticks
from experiments.bench.figures import Figure, figure_of
from experiments.bench.load_child import PATIENCE, Child
from experiments.bench.memory import own_memory, slope
from experiments.bench.sim import frame_times
from experiments.files import Resolved, load
from experiments.ports import free_endpoint
from mechanics.yaml_input import InputError, Problem

EXPERIMENT = "grasped_static"
MINUTES, VIEWERS = 20.0, 4
#: what it takes to begin, and to look at the log afterwards, beside those minutes [s]
AROUND = 60.0
#: the gates are there, but wide: a set-point that a crowded machine has held up is not to end the measurement
LIMITS = {
    "age": 5,
    "silence": 5,
    "acceleration": 1000,
    "turn_acceleration_deg": 1e6,
    "jump": 1000,
    "hold_after": 2,
    "stop_after": 5,
}
#: of the whole time: left out of the slopes of memory, and how long a block of their regression is
WARM_UP, BLOCK = 0.1, 0.05
#: how long a phase with or without viewers is at least where there is time, and how long viewers come and go [s]
PHASE, SETTLE = 30.0, 2.0
#: between two looks at the memory, and at the results of a run that is about to end [s]
LOOK, LAST_LOOK = 2.0, 0.2
_TICKS_PER_S = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


def run(minutes: float = MINUTES, viewers: int = VIEWERS, sets: Sequence[str] = ()) -> Iterator[Figure]:
    """Load the station for so many ``minutes``; ``sets`` change experiment and station.

    Raises NotConnected where a process does not come up, InputError for ``sets`` that cannot be, and where the system
    does not tell how much memory a process has.
    """
    try:
        own_memory(os.getpid())
    except OSError:
        wrong, expected = "this system does not tell a process's own memory", "Linux, with /proc/PID/smaps_rollup"
        raise InputError([Problem("bench", None, "load", wrong, expected)]) from None
    chosen = [
        "world.clock=realtime",
        f"bus.endpoint={free_endpoint()}",
        "stages.1.controllers=[closed_loop]",
        "health.on_fault=warn",  # how the streams are is measured here
        *(f"devices.arm.limits.{name}={value}" for name, value in LIMITS.items()),
        f"stages.1.trials={max(2, round(6 * minutes))}",  # more than there is time for: it is ended when that is over
        *sets,
    ]
    resolved = load(EXPERIMENT, None, chosen)
    yield from rendering(resolved)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="extrinsic-load-")))
        out, sleeps = folder / "run", folder / "sleeps"
        runner = Child("experiments.bench.load_runner", "runner", folder)
        stack.callback(shutil.rmtree, out, ignore_errors=True)  # gigabytes
        stack.enter_context(runner)
        order = {"experiment": EXPERIMENT, "sets": chosen, "out": str(out), "sleeps": str(sleeps)}
        runner.tell(json.dumps(order))
        pids = {"host": _heard(runner, "host", runner, out), "runner": runner.pid}
        _heard(runner, "loop", runner, out)
        lookers: list[Child] = []
        for i in range(viewers):  # one after the other: to come up together would be a load of another kind
            looker = stack.enter_context(Child("experiments.bench.load_viewer", f"viewer {i + 1}", folder))
            looker.tell(resolved.station.model_dump_json())
            _heard(looker, "ready", runner, out)
            lookers.append(looker)
        pids |= {looker.name: looker.pid for looker in lookers}
        seen = _Watching(runner, lookers, pids)
        seen.run(60 * minutes)
        results = _ended(runner, out)
        yield _kept_going(seen, minutes, results)
        if results.get("log") is None:
            raise NotConnected("runner", "end in order", _reason(runner, out), "`extrinsic run` tells more")
        yield from losses(results["log"])
        yield _slowest(resolved.station, out / results["log"]["file"])
        ticks = load_ticks.ticks_of(load_ticks.read_sleeps(sleeps))
        yield from load_ticks.figures(ticks, seen.phases, viewers)
        yield _looked(lookers, seen)
        yield from seen.figures()


def rendering(resolved: Resolved) -> Iterator[Figure]:
    """What the station's pictures cost the simulator, of one processor, each frame by itself and nothing beside it."""
    shares = []
    for name, device in resolved.station.devices.items():
        if isinstance(device, TactileConfig | TagCameraConfig):
            each = frame_times(resolved, device, 10)
            yield figure_of(f"{name}: frame", each, "ms", f"{device.rate:g} Hz")
            shares.append(float(np.median(each)) * 1e-3 * device.rate)
    yield figure_of("rendering", [100 * sum(shares)], "% of a core", "all pictures at their rates")


def _heard(child: Child, key: str, runner: Child, out: Path) -> Any:
    """What a ``child`` says under ``key``. Raises NotConnected, with the run's own reason where that has ended."""
    try:
        return child.heard(key)
    except NotConnected as error:
        if runner.running and _results(out)["status"] == "running":
            raise
        raise NotConnected("runner", "run on", _reason(runner, out), "`extrinsic run` tells more") from error


def _reason(runner: Child, out: Path) -> str:
    """Why a run has ended, by its results, or what its process said last."""
    return _results(out).get("reason") or runner.last_words()


class _Watching:
    """The time under load: the memory of every process, viewers that come and go."""

    def __init__(self, runner: Child, viewers: Sequence[Child], pids: Mapping[str, int]):
        self._runner, self._viewers, self._pids = runner, viewers, pids
        self.memory: dict[str, list[tuple[float, float]]] = {name: [] for name in pids}
        self.phases: list[load_ticks.Phase] = []
        self.seconds = self.span = self.looked = 0.0
        self._cpu: dict[str, tuple[float, float]] = {}

    def run(self, span: float) -> None:
        """Watch for ``span`` seconds, or until the runner ends."""
        self.span, begin = span, time.monotonic()
        warm = WARM_UP * span
        settle = min(SETTLE, 0.02 * span)
        # viewers look on while all warms up, so that what their first look makes is there before memory counts
        first = load_ticks.Phase(begin + settle, begin + warm, True)
        plan = [first, *load_ticks.schedule(begin + warm, span - warm, PHASE, settle)]
        cpu, look, looking = self._processor(), begin, False
        for phase in plan:
            while time.monotonic() < phase.begin - settle and self._runner.running:
                look = self._look(look, phase.begin - settle)
            if phase.viewers is not looking:
                looking = phase.viewers
                for viewer in self._viewers:
                    viewer.tell("look" if looking else "rest")
            while time.monotonic() < phase.end and self._runner.running:
                look = self._look(look, phase.end)
            if not self._runner.running:
                break
            self.phases += [phase]
            self.looked += (phase.end - phase.begin + settle) * phase.viewers
        self.phases = self.phases[1:]
        self.phases = self.phases[: len(self.phases) // 2 * 2]
        self.seconds = time.monotonic() - begin
        self._cpu = {name: (cpu[name], after) for name, after in self._processor().items() if name in cpu}

    def _look(self, due: float, until: float) -> float:
        """Wait until the next look at the memory is ``due``, ``until``, or the runner's end; when the next look is."""
        if self._runner.wait(max(min(due, until) - time.monotonic(), 0.0)) or time.monotonic() < due:
            return due
        for name, pid in self._pids.items():
            size = own_memory(pid)
            if size is not None:
                self.memory[name].append((time.monotonic(), size))
        return due + min(LOOK, self.span / 200)

    def _processor(self) -> dict[str, float]:
        """The processor time of every process until now [s]."""
        found = {}
        for name, pid in self._pids.items():
            try:
                fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
            except OSError:
                continue
            found[name] = (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
        return found

    def figures(self) -> Iterator[Figure]:
        """Processor and memory of every process, and the slope of the memory with its interval."""
        for name, (before, after) in self._cpu.items():
            yield figure_of(f"{name}: processor", [100 * (after - before) / self.seconds], "% of a core")
        after, block = WARM_UP * self.span, BLOCK * self.span
        ends: dict[str, list[float]] = {}
        for name, seen in self.memory.items():
            if not seen:
                continue
            times, sizes = zip(*seen, strict=True)
            yield figure_of(f"{name}: memory", sizes, "MB", "its own pages (USS)")
            try:
                found = slope(times, sizes, after=after, block=block)
            except ValueError:  # it ended too soon
                continue
            what = f"means of {found.blocks} blocks of {block:g} s after {after:g} s, 95 % interval"
            yield Figure(f"{name}: memory slope", found.slope, found.low, found.high, "MB/h", found.blocks, what)
            ends.setdefault("viewers" if name.startswith("viewer") else name, []).append(found.high)
        for name, highs in ends.items():
            yield figure_of(f"{name}: memory slope, upper end", [max(highs)], "MB/h", "of the interval, the highest")


def _ended(runner: Child, out: Path) -> dict[str, Any]:
    """End the run in order and return its results; the report, of a log of gigabytes, is not waited for."""
    runner.ask_to_end()
    deadline = time.monotonic() + PATIENCE
    # its results are a file, which is looked at anew until the process has ended
    while not runner.wait(LAST_LOOK) and time.monotonic() < deadline:
        if (results := _results(out)).get("status") != "running":
            runner.kill()
            return results
    return _results(out)


def _results(out: Path) -> dict[str, Any]:
    try:
        return json.loads((out / "results.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {"status": "running"}


def _kept_going(seen: _Watching, minutes: float, results: Mapping[str, Any]) -> Figure:
    share = min(100.0, 100 * seen.seconds / (60 * minutes))
    what = f"{minutes:g} min, {len(results.get('trials', ()))} trials"
    if share < 100:
        what += f"; it ended as {results['status']}: {results.get('reason', '')}"
    return figure_of("run kept going", [share], "% of its time", what)


def _looked(viewers: Sequence[Child], seen: _Watching) -> Figure:
    """What each viewer was given while it looked on."""
    counts = []
    for viewer in viewers:
        viewer.ask_to_end()
        counts.append(sum(viewer.heard("seen").values()))
    what = "views of all streams, decoded, in the phases with viewers"
    return figure_of("viewers: messages", [count / seen.looked for count in counts], "1/s", what)


def losses(log: Mapping[str, Any]) -> Iterator[Figure]:
    """Readings lost, stream by stream and together, by the log's own account (`results.json`, ``log``).

    Of a stream the larger of two counts: sequence numbers that never came, and messages that the station published but
    the log has not.
    """
    lost: dict[str, int] = {}
    for topic, count in log["messages"].items():
        missing = max(0, log["published"].get(topic, 0) - count)
        lost[topic] = max(log["gaps"].get(topic, 0), missing)
        yield figure_of(f"{topic}: lost", [lost[topic]], "messages", f"of {count + lost[topic]}")
    unheard = {topic: n for topic, n in log["published"].items() if n and topic not in log["messages"]}
    total = max(sum(lost.values()) + sum(unheard.values()), log["lost"])
    yield figure_of("readings lost", [total], "messages", f"of {sum(log['messages'].values()) + total}")


def _slowest(station: StationConfig, path: Path) -> Figure:
    """What the slowest stream of a device came to, of the rate that its file gives it: below, time was given up."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    told = summary.statistics
    seconds = (told.message_end_time - told.message_start_time) * 1e-9
    counts = {summary.channels[i].topic: n for i, n in told.channel_message_counts.items()}
    shares = {}
    for name, device in station.devices.items():
        count = max((n for topic, n in counts.items() if topic.startswith(f"{station.name}/{name}/")), default=0)
        shares[name] = 100 * count / seconds / device.rate
    slowest = min(shares, key=lambda name: shares[name])
    what = ", ".join(f"{name} {share:.1f} %" for name, share in shares.items())
    least, most = min(shares.values()), max(shares.values())
    return Figure("slowest stream", least, least, most, "% of its rate", 1, f"{slowest}; {what}")
