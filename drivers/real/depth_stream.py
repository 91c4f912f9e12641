"""The depth stream of a RealSense, through Intel's own library: of a live camera, or of a recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, NotConnected
from drivers.finger_frames import DEPTH_UNIT
from drivers.real.bubble_config import DepthLens, RealSenseBubbleConfig
from drivers.real.guarded import guarded
from drivers.real.realsense import chosen, library, offered, resolved, rest, set_option
from mechanics.camera import CameraModel

#: frames that wait in the library while this process is held up: half a second
_QUEUE = 16
#: the camera's lens and the station file's may differ by so much anywhere in the stream's picture [px]
_LENS_AGREES = 0.25
#: how long a library that hangs is waited for when it is to stop [s]
_STOP = 2.0
#: who is so far behind a recording's pace does not make up for it [s]
_HELD_UP = 0.5
#: a recording's frames come at once; after so long without any, whether it has ended is asked [s]
_AT_ONCE = 0.01


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """A frame: the library's ``number`` of it, its times, and the picture (h, w) in `DEPTH_UNIT`, 0 where none is.

    ``told_ns`` is the library's time of it, in Unix time where ``unix``; ``arrival_ns`` is when it came, by our clock.
    """

    number: int
    told_ns: int
    unix: bool
    arrival_ns: int
    depth: NDArray[np.uint16]


class DepthStream:
    """The stream that a station file describes. One thread at a time uses it."""

    def __init__(self, device: str, config: RealSenseBubbleConfig):
        self.device, self._config = device, config
        what = config.recording or f"RealSense {config.serial}".rstrip()
        #: what an error says was asked
        self.asked = f"connect to {what}"
        rows, columns = config.pixels
        self._picked = rows[:, None], columns[None, :]
        self._rs: Any = None
        self._pipeline: Any = None
        self._fetch: Callable[[int], tuple[bool, Any]] | None = None
        self._playback: Any = None
        self._pace = _Pace(1.0 / config.rate)
        self._waiting: tuple[DepthFrame, float] | None = None  # a frame of a recording, and when it is due
        self._steps = np.zeros(0, np.uint16)

    def open(self, timeout: float) -> None:
        """Start it. Raises NotConnected, at once where there is no such camera, file or stream."""
        self.close()
        rs, config, deadline = library(self.device, self.asked), self._config, time.monotonic() + timeout
        asked, camera = rs.config(), ""
        if config.recording:
            file = Path(config.recording).expanduser()
            if not file.is_file():
                raise self._not_reached("there is no such file", "Correct `recording`")
            # not repeated by the library, which ends this process where it is stopped just then (librealsense 2.59)
            asked.enable_device_from_file(str(file), repeat_playback=False)
        else:
            camera = chosen(rs, self.device, self.asked, config.serial, timeout)
            asked.enable_device(camera)
        asked.enable_stream(rs.stream.depth, *config.camera_size, rs.format.z16, round(config.rate))
        pipeline, left = rs.pipeline(), max(deadline - time.monotonic(), 0.1)
        has = partial(self._what_it_has, rs, camera)
        profile = resolved(self.device, self.asked, pipeline, asked, left, has)
        try:
            self._check(rs, profile)
            self._steps = depth_steps(self._unit(rs, profile.get_device()))
            playback = profile.get_device().as_playback() if config.recording else None
            if playback is None:
                queue = rs.frame_queue(_QUEUE, True)
                pipeline.start(asked, queue)
                fetch = queue.try_wait_for_frame
            else:
                playback.set_real_time(False)  # at its own pace, the library leaves frames out on a busy machine
                playback = pipeline.start(asked).get_device().as_playback()
                fetch = pipeline.try_wait_for_frames  # and into a queue it plays two frames in all
        except RuntimeError as error:
            with suppress(RuntimeError):
                pipeline.stop()
            if config.recording:
                rest(pipeline, profile)
            remedy = "Record it anew" if config.recording else "Plug it in again; see whether another program has it"
            raise self._not_reached(str(error), remedy) from error
        self._rs, self._pipeline, self._playback, self._fetch = rs, pipeline, playback, fetch
        self._pace = _Pace(1.0 / config.rate)

    def take(self, timeout: float) -> DepthFrame | None:
        """The next frame, at the pace at which it was exposed; None after ``timeout`` [s].

        Raises DeviceTimeout at a recording's end, DeviceFault where the stream is another one than it was.
        """
        if self._playback is None:
            return self._fetched(timeout)
        deadline = time.monotonic() + timeout
        if self._waiting is None:
            frame = self._fetched(timeout)
            if frame is None:
                return None
            self._waiting = frame, self._pace.due(frame.number, frame.told_ns, time.monotonic())
        frame, due = self._waiting
        # a recording has no event to wait for: its frames come when they were exposed, and `timeout` bounds the wait
        time.sleep(max(0.0, min(due, deadline) - time.monotonic()))
        if due > deadline:
            return None
        self._waiting = None
        return replace(frame, arrival_ns=time.time_ns())

    def _fetched(self, timeout: float) -> DepthFrame | None:
        rs, fetch = self._rs, self._fetch
        assert fetch is not None
        try:
            wait = timeout if self._playback is None else min(timeout, _AT_ONCE)
            got, frame = fetch(max(1, round(wait * 1e3)))
            if not got:
                if self._playback is not None and self._playback.current_status() == rs.playback_status.stopped:
                    self._at_its_end()
                return None
            arrival = time.time_ns()
            depth = frame.as_frameset().get_depth_frame() if frame.is_frameset() else frame.as_depth_frame()
            raw = np.asanyarray(depth.get_data())
            number, told = int(depth.get_frame_number()), round(depth.get_timestamp() * 1e6)
            domain = depth.get_frame_timestamp_domain()
        except RuntimeError as error:
            raise DeviceFault(self.device, "read", str(error), "See to its cable and its USB port", True) from error
        width, height = self._config.camera_size
        if raw.shape != (height, width) or raw.dtype != np.uint16:
            raise DeviceFault(
                self.device,
                "read a picture",
                f"{raw.dtype} of shape {raw.shape}, not uint16 of {height} × {width}",
                "Plug it in again, or correct `camera_size`",
                recoverable=True,
            )
        unix = self._playback is None and domain != rs.timestamp_domain.hardware_clock
        return DepthFrame(number, told, unix, arrival, self._steps[raw[self._picked]])

    def _at_its_end(self) -> None:
        """Begin the recording again where it loops. Raises DeviceTimeout where it does not."""
        if not self._config.loop:
            raise self.ended()
        pace = self._pace
        self.open(_STOP)
        self._pace = pace

    def ended(self) -> DeviceTimeout:
        """What is raised at a recording's end."""
        return DeviceTimeout(
            self.device,
            f"read {self._config.recording}",
            "the recording has ended",
            "Close and open it to play it again; with `loop: true` it begins again by itself",
        )

    def close(self) -> None:
        """Stop it, however it is; idempotent."""
        pipeline, self._pipeline = self._pipeline, None
        playback, self._playback = self._playback, None
        self._fetch = self._waiting = None
        if pipeline is not None:
            with suppress(RuntimeError, TimeoutError):
                guarded(pipeline.stop, _STOP)
            if playback is not None:
                rest(pipeline, playback)

    def _check(self, rs: Any, profile: Any) -> None:
        """Whether it is the camera of the station file, with its lens; and set what is to be set before it starts."""
        config, camera = self._config, profile.get_device()
        serial = _info(rs, camera, rs.camera_info.serial_number)
        if config.serial and serial != config.serial:
            raise self._not_reached(
                f"it is {serial or 'one without a number'}, not {config.serial}", "Correct `serial`"
            )
        told = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        k1, k2, p1, p2, k3 = told.coeffs
        lens = DepthLens(fx=told.fx, fy=told.fy, cx=told.ppx, cy=told.ppy, distortion=(k1, k2, p1, p2, k3))
        if config.camera is None:
            known = told.model in (rs.distortion.none, rs.distortion.brown_conrady) or not any(lens.distortion)
            if not known:
                raise self._not_reached(
                    f"its lens is of the kind {told.model}", "Calibrate it, and give `camera` in the station file"
                )
            if (off := _apart(lens, config.told_lens, config.camera_size)) > _LENS_AGREES:
                said = ", ".join(
                    f"{key}: {value:.7g}" for key, value in lens.model_dump(exclude={"distortion"}).items()
                )
                if any(lens.distortion):
                    said += f", distortion: [{', '.join(f'{k:.7g}' for k in lens.distortion)}]"
                raise self._not_reached(
                    f"by its lens, pixels lie up to {off:.3g} px from where the station file has them",
                    f"Write `lens: {{{said}}}` there",
                )
        if not config.recording:
            sensor = camera.first_depth_sensor()
            wanted = {
                "visual_preset": config.preset,
                "laser_power": config.laser_power,
                "depth_units": config.depth_unit,
            }
            for option, value in wanted.items():  # a preset may set the others
                if value not in ("", None):
                    set_option(rs, self.device, self.asked, sensor, option, value)

    def _unit(self, rs: Any, camera: Any) -> float:
        """One step of its depth [m]."""
        sensor = camera.first_depth_sensor()
        if not sensor.supports(rs.option.depth_units):  # the library would say a millimetre
            raise self._not_reached("it does not say what a step of its depth is", "Record it anew, with its options")
        unit = float(sensor.get_depth_scale())
        if not 0 < unit < 1:
            raise self._not_reached(f"it says that a step of its depth is {unit:g} m", "Record or set it anew")
        return unit

    def _what_it_has(self, rs: Any, serial: str) -> str:
        """The remedy for a camera or a recording without the stream that is asked for."""
        try:
            if serial:
                cameras = rs.context().query_devices()
                (camera,) = (c for c in cameras if _info(rs, c, rs.camera_info.serial_number) == serial)
            else:
                camera = rs.context().load_device(str(Path(self._config.recording).expanduser()))
            streams = offered(rs, camera)
        except (RuntimeError, ValueError):
            return "Plug it in again" if serial else "It is damaged, or no recording of a RealSense: record it anew"
        if not streams:
            return "It has no depth stream"
        usb = _info(rs, camera, rs.camera_info.usb_type_descriptor)
        slow = f" (it is on USB {usb}: at a port of USB 3 it has more)" if usb.startswith("2") else ""
        return f"Correct `camera_size` and `rate`: it has depth of {streams}{slow}"

    def _not_reached(self, got: str, remedy: str) -> NotConnected:
        return NotConnected(self.device, self.asked, got, remedy)


