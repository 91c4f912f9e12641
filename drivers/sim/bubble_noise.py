"""The noise of a depth camera that looks at a membrane from inside, as figures of a mismatch profile."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.scene import Strict

_LEAST_JUMP, _MOST_JUMP = 2e-3, 8e-3
Image = NDArray[np.float32]


class DepthNoise(Strict):
    """What one kind of depth camera adds to a depth; nothing by default.

    Figures of a real membrane seen by a stereo camera: `noise_mm` 0.05 (median over the pixels), `correlation_px` 4 to
    8, `memory` 0.11 (a filter in the camera's driver), `roughness_mm` 0.08 to 0.12, `dropout` 0.05, `jumps` 0.3
    to 1 in ten thousand. A time-of-flight camera of 224 × 171 pixels has 0.3 mm, white. Depths are whole tenths of a
    millimetre in any case.
    """

    noise_mm: float = Field(default=0.0, ge=0, le=10, description="1 sigma of a pixel from frame to frame")
    correlation_px: float = Field(default=0.0, ge=0, le=50, description="where neighbours agree to 1/e; 0: white")
    memory: float = Field(default=0.0, ge=0, le=10, description="when it is another one, to 1/e [s]; 0: each frame")
    roughness_mm: float = Field(default=0.0, ge=0, le=10, description="1 sigma of a pixel's constant error")
    dropout: float = Field(default=0.0, ge=0, lt=1, description="share of the pixels that never have a depth")
    jumps: float = Field(default=0.0, ge=0, lt=0.1, description="share of the pixels of a frame off by 2 to 8 mm")


class BubbleNoise(Strict):
    """The Soft Bubble's camera, of either kind."""

    time_of_flight: DepthNoise = DepthNoise()
    stereo: DepthNoise = DepthNoise()


class NoiseSource:
    """One camera's noise: what is constant is drawn at once, the rest frame by frame."""

    def __init__(self, figures: DepthNoise, shape: tuple[int, int], rng: np.random.Generator, period: float = 0.0):
        """``period`` [s] is the least time between frames."""
        self._last: tuple[float, Image] | None = None
        self._period = period
        self._figures, self._shape, self._rng = figures, shape, rng
        #: constant error of each pixel [m]
        self.roughness: Image = self._field(figures.roughness_mm) if figures.roughness_mm else np.zeros(shape, "f4")
        #: pixels that never have a depth
        self.blind: NDArray[np.bool_] = np.zeros(shape, bool)
        if figures.dropout:
            field = self._field(1.0)
            self.blind = field > np.quantile(field, 1 - figures.dropout)

    def begin_trial(self, rng: np.random.Generator) -> None:
        """What is drawn frame by frame comes from ``rng`` from now on, and is like no frame before."""
        self._rng, self._last = rng, None

    @property
    def noisy(self) -> bool:
        """Whether two pictures of the same differ."""
        return self._figures.noise_mm > 0

    def spoil(self, depth: NDArray, at: float | None) -> Image:
        """A depth image [m] as the camera gives it ``at`` an instant [s]; None: the mean of many frames.

        Such a mean keeps only what is constant.
        """
        figures = self._figures
        out = depth.astype(np.float32)
        if figures.roughness_mm:
            out += self.roughness
        if figures.noise_mm and at is not None:
            out += self._next(at)
        if figures.jumps and at is not None:
            count = self._rng.poisson(figures.jumps * out.size)
            size = self._rng.uniform(_LEAST_JUMP, _MOST_JUMP, count) * self._rng.choice([-1.0, 1.0], count)
            out.reshape(-1)[self._rng.integers(0, out.size, count)] += size.astype(np.float32)
        if figures.dropout:
            out[self.blind] = np.nan
        return out

    def _next(self, at: float) -> Image:
        """The noise of the next frame, as like the last one as the time between them has it."""
        figures = self._figures
        new = self._field(figures.noise_mm)
        if not figures.memory:
            return new
        if self._last is not None:
            then, old = self._last
            kept = np.float32(np.exp(-max(at - then, self._period) / figures.memory))
            new = kept * old + np.sqrt(1 - kept * kept) * new
        self._last = at, new
        return new

    def _field(self, size_mm: float) -> Image:
        """Gaussian numbers of standard deviation ``size_mm``, in metres, as correlated as the camera's pixels are."""
        size = size_mm * 1e-3
        # blurred by a Gaussian of sigma s, white noise has the autocorrelation exp(−r²/4s²)
        sigma = 0.5 * self._figures.correlation_px
        if sigma < 0.3:
            return np.float32(size) * self._rng.standard_normal(self._shape, np.float32)
        reach = int(np.ceil(3 * sigma))
        rows, columns = self._shape
        kernel = cv2.getGaussianKernel(2 * reach + 1, sigma).astype(np.float32)
        kernel *= np.sqrt(size) / np.linalg.norm(kernel)  # applied along both axes
        white = self._rng.standard_normal((rows + 2 * reach, columns + 2 * reach), np.float32)
        blurred = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)
        return np.asarray(blurred[reach : reach + rows, reach : reach + columns], np.float32)
