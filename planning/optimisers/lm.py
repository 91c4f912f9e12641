"""Second order: Levenberg–Marquardt on the Gauss–Newton model, one block tridiagonal solve per step."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import isfinite
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mechanics.readings import Array
from planning.optimisers.base import Objective, Optimiser, Optimum, Quadratic, register
from planning.optimisers.block_tridiagonal import damped_solve
from planning.optimisers.checks import checked_start, require_finite

#: below the least the step is Gauss–Newton's, and a refusal must still be felt; beyond the largest it is rounding
SMALLEST, LARGEST = 1e-7, 1e16
#: trials that the model may misjudge before it asks for the curvature
MISJUDGED = 2
#: how far from 1 the gain ratio may be before the damping is mended, and what that multiplies it by at most
RIGHT, MOST_GROWTH = 0.25, 10.0
#: step of the differences that make a Hessian [units of z], and how far its entries may exceed Gauss–Newton's
DIFFERENCE, JUMP = 1e-5, 30.0
#: damping that is handed on at most: what stalled one problem need not slow down the next
LARGEST_HANDED_ON = 1.0


@dataclass(frozen=True, eq=False)
class Curvature:
    """What Gauss–Newton leaves out of a Hessian, Σ 2 r ∇²r: blocks ``diagonal`` (K, D, D) and ``below`` (K−1, D, D)."""

    diagonal: Array
    below: Array


@dataclass
class Warm:
    """What one call leaves to the next: the damping that it ended with, and the curvature where it had to ask for it.

    Receding horizon gives the same one to each call.
    """

    damping: float | None = None
    curvature: Curvature | None = None


@register
@dataclass
class LevenbergMarquardt(Optimiser):
    """Steps δ of (H + λ diag(JᵀJ)) δ = −g, with the damping λ set by the gain ratio (Nielsen 1999).

    A trial is taken where the loss falls; λ then shrinks by up to 3 as the model proves right. Where that promised more
    than a quarter too much or too little, λ does not fall below what gives it the loss's curvature along the step, by
    the two gradients: in a flat valley that is the secant method at no further query. Where the loss does not fall
    (the gradient jumps where the active set of a program changes) or is not finite (behind a barrier), λ grows by 2, 4,
    8 … and the step is tried again.

    H is Gauss–Newton's 2 JᵀJ. Where ``exact``, and trials bring less than half of what that promised or half as much
    again, `curvature` is added to it, which Gauss–Newton leaves out, and kept until it misjudges too. To turn the
    grasped object about its contact at all steps alike costs next to nothing; in so flat a valley it is all there is.

    ``iterations`` is the most trials; the curve has the loss of the point where it stands after each. A query is a
    trial or one of the gradients of a curvature: three for each variable that is tied to its neighbours, as a rule the
    angle, and one for each other.

    It has converged where the model promises less than ``loss_tolerance`` of the loss, at this λ or without damping;
    where the gradient's largest component is below ``gradient_tolerance`` of what it was at the start; or where the
    step is below ``step_tolerance`` in units of z (about 1 mm, 1 N). It has stalled where the promise or the step got
    as small by refusals only. ``warm`` carries damping and curvature from call to call.
    """

    name: ClassVar[str] = "lm"
    iterations: int = 100
    loss_tolerance: float = 1e-8
    gradient_tolerance: float = 1e-10
    step_tolerance: float = 1e-9
    damping: float = 1e-3
    exact: bool = True
    warm: Warm | None = None

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"lm: iterations: expected at least 1, received {self.iterations}")
        for name in ("damping", "loss_tolerance", "gradient_tolerance", "step_tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"lm: {name}: expected a positive number, received {getattr(self, name)}")

    def optimise(self, objective: Objective, z: Array, rng: np.random.Generator) -> Optimum:
        """Improve ``z`` (K, D); ``rng`` is not used. Raises ValueError where the loss is not finite at ``z``."""
        z = checked_start(self.name, objective, z)
        free = np.ascontiguousarray(objective.free, dtype=np.bool_)
        began = time.perf_counter()
        model = objective.quadratic(z)
        require_finite(self.name, model.value)
        flat = self.gradient_tolerance * _largest(model.gradient, free)
        warm = self.warm or Warm()
        damping = self.damping if warm.damping is None else warm.damping
        growth, curve, asked, queries, misjudged = 2.0, [model.value], [1], 1, 0
        rest = warm.curvature
        if rest is not None and rest.diagonal.shape != model.diagonal.shape:
            rest = None
        H = _hessian(model, rest)
        known_here = False  # whether ``rest`` is of this z
        while True:
            if _largest(model.gradient, free) <= flat:
                status = "converged"
                break
            z_trial, promised, length, bend, damping = _trial(z, model.gradient, model.diagonal, *H, free, damping)
            if damping > LARGEST:
                status = "stalled"
                break
            refused = growth > 2
            small = promised <= self.loss_tolerance * model.value or length <= self.step_tolerance
            # (1 + λ) times the promise is what the diagonal of H alone would promise without damping
            if (1 + damping) * promised <= self.loss_tolerance * model.value or (small and refused):
                status = "stalled" if refused else "converged"
                break
            if small and damping <= 1:
                status = "converged"
                break
            if len(curve) == self.iterations:
                status = "iterations"
                break
            trial = objective.quadratic(z_trial)
            queries += 1
            gain = (model.value - trial.value) / promised if _usable(trial, free) else 0.0
            if gain > 0:
                least = 0.0 if abs(gain - 1) < RIGHT else _secant(z, z_trial, trial.gradient, bend)
                damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3, min(least, MOST_GROWTH))
                damping, growth = max(damping, SMALLEST), 2.0
                z, model, known_here, H = z_trial, trial, False, _hessian(trial, rest)
            else:
                damping, growth = damping * growth, 2 * growth
            curve.append(model.value)
            asked.append(queries)
            misjudged += not 0.5 < gain < 1.5
            if self.exact and misjudged >= MISJUDGED and not known_here:
                rest, gradients = curvature(objective, z, model)
                queries += gradients
                misjudged, known_here = MISJUDGED - 1, True
                warm.curvature, H = rest, _hessian(model, rest)
        warm.damping = min(damping, LARGEST_HANDED_ON)
        return Optimum(z, model.value, np.array(curve), queries, time.perf_counter() - began, status, tuple(asked))


def curvature(objective: Objective, z: Array, model: Quadratic) -> tuple[Curvature, int]:
    """Return the exact Hessian less Gauss–Newton's ``model`` of it at ``z`` (K, D), and how many gradients that took.

    Forward differences of the gradient, of many columns at once (Curtis, Powell, Reid 1974). A variable that is tied to
    the neighbouring steps, which Gauss–Newton's blocks tell, is moved at every third step; any other at all of them:
    between D and 3 D gradients whatever K. Where an active set changes between the two points the difference is a jump
    over a small number: a column much larger than any of Gauss–Newton's is taken to be Gauss–Newton's.
    """
    K, D = z.shape
    free = np.ascontiguousarray(objective.free, dtype=np.bool_)
    diagonal, below = model.diagonal.copy(), model.below.copy()
    above = np.swapaxes(below, 1, 2).copy()
    most = JUMP * max(float(np.abs(diagonal).max()), float(np.abs(below).max(initial=0.0)))
    tied = np.any(below, axis=(0, 1)) | np.any(below, axis=(0, 2))
    asked = 0
    for i in range(D):
        apart = 3 if tied[i] else 1
        for first in range(min(apart, K)):
            if not free[first::apart, i].any():
                continue
            there = z.copy()
            there[first::apart, i] += DIFFERENCE * free[first::apart, i]
            value, gradient = objective.gradient(there)
            asked += 1
            if np.isfinite(value) and np.isfinite(gradient).all():
                _enter(gradient, model.gradient, free, first, apart, i, most, diagonal, below, above)
    diagonal = 0.5 * (diagonal + np.swapaxes(diagonal, 1, 2))
    below = 0.5 * (below + np.swapaxes(above, 1, 2))
    return Curvature(diagonal - model.diagonal, below - model.below), asked


@njit(cache=True, fastmath=False, error_model="numpy")
def _enter(there, here, free, first, apart, i, most, diagonal, below, above):
    """Write the columns that moving variable i at steps ``first``, ``first`` + ``apart``, … changed the gradient by."""
    K, D = here.shape
    reach = 1 if apart > 1 else 0
    for k in range(first, K, apart):
        if not free[k, i]:
            continue
        size = 0.0
        for n in range(max(k - reach, 0), min(k + reach, K - 1) + 1):
            for j in range(D):
                if free[n, j]:
                    size = max(size, abs(there[n, j] - here[n, j]))
        if not size < most * DIFFERENCE:
            continue
        for j in range(D):
            if free[k, j]:
                diagonal[k, j, i] = (there[k, j] - here[k, j]) / DIFFERENCE
            if reach and k < K - 1 and free[k + 1, j]:
                below[k, j, i] = (there[k + 1, j] - here[k + 1, j]) / DIFFERENCE
            if reach and k > 0 and free[k - 1, j]:
                above[k - 1, j, i] = (there[k - 1, j] - here[k - 1, j]) / DIFFERENCE


def _hessian(model: Quadratic, rest: Curvature | None) -> tuple[Array, Array]:
    """Gauss–Newton's blocks, with what they leave out where that is known."""
    if rest is None:
        return model.diagonal, model.below
    return model.diagonal + rest.diagonal, model.below + rest.below


