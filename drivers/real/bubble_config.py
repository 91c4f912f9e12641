"""What a station file says of a Soft Bubble with a RealSense."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator

from drivers.config import RealDevice, TactileConfig
from drivers.finger_frames import (
    BUBBLE_DISTANCE,
    BUBBLE_DOME,
    BUBBLE_SHIFT,
    REALSENSE_FOCAL,
    bubble_camera_pose,
)
from drivers.real.realsense import RECORDINGS
from drivers.real.reference import REFERENCE_KEY
from mechanics.camera import CameraModel
from mechanics.yaml_input import Refusal


class DepthLens(BaseModel, frozen=True, extra="forbid"):
    """The lens of a depth stream as the camera tells it [px], with OpenCV's distortion (k1, k2, p1, p2, k3)."""

    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


class RealSenseBubbleConfig(RealDevice, TactileConfig, frozen=True):
    """A Soft Bubble with a RealSense. Its optics are told by ``lens``, ``distance``, ``shift``, or by ``camera``.

    A depth picture is cropped first, then every so many-th pixel is taken: depths are never averaged, since a mean
    across an edge or a hole is the depth of nothing.
    """

    driver: Literal["realsense_bubble"]
    sensor: Literal["soft_bubble"] = "soft_bubble"
    recording: str = Field(
        default="", description=f"file ({', '.join(RECORDINGS)}) that is played back instead of a live camera"
    )
    loop: bool = Field(default=False, description="whether the recording begins again at its end")
    rate: float = Field(default=30.0, ge=1, le=90, description="of the depth stream [Hz]; a whole number")
    camera_size: tuple[int, int] = Field(default=(640, 480), description="width and height of the depth stream [px]")
    crop: tuple[int, int, int, int] | None = Field(
        default=None, description="what is kept of it: left, top, width, height [px]"
    )
    lens: DepthLens | None = Field(
        default=None, description="as the camera tells it for this depth stream; the usual one where it is not given"
    )
    distance: float = Field(
        default=BUBBLE_DISTANCE, gt=0, le=1, description="of the camera to the unpressed dome's apex [m]"
    )
    shift: float = Field(
        default=BUBBLE_SHIFT,
        ge=-0.2,
        le=0.2,
        description="of the dome's axis from the camera's, along the picture's x [m]",
    )
    camera: dict[str, Any] | None = Field(
        default=None,
        description="the calibrated camera of the pictures (width, height, K, distortion, X_WC) in the finger's frame",
    )
    dome: tuple[float, float, float] = Field(
        default=BUBBLE_DOME, description="the unpressed dome's semi-axes along the picture's x and y, its height [m]"
    )
    preset: str = Field(default="", description="the camera's visual preset by name, `High Accuracy`, say")
    laser_power: float | None = Field(default=None, ge=0, le=1000, description="of its projector [mW]; 0: none")
    depth_unit: float | None = Field(
        default=None, gt=0, le=0.01, description="asked of the camera [m]; its own, 1 mm for many, where not given"
    )
    delay: float = Field(
        default=0.0, ge=0, le=1, description="from exposure to arrival, where the camera's clock is not ours [s]"
    )
    silence: float = Field(default=2.0, ge=0.2, le=30, description="so long without a frame, and it has gone [s]")
    reference: str = Field(default="", description=REFERENCE_KEY)

    @model_validator(mode="after")
    def _of_one_source(self) -> Self:
        if not self.rate.is_integer():
            raise Refusal(f"a depth stream has no {self.rate:g} Hz", "6, 15, 30, 60 or 90", at=("rate",))
        if not self.recording:
            if self.loop:
                raise Refusal("there is no recording to play again", "recording: FILE", at=("loop",))
            return self
        if not self.recording.endswith(RECORDINGS):
            expected = f"a file whose name ends in {' or '.join(RECORDINGS)}"
            raise Refusal(f"{self.recording} is no recording", expected, at=("recording",))
        for key in ("preset", "laser_power", "depth_unit"):
            if getattr(self, key) not in ("", None):
                raise Refusal("a recording is as it was made", "no such key, or no recording", at=(key,))
        return self

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if not all(32 <= side <= 4096 for side in self.camera_size):
            raise Refusal(f"{self.camera_size} is no size", "two figures from 32 to 4096", at=("camera_size",))
        left, top, wide, high = self.window
        if min(left, top) < 0 or left + wide > self.camera_size[0] or top + high > self.camera_size[1]:
            within = f"{self.camera_size[0]} × {self.camera_size[1]}"
            raise Refusal(f"{self.crop} is not within {within}", "left, top, width, height", at=("crop",))
        if wide < self.width or high < self.height:
            expected = f"width: at most {wide}, height: at most {high}"
            raise Refusal(f"no {self.width} × {self.height} pixels are left of {wide} × {high}", expected)
        if not 0 < self.dome[2] < self.distance or min(self.dome) <= 0:
            raise Refusal(f"{self.dome} is no dome {self.distance:g} m high", "three lengths [m]", at=("dome",))
        if self.indentation >= self.dome[2]:
            raise Refusal(
                f"{self.indentation * 1e3:g} mm is deeper than the dome is high",
                f"less than {self.dome[2] * 1e3:g} mm, usually 12",
                at=("indentation",),
            )
        return self

    @model_validator(mode="after")
    def _sees(self) -> Self:
        if self.camera is not None:
            try:
                model = CameraModel.from_dict(self.camera)
            except ValueError as error:
                raise Refusal(str(error), "a camera model as `calibrate_camera` writes it", at=("camera",)) from None
            if (model.width, model.height) != (self.width, self.height):
                raise Refusal(
                    f"it is one of {model.width} × {model.height} pixels",
                    f"{self.width} × {self.height}",
                    at=("camera",),
                )
        return self

    @property
    def window(self) -> tuple[int, int, int, int]:
        """What is kept of the depth stream's picture: left, top, width, height [px]."""
        return self.crop if self.crop is not None else (0, 0, *self.camera_size)

    @cached_property
    def pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows (h,) and columns (w,) of the depth stream's picture that a reading's picture has."""
        left, top, wide, high = self.window
        rows = top + ((np.arange(self.height) + 0.5) * high / self.height).astype(np.intp)
        columns = left + ((np.arange(self.width) + 0.5) * wide / self.width).astype(np.intp)
        return rows, columns

    @property
    def told_lens(self) -> DepthLens:
        """The depth stream's lens: the usual one where the station file has none."""
        if self.lens is not None:
            return self.lens
        width, height = self.camera_size
        focal = REALSENSE_FOCAL * width / 640.0
        return DepthLens(fx=focal, fy=focal, cx=0.5 * (width - 1), cy=0.5 * (height - 1))

    @property
    def optics(self) -> CameraModel:
        """The camera of a reading's picture; its world is the finger's frame."""
        if self.camera is not None:
            return CameraModel.from_dict(self.camera)
        lens, (_, _, wide, high), (rows, columns) = self.told_lens, self.window, self.pixels
        across, down = wide / self.width, high / self.height
        # the pixels that are taken lie at `across · i + offset`, to half a pixel of the stream
        cx = (lens.cx - float(np.mean(columns - across * np.arange(self.width)))) / across
        cy = (lens.cy - float(np.mean(rows - down * np.arange(self.height)))) / down
        K = np.array([[lens.fx / across, 0, cx], [0, lens.fy / down, cy], [0, 0, 1]])
        pose = bubble_camera_pose(self.distance, self.shift)
        return CameraModel(self.width, self.height, K, np.array(lens.distortion), pose)
