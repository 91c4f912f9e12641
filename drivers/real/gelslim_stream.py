"""A GelSlim tactile finger: the colour camera behind its gel, over HTTP, USB or RealSense."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.config import TactileConfig
from drivers.finger_frames import X_EE_FINGER, gel_camera
from drivers.interfaces import Description
from drivers.real.colour_camera import CameraDevice, ColourCamera, Picture
from drivers.real.reference import KEPT, REFERENCE_KEY, ReferencedFinger
from drivers.registry import Driver
from mechanics.camera import CameraModel
from mechanics.readings import ImageReading, Stamp
from mechanics.yaml_input import Refusal

#: grey levels by which the halves of a reference's frames may differ on average: beyond that something moved
_STILL = 2.0


class GelSlimConfig(CameraDevice, TactileConfig, frozen=True):
    """A GelSlim. Its optics are told by ``view``, ``distance``, ``tilt``, ``bend``, or by a calibrated ``camera``."""

    driver: Literal["gelslim_stream"]
    sensor: Literal["gelslim"] = "gelslim"
    indentation: float = Field(
        default=0.0008, gt=0, le=0.003, description="how deep the held object's face is pressed into the gel [m]"
    )
    view: float = Field(default=0.0452, gt=0, le=0.2, description="of the gel across the picture's width [m]")
    distance: float = Field(default=0.040, gt=0, le=0.5, description="of the camera's pupil from the gel [m]")
    tilt: float = Field(
        default=0.06, ge=-0.8, le=0.8, description="of the camera: it sees the lower rows from nearer [rad]"
    )
    bend: float = Field(default=0.12, ge=-1, le=1, description="the lens' radial distortion k1")
    marker_pitch: float | None = Field(
        default=0.0023, gt=0, le=0.02, description="from dot to dot on the gel [m]; none where it has no dots"
    )
    camera: dict[str, Any] | None = Field(
        default=None, description="the calibrated camera (width, height, K, distortion, X_WC), in the finger's frame"
    )
    reference: str = Field(default="", description=REFERENCE_KEY)

    @model_validator(mode="after")
    def _sees(self) -> Self:
        try:
            model = self.optics
        except ValueError as error:
            raise Refusal(str(error), "a camera model as `calibrate_camera` writes it", at=("camera",)) from None
        if (model.width, model.height) != (self.width, self.height):
            raise Refusal(
                f"it is one of {model.width} × {model.height} pixels", f"{self.width} × {self.height}", at=("camera",)
            )
        return self

    @property
    def optics(self) -> CameraModel:
        """The camera, its world being the finger's frame."""
        if self.camera is not None:
            return CameraModel.from_dict(self.camera)
        return gel_camera(
            self.width, self.height, view=self.view, distance=self.distance, tilt=self.tilt, bend=self.bend
        )


class GelSlim(ColourCamera[ImageReading], ReferencedFinger[Picture]):
    """One GelSlim finger; its readings are bgr8. `drivers.finger_frames` says how it sits at the end-effector."""

    def __init__(self, name: str, config: GelSlimConfig):
        super().__init__(name, config, KEPT)
        self._finger = config

    def describe(self) -> Description:
        """``extra`` has what estimation needs: the camera, the finger's frame in ee, the dots' pitch, the depth.

        ``mm_per_px`` is in the middle of the picture at rest.
        """
        config = self._finger
        camera = config.optics
        extra: dict[str, Any] = {
            "sensor": "gelslim",
            "finger": config.finger,
            "encoding": "bgr8",
            "width": config.width,
            "height": config.height,
            "mm_per_px": 1e3 * _distance(camera) / float(camera.K[0, 0]),
            "indentation_mm": 1e3 * config.indentation,
            "camera": camera.as_dict(),
            "X_ee_finger": [list(row) for row in X_EE_FINGER[config.finger]],
            "reference": bool(config.reference),
        }
        if config.marker_pitch is not None:
            extra["marker_pitch_mm"] = 1e3 * config.marker_pitch
        return Description(
            name=self.name,
            kind="tactile",
            model="GelSlim",
            backend="real",
            serial=config.serial or config.shown_address,
            frame=self.name,
            rate=config.rate,
            range=(0.0, 255.0),
            resolution=(1.0,),
            extra=extra,
        )

    @property
    def _reference_named(self) -> str:
        return self._finger.reference

    @property
    def _reference_like(self) -> tuple[tuple[int, ...], type[np.uint8]]:
        return (self._finger.height, self._finger.width, 3), np.uint8

    def _mean(self, frames: Picture) -> Picture:
        stack, half = frames.astype(np.float32), len(frames) // 2
        change = float(np.abs(stack[:half].mean(axis=0) - stack[half:].mean(axis=0)).mean())
        if change > _STILL:
            raise ValueError(f"the picture changes, by {change:.1f} grey levels")
        return np.rint(stack.mean(axis=0)).astype(np.uint8)

    def _made(self, stamp: Stamp, picture: Picture) -> ImageReading:
        return ImageReading(stamp, picture, "bgr8")


def _distance(camera: CameraModel) -> float:
    """From the camera to the gel along its axis [m]."""
    return float(-camera.X_WC[2, 3] / camera.X_WC[2, 2])


DRIVER = Driver(GelSlimConfig, GelSlim)
