"""`extrinsic bench planning`: our planner beside cvxpylayers, on the pivoting pentagon, everything measured in one run.

The reference for forces, gradients and loss curves is cvxpylayers at its accurate settings (SCS, dense, 1e-9); times
are compared with cvxpylayers at its fastest ones. At the shortest horizon whole plans of both are run; at longer ones
a few iterations are timed, and a plan is a hundred of them, which the figure's note says. The paper's form is measured
at every horizon, the closed one at the shortest.

Everything starts a little off the skill's nominal trajectory, by 0.1 mm and 0.1 N: on it gradients are zero but for
rounding, and Adam divides them by their own size, so that the last digit decides the curve. How the optimisers do from
the nominal trajectory itself is told apart, and so is how they do from starts that are farther off.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from experiments import registries
from experiments.bench.figures import Figure, Part, figure_of, in_parts
from experiments.bench.planning_case import Case
from experiments.bench.planning_optimisers import at_other_slack_weights, from_elsewhere, others
from experiments.bench.planning_problem import described, disturbed, pivoting_pentagon
from experiments.bench.planning_timing import Watched, apart, repeated
from experiments.planning.make import objective
from experiments.progress import Heard, unheard
from mechanics.readings import Array
from planning.optimisers.base import Optimum
from planning.problem import Form

HORIZONS = (40, 200, 1000)
FASTEST, ACCURATE = "cvxpylayers-fast", "cvxpylayers"
#: how the backends are called in figures
NAMES = {FASTEST: "cvxpylayers fastest", ACCURATE: "cvxpylayers accurate", "torch": "torch", "fused": "fused"}
GRAD = "Grad 100"
#: iterations of cvxpylayers that are timed where no whole plan is run
FEW = 2
#: about where forces and gradients are compared: the start, and so many points this far from it
NEARBY, AWAY = 3, 0.1


def run(runs: int = 5, horizons: Sequence[int] = HORIZONS, heard: Heard = unheard) -> Iterator[Figure]:
    """Measure everything, figure by figure."""
    shortest, longest = min(horizons), max(horizons)
    cost: dict[str, dict[int, float]] = {f"fused, {GRAD}": {}, "fused, lm": {}}
    parts: list[Part] = [(7, lambda: [_second_start(runs)])]
    for form, steps in [*((Form.PAPER, steps) for steps in horizons), (Form.CLOSED, shortest)]:
        parts += _problem(form, steps, steps == shortest, runs, cost)
    yield from in_parts(parts, heard)
    if shortest < longest:
        for method, found in cost.items():
            name = f"{method}, paper form: cost of an iteration and step, {shortest} to {longest} steps"
            yield figure_of(name, [found[longest] / found[shortest]], "×")


def _problem(form: Form, steps: int, whole: bool, runs: int, cost: dict[str, dict[int, float]]) -> list[Part]:
    """The parts of a problem: all are about one case, made where the first begins, and ``cost`` is what they found."""
    case: list[Case] = []

    def begin() -> Iterator[Figure]:
        problem = pivoting_pentagon(steps, form)
        made = {name: objective(name)(problem) for name in NAMES}
        case.append(Case(problem, made, disturbed(problem, made["fused"], np.random.default_rng(0)), runs, whole))
        return _accuracy(case[0])

    def end() -> Iterator[Figure]:
        yield from others(case[0])
        if whole:
            yield from from_elsewhere(case[0])
        if form is Form.PAPER:
            if whole:
                yield from at_other_slack_weights(case[0])
            for method, found in cost.items():
                found[steps] = case[0].known[method, "iteration"] / steps

    through_cvxpylayers = (20 if form is Form.PAPER else 90) if whole else 0.015 * steps
    compiled = (3 + 0.02 * steps) * runs  # most of it is the plans through torch
    return [
        (3 + 0.035 * steps, begin),
        (through_cvxpylayers + compiled, lambda: _gradient(case[0])),
        (8 if whole else 0.02 * steps, end),
    ]


# -- accuracy --------------------------------------------------------------------------------------------------------


def _accuracy(case: Case) -> Iterator[Figure]:
    """Forces and gradient of every backend, at the start and near it, against cvxpylayers' accurate ones."""
    rng, free = np.random.default_rng(0), case.problem.free
    points = [case.start]
    points += [case.start + AWAY * np.where(free, rng.standard_normal(free.shape), 0.0) for _ in range(NEARBY)]
    reference = case.objectives[ACCURATE]
    expected = [(reference.evaluate(z).forces, reference.gradient(z)[1]) for z in points]
    for name, one in case.objectives.items():
        if name == ACCURATE:
            continue
        method = f"{NAMES[name]}, {GRAD}"
        off = np.array(
            [
                (apart(one.evaluate(z).forces, forces), apart(one.gradient(z)[1], gradient))
                for z, (forces, gradient) in zip(points, expected, strict=True)
            ]
        ).max(axis=0)
        what = f"the worst of {len(points)} points; {described(case.problem)}"
        yield case.figure(method, "force error", off[0], "relative", what)
        yield case.figure(method, "gradient error", off[1], "relative", what)


