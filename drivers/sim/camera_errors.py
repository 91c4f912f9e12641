"""From the ideal picture of a tag camera to a real one: lens, blur, brightness, noise, by the figures of a profile."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from drivers.sim.mismatch import CameraFigures
from mechanics.camera import CameraModel
from mechanics.readings import Array

_STEPS = 2**16


@cache
def _quantiles() -> NDArray[np.float32]:
    """The normal distribution in so many equal shares: drawn from, it costs a fifth of the exact one, up to 4.3 σ."""
    return ndtri((np.arange(_STEPS) + 0.5) / _STEPS).astype(np.float32)


def calibrated(pinhole: CameraModel, figures: CameraFigures) -> CameraModel:
    """The camera as its calibration has it: what it says of itself."""
    return CameraModel(pinhole.width, pinhole.height, pinhole.K, np.array(figures.distortion), pinhole.X_WC)


def actual(camera: CameraModel, figures: CameraFigures, rng: np.random.Generator) -> CameraModel:
    """The camera as it is: off from its calibration by what that leaves."""
    focal, *bends = rng.standard_normal(6)
    K = camera.K.copy()
    K[:2, :2] *= 1 + figures.focal_error * focal
    return CameraModel(
        camera.width,
        camera.height,
        K,
        camera.distortion * (1 + figures.distortion_error * np.array(bends)),
        camera.X_WC,
    )


def exposed(picture: Array, figures: CameraFigures, rng: np.random.Generator) -> NDArray[np.uint8]:
    """One frame of the picture (h, w) in grey levels: out of focus, a little too bright or dark, and noisy."""
    if not (figures.blur_px or figures.exposure or figures.noise):
        return np.rint(picture).astype(np.uint8)
    levels = picture.astype(np.float32)
    if figures.blur_px:
        cv2.GaussianBlur(levels, (0, 0), figures.blur_px, dst=levels, borderType=cv2.BORDER_REPLICATE)
    if figures.exposure:
        levels *= 1 + figures.exposure * rng.standard_normal()
    if figures.noise:
        grain = _quantiles().take(rng.integers(0, _STEPS, levels.shape, np.uint16), mode="clip")
        grain *= figures.noise
        levels += grain
    return np.asarray(cv2.convertScaleAbs(np.maximum(levels, 0)), np.uint8)  # rounds and saturates
