"""What devices share that are colour cameras: where their frames come from, how a picture is cut, stamps, captures."""

from __future__ import annotations

import re
import time
from abc import abstractmethod
from typing import Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from drivers.config import RealDevice
from drivers.errors import DeviceFault, DeviceTimeout, NotConnected, ProtocolError
from drivers.interfaces import R, freshness
from drivers.real.frames import ADDRESSES, Frame, FrameSource, frame_source, known_address
from drivers.streaming import StreamingImager
from mechanics.readings import Stamp
from mechanics.yaml_input import Refusal

Picture = NDArray[np.uint8]
_TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


class CameraDevice(RealDevice, frozen=True):
    """What a station file says of every colour camera. ``width`` and ``height`` are those of its readings' pictures.

    A picture is turned first, then flipped, then cropped, then scaled.
    """

    address: str = Field(description=f"where its frames come from: {ADDRESSES}")
    rate: float = Field(default=30.0, gt=0, le=120, description="frames that are read [Hz]; of more, as many")
    width: int = Field(default=640, ge=32, le=4096, description="of the picture that it gives [px]")
    height: int = Field(default=480, ge=32, le=4096, description="[px]")
    rotate: Literal[0, 90, 180, 270] = Field(default=0, description="counter-clockwise [deg]")
    flip: bool = Field(default=False, description="left becomes right, as where the camera looks through one mirror")
    crop: tuple[int, int, int, int] | None = Field(
        default=None, description="what is kept of the turned picture: left, top, width, height [px]"
    )
    scale: bool = Field(default=False, description="whether what is left is resized to width × height")
    camera_size: tuple[int, int] | None = Field(
        default=None, description="width and height of the frames as they come [px]; needed with crop or scale"
    )
    delay: float = Field(
        default=0.0, ge=0, le=1, description="from exposure to arrival, where the camera tells no time itself [s]"
    )
    silence: float = Field(default=2.0, ge=0.2, le=30, description="so long without a frame, and it has gone [s]")

    @model_validator(mode="after")
    def _of_a_known_kind(self) -> Self:
        if not known_address(self.address):
            raise Refusal(f"{self.address!r} is no camera's address", ADDRESSES, at=("address",))
        return self

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.camera_size is None:
            if self.crop is not None or self.scale:
                raise Refusal("crop and scale need camera_size", "camera_size: [width, height]")
            return self
        if not all(1 <= side <= 4096 for side in self.camera_size):
            raise Refusal(f"{self.camera_size} is no size", "two figures from 1 to 4096", at=("camera_size",))
        width, height = self.turned_size
        if self.crop is not None:
            left, top, wide, high = self.crop
            if min(left, top) < 0 or min(wide, high) < 1 or left + wide > width or top + high > height:
                raise Refusal(f"{self.crop} is not within {width} × {height}", "left, top, width, height", at=("crop",))
            width, height = wide, high
        if (width, height) != (self.width, self.height) and not self.scale:
            expected = f"width: {width}, height: {height}, or scale: true"
            raise Refusal(f"what is left is {width} × {height}, not {self.width} × {self.height}", expected)
        return self

    @property
    def shown_address(self) -> str:
        """The address without a password."""
        return re.sub(r"//[^/@]*@", "//", self.address)

    @property
    def frame_size(self) -> tuple[int, int]:
        """Width and height of the frames as they come."""
        if self.camera_size is not None:
            return self.camera_size
        return (self.height, self.width) if self.rotate in (90, 270) else (self.width, self.height)

    @property
    def turned_size(self) -> tuple[int, int]:
        """And after they were turned."""
        width, height = self.frame_size
        return (height, width) if self.rotate in (90, 270) else (width, height)

    def shaped(self, frame: Picture) -> Picture:
        """The picture of a frame (h, w[, 3]) of `frame_size`."""
        picture: Any = frame
        if self.rotate:
            picture = cv2.rotate(picture, _TURNS[self.rotate])
        if self.flip:
            picture = cv2.flip(picture, 1)
        if self.crop is not None:
            left, top, width, height = self.crop
            picture = picture[top : top + height, left : left + width]
        if self.scale and picture.shape[:2] != (self.height, self.width):
            smaller = picture.shape[0] * picture.shape[1] > self.width * self.height
            how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
            picture = cv2.resize(picture, (self.width, self.height), interpolation=how)
        return np.ascontiguousarray(picture)