# -- first order -----------------------------------------------------------------------------------------------------


def _gradient(case: Case) -> Iterator[Figure]:
    """Grad 100 through every backend: what an iteration costs, what the plan does, where its loss ends."""
    optimiser = registries.optimisers()["gradient"]()
    what = f"Adam at {optimiser.rate:g}, {optimiser.iterations} queries; {described(case.problem)}"
    curves: dict[str, Array] = {}
    for name, one in case.objectives.items():
        method = f"{NAMES[name]}, {GRAD}"
        found = (_through_cvxpylayers if name in (FASTEST, ACCURATE) else _compiled)(case, one, optimiser)
        iterations, plans, optimum, note = found
        yield case.figure(method, "iteration", iterations * 1e3, "ms", note)
        yield case.figure(method, "plan", plans * 1e3, "ms", note)
        if optimum is not None:
            curves[name] = optimum.curve
            yield case.figure(method, "loss", optimum.value, "", what)
        for quantity in ("iteration", "plan"):
            ratio = case.known[f"{NAMES[FASTEST]}, {GRAD}", quantity] / case.known[method, quantity]
            yield case.figure(method, f"{quantity}s per cvxpylayers {quantity}", ratio, "×")
    if ACCURATE in curves:
        for name in (FASTEST, "torch", "fused"):
            off = float((np.abs(curves[name] - curves[ACCURATE]) / np.abs(curves[ACCURATE])).max())
            yield case.figure(f"{NAMES[name]}, {GRAD}", "loss curve off cvxpylayers accurate", off, "relative")


Found = tuple[Array, Array, Optimum | None, str]


def _through_cvxpylayers(case: Case, one: Any, optimiser: Any) -> Found:
    one.gradient(case.start)  # compiles the layers
    if not case.whole:
        times = repeated(lambda: one.gradient(case.start), FEW, budget=0.0, warm=0)
        note = f"{FEW} iterations timed; a plan is {optimiser.iterations} of them"
        return times, times * optimiser.iterations, None, note
    watched = Watched(one)
    begin = time.perf_counter()
    optimum = optimiser.optimise(watched, case.start, np.random.default_rng(0))
    return np.array(watched.times), np.array([time.perf_counter() - begin]), optimum, "one whole plan"


def _compiled(case: Case, one: Any, optimiser: Any) -> Found:
    rng = np.random.default_rng(0)
    optimum = optimiser.optimise(one, case.start, rng)
    plans = repeated(lambda: optimiser.optimise(one, case.start, rng), case.runs, warm=0)
    iterations = repeated(lambda: one.gradient(case.start), case.runs)
    return iterations, plans, optimum, ""


# -- start-up ----------------------------------------------------------------------------------------------------------


_START = """
import time
begin = time.perf_counter()
from experiments import kernels
kernels.keep()
kernels.warm()
print(time.perf_counter() - begin)
"""


def _second_start(runs: int) -> Figure:
    """What a new process waits for the compiled kernels, numba's import included, once they have been compiled."""

    def start() -> float:
        done = subprocess.run([sys.executable, "-c", _START], capture_output=True, text=True, check=True)
        return float(done.stdout)

    start()
    return figure_of("kernels ready in a new process", [start() for _ in range(max(3, runs))], "s")
