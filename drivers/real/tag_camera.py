"""The AprilTag camera: a colour camera over HTTP, USB or RealSense, and the project's own detector on its pictures."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.config import TagCameraConfig
from drivers.interfaces import Description, TagCamera
from drivers.real.colour_camera import CameraDevice, ColourCamera, Picture
from drivers.registry import Driver
from drivers.tags import TagDetector
from mechanics.camera import CameraModel, rigid
from mechanics.readings import ImageReading, Stamp, TagDetection, TagReading
from mechanics.square_pose import square_pose
from mechanics.yaml_input import Refusal


class RealTagCameraConfig(CameraDevice, TagCameraConfig, frozen=True):
    """A camera that sees the tags. ``position`` and ``look_at`` [m] are in the 3-D world (x right, y away, z up).

    What calibration finds (`calibrate_camera`) takes the place of what is said here of the lens and the place.
    """

    driver: Literal["tag_camera"]
    rate: float = Field(default=10.0, gt=0, le=120, description="pictures that are searched [Hz]")
    width: int = Field(default=1280, ge=64, le=4096, description="of the picture that is searched [px]")
    height: int = Field(default=720, ge=64, le=4096, description="[px]")
    centre: tuple[float, float] | None = Field(
        default=None, description="principal point [px]; the picture's middle where it is not known"
    )
    distortion: tuple[float, float, float, float, float] = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0), description="OpenCV's k1, k2, p1, p2, k3"
    )
    X_WC: tuple[tuple[float, ...], ...] | None = Field(
        default=None, description="the camera's pose in the world, 4 × 4, in the place of position and look_at"
    )
    family: Literal["tag36h11", "tag25h9", "tag16h5"] = "tag36h11"
    decimate: float = Field(default=2.0, ge=1, le=8, description="how much smaller the picture is that is searched")
    blur: float = Field(default=0.8, ge=0, le=4, description="of the picture that is searched [px]")
    search_every: float = Field(
        default=0.5, ge=0, le=60, description="how often all of the picture is searched for new tags [s]; 0: always"
    )

    @model_validator(mode="before")
    @classmethod
    def _looks_somewhere(cls, data: Any) -> Any:
        """By its pose, where that is given."""
        if not (isinstance(data, dict) and data.get("X_WC") is not None):
            return data
        try:
            X_WC = rigid("X_WC", data["X_WC"])
        except (TypeError, ValueError, OverflowError) as error:
            raise Refusal(str(error), "4 rows of 4 numbers, a rotation and a place", at=("X_WC",)) from None
        position, ahead = X_WC[:3, 3], X_WC[:3, 2]
        return {"position": tuple(position.tolist()), "look_at": tuple((position + ahead).tolist()), **data}

    @model_validator(mode="after")
    def _can_be(self) -> Self:
        with np.errstate(all="ignore"):  # what is not finite is no camera
            try:
                model = self.model
            except ValueError as error:
                raise Refusal(str(error), "a camera that can be") from None
            position, ahead = np.array(self.position), np.subtract(self.look_at, self.position)
            same = np.allclose(position, model.X_WC[:3, 3], atol=1e-6)
            same = same and np.allclose(np.cross(ahead, model.X_WC[:3, 2]), 0.0, atol=1e-6)
        if not same:
            raise Refusal("says twice where the camera stands", "X_WC alone, or position and look_at", at=("X_WC",))
        return self

    @property
    def model(self) -> CameraModel:
        """The camera as it is described here."""
        size = self.width, self.height
        cx, cy = self.centre or (0.5 * (self.width - 1), 0.5 * (self.height - 1))
        K = np.array([[self.focal, 0.0, cx], [0.0, self.focal, cy], [0.0, 0.0, 1.0]])
        if self.X_WC is not None:
            return CameraModel(*size, K, np.array(self.distortion), np.array(self.X_WC, float))
        return CameraModel(*size, K, np.array(self.distortion), super().model.X_WC)


class RealTagCamera(ColourCamera[TagReading], TagCamera):
    """A tag camera. Tags are followed from picture to picture, and all of a picture is searched now and then.

    A tag that comes into view beside others is therefore seen ``search_every`` later at the latest. Each detection says
    how ambiguous its pose in space is.
    """

    grey = True

    def __init__(self, name: str, config: RealTagCameraConfig):
        super().__init__(name, config, 256)
        self._camera = config
        self._model = config.model
        self._detector: TagDetector | None = None
        self._followed: set[int] = set()
        self._searched = 0.0
        self._image: ImageReading | None = None

    def describe(self) -> Description:
        """``extra`` has the camera (a `CameraModel` as a dict) and the family of its tags."""
        config = self._camera
        return Description(
            name=self.name,
            kind="tag_camera",
            model="AprilTag camera",
            backend="real",
            serial=config.serial or config.shown_address,
            frame=self.name,
            rate=config.rate,
            range=(float(config.width), float(config.height)),
            resolution=(1.0,),
            extra={"camera": self._model.as_dict(), "family": config.family},
        )

    def image(self) -> ImageReading | None:
        """The picture (mono8) behind the newest reading, by which it is stamped; None before the first."""
        return self._image

    def _made(self, stamp: Stamp, picture: Picture) -> TagReading:
        detections = tuple(self._judged(tag) for tag in self._found(picture))
        self._image = ImageReading(stamp, picture, "mono8")
        return TagReading(stamp, detections, self._camera.family)

    def _found(self, picture: Picture) -> tuple[TagDetection, ...]:
        detector, now = self._detector, time.monotonic()
        assert detector is not None
        # whoever asks for a frame wants all that is in it, a tag that has just come into view among it
        if not self._followed or self._asks or now - self._searched >= self._camera.search_every:
            detector.forget()
            self._searched = now
        found = detector.track(picture, self._followed)
        self._followed = {tag.id for tag in found}
        return found

    def _judged(self, tag: TagDetection) -> TagDetection:
        pose = square_pose(self._model, tag.corners, 1.0)  # the ambiguity is the same for any size
        return tag if pose is None else replace(tag, ambiguity=pose.ambiguity)

    def _open(self, timeout: float) -> None:
        config = self._camera
        camera = self._model if self._model.distortion.any() else None
        self._detector = TagDetector(config.family, decimate=config.decimate, blur=config.blur, camera=camera)
        self._followed, self._image = set(), None
        try:
            super()._open(timeout)
        except BaseException:
            self._put_away()
            raise

    def _shut(self) -> None:
        super()._shut()
        self._put_away()

    def _put_away(self) -> None:
        detector, self._detector = self._detector, None
        if detector is not None:
            detector.close()


DRIVER = Driver(RealTagCameraConfig, RealTagCamera)