class ColourCamera(StreamingImager[R]):
    """A device whose readings are made of a colour camera's frames, each as it comes.

    ``capture_ns`` is what the camera says (``X-Timestamp``, say) where that is plausible, else the arrival less
    ``delay``. A frame that is damaged counts as corrupt. A frame of another size is a DeviceFault: nobody resizes it
    unasked.
    """

    #: whether a reading needs no colour
    grey = False

    def __init__(self, name: str, config: CameraDevice, buffer: int):
        super().__init__(name, buffer)
        self._config = config
        self._source: FrameSource | None = None
        self._first: tuple[Frame, Picture] | None = None

    @abstractmethod
    def _made(self, stamp: Stamp, picture: Picture) -> R:
        """The reading that a picture gives."""

    @property
    def camera_rate(self) -> float:
        """Frames per second as measured; 0 while that is unknown."""
        return 0.0 if self._source is None else self._source.rate

    # -- StreamingSensor -------------------------------------------------------------------------------------------

    def _open(self, timeout: float) -> None:
        config = self._config
        self._source = frame_source(
            self.name,
            config.address,
            rate=config.rate,
            size=config.frame_size,
            delay=config.delay,
            silence=config.silence,
        )
        self.max_age = freshness(config.rate)
        super()._open(timeout)

    def _begin(self, timeout: float) -> None:
        source = self._source
        assert source is not None
        deadline = time.monotonic() + timeout
        source.open(timeout)
        wanted = self._config.serial
        if wanted and source.serial and source.serial != wanted:
            raise NotConnected(
                self.name, f"connect to {source.address}", f"it is {source.serial}, not {wanted}", "Correct `serial`"
            )
        damage: ProtocolError | None = None
        while (left := deadline - time.monotonic()) > 0 and not self._closing.is_set():
            frame = source.take(min(0.2, left))
            if frame is not None:
                try:
                    self._first = frame, self._picture(frame)
                    return
                except ProtocolError as error:
                    damage = error
        raise damage or DeviceTimeout(
            self.name, f"connect to {source.address}", f"no frame within {timeout:g} s", "Restart the camera"
        )

    def _poll(self) -> None:
        assert self._source is not None
        first, self._first = self._first, None
        if first is not None:
            self._deliver(*first)
            return
        frame = self._source.take()
        if frame is None:
            return
        if not self._needed:
            self._pass_by(frame.number)
            return
        try:
            picture = self._picture(frame)
        except ProtocolError:
            self._push_damaged(self._stamp(frame))
            return
        self._deliver(frame, picture)

    def _end(self) -> None:
        self._first = None
        if self._source is not None:
            self._source.close()

    def _deliver(self, frame: Frame, picture: Picture) -> None:
        reading = self._made(self._stamp(frame), picture)
        self._push(reading)

    def _stamp(self, frame: Frame) -> Stamp:
        return Stamp(frame.capture_ns, frame.arrival_ns, frame.number, self.name)

    def _picture(self, frame: Frame) -> Picture:
        """Raises ProtocolError for a damaged one, DeviceFault for one of another size."""
        image = frame.picture(self.grey)
        height, width = image.shape[:2]
        expected = self._config.frame_size
        if (width, height) != expected:
            raise DeviceFault(
                self.name,
                "read a picture",
                f"its frames are {width} × {height}, not {expected[0]} × {expected[1]}",
                "Set the camera back, or correct width, height or camera_size in the station file",
                recoverable=True,
            )
        return self._config.shaped(image)
