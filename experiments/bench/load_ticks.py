"""What viewers cost a control loop: its work and its lateness in phases with and without them, in pairs.

At a fixed rate a loop that is slowed keeps its period for a while: it sleeps less. So its *work* is looked at, from
waking up to going to sleep again, and its *lateness*, how much longer it slept than it asked to; work and sleep
together are its period.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.bench.figures import Figure
from experiments.statistics import mean
from mechanics.readings import Array

SLEEP = struct.Struct("<4d")
"""When a sleep began [s, monotonic], how long it was to take, how long it took [s]; 1 if it is the control loop's."""

#: a phase in which the loop ticked less often tells nothing: the run was between two trials
FEWEST = 20
#: of the period; a tick that took longer was late
LATE = 1.5


@dataclass(frozen=True)
class Ticks:
    """The ticks of a control loop (n,): when each began [s, monotonic], its work, its lateness, its period [s]."""

    at: Array
    work: Array
    late: Array
    period: Array

    def within(self, begin: float, end: float) -> Ticks:
        """Those that began in a span of time."""
        kept = (self.at >= begin) & (self.at < end)
        return Ticks(self.at[kept], self.work[kept], self.late[kept], self.period[kept])


def ticks_of(sleeps: Array) -> Ticks:
    """The ticks between ``sleeps`` (n, 4): begin [s, monotonic], what was asked for, what it took [s], 1 if the loop's.

    A tick lies between two sleeps of the loop and ends with the second; other sleeps (waits between motions) begin and
    end none.
    """
    begin, asked, took, kind = np.asarray(sleeps, float).reshape(-1, 4).T
    own = kind == 1
    both = own[1:] & own[:-1]
    woke, work = (begin + took)[:-1][both], (begin[1:] - (begin + took)[:-1])[both]
    late = (took - asked)[1:][both]
    return Ticks(woke, work, late, work + took[1:][both])


def read_sleeps(path: Path) -> Array:
    """The sleeps (n, 4) of a file that `experiments.bench.load_runner` writes; an unfinished last one is left out."""
    data = path.read_bytes()
    return np.frombuffer(data[: len(data) // SLEEP.size * SLEEP.size], "<f8").reshape(-1, 4)


@dataclass(frozen=True)
class Phase:
    """A span of time [s, monotonic] with or without viewers."""

    begin: float
    end: float
    viewers: bool


def schedule(begin: float, span: float, length: float, settle: float) -> list[Phase]:
    """Pairs of phases of ``length`` seconds that fill ``span``, from ``begin`` on, four pairs at least.

    Every other pair has its viewers first, so that a drift favours neither. The first ``settle`` seconds of a phase are
    left out of it: viewers come and go then.
    """
    pairs = max(4, int(span // (2 * length)))
    each = span / (2 * pairs)
    return [
        Phase(begin + i * each + settle, begin + (i + 1) * each, (i % 2 == 1) != (i // 2 % 2 == 1))
        for i in range(2 * pairs)
    ]


def ratio(name: str, ticks: Ticks, phases: Sequence[Phase], of: Callable[[Ticks], float], what: str) -> Figure | None:
    """``of`` with viewers over ``of`` without, over pairs of phases: the geometric mean and its 95 % interval.

    The logarithm of each pair's ratio is one value of Student's t. None where fewer than two pairs have ticks enough.
    """
    logarithms = []
    for first, second in zip(phases[::2], phases[1::2], strict=True):
        parts = {phase.viewers: ticks.within(phase.begin, phase.end) for phase in (first, second)}
        if min(part.at.size for part in parts.values()) >= FEWEST:
            logarithms.append(float(np.log(of(parts[True]) / of(parts[False]))))
    if len(logarithms) < 2:
        return None
    found = mean(logarithms)
    assert found.low is not None and found.high is not None
    low, middle, high = (float(np.exp(x)) for x in (found.low, found.mean, found.high))
    return Figure(name, middle, low, high, "× without", found.n, what)


def figures(ticks: Ticks, phases: Sequence[Phase], viewers: int) -> list[Figure]:
    """What the loop did with and without ``viewers``, and the ratios."""
    found: list[Figure | None] = []
    for looking, said in ((False, "without viewers"), (True, f"with {viewers} viewers")):
        parts = [ticks.within(phase.begin, phase.end) for phase in phases if phase.viewers is looking]
        if not any(part.at.size for part in parts):  # the run ended too soon
            continue
        periods = np.concatenate([part.period for part in parts])
        for name, values in (
            (f"loop, work per tick, {said}", np.concatenate([part.work for part in parts])),
            (f"loop, lateness per tick, {said}", np.concatenate([part.late for part in parts])),
            (f"loop, period, {said}", periods),
        ):
            low, middle, high = (float(q) * 1e3 for q in np.quantile(values, (0.05, 0.5, 0.95)))
            found.append(Figure(name, middle, low, high, "ms", values.size, "median, 5 % and 95 % of the ticks"))
        late = 100 * float((periods > LATE * np.median(ticks.period)).mean())
        what = f"ticks that took longer than {LATE:g} times the median"
        found.append(Figure(f"loop, late ticks, {said}", late, late, late, "%", periods.size, what))
    pairs = "geometric mean over pairs of phases, with its 95 % interval"
    found += [
        ratio(f"loop, {name}: viewers", ticks, phases, of, pairs)
        for name, of in (
            ("work per tick", lambda part: float(part.work.mean())),
            ("median work per tick", lambda part: float(np.median(part.work))),
            ("period", lambda part: float(part.period.mean())),
        )
    ]
    return [figure for figure in found if figure is not None]