def _usable(model: Quadratic, free: NDArray[np.bool_]) -> bool:
    """Whether loss and gradient are finite."""
    return isfinite(model.value) and isfinite(_largest(model.gradient, free))


@njit(cache=True, fastmath=False, error_model="numpy")
def _largest(gradient, free):
    """The largest magnitude (K, D) → float among the free variables; NaN where one is none."""
    largest = 0.0
    for k in range(gradient.shape[0]):
        for i in range(gradient.shape[1]):
            if free[k, i]:
                if np.isnan(gradient[k, i]):
                    return np.nan
                largest = max(largest, abs(gradient[k, i]))
    return largest


@njit(cache=True, fastmath=False, error_model="numpy")
def _secant(z, z_trial, gradient, bend):
    """By how much to multiply λ, that H + λ diag(JᵀJ) has along the step δ the curvature that the loss has there.

    The model's gradient at δ is −λ diag(JᵀJ) δ. Along δ that is −``bend``, δᵀ``gradient`` with the loss's own; without
    the difference the step would have ended where the loss's is zero.
    """
    along = 0.0
    for k in range(z.shape[0]):
        for i in range(z.shape[1]):
            along += gradient[k, i] * (z_trial[k, i] - z[k, i])
    return 1.0 + along / bend


@njit(cache=True, fastmath=False, error_model="numpy")
def _trial(z, gradient, scale, diagonal, below, free, damping):
    """The damped step's end z + δ (K, D), the fall of the loss that the model promises, δ's largest part, how much of
    the curvature along δ is damping, λ δᵀ diag(JᵀJ) δ, and the damping λ.

    ``diagonal`` and ``below`` are H's blocks; the damping is in units of the diagonals of ``scale`` (K, D, D), which is
    2 JᵀJ, and grows until the damped matrix is positive definite. A variable on which no residual depends has no
    gradient either; a small floor under the diagonal keeps it where it is.
    """
    K, D = z.shape
    most = 0.0
    for k in range(K):
        for i in range(D):
            if free[k, i]:
                most = max(most, scale[k, i, i])
    added, step, down = np.empty((K, D)), np.empty((K, D)), -gradient
    while damping <= LARGEST:
        for k in range(K):
            for i in range(D):
                added[k, i] = damping * max(scale[k, i, i], 1e-8 * most)
        if damped_solve(diagonal, below, down, free, added, step):
            promised, length, bend = 0.0, 0.0, 0.0
            for k in range(K):
                for i in range(D):
                    if free[k, i]:
                        # −gᵀδ − ½ δᵀHδ with H δ = −g − λ diag(JᵀJ) δ
                        bend += added[k, i] * step[k, i] ** 2
                        promised += 0.5 * step[k, i] * (added[k, i] * step[k, i] - gradient[k, i])
                        length = max(length, abs(step[k, i]))
                    step[k, i] += z[k, i]
            return step, promised, length, bend, damping
        damping *= 2.0
    return z, 0.0, 0.0, 0.0, damping
