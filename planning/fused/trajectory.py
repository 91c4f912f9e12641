"""The loss of whole trajectories with gradient and Gauss–Newton model, and Adam on it: the compiled entry points."""

from __future__ import annotations

from math import inf, isfinite, sqrt

import numpy as np

from planning.fused.adjoint import pull_back
from planning.fused.geometry import differentiate, forces_in_world, place
from planning.fused.layout import (
    COLUMNS,
    CONTACTS,
    GROUNDS,
    INTS,
    LENGTH,
    OBJECTS,
    PAPER,
    POSE,
    POSE_D,
    RHO,
    ROOT_SLACK,
    ROWS,
    SCALE,
    SLACK,
    TWO_BODIES,
    W_SMOOTH,
    Y,
)
from planning.fused.program import INFEASIBLE, solve
from planning.fused.residuals import MILLIMETRE, of_step
from planning.fused.sources import entry, fingerprint, inlined, kernel

VALUE, GRADIENT, QUADRATIC, ADAM = range(4)
"""Levels: what `run` is asked for."""


@inlined
def _trajectory(z, kinds, steps, fixed, flags, free, start, warm, w, c, i, pose, gradient, diagonal, below, level):
    """Loss of one z (K, 5); derivatives are overwritten, ``pose`` (K, 8) is room for the go's poses and theirs."""
    K, contacts, total = len(z), flags[OBJECTS] + flags[GROUNDS], 0.0
    for k in range(K):
        for j in range(5):
            w[Y, j] = (z[k, j] if free[k, j] else start[k, j]) * fixed[SCALE + j]
            if level:
                gradient[k, j] = 0.0
                if level == 2:
                    for m in range(5):
                        diagonal[k, j, m] = 0.0
        place(w, c, kinds, steps, fixed, flags, k)
        status, warm[k] = solve(
            w, c, i, kinds, k, contacts, flags[TWO_BODIES] != 0, flags[PAPER] != 0, fixed[LENGTH], warm[k]
        )
        if status >= INFEASIBLE:
            warm[k] = 0
            return inf
        forces_in_world(c, flags[OBJECTS])
        if level == 2:
            differentiate(w, c, i, kinds, free, steps, fixed, flags, k)
        total += of_step(w, c, kinds, free, steps, fixed, flags, gradient, diagonal, k, level)
        if not total < inf:
            return inf
        if level == 1:
            pull_back(w, c, i, kinds, free, steps, fixed, flags, gradient, k)
        for r in range(3):
            pose[k, r] = w[POSE, r]
        if level:
            a, t = (fixed[SCALE] if free[k, 0] else 0.0), (fixed[SCALE + 1] if free[k, 1] else 0.0)
            pose[k, 3], pose[k, 4], pose[k, 5] = a * w[POSE_D, 0], a * w[POSE_D, 1], a
            pose[k, 6], pose[k, 7] = t * w[POSE_D, 2], t * w[POSE_D, 3]
    if K > 1 and fixed[W_SMOOTH] > 0:
        total += _smoothness(pose, fixed, gradient, diagonal, below, level)
    return total if total < inf else inf


@kernel
def _smoothness(pose, fixed, gradient, diagonal, below, level):
    """Smoothness of the go's poses, which couples neighbours through angle and travel."""
    total, size = 0.0, fixed[W_SMOOTH] / MILLIMETRE
    for k in range(len(pose) - 1):
        if level == 2:
            for j in range(5):
                for m in range(5):
                    below[k, j, m] = 0.0
        for r in range(3):
            s = size * fixed[RHO] if r == 2 else size
            d = s * (pose[k + 1, r] - pose[k, r])
            total += d * d
            if not level:
                continue
            here_a, next_a = s * pose[k, 3 + r], s * pose[k + 1, 3 + r]
            here_t, next_t = (s * pose[k, 6 + r], s * pose[k + 1, 6 + r]) if r < 2 else (0.0, 0.0)
            gradient[k, 0] -= 2 * d * here_a
            gradient[k, 1] -= 2 * d * here_t
            gradient[k + 1, 0] += 2 * d * next_a
            gradient[k + 1, 1] += 2 * d * next_t
            if level == 2:
                _square(diagonal, k, here_a, here_t, here_a, here_t, 2.0)
                _square(diagonal, k + 1, next_a, next_t, next_a, next_t, 2.0)
                _square(below, k, next_a, next_t, here_a, here_t, -2.0)
    return total


