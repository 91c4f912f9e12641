"""The figures of a Soft Bubble: its unpressed dome, and the depth camera under it."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drivers.finger_frames import (
    BUBBLE_DISTANCE,
    BUBBLE_DOME,
    BUBBLE_SHIFT,
    DEPTH_UNIT,
    REALSENSE_FOCAL,
    bubble_camera_pose,
)
from mechanics.camera import CameraModel
from mechanics.readings import Array

__all__ = ["DEPTH_UNIT", "DOME", "DepthCamera", "Dome", "camera_of"]


@dataclass(frozen=True, slots=True)
class Dome:
    """The unpressed membrane: an ellipsoid over an elliptic rim, as measured on a real one.

    Semi-axes ``a`` along x and ``b`` along y, height of the apex over the rim's plane ``top`` [m]; ``gas`` is κ [m⁻⁴],
    the gas's bulk modulus over its volume and the membrane's tension.
    """

    a: float = BUBBLE_DOME[0]
    b: float = BUBBLE_DOME[1]
    top: float = BUBBLE_DOME[2]
    gas: float = 1.5e6

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height (...) [m] over (x, y) (...), zero beyond the rim."""
        rest = 1.0 - (np.asarray(x, float) / self.a) ** 2 - (np.asarray(y, float) / self.b) ** 2
        return self.top * np.sqrt(np.maximum(rest, 0.0))

    @property
    def feedback(self) -> float:
        """How much a load on the free membrane answers itself: κ∫φ with −∇²φ = 1, φ = 0 on the ellipse."""
        a2, b2 = self.a**2, self.b**2
        return self.gas * pi * self.a * self.b / 4 * a2 * b2 / (a2 + b2)


DOME = Dome()


@dataclass(frozen=True, slots=True)
class DepthCamera:
    """A depth camera and how it is mounted, its x along the dome's long axis.

    ``focal`` in pixels, principal point in the middle. ``distance`` [m] from the camera to the dome's apex along the
    optical axis; the dome's axis lies ``shift`` [m] from it along the image's x.
    """

    model: str
    kind: Literal["time_of_flight", "stereo"]
    width: int
    height: int
    focal: float
    distance: float = BUBBLE_DISTANCE
    shift: float = 0.0

    @property
    def rays(self) -> tuple[Array, Array]:
        """Slopes of the rays: x per column, y per row."""
        across: Array = (np.arange(self.width, dtype=np.float64) - 0.5 * (self.width - 1)) / self.focal
        down: Array = (np.arange(self.height, dtype=np.float64) - 0.5 * (self.height - 1)) / self.focal
        return across, down

    def model_in_finger(self) -> CameraModel:
        """As a CameraModel whose world is the finger's frame (`drivers.sim.soft_bubble.SimSoftBubble`)."""
        f, cx, cy = self.focal, 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        return CameraModel(self.width, self.height, K, X_WC=bubble_camera_pose(self.distance, self.shift))


def camera_of(width: int, height: int) -> DepthCamera:
    """The camera that gives pictures of this size: a pico flexx below 320 columns, a RealSense from there on.

    The pico flexx sees 62° across its columns (data sheet) and sits on the dome's axis. The RealSense has 434 pixels of
    focal length at 640 columns and sits 21 mm off the axis, as in the fingers that were measured.
    """
    if width < 320:
        return DepthCamera("pico flexx", "time_of_flight", width, height, 0.5 * width / tan(radians(31)))
    return DepthCamera("RealSense", "stereo", width, height, REALSENSE_FOCAL * width / 640.0, shift=BUBBLE_SHIFT)
