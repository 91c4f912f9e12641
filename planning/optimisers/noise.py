"""Noise that samplers put on trajectories: white, or coloured so that neighbouring steps move together."""

from __future__ import annotations

import numpy as np

from mechanics.readings import Array


def coloured(rng: np.random.Generator, shape: tuple[int, int, int], beta: float) -> Array:
    """Gaussian noise (B, K, D) whose power falls with frequency f as f^−β along the K steps.

    Timmer and König (1995), as in iCEM's reference: Fourier components with independent normal parts, scaled by
    f^(−β/2); the mean over the steps is drawn with the power of the lowest frequency, 1/K. As there, the variance about
    that mean is one, so that noise with a larger β has more variance in all (1.4 at β = 3). β = 0 is white noise of
    unit variance, and so is the noise of a single step. The noise is periodic over the K steps.
    """
    batch, steps, variables = shape
    if beta == 0 or steps == 1:
        return rng.standard_normal(shape)
    frequency = np.fft.rfftfreq(steps)
    frequency[0] = frequency[1]
    scale = frequency ** (-beta / 2)
    parts = rng.standard_normal((2, batch, variables, len(scale))) * scale
    spectrum = parts[0] + 1j * parts[1]
    # The mean, and for an even number of steps the highest frequency, are real: all their power is in that part.
    single = np.zeros(len(scale), dtype=bool)
    single[0], single[-1] = True, steps % 2 == 0
    spectrum[..., single] = np.sqrt(2) * parts[0][..., single]
    # Parseval: each of the other components stands for two, its own and its conjugate.
    power = 2 * np.sum((scale**2 * np.where(single, 1.0, 2.0))[1:]) / steps**2
    return np.fft.irfft(spectrum, n=steps, axis=-1).transpose(0, 2, 1) / np.sqrt(power)
