"""The pictures that a run's log has of its trials: one per device and waypoint, small enough to lie in a page.

As in `experiments.view`, a picture belongs to the waypoint that was measured after it. A depth picture is shown as
what the membrane has moved, against the untouched finger where the log has that, else against the trial's first
picture; its grey values are lengths, to which the page gives the colours of one scale.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.finger_frames import DEPTH_UNIT
from drivers.wire import topics
from drivers.wire.log_reader import Logged
from mechanics.readings import ImageReading

DEPTH = "16UC1"
#: columns that a picture keeps: of a membrane, which has no finer detail, and of a camera
COLUMNS = {"deformation": 160, "picture": 256}
QUALITY = {"deformation": 90, "picture": 70}  # of JPEG
#: a grey value is so many units of depth, from the first of these lengths [units] on: −5 mm to 20.5 mm
ZERO = 50
#: bytes of pictures that a report carries at most; then every other waypoint's are left out, and so on
ROOM = 900_000
#: the share of a finger's pixels that may move farther than the scale reaches
_BEYOND = 0.005
_MM = DEPTH_UNIT * 1e3
_COARSEST = 2**20

Image = NDArray[Any]


@dataclass
class Strip:
    """One device's pictures in a trial. ``kind`` is ``deformation`` or ``picture``; ``against`` is what a deformation
    is measured against, ``reach`` how far it goes [mm]; ``shots``: step, capture time [ns] and JPEG."""

    device: str
    kind: str
    against: str = ""
    reach: float = 0.0
    width: int = 0
    height: int = 0
    shots: list[tuple[int, int, bytes]] = field(default_factory=list)
    base: Image | None = field(default=None, repr=False)

    def json(self, begin_ns: int) -> dict[str, Any]:
        """As `carried` takes it; times [s] since ``begin_ns``."""
        shots = [[(t - begin_ns) * 1e-9, step, base64.b64encode(data).decode("ascii")] for step, t, data in self.shots]
        plain = {name: getattr(self, name) for name in ("device", "kind", "against", "reach", "width", "height")}
        return {**plain, "shots": shots}


class Pictures:
    """Takes the messages of a log in its order. Not more than ``room`` bytes are kept, evenly over all waypoints."""

    def __init__(self, room: int = ROOM) -> None:
        self._room, self._stride, self._size = room, 1, 0
        self._newest: dict[str, Logged] = {}
        self._untouched: dict[str, Image] = {}
        self._strips: dict[str, Strip] | None = None
        self._all: list[dict[str, Strip]] = []

    def take(self, logged: Logged) -> None:
        """Keep a picture until it is known whether anybody wants it; everything else is passed by."""
        device, stream = topics.device_and_stream(logged.topic)
        if stream == "image" and self._strips is not None:
            self._newest[device] = logged
        elif stream == "reference":
            reading = _decoded(logged)
            if reading is not None and reading.encoding == DEPTH:
                self._untouched[device] = reading.image

    def begin(self) -> dict[str, Strip]:
        """A trial begins; returns what is going to hold its pictures, by device."""
        self._newest = {}
        self._strips = {}
        self._all.append(self._strips)
        return self._strips

    def end(self) -> None:
        """The trial has ended."""
        self._strips = None

    def settle(self, step: int) -> None:
        """A waypoint was measured: the newest pictures are its own."""
        newest, self._newest = self._newest, {}
        if self._strips is None or step % self._stride:
            return
        for device, logged in newest.items():
            reading = _decoded(logged)
            if reading is not None:
                self._keep(device, step, reading)

    def _keep(self, device: str, step: int, reading: ImageReading) -> None:
        assert self._strips is not None
        kind = "deformation" if reading.encoding == DEPTH else "picture"
        strip = self._strips.setdefault(device, Strip(device, kind))
        if strip.kind != kind:
            return
        picture = reading.image
        if kind == "deformation":
            moved = self._moved(strip, picture)
            if moved is None:
                return
            strip.reach = max(strip.reach, float(np.quantile(moved, 1 - _BEYOND)) * _MM)
            picture = np.clip(np.rint(moved) + ZERO, 0, 255).astype(np.uint8)
        else:
            picture = _shrunk(picture, COLUMNS[kind])
        made, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY[kind]])
        if made:
            strip.height, strip.width = picture.shape[:2]
            strip.shots.append((step, reading.stamp.capture_ns, data.tobytes()))
            self._size += len(data)
            self._make_room()

    def _moved(self, strip: Strip, depth: Image) -> Image | None:
        """How far the membrane has come toward the camera (h, w) [units of depth]; 0 where that is not known."""
        base = strip.base
        if base is None:
            untouched = self._untouched.get(strip.device)
            if untouched is not None and untouched.shape == depth.shape:
                base, strip.against = untouched, "the untouched finger"
            else:
                base, strip.against = depth, "the first picture of the trial"
            strip.base = base
        if base.shape != depth.shape:
            return None
        valid = ((depth > 0) & (base > 0)).astype(np.float32)
        moved = (base.astype(np.float32) - depth) * valid
        share = _shrunk(valid, COLUMNS["deformation"])
        return np.where(share > 0, _shrunk(moved, COLUMNS["deformation"]) / np.maximum(share, 1e-6), 0.0)

    def _make_room(self) -> None:
        while self._size > self._room and self._stride < _COARSEST:
            self._stride *= 2
            for strip in (strip for strips in self._all for strip in strips.values()):
                strip.shots = [shot for shot in strip.shots if shot[0] % self._stride == 0]
            self._size = sum(len(shot[2]) for strips in self._all for s in strips.values() for shot in s.shots)


def _decoded(logged: Logged) -> ImageReading | None:
    try:
        value = logged.value()
    except ProtocolError:
        return None
    return value if isinstance(value, ImageReading) else None


def _shrunk(picture: Image, columns: int) -> Image:
    height, width = picture.shape[:2]
    if width <= columns:
        return picture
    size = columns, max(1, round(height * columns / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


@cache
def colours(count: int = 16) -> list[str]:
    """The colours of a deformation from none to the end of its scale (viridis: even in lightness, safe for the colour
    blind), as #rrggbb."""
    grey = np.linspace(0, 255, count).round().astype(np.uint8)[:, None]
    blue_green_red = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[:, 0]
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in blue_green_red.tolist()]