class _Pace:
    """When the frames of a recording are due, by what the camera said of their exposure; ``period`` [s] is the usual.

    Who is held up for half a second goes on from there.
    """

    def __init__(self, period: float):
        self._period = period
        self._last: tuple[int, int, float] | None = None

    def due(self, number: int, told_ns: int, now: float) -> float:
        due = now
        if self._last is not None:
            last, last_told_ns, last_due = self._last
            onward = number > last and told_ns > last_told_ns  # and not the beginning again
            due = last_due + ((told_ns - last_told_ns) * 1e-9 if onward else self._period)
        due = due if now - due < _HELD_UP else now
        self._last = number, told_ns, due
        return due


def depth_steps(unit: float) -> NDArray[np.uint16]:
    """Depth in `DEPTH_UNIT` for each of the 65536 figures that a camera has for a depth, in its own ``unit`` [m].

    0, which is no depth, stays 0, and what lies beyond the last step has none either.
    """
    steps = np.rint(np.arange(1 << 16) * (unit / DEPTH_UNIT))
    return np.where(steps < 1 << 16, steps, 0).astype(np.uint16)


def _apart(lens: DepthLens, other: DepthLens, size: tuple[int, int]) -> float:
    """How far pixels of two lenses lie apart at most, on a grid over the picture [px]."""
    width, height = size
    cameras = [CameraModel(width, height, each.matrix, np.array(each.distortion)) for each in (lens, other)]
    across, down = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    rays = np.column_stack(((across.ravel() - lens.cx) / lens.fx, (down.ravel() - lens.cy) / lens.fy, np.ones(81)))
    one, two = (camera.project(rays) for camera in cameras)
    return float(np.linalg.norm(one - two, axis=1).max())


def _info(rs: Any, camera: Any, what: Any) -> str:
    return camera.get_info(what) if camera.supports(what) else ""
