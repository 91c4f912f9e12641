"""Recordings of a depth camera in software, made by Intel's own library, and cameras that are plugged in and out."""

from __future__ import annotations

import importlib
import itertools
import threading
import time
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.real.realsense_bubble import RealSenseBubble, RealSenseBubbleConfig
from mechanics.readings import ImageReading

WIDTH, HEIGHT, RATE = 320, 240, 30
SERIAL = "0123456789"
#: the lens of the camera in software
LENS = {"fx": 217.25, "fy": 216.5, "cx": 160.5, "cy": 118.75}
#: frames of the recording of numbered pictures, and those that it lacks
COUNT, MISSING = 20, (7, 8)
#: when the first frame was exposed, by the camera [s]
EPOCH = 1.7e9

Depth = NDArray[np.uint16]


def library() -> Any:
    """The module pyrealsense2, which says nothing of its types."""
    return importlib.import_module("pyrealsense2")


def numbered(number: int, width: int = WIDTH, height: int = HEIGHT) -> Depth:
    """Depths that say where they are and which picture they are of; a corner and every 37th pixel have none."""
    rows, columns = np.mgrid[:height, :width]
    depth = 1000 + 16 * number + (rows * 7 + columns * 3) % 16
    depth[(rows * width + columns) % 37 == 0] = 0
    depth[:20, :30] = 0
    return depth.astype(np.uint16)


def dome(width: int, height: int, lens: dict[str, float], distance: float = 0.1, shift: float = 0.021) -> Depth:
    """The unpressed membrane: where each ray meets the ellipsoid of a Soft Bubble's dome [0.1 mm]."""
    a, b, top = 0.0557, 0.0406, 0.041
    rows, columns = np.mgrid[:height, :width]
    rx, ry = (columns - lens["cx"]) / lens["fx"], (rows - lens["cy"]) / lens["fy"]
    base = distance - top
    p = (rx / a) ** 2 + (ry / b) ** 2 + 1 / top**2
    q = rx * shift / a**2 + base / top**2
    z = (q + np.sqrt(np.maximum(q**2 - p * ((shift / a) ** 2 + (base / top) ** 2 - 1), 0))) / p
    inside = ((rx * base - shift) / a) ** 2 + (ry * base / b) ** 2 < 1
    return np.where(inside, np.rint(z * 1e4), 0).astype(np.uint16)


def record(
    file: Path,
    pictures: Iterable[Depth],
    *,
    unit: float | None = 1e-4,
    lens: dict[str, float] | None = None,
    missing: Collection[int] = (),
    stream: str = "depth",
) -> Path:
    """Record frames 1, 2 and so on at `RATE`, without those that are ``missing``; as long as it takes."""
    rs = library()
    frames = [(n, picture) for n, picture in enumerate(pictures, 1) if n not in missing]
    height, width = frames[0][1].shape
    camera = rs.software_device()
    camera.register_info(rs.camera_info.serial_number, SERIAL)
    camera.register_info(rs.camera_info.name, "a camera in software")
    sensor, video, optics = camera.add_sensor("Stereo Module"), rs.video_stream(), rs.intrinsics()
    lens = lens or LENS
    optics.width, optics.height, optics.model = width, height, rs.distortion.brown_conrady
    optics.fx, optics.fy, optics.ppx, optics.ppy = lens["fx"], lens["fy"], lens["cx"], lens["cy"]
    video.type, video.fmt = getattr(rs.stream, stream), rs.format.z16
    video.width, video.height, video.fps, video.bpp, video.intrinsics = width, height, RATE, 2, optics
    profile = sensor.add_video_stream(video).as_video_stream_profile()
    if unit is not None:
        sensor.add_read_only_option(rs.option.depth_units, unit)
    recorder = rs.recorder(str(file), camera)
    recorded = recorder.query_sensors()[0]
    recorded.open(recorded.get_stream_profiles()[0])
    arrived, everything, pace = itertools.count(1), threading.Event(), threading.Event()

    def count(_: object) -> None:
        if next(arrived) == len(frames):
            everything.set()

    recorded.start(count)
    begun = time.monotonic()
    for number, picture in frames:
        pace.wait(max(0.0, begun + (number - 1) / RATE - time.monotonic()))  # it is played back as it was made
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp, frame.profile = np.ascontiguousarray(picture), 2 * width, 2, profile
        frame.timestamp, frame.domain = 1e3 * (EPOCH + (number - 1) / RATE), rs.timestamp_domain.system_time
        frame.frame_number, frame.depth_units = number, unit or 0.0
        sensor.on_video_frame(frame)
    assert everything.wait(20)
    recorded.stop()
    recorded.close()
    del recorder, recorded
    return file


def entry(**fields: Any) -> dict[str, Any]:
    """What a station file says of a finger with such a camera."""
    usual = {"kind": "tactile", "backend": "real", "driver": "realsense_bubble", "finger": "left"}
    size = {"camera_size": [WIDTH, HEIGHT], "width": WIDTH, "height": HEIGHT, "rate": RATE, "lens": LENS}
    return {**usual, **size, **fields}


def bubble_playback(folder: Path) -> dict[str, Any]:
    """The station's entry of a Soft Bubble whose camera is a recording, made in ``folder``, that begins ever again."""
    lens = {"fx": 434.0, "fy": 433.5, "cx": 320.25, "cy": 239.0}
    file = record(folder / "bubble.db3", [dome(640, 480, lens)] * 30, lens=lens)
    size = {"camera_size": [640, 480], "width": 224, "height": 171}
    return entry(**size, lens=lens, recording=str(file), loop=True, reference="take")


#: what stood for cameras. The library ends a process where such a thing goes while one of its threads is at work
_PLAYERS: list[Any] = []


class Ports:
    """Stands for the module pyrealsense2, with recordings that are plugged in as if they were live cameras."""

    def __init__(self) -> None:
        self._library = library()
        self._context = self._library.context()
        self._plugged: tuple[Path, Any] | None = None
        self.started = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._library, name)

    def context(self) -> Any:
        return self._context

    def pipeline(self) -> Any:
        self.started += 1
        return self._library.pipeline(self._context)

    def plug(self, file: Path) -> None:
        self._plugged = file, self._context.load_device(str(file))
        _PLAYERS.append(self._plugged[1])

    def unplug(self) -> None:
        if self._plugged is not None:
            self._context.unload_device(str(self._plugged[0]))
            self._plugged = None


def bubble(**fields: Any) -> RealSenseBubble:
    """A finger with such a camera, closed."""
    return RealSenseBubble("finger_left", RealSenseBubbleConfig.model_validate(entry(**fields)))


def trouble(finger: RealSenseBubble, kind: type[DriverError], patience: float = 20.0) -> DriverError:
    """The error that reading ends in, sooner or later."""
    deadline = time.monotonic() + patience
    with pytest.raises(kind) as caught:
        while time.monotonic() < deadline:
            finger.latest(1.0)
    return caught.value


def reading_after(finger: RealSenseBubble, sequence: int, patience: float = 20.0) -> ImageReading:
    """The first reading after ``sequence`` that anybody gets, through trouble and back."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            reading = finger.latest(1.0)
        except DriverError:
            continue
        if reading.stamp.sequence > sequence:
            return reading
    raise AssertionError("no reading")