def carried(trials: Iterable[Any], imagers: Any = None) -> dict[str, Any]:
    """What the page has of the pictures: per trial its devices', with one ``reach`` [mm] for all fingers of a trial.

    ``imagers`` are the devices that could have sent some, in the order in which they are shown. ``unit`` and ``zero``
    turn a grey value g into a deformation [mm]: (g − zero) · unit.
    """
    names = [str(name) for name in imagers] if isinstance(imagers, list) else []
    found = [_devices(trial, names) for trial in trials]
    scale = {"unit": round(_MM, 6), "zero": ZERO, "colours": colours()}
    return {"trials": found, "imagers": names, **scale}


def _devices(trial: Any, names: list[str]) -> list[dict[str, Any]]:
    strips = trial.get("pictures") if isinstance(trial, Mapping) else None
    shown = [dict(strip) for strip in strips or [] if isinstance(strip, Mapping) and strip.get("shots")]
    reach = max([strip["reach"] for strip in shown if strip["kind"] == "deformation"], default=0.0)
    for strip in shown:
        strip["reach"] = max(1.0, float(np.ceil(2 * reach) / 2)) if strip["kind"] == "deformation" else 0.0
        strip["shots"] = [[round(t, 4), step, data] for t, step, data in strip["shots"]]
    order = {name: place for place, name in enumerate(names)}
    return sorted(shown, key=lambda s: (order.get(s["device"], len(order)), s["kind"] != "deformation", s["device"]))
