"""Intel's RealSense library, where it is installed, and the cameras that it sees."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from drivers.errors import NotConnected
from drivers.real.guarded import guarded

#: what a recording's name ends in
RECORDINGS = (".db3", ".bag")
#: what has played one is kept for so long after it was stopped [s]
_REST = 5.0


def library(device: str, asked: str) -> Any:
    """The module pyrealsense2. Raises NotConnected, for ``device`` that ``asked``, where it cannot be had."""
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise NotConnected(
            device, asked, "the package pyrealsense2 is missing", "pip install 'extrinsic[realsense]'"
        ) from error
    except ImportError as error:
        raise NotConnected(
            device, asked, f"pyrealsense2 cannot be loaded: {error}", "On Debian: apt install libusb-1.0-0"
        ) from error
    return pyrealsense2


def chosen(rs: Any, device: str, asked: str, serial: str, timeout: float) -> str:
    """The number of the camera ``serial``; of the only one there is where that is empty. Raises NotConnected.

    Ask before a pipeline is started: the library looks for a camera that is not there for fifteen seconds.
    """
    try:
        cameras = guarded(lambda: list(rs.context().query_devices()), timeout)
        serials = [camera.get_info(rs.camera_info.serial_number) for camera in cameras]
    except TimeoutError:
        raise NotConnected(device, asked, f"no list of cameras within {timeout:.3g} s", "Plug it in again") from None
    except RuntimeError as error:
        raise NotConnected(device, asked, str(error), "See whether you may use USB devices (udev rules)") from error
    wanted = serial or (serials[0] if len(serials) == 1 else "")
    if wanted not in serials:
        there = ", ".join(serials) or "none"
        raise NotConnected(device, asked, f"no RealSense {wanted}".rstrip(), f"Plug it in. Cameras here: {there}")
    return wanted


def resolved(device: str, asked: str, pipeline: Any, config: Any, timeout: float, remedy: Callable[[], str]) -> Any:
    """The profile that ``pipeline`` would start with: its device, its streams. Raises NotConnected with a ``remedy``.

    Ask before every `pipeline.start`: that one waits fifteen seconds for what is not there, and no thread of this
    process runs meanwhile, so that nobody can guard it. This one answers at once.
    """
    try:
        return guarded(lambda: config.resolve(pipeline), timeout)
    except TimeoutError:
        raise NotConnected(device, asked, f"no answer within {timeout:.3g} s", "Plug it in again") from None
    except RuntimeError as error:
        raise NotConnected(device, asked, str(error), remedy()) from error


_rested: deque[tuple[float, tuple[Any, ...]]] = deque()
_resting = threading.Lock()


def rest(*players: Any) -> None:
    """Let go of what has played a recording, but only when no thread of the library uses it any more.

    Its threads still run when `pipeline.stop` returns. Where the last reference to the pipeline or its device goes
    right then, the process ends with "pure virtual method called", once in some hundred times (librealsense 2.59).
    """
    now, gone = time.monotonic(), []
    with _resting:
        _rested.append((now, players))
        while _rested[0][0] < now - _REST:
            gone.append(_rested.popleft())  # what that ends is not to hold the lock


def offered(rs: Any, camera: Any) -> str:
    """The depth streams (z16) that a camera or recording has, in words."""
    rates: dict[tuple[int, int], set[int]] = {}
    for sensor in camera.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16:
                video = profile.as_video_stream_profile()
                rates.setdefault((video.width(), video.height()), set()).add(profile.fps())
    return "; ".join(
        f"{width} × {height} at {', '.join(map(str, sorted(of)))} Hz" for (width, height), of in sorted(rates.items())
    )


def set_option(rs: Any, device: str, asked: str, sensor: Any, name: str, value: float | str) -> None:
    """Set the option ``name`` of a sensor (``laser_power``, say), to a figure or by the name of a value.

    Raises NotConnected, for ``device`` that ``asked``, where it has no such option or the option no such value.
    """
    option = getattr(rs.option, name)
    if not sensor.supports(option) or sensor.is_option_read_only(option):
        raise NotConnected(device, asked, f"this camera's {name} cannot be set", "Leave it out of the station file")
    span = sensor.get_option_range(option)
    if isinstance(value, str):
        steps = range(round((span.max - span.min) / (span.step or 1.0)) + 1)
        values = [span.min + n * (span.step or 1.0) for n in steps]
        words = {str(sensor.get_option_value_description(option, v)): v for v in values}
        known = {word.casefold(): v for word, v in words.items()}
        if value.casefold() not in known:
            raise NotConnected(device, asked, f"its {name} is never {value!r}", f"It can be {', '.join(words)}")
        value = known[value.casefold()]
    if not span.min <= value <= span.max:
        raise NotConnected(
            device, asked, f"its {name} cannot be {value:g}", f"It can be from {span.min:g} to {span.max:g}"
        )
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise NotConnected(device, asked, f"{name} {value:g}: {error}", "Plug it in again") from error
