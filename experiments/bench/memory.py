"""How much memory a process has for itself, and whether it grows: a slope with its 95 % interval."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.statistics import LEVEL

MB = 1e6
HOUR = 3600.0
#: fewer blocks tell no slope, and no interval
FEWEST = 4


def own_memory(pid: int) -> float | None:
    """The unique set size of a process [MB]: what its end would give back. None for one that has ended.

    Pages that it shares (libraries, the cache of the disk) are not its own. Raises OSError where the kernel does not
    tell: Linux does, in /proc.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    except (ProcessLookupError, FileNotFoundError):
        if Path("/proc/self/smaps_rollup").exists():
            return None
        raise
    sizes = {name: value for name, _, value in (line.partition(":") for line in lines[1:])}
    kibibytes = sum(int(sizes[name].split()[0]) for name in ("Private_Clean", "Private_Dirty"))
    return kibibytes * 1024 / MB


@dataclass(frozen=True)
class Slope:
    """A slope, its interval from ``low`` to ``high``, and the blocks that it was found from."""

    slope: float
    low: float
    high: float
    blocks: int


def slope(times: ArrayLike, values: ArrayLike, *, after: float, block: float) -> Slope:
    """The least-squares slope of ``values`` (n,) over ``times`` (n,) [s], in values per hour, with its 95 % interval.

    What came in the first ``after`` seconds is left out (the warm-up); the rest counts as means of blocks of ``block``
    seconds, since neighbouring samples tell the same. What the block means' residuals still have in common with their
    neighbours, ρ (lag one, of an AR(1) process), leaves n (1 − ρ) / (1 + ρ) of n blocks as if they were independent,
    and widens Student's interval so, to two degrees of freedom at the least. Raises ValueError for fewer blocks than
    four.
    """
    t, x = np.asarray(times, float), np.asarray(values, float)
    kept = t - t[0] >= after if t.size else np.zeros(0, bool)
    t, x = t[kept], x[kept]
    numbers = ((t - t[0]) // block).astype(int) if t.size else np.zeros(0, int)
    if t.size and (t[-1] - t[0]) % block < block / 2:  # a last block of a few samples is none
        t, x, numbers = (part[numbers < numbers[-1]] for part in (t, x, numbers))
    each = np.unique(numbers)
    if each.size < FEWEST:
        raise ValueError(f"slope: expected {FEWEST} blocks of {block:g} s or more after {after:g} s, got {each.size}")
    hours = np.array([t[numbers == number].mean() for number in each]) / HOUR
    means = np.array([x[numbers == number].mean() for number in each])
    centred = hours - hours.mean()
    spread = float(centred @ centred)
    found = float(centred @ means) / spread
    residuals = means - means.mean() - found * centred
    power = float(residuals @ residuals)
    if power <= 1e-18 * float(means @ means):  # a straight line, to the last bits
        return Slope(found, found, found, each.size)
    # two of the residuals' degrees of freedom are the line's, which makes their own correlation look smaller
    rho = min(max(float(residuals[1:] @ residuals[:-1]) / power + 2 / each.size, 0.0), 0.9)
    effective = each.size * (1 - rho) / (1 + rho)
    error = np.sqrt(power / (each.size - 2) / spread * each.size / effective)
    half = float(stats.t.ppf((1 + LEVEL) / 2, max(effective - 2, 2.0)) * error)
    return Slope(found, found - half, found + half, each.size)
