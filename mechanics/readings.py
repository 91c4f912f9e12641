"""What a device measures, as frozen values with stamps.

Everything above the drivers sees only these. Arrays are float64 and read-only by convention; units are SI.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Status(enum.IntEnum):
    """Whether a reading can be trusted. Anything but OK is excluded from control and shown in the report."""

    OK = 0
    STALE = 1
    SATURATED = 2
    NO_CONTACT = 3
    INVALID = 4


@dataclass(frozen=True, slots=True)
class Stamp:
    """When, where and in which order something was measured.

    ``capture_ns`` is the instant of measurement and ``receive_ns`` the instant this process got it, both in the
    station's clock (simulated time in lockstep, Unix time otherwise). ``sequence`` counts from 0 per stream and
    never skips at the source, so a skip seen by a receiver is a loss. ``frame`` names the frame of the values.
    """

    capture_ns: int
    receive_ns: int
    sequence: int
    frame: str
    status: Status = Status.OK


@dataclass(frozen=True, slots=True)
class PoseReading:
    """A planar pose: ``pose`` = (x, y, θ) [m, m, rad], the pose of ``child`` in the stamp's frame."""

    stamp: Stamp
    pose: Array
    child: str = "ee"


@dataclass(frozen=True, slots=True)
class WrenchReading:
    """A spatial wrench ``wrench`` = (fx, fy, fz, tx, ty, tz) [N, N·m] about the origin of the stamp's frame, in it.

    It is the wrench that the body on the sensor's *load side* exerts *on the sensor*: the tool on a wrist sensor,
    the table top on an under-table sensor.
    """

    stamp: Stamp
    wrench: Array


@dataclass(frozen=True, slots=True)
class ImageReading:
    """One frame of a camera or a tactile sensor.

    ``image`` is (h, w) uint16 depth in 0.1 mm for encoding ``16UC1``, (h, w) uint8 for ``mono8``, (h, w, 3) uint8
    for ``bgr8``.
    """

    stamp: Stamp
    image: NDArray[np.uint8] | NDArray[np.uint16]
    encoding: str


@dataclass(frozen=True, slots=True)
class TagDetection:
    """One AprilTag in one frame.

    ``corners`` is (4, 2) [px] in the tag's own order: (−,−), (+,−), (+,+), (−,+) in the tag frame, whose x points
    right and y up when the tag is seen upright. Pixel centres lie at integer coordinates (OpenCV's convention).

    ``ambiguity`` is that of the tag's pose in space, from 0 to 1 (`mechanics.square_pose`); None where nobody looked.
    A pose in the task plane has none.
    """

    id: int
    corners: Array
    hamming: int
    margin: float
    ambiguity: float | None = None


@dataclass(frozen=True, slots=True)
class TagReading:
    """All tags of one family that were detected in one frame of a camera."""

    stamp: Stamp
    detections: tuple[TagDetection, ...]
    family: str = "tag36h11"


@dataclass(frozen=True, slots=True)
class GripperReading:
    """Finger opening ``width`` [m], grasp force ``force`` [N], and whether something is held."""

    stamp: Stamp
    width: float
    force: float
    holding: bool


@dataclass(frozen=True, slots=True)
class ContactTruth:
    """One contact of the plant: on which body, where and which way, in W.

    ``point`` (2,) [m], unit ``normal`` (2,) into the body ``on``, ``force`` (2,) [N] on that body, and what the
    contact does: ``stick``, ``slip+``, ``slip-``.
    """

    on: str
    by: str
    point: Array
    normal: Array
    force: Array
    mode: str


@dataclass(frozen=True, slots=True)
class TruthReading:
    """What the plant alone knows; only metrics, the log and the report may look.

    Poses (3,) in W; ``eo`` is None where there is no extrinsic object. ``wrench`` (fx, fy, τ) [N, N, N·m] is of the
    sensor on the go about the grasp centre, axes of W.
    """

    stamp: Stamp
    ee: Array
    go: Array
    eo: Array | None
    wrench: Array
    contacts: tuple[ContactTruth, ...] = field(default=())