@kernel
def _square(blocks, k, a, t, b, u, factor):
    """Add ``factor`` times (a, t)ᵀ (b, u) to the corner of a block that belongs to angle and travel."""
    blocks[k, 0, 0] += factor * a * b
    blocks[k, 0, 1] += factor * a * u
    blocks[k, 1, 0] += factor * t * b
    blocks[k, 1, 1] += factor * t * u


@kernel
def _finite(gradient):
    for k in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            if not isfinite(gradient[k, j]):
                return False
    return True


@kernel
def _adam_step(gradient, free, first, second, step, rate, beta1, beta2, decay1, decay2, eps):
    """Update the moments and write the next step (K, 5); ``decay`` are the betas to the power of the queries so far."""
    for k in range(len(step)):
        for j in range(5):
            if free[k, j]:
                g = gradient[k, j]
                first[k, j] = beta1 * first[k, j] + (1 - beta1) * g
                second[k, j] = beta2 * second[k, j] + (1 - beta2) * (g * g)
                mean, square = first[k, j] / (1 - decay1), second[k, j] / (1 - decay2)
                step[k, j] = -rate * mean / (sqrt(square) + eps)


@kernel
def _sum(a, factor, b, into):
    """a + factor · b (K, 5)."""
    for k in range(len(into)):
        for j in range(5):
            into[k, j] = a[k, j] + factor * b[k, j]


def _entry(sources):
    @entry
    def run(
        z, kinds, steps, fixed, flags, free, start, warm, values, gradient, diagonal, below, level,
        best, rate, beta1, beta2, eps,
    ):  # fmt: skip
        """Fill ``values`` (B,) for z (B, K, 5); with ``level`` 1 or 2 the derivatives at z[0] as well.

        With ``level`` ADAM it is `planning.optimisers.gradient.adam` from z[0], step for step: ``values`` is its curve,
        ``best`` (K, 5) its answer. One entry point, since what it calls is optimised again for each.
        """
        K = z.shape[1]
        w, c, i = np.zeros((ROWS, 8)), np.zeros((CONTACTS, COLUMNS)), np.zeros(INTS, np.int64)
        for r in range(3):
            w[ROOT_SLACK, r] = sqrt(fixed[SLACK + r])
        pose, adam = np.empty((K + sources * 0, 8)), level == ADAM
        here, step, there = np.empty((K, 5)), np.zeros((K, 5)), np.empty((K, 5))
        first, second = np.zeros((K, 5)), np.zeros((K, 5))
        least, stands, decay1, decay2 = inf, inf, 1.0, 1.0
        if adam:
            _sum(z[0], 0.0, step, here)
            _sum(z[0], 0.0, step, best)
        for n in range(len(values)):
            if adam:
                _sum(here, 1.0, step, there)
            value = _trajectory(
                there if adam else z[n],
                kinds, steps, fixed, flags, free, start, warm, w, c, i, pose, gradient, diagonal, below,
                1 if adam else level,
            )  # fmt: skip
            values[n] = value
            if not adam:
                continue
            if value < inf and _finite(gradient):
                here, there = there, here
                stands = value
                if value < least:
                    least = value
                    _sum(here, 0.0, step, best)
                decay1 *= beta1
                decay2 *= beta2
                _adam_step(gradient, free, first, second, step, rate, beta1, beta2, decay1, decay2, eps)
            else:
                _sum(step, -0.5, step, step)
            values[n] = stands

    return run


run = _entry(fingerprint())
