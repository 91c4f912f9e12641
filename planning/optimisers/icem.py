"""The improved cross-entropy method (Pinneri et al. 2020): a Gaussian fitted to the best of its own samples."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mechanics.readings import Array
from planning.optimisers.base import Objective, Optimiser, Optimum, register
from planning.optimisers.checks import checked_start, require_finite
from planning.optimisers.noise import coloured


@dataclass
class Elites:
    """What one call leaves to the next: its elites (E, K, D), best first. Receding horizon gives the same one to each.

    ``shift`` is by how many steps the horizon has moved on since.
    """

    z: Array | None = None
    shift: int = 1


@register
@dataclass
class ICEM(Optimiser):
    """iCEM with ``iterations`` × ``samples`` queries: 10 × 10 and 50 × 20 are the paper's.

    Of each batch, and of the ``reuse`` share of the last elites (whose losses are known), the best ``elites`` set the
    mean and the standard deviation of the next: (1 − momentum) of the new, momentum of the old. Noise is coloured along
    the steps by ``beta``. Batches shrink by ``decay``, to twice the elites at the least. The first batch starts with
    the start itself, followed by what ``warm`` kept of the last call, shifted; the last starts with the mean. The best
    of all is returned; the curve is the least loss after each iteration.

    None is the reference's value from 20 samples on: 10 ``elites``, ``decay`` 1.25 and ``momentum`` 0.1. With fewer, a
    fifth of the samples are elites, two at the least, batches do not shrink, and as two samples say little of a spread,
    the momentum is 0.5.
    ``sigma`` is the first standard deviation in units of z (about 1 mm, 1 N), one for all variables or one for each;
    with ``spread`` each sample of the first batch has its own, between ``sigma``/``spread`` and ``sigma``.
    """

    name: ClassVar[str] = "icem"
    iterations: int = 50
    samples: int = 20
    sigma: float | tuple[float, ...] = 0.1
    beta: float = 3.0
    spread: float = 1.0
    elites: int | None = None
    reuse: float = 0.3
    decay: float | None = None
    momentum: float | None = None
    warm: Elites | None = None

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"icem: iterations: expected at least 1, received {self.iterations}")
        if self.samples < 4:
            raise ValueError(f"icem: samples: expected at least 4, received {self.samples}")
        if self.elites is not None and not 2 <= self.elites <= self.samples // 2:
            raise ValueError(f"icem: elites: expected 2 to half of {self.samples} samples, received {self.elites}")
        if not np.all(np.asarray(self.sigma) >= 0):
            raise ValueError(f"icem: sigma: expected standard deviations, received {self.sigma}")
        if self.decay is not None and not self.decay >= 1:
            raise ValueError(f"icem: decay: expected at least 1, received {self.decay}")
        for name in ("reuse", "momentum"):
            share = getattr(self, name)
            if share is not None and not 0 <= share < 1:
                raise ValueError(f"icem: {name}: expected a share in [0, 1), received {share}")

    @property
    def elite_count(self) -> int:
        """How many samples of a batch are elites."""
        if self.elites is not None:
            return self.elites
        return max(2, self.samples // 5) if self._few else 10

    @property
    def _few(self) -> bool:
        return self.samples < 20

    @property
    def sizes(self) -> list[int]:
        """Queries of each iteration."""
        decay = self.decay if self.decay is not None else 1.0 if self._few else 1.25
        sizes = [self.samples]
        while len(sizes) < self.iterations:
            sizes.append(max(2 * self.elite_count, int(sizes[-1] / decay)))
        return sizes

    def optimise(self, objective: Objective, z: Array, rng: np.random.Generator) -> Optimum:
        """Improve ``z`` (K, D). Raises ValueError where the loss is not finite at ``z``."""
        start = checked_start(self.name, objective, z)
        began = time.perf_counter()
        mean, deviation = start, np.where(objective.free, self.sigma, 0.0)
        kept, kept_losses = np.empty((0, *mean.shape)), np.empty(0)
        keep = max(1, int(self.reuse * self.elite_count)) if self.reuse > 0 else 0
        curve, asked, queries, sizes = [], [], 0, self.sizes
        old = self.momentum if self.momentum is not None else 0.5 if self._few else 0.1
        best, least = start, np.inf
        for i, count in enumerate(sizes):
            noise = coloured(rng, (count, *mean.shape), self.beta)
            if i == 0:
                noise *= self.spread ** -rng.random((count, 1, 1))
            trials = mean + deviation * noise
            if i == 0:
                given = self._shifted(start, objective.free, trials)[:keep]
                trials[0], trials[1 : 1 + len(given)] = start, given
            elif i == len(sizes) - 1:
                trials[0] = mean
            losses = objective.values(trials)
            queries += count
            if i == 0:
                require_finite(self.name, losses[0])
            if losses.min() < least:
                best, least = trials[np.argmin(losses)], float(losses.min())
            if i == 0:  # a Gaussian's centre beats its samples: as an elite it would stay, and make the spread collapse
                trials, losses = trials[1:], losses[1:]
            trials, losses = np.concatenate([trials, kept]), np.append(losses, kept_losses)
            order = np.argsort(losses, kind="stable")[: self.elite_count]
            order = order[np.isfinite(losses[order])]
            elites = trials[order]
            kept, kept_losses = elites[:keep], losses[order][:keep]
            if len(elites) > 1:
                mean = (1 - old) * elites.mean(axis=0) + old * mean
                deviation = (1 - old) * elites.std(axis=0) + old * deviation
            curve.append(least)
            asked.append(queries)
        if self.warm is not None:
            self.warm.z = kept
        return Optimum(best, least, np.array(curve), queries, time.perf_counter() - began, asked=tuple(asked))

    def _shifted(self, start: Array, free: NDArray[np.bool_], trials: Array) -> Array:
        """The last call's elites (E, K, D), moved on by ``shift`` steps; their last steps are those of ``trials``."""
        if self.warm is None or self.warm.z is None:
            return trials[:0]
        elites, shift = self.warm.z, self.warm.shift
        if elites.shape[1:] != start.shape or not 0 <= shift <= len(start):
            raise ValueError(
                f"icem: warm: expected elites of shape {start.shape} and a shift of 0 to {len(start)} steps, "
                f"received {elites.shape[1:]} and {shift}"
            )
        moved = np.concatenate([elites[:, shift:], trials[: len(elites), len(start) - shift :]], axis=1)
        return np.where(free, moved, start)
