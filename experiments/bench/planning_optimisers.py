"""The optimisers of `extrinsic bench planning` side by side, all on the fused kernel: second order and sampling."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from experiments import registries
from experiments.bench.figures import Figure
from experiments.bench.planning_case import Case
from experiments.bench.planning_problem import disturbed, pivoting_pentagon, regrasped
from experiments.bench.planning_timing import repeated
from experiments.planning.make import objective
from mechanics.readings import Array
from planning.optimisers.base import Optimum
from planning.optimisers.lm import Warm
from planning.problem import Problem
from planning.receding import shifted, window

#: windows of a receding horizon, and those at its beginning that do not count
WINDOWS, SETTLING = 60, 3
#: other starts, and how far they are off the nominal trajectory, 1σ in units of z: about 1 mm, 1 N
STARTS, FAR = 20, 1.0
#: the paper's table: name and settings by the number of queries
SAMPLED = {
    "MPPI 100": ("mppi", {"iterations": 1, "samples": 100}),
    "MPPI 1000": ("mppi", {"iterations": 10, "samples": 100}),
    "iCEM 100": ("icem", {"iterations": 10, "samples": 10}),
    "iCEM 1000": ("icem", {"iterations": 50, "samples": 20}),
}
GRAD = "fused, Grad 100"
#: penalties of the paper form's slack, beside U = 1, that the two optimisers are compared at as well as the plans' own.
#: The smaller one leaves forces unbalanced by 0.05 N: a floor under the loss, which no optimiser can get below
SLACK_WEIGHTS = (100.0, 1000.0)


def others(case: Case) -> Iterator[Figure]:
    """Levenberg–Marquardt, cold and warm, and at the shortest horizon the sampling methods."""
    one = case.objectives["fused"]
    best = _solved("lm", one, case.start)
    plans = repeated(lambda: _solved("lm", one, case.start), case.runs)
    note = f"{len(best.curve) - 1} trials, {best.queries} queries, {best.status}"
    yield case.figure("fused, lm", "plan", plans * 1e3, "ms", note)
    yield case.figure("fused, lm", "iteration", plans / best.queries * 1e3, "ms", "a plan's time over its queries")
    yield case.figure("fused, lm", "loss", best.value, "")
    yield from _against_cvxpylayers(case, "fused, lm")
    yield from _against_adam(case)
    yield from _replanned(case)
    if case.whole:
        yield from _sampled(case)


def _solved(name: str, one: Any, start: Array, seed: int = 0, **settings: Any) -> Optimum:
    return registries.optimisers()[name](**settings).optimise(one, start, np.random.default_rng(seed))


def _against_cvxpylayers(case: Case, method: str) -> Iterator[Figure]:
    slow = case.known["cvxpylayers fastest, Grad 100", "plan"]
    ratio = slow / case.known[method, "plan"]
    yield case.figure(method, "plans per cvxpylayers plan", ratio, "×", "its Grad 100")


def _sampled(case: Case) -> Iterator[Figure]:
    one = case.objectives["fused"]
    for method, (name, settings) in SAMPLED.items():
        _solved(name, one, case.start, **settings)
        found = [_solved(name, one, case.start, seed, **settings) for seed in range(case.runs)]
        what = f"{settings['iterations']} × {settings['samples']}, {found[0].queries} queries, {case.runs} seeds"
        yield case.figure(f"fused, {method}", "plan", np.array([f.time_s for f in found]) * 1e3, "ms", what)
        yield case.figure(f"fused, {method}", "loss", [f.value for f in found], "", what)


def _replanned(case: Case) -> Iterator[Figure]:
    """A horizon that slides one step at a time over a longer motion, the grasp estimated anew at each step.

    Rounds of it take turns with single iterations of cvxpylayers: both are as fast as the machine is at that moment,
    and their ratio is of one moment, too.
    """
    long = pivoting_pentagon(case.steps + WINDOWS, case.problem.form)
    slow, ratios, times, queries = case.objectives["cvxpylayers-fast"], [], [], []
    for _ in range(max(case.runs, 5) if case.whole else 1):
        begin = time.perf_counter()
        slow.gradient(case.start)
        iteration = time.perf_counter() - begin
        taken, queries = _one_horizon(long, case.steps)
        times.append(taken)
        ratios.append(iteration / np.median(taken))
    what = (
        f"{WINDOWS} windows over {case.steps + WINDOWS} steps, each from the last plan moved on by a step, the grasp "
        f"estimated anew, the objective's set-up counted; {np.median(queries):.0f} queries in the median"
    )
    yield case.figure("fused, lm warm", "plan", np.concatenate(times) * 1e3, "ms", what)
    what = "taking turns with single iterations, each against the median of the re-plans that follow it"
    yield case.figure("fused, lm warm", "re-plans per cvxpylayers iteration", ratios, "×", what)


def _one_horizon(long: Problem, steps: int) -> tuple[Array, Array]:
    """Times [s] and queries (n,) of the re-plans over a motion, those while it settles left out."""
    rng, make = np.random.default_rng(0), objective("fused")
    # so near to the optimum Gauss–Newton's own curvature will do
    lm = registries.optimisers()["lm"](warm=Warm(), exact=False)
    z, times, queries = None, [], []
    for i in range(WINDOWS):
        cut = regrasped(window(long, i, steps), rng)
        begin = time.perf_counter()
        one = make(cut)
        found = lm.optimise(one, one.start if z is None else z, rng)
        times.append(time.perf_counter() - begin)
        queries.append(found.queries)
        z = shifted(found.z)
    return np.array(times[SETTLING:]), np.array(queries[SETTLING:])


def _against_adam(case: Case) -> Iterator[Figure]:
    """How far lm ends below Grad 100 from the same start, and how soon it is at a quarter of that loss."""
    ratio = case.known["fused, lm", "loss"] / case.known[GRAD, "loss"]
    yield case.figure("fused, lm", "loss over Grad 100's", ratio, "×", "from the same start")
    one = case.objectives["fused"]
    sooner = _sooner(one, case.start, max(case.runs, 5))
    if np.isfinite(sooner).all():
        yield case.figure("fused, lm", "time to a quarter of Grad 100's loss over Grad 100's time", sooner, "×")


def _sooner(one: Any, start: Array, runs: int) -> Array:
    """Times (runs,) of lm until its loss is a quarter of Grad 100's, over the times of Grad 100; ∞: it never is."""
    first = [_solved("gradient", one, start) for _ in range(runs)]
    enough = _solved("lm", one, start).curve <= first[0].value / 4
    if not enough.any():
        return np.full(runs, np.inf)
    trials = int(np.argmax(enough)) + 1
    second = [_solved("lm", one, start, iterations=trials) for _ in range(runs)]
    return np.array([b.time_s / a.time_s for a, b in zip(first, second, strict=True)])


