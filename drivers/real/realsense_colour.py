"""Colour frames of an Intel RealSense camera, through Intel's own library."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, NotConnected
from drivers.real.frames import FrameSource
from drivers.real.realsense import RECORDINGS, chosen, library, resolved, rest
from drivers.streaming import POLL


class RealsenseSource(FrameSource):
    """The colour stream of the RealSense with number ``serial``; of the only one where that is empty.

    A recording's path (``.db3``, ``.bag``) instead of a number plays that back, once, at its own pace.
    """

    def __init__(
        self,
        name: str,
        serial: str,
        address: str,
        *,
        rate: float,
        size: tuple[int, int],
        delay: float = 0.0,
        silence: float = 2.0,
    ):
        super().__init__(name, address, rate=rate, delay=delay, silence=silence)
        self._wanted, self._size = serial, size
        self._pipeline: Any = None
        self._profile: Any = None
        self._fps, self._frame = 0, -1

    def _reach(self, timeout: float) -> None:
        asked = f"connect to {self.address}"
        rs = library(self.name, asked)
        config = rs.config()
        if self._wanted.endswith(RECORDINGS):
            config.enable_device_from_file(self._wanted, repeat_playback=False)
        else:
            config.enable_device(chosen(rs, self.name, asked, self._wanted, timeout))
            config.enable_stream(rs.stream.color, *self._size, rs.format.bgr8, round(self._rate))
        pipeline, (width, height) = rs.pipeline(), self._size
        remedy = f"See whether it offers {width} × {height} colour at {self._rate:g} Hz (realsense-viewer)"
        resolved(self.name, asked, pipeline, config, timeout, lambda: remedy)
        try:
            profile = pipeline.start(config)
        except RuntimeError as error:
            raise self._not_reached(str(error), remedy) from error
        self._pipeline, self._profile = pipeline, profile
        self._fps, self._frame = profile.get_stream(rs.stream.color).fps(), -1
        self.serial = profile.get_device().get_info(rs.camera_info.serial_number)

    def _drain(self) -> None:
        try:
            got, frames = self._pipeline.try_wait_for_frames(round(POLL * 1e3))
        except RuntimeError as error:
            raise DeviceFault(self.name, f"read {self.address}", str(error), "See to its plug", True) from error
        colour = frames.get_color_frame() if got else None
        if not colour:
            return
        number = colour.get_frame_number()
        missed = number - self._frame - 1 if self._frame >= 0 and number > self._frame else 0
        if number == self._frame:
            return  # with a new frame of another stream comes the old one of this
        self._frame = number
        told = colour.get_timestamp() * 1e6  # plausible where the library puts it into this machine's time
        self._offer(partial(self._picture, colour), round(told), missed if self._fps <= 1.05 * self._rate else 0)

    def _picture(self, colour: Any) -> Callable[[bool], NDArray[np.uint8]]:
        form = str(colour.get_profile().format())
        image = np.array(colour.get_data(), np.uint8)  # a copy: the library takes its buffers back
        return partial(_converted, self.name, image, "rgb8" in form)

    def _detach(self) -> Callable[[], object]:
        pipeline, self._pipeline = self._pipeline, None
        profile, self._profile = self._profile, None

        def stop() -> None:
            if pipeline is None:
                return
            try:
                pipeline.stop()
            finally:
                if self._wanted.endswith(RECORDINGS):
                    rest(pipeline, profile)

        return stop


def _converted(name: str, image: NDArray[np.uint8], rgb: bool, grey: bool) -> NDArray[np.uint8]:
    if image.ndim != 3 or image.shape[2] != 3:
        raise NotConnected(name, "read a picture", f"an array of shape {image.shape}", "Its colour stream is bgr8")
    if grey:
        return cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_RGB2GRAY if rgb else cv2.COLOR_BGR2GRAY))
    return cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_RGB2BGR)) if rgb else image
