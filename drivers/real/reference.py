"""The picture of a tactile finger that nothing touches: taken when asked for, or read from a file."""

from __future__ import annotations

import time
from abc import abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Generic, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import CommandRefused, DeviceTimeout
from drivers.interfaces import TactileSensor
from drivers.streaming import StreamingSensor
from mechanics.readings import ImageReading

#: frames of a reference picture
REFERENCE_FRAMES = 30
#: frames that a finger keeps
KEPT = 64
#: what a station file says of a reference that is taken when it is first asked for
TAKEN = "take"
REFERENCE_KEY = (
    "file (PNG) with the picture of the untouched finger; `take`: it is taken when it is first asked for, and nothing "
    "may touch the finger then"
)

P = TypeVar("P", NDArray[np.uint8], NDArray[np.uint16])


class ReferencedFinger(StreamingSensor[ImageReading], TactileSensor, Generic[P]):
    """A finger whose station file names its reference. It keeps `KEPT` frames."""

    _reference: P | None = None

    @property
    @abstractmethod
    def _reference_named(self) -> str:
        """What the station file says: a file, `TAKEN`, or nothing."""

    @property
    @abstractmethod
    def _reference_like(self) -> tuple[tuple[int, ...], type[np.uint8] | type[np.uint16]]:
        """Shape and type of the picture."""

    @abstractmethod
    def _mean(self, frames: P) -> P:
        """The mean of ``frames`` (n, h, w[, 3]). Raises ValueError, saying why, where they are not of one picture."""

    def reference(self) -> P:
        """The picture (h, w[, 3]) of the untouched finger: taken before, or read from the file in the station file.

        Raises CommandRefused where there is none.
        """
        self._need_connection("give its reference picture")
        if self._reference is None:
            named = self._reference_named
            if named == TAKEN:
                return self.take_reference()
            if not named:
                raise self._no_reference("there is none")
            self._reference = self._loaded(Path(named).expanduser())
        return cast("P", self._reference.copy())

    def take_reference(self, frames: int = REFERENCE_FRAMES, timeout: float = 10.0, file: Path | None = None) -> P:
        """Take the reference now, with nothing at the finger: the mean of ``frames`` (2 to 60) frames from now on.

        It counts from now on, and is written to ``file`` (PNG) where that is given. Raises DeviceTimeout, and
        CommandRefused where the picture changes meanwhile.
        """
        asked = "take its reference picture"
        self._need_connection(asked)
        if not 2 <= frames <= KEPT - 4:
            raise CommandRefused(self.name, asked, f"a mean of {frames} frames", f"Ask for 2 to {KEPT - 4}")
        begin, deadline = time.time_ns(), time.monotonic() + timeout
        with self._asking(), self._arrived:
            while len(seen := [r.image for r in self._readings if r.stamp.capture_ns >= begin]) < frames:
                self._raise_trouble()
                self._need_connection(asked)
                left = deadline - time.monotonic()
                if left <= 0:
                    got = f"{len(seen)} of {frames} frames within {timeout:g} s"
                    raise DeviceTimeout(self.name, asked, got, "Check `extrinsic status STATION`")
                self._arrived.wait(left)
        try:
            picture = self._mean(cast("P", np.stack(seen[:frames])))
        except ValueError as error:
            raise CommandRefused(self.name, asked, str(error), "Let nothing touch the finger") from None
        if file is not None:
            self._keep(picture, file.expanduser(), asked)
        self._reference = picture
        return cast("P", picture.copy())

    def _keep(self, picture: P, file: Path, asked: str) -> None:
        aside = file.with_name(f".{file.name}.part")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            aside.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
            aside.replace(file)
        except OSError as error:
            with suppress(OSError):
                aside.unlink(missing_ok=True)
            raise CommandRefused(
                self.name, asked, f"{file} cannot be written: {error.strerror}", "Name a PNG file in a folder"
            ) from error

    def _loaded(self, file: Path) -> P:
        if not file.is_file():
            raise self._no_reference(f"there is no file {file}")
        shape, kind = self._reference_like
        colour = cv2.IMREAD_COLOR if len(shape) == 3 else cv2.IMREAD_UNCHANGED
        image = cv2.imread(str(file), colour | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise self._no_reference(f"{file} is no picture")
        if image.shape[:2] != shape[:2]:
            raise self._no_reference(
                f"{file} has {image.shape[1]} × {image.shape[0]} pixels, not {shape[1]} × {shape[0]}"
            )
        if image.shape != shape or image.dtype != kind:
            raise self._no_reference(f"{file} is no picture of {np.dtype(kind).itemsize * 8} bits in one channel")
        return cast("P", image)

    def _no_reference(self, reason: str) -> CommandRefused:
        return CommandRefused(
            self.name,
            "give its reference picture",
            reason,
            f"With nothing at the finger, `extrinsic check-device STATION {self.name}` takes one; name its file as "
            "`reference` in the station file",
        )

    def _shut(self) -> None:
        super()._shut()
        self._reference = None