def at_other_slack_weights(case: Case) -> Iterator[Figure]:
    """Grad 100 and lm where the program holds the grasped object's balance less firmly than plans do."""
    for weight in SLACK_WEIGHTS:
        one = objective("fused")(replace(case.problem, slack_weight=weight))
        grad, lm = (_solved(name, one, case.start).value for name in ("gradient", "lm"))
        yield case.figure(f"fused, lm, slack weight {weight:g}", "loss", lm, "")
        ratio, what = lm / grad, "from the same start"
        yield case.figure(f"fused, lm, slack weight {weight:g}", "loss over Grad 100's", ratio, "×", what)


def from_elsewhere(case: Case) -> Iterator[Figure]:
    """Where every optimiser ends from the nominal trajectory itself, and Grad 100 and lm from starts far off it."""
    one, nominal = case.objectives["fused"], case.problem.start
    methods = {"Grad 100": ("gradient", {}), "lm": ("lm", {}), **SAMPLED}
    for method, (name, settings) in methods.items():
        seeds = range(case.runs if method in SAMPLED else 1)
        losses = [_solved(name, one, nominal, seed, **settings).value for seed in seeds]
        yield case.figure(f"fused, {method}", "loss from the nominal trajectory", losses, "")
    rng = np.random.default_rng(1)
    starts = [disturbed(case.problem, one, rng, FAR) for _ in range(STARTS)]
    ends = {name: np.array([_solved(name, one, start).value for start in starts]) for name in ("gradient", "lm")}
    what = f"{STARTS} starts, {FAR:g} mm and {FAR:g} N (1σ) off the nominal trajectory"
    yield case.figure(GRAD, "loss from far off", ends["gradient"], "", what)
    yield case.figure("fused, lm", "loss from far off", ends["lm"], "", what)
    yield case.figure("fused, lm", "loss over Grad 100's from far off", ends["lm"] / ends["gradient"], "×", what)
