"""What the camera behind a real gel does to its picture: the figures of a mismatch profile, and how they come about."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.scene import Strict


class GelNoise(Strict):
    """Errors of a gel's picture; all zero: the picture is what optics and rounding make of the gel."""

    noise: float = Field(default=0.0, ge=0, le=50, description="1 sigma of a pixel's colour channel [grey levels]")
    exposure: float = Field(default=0.0, ge=0, lt=0.5, description="relative brightness of a frame, 1 sigma")
    bias: float = Field(default=0.0, ge=0, le=50, description="of each colour channel, constant, 1 sigma [grey levels]")
    vignetting: float = Field(default=0.0, ge=0, lt=1, description="relative loss of light in the picture's corners")


class NoisyExposure:
    """Turns pictures (h, w, 3) in grey levels into bgr8 with the errors of ``figures``.

    The same generator gives the same errors. What is constant is drawn first, so it does not hang on the frames.
    """

    def __init__(self, figures: GelNoise, width: int, height: int, rng: np.random.Generator):
        self._figures, self._rng = figures, rng
        self._bias = (figures.bias * rng.standard_normal(3)).astype(np.float32)
        x, y = np.meshgrid(np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32))
        self._shade = (1 - 0.5 * figures.vignetting * (x * x + y * y))[..., None]

    def begin_trial(self, rng: np.random.Generator) -> None:
        """What is drawn frame by frame comes from ``rng`` from now on."""
        self._rng = rng

    def constant(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """The picture with what does not change from frame to frame: vignetting and bias."""
        figures = self._figures
        if figures.vignetting:
            picture = np.multiply(picture, self._shade, dtype=np.float32)
        return picture + self._bias if figures.bias else picture

    def expose(self, picture: NDArray[np.float32]) -> NDArray[np.uint8]:
        """One frame."""
        figures = self._figures
        if figures.exposure:
            picture = np.multiply(picture, 1 + figures.exposure * self._rng.standard_normal(), dtype=np.float32)
        picture = self.constant(picture)
        if figures.noise:
            grain = self._rng.standard_normal(picture.shape, np.float32)
            grain *= figures.noise
            picture = np.add(grain, picture, out=grain)
        return rounded(picture)


def rounded(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Whole grey levels, cut off at black and white."""
    levels = cv2.convertScaleAbs(np.maximum(picture, 0))  # rounds and saturates
    return np.asarray(levels, np.uint8)
