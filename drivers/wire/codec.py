"""Readings to messages and back. Decoding yields a reading or a ProtocolError, nothing else.

A planar pose is embedded in SE(3) as the task plane lies in the world: x to X, y to Z, counter-clockwise in the plane
is a rotation about −Y. Wrenches and poses take a direct path through one packed structure, because they come by the
thousand; it writes the very bytes that the general path writes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any, cast

import cv2
import numpy as np

from drivers.errors import ProtocolError
from drivers.wire import messages, pictures
from drivers.wire.messages import NANOSECONDS
from mechanics.readings import (
    Array,
    ContactTruth,
    GripperReading,
    ImageReading,
    PoseReading,
    Stamp,
    Status,
    TagDetection,
    TagReading,
    TruthReading,
    WrenchReading,
)
from mechanics.square_pose import square_homography

Reading = PoseReading | WrenchReading | ImageReading | TagReading | GripperReading | TruthReading

TYPES: dict[type, str] = {
    PoseReading: messages.POSE,
    WrenchReading: messages.WRENCH,
    ImageReading: messages.IMAGE,
    TagReading: messages.DETECTIONS,
    GripperReading: messages.GRIPPER,
    TruthReading: messages.TRUTH,
}
"""The message type that carries a reading."""

JPEG_QUALITY = 95
_OUT_OF_PLANE = 1e-6
_CHANNELS = {"mono8": (np.uint8, 1), "bgr8": (np.uint8, 3), "16UC1": (np.uint16, 1)}


def encode_reading(reading: Reading, shift_ns: int = 0) -> bytes:
    """The reading as CDR of its type in `TYPES`; ``shift_ns`` is added to its capture time."""
    stamp = reading.stamp
    capture_ns = stamp.capture_ns + shift_ns
    if isinstance(reading, WrenchReading):
        return _pack(capture_ns, stamp.frame, reading.wrench.tolist())
    if isinstance(reading, PoseReading):
        x, y, theta = reading.pose.tolist()
        half = 0.5 * theta
        return _pack(capture_ns, stamp.frame, (x, 0.0, y, 0.0, -math.sin(half), 0.0, math.cos(half)))
    return messages.encode(_ENCODERS[type(reading)](reading, messages.header(capture_ns, stamp.frame)))


def encode_compressed(reading: ImageReading, shift_ns: int = 0) -> bytes:
    """The picture as sensor_msgs/CompressedImage: JPEG for 8-bit images, PNG for depth."""
    form, options = ("png", [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if reading.encoding != "16UC1":
        form, options = ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    done, data = cv2.imencode(f".{form}", reading.image, options)
    if not done:
        raise ProtocolError("wire", "compress an image", f"no {form} of {reading.image.shape} {reading.encoding}", "")
    return messages.encode(
        messages.message(
            messages.COMPRESSED_IMAGE,
            header=messages.header(reading.stamp.capture_ns + shift_ns, reading.stamp.frame),
            format=f"{reading.encoding}; {form} compressed {reading.encoding}",
            data=data.reshape(-1),
        )
    )


def decode_reading(
    type_name: str, payload: bytes, sequence: int, status: int = 0, receive_ns: int | None = None
) -> Reading:
    """The reading in a payload. ``receive_ns`` is its capture time where not given. Raises ProtocolError."""
    try:
        decoder = _DECODERS[type_name]
    except KeyError:
        raise ProtocolError("wire", f"read {type_name}", "no reading travels as this type", "") from None
    try:
        state = Status(status)
    except ValueError as error:
        raise ProtocolError("wire", f"read {type_name}", str(error), "") from error

    def stamp(capture_ns: int, frame: str) -> Stamp:
        return Stamp(capture_ns, capture_ns if receive_ns is None else receive_ns, sequence, frame, state)

    return decoder(payload, type_name, stamp)


def jpeg_of(payload: bytes) -> bytes | None:
    """The JPEG in a sensor_msgs/CompressedImage as it was sent; None where the picture is another.

    Raises ProtocolError.
    """
    data = messages.decode(payload, messages.COMPRESSED_IMAGE).data.tobytes()
    size = pictures.pixels(data)
    return data if data.startswith(b"\xff\xd8") and size is not None and 0 < size <= pictures.MOST else None


def decode_target(payload: bytes) -> tuple[int, Array]:
    """Capture time [ns] and pose (3,) of ee in W that an ArmTarget asks for. Raises ProtocolError."""
    value = messages.decode(payload, messages.TARGET)
    return messages.stamp_ns(value.header.stamp), value.pose.copy()


def decode_diagnostics(payload: bytes) -> tuple[int, list[tuple[int, str]]]:
    """Capture time [ns], and of each part its level (0 ok, 1 warning, 2 error) and message. Raises ProtocolError."""
    value = messages.decode(payload, messages.DIAGNOSTICS)
    return messages.stamp_ns(value.header.stamp), [(int(s.level), f"{s.name}: {s.message}") for s in value.status]


def decode_gates(payload: bytes) -> tuple[str, dict[str, int]]:
    """What the gates of an arm say where something is the matter, else nothing, and their counts. Raises ProtocolError.

    The counts are ``accepted`` and ``refused by <gate>``, of set-points since the arm's server began.
    """
    value = messages.decode(payload, messages.DIAGNOSTICS)
    said = "; ".join(part.message for part in value.status if int(part.level))
    pairs = [(pair.key, pair.value) for part in value.status for pair in part.values]
    return said, {key: int(text) for key, text in pairs if text.isdecimal() and len(text) < _COUNT}


Stamper = Callable[[int, str], Stamp]


def _stamped(header: Any, stamp: Stamper) -> Stamp:
    return stamp(messages.stamp_ns(header.stamp), header.frame_id)


_COUNT = 18  # digits of a count that is one

# Poses and wrenches: encapsulation, seconds, nanoseconds, length of the frame's name; the name; aligned doubles.
_HEAD = struct.Struct("<4siII")
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NAME = 256  # bytes of a frame's name that is worth keeping; longer ones take the general path


@lru_cache(maxsize=256)
def _layout(name_size: int, values: int) -> struct.Struct:
    padding = -(12 + name_size) % 8
    return struct.Struct(f"<4siII{name_size}s{padding}x{values}d")


@lru_cache(maxsize=256)
def _name(frame: str) -> bytes:
    return frame.encode() + b"\x00"


def _pack(capture_ns: int, frame: str, values: Any) -> bytes:
    name = _name(frame)
    seconds, nanoseconds = divmod(capture_ns, NANOSECONDS)
    try:
        layout = _layout(len(name), len(values))
        return layout.pack(_LITTLE_ENDIAN, seconds, nanoseconds, len(name), name, *values)
    except struct.error as error:
        raise ProtocolError("wire", "encode a reading", str(error), "Stamps must fit 32 bits of seconds") from error


def _unpack(payload: bytes, type_name: str, stamp: Stamper, values: int) -> tuple[Stamp, tuple[float, ...]]:
    if len(payload) >= _HEAD.size and payload[:4] == _LITTLE_ENDIAN:
        size = _HEAD.unpack_from(payload)[3]
        if 0 < size <= _NAME:
            layout = _layout(size, values)
            if layout.size == len(payload):
                _, seconds, nanoseconds, _, name, *numbers = layout.unpack(payload)
                frame = _frame(name)
                if nanoseconds < NANOSECONDS and frame is not None:
                    return stamp(seconds * NANOSECONDS + nanoseconds, frame), tuple(numbers)
    value = messages.decode(payload, type_name)  # another byte order, trailing padding, or nonsense
    if type_name == messages.WRENCH:
        force, torque = value.wrench.force, value.wrench.torque
        return _stamped(value.header, stamp), (force.x, force.y, force.z, torque.x, torque.y, torque.z)
    position, turn = value.pose.position, value.pose.orientation
    numbers = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
    return _stamped(value.header, stamp), numbers


@lru_cache(maxsize=256)
def _frame(name: bytes) -> str | None:
    if not name.endswith(b"\x00"):
        return None
    try:
        return name[:-1].decode()
    except UnicodeDecodeError:
        return None


def _decode_wrench(payload: bytes, type_name: str, stamp: Stamper) -> WrenchReading:
    done, values = _unpack(payload, type_name, stamp, 6)
    return WrenchReading(done, np.array(values))


def _decode_pose(payload: bytes, type_name: str, stamp: Stamper) -> PoseReading:
    done, (x, off, y, qx, qy, qz, qw) = _unpack(payload, type_name, stamp, 7)
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    in_plane = abs(off) <= _OUT_OF_PLANE and math.hypot(qx, qz) <= _OUT_OF_PLANE and abs(norm - 1.0) <= _OUT_OF_PLANE
    if not (in_plane and math.isfinite(x) and math.isfinite(y)):
        raise ProtocolError(
            "wire", f"read {type_name}", "a pose that does not lie in the task plane", "Poses on the bus are planar"
        )
    theta = -2.0 * math.atan2(qy, qw)
    return PoseReading(done, np.array([x, y, math.remainder(theta, 2.0 * math.pi)]))


def _encode_gripper(reading: GripperReading, header: Any) -> Any:
    return messages.message(
        messages.GRIPPER, header=header, width=reading.width, force=reading.force, holding=reading.holding
    )


def _decode_gripper(payload: bytes, type_name: str, stamp: Stamper) -> GripperReading:
    value = messages.decode(payload, type_name)
    return GripperReading(_stamped(value.header, stamp), value.width, value.force, value.holding)


def _encode_tags(reading: TagReading, header: Any) -> Any:
    """Corners and homography as `TagDetection` states them: tag frame with y up, pixel centres at integers."""
    detections = []
    for found in reading.detections:
        homography = square_homography(found.corners)
        centre = homography[:2, 2] / homography[2, 2] if homography[2, 2] else found.corners.mean(axis=0)
        points = [messages.message("apriltag_msgs/msg/Point", x=float(x), y=float(y)) for x, y in found.corners]
        detections.append(
            messages.message(
                "apriltag_msgs/msg/AprilTagDetection",
                family=reading.family,
                id=found.id,
                hamming=found.hamming,
                goodness=_goodness(found.ambiguity),
                decision_margin=found.margin,
                centre=messages.message("apriltag_msgs/msg/Point", x=float(centre[0]), y=float(centre[1])),
                corners=points,
                homography=homography.reshape(-1),
            )
        )
    return messages.message(messages.DETECTIONS, header=header, detections=detections)


def _decode_tags(payload: bytes, type_name: str, stamp: Stamper) -> TagReading:
    value = messages.decode(payload, type_name)
    families = {found.family for found in value.detections} or {"tag36h11"}
    if len(families) > 1:
        raise ProtocolError("wire", f"read {type_name}", f"several tag families in one frame: {sorted(families)}", "")
    detections = tuple(
        TagDetection(
            found.id,
            np.array([(point.x, point.y) for point in found.corners]),
            found.hamming,
            found.decision_margin,
            _ambiguity(found.goodness),
        )
        for found in value.detections
    )
    return TagReading(_stamped(value.header, stamp), detections, families.pop())


_LEAST_GOODNESS = float(np.finfo(np.float32).tiny)


def _goodness(ambiguity: float | None) -> float:
    """1 − ambiguity, in the field that detectors of today leave at 0; 0 itself says that nobody looked."""
    return 0.0 if ambiguity is None else max(1.0 - ambiguity, _LEAST_GOODNESS)


def _ambiguity(goodness: float) -> float | None:
    return 1.0 - goodness if 0.0 < goodness <= 1.0 else None


def _encode_image(reading: ImageReading, header: Any) -> Any:
    image = np.ascontiguousarray(reading.image)
    height, width = image.shape[:2]
    return messages.message(
        messages.IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=reading.encoding,
        is_bigendian=0,
        step=image.nbytes // max(height, 1),
        data=image.reshape(-1).view(np.uint8),
    )


def _decode_image(payload: bytes, type_name: str, stamp: Stamper) -> ImageReading:
    value = messages.decode(payload, type_name)
    dtype, channels = _pixels(value.encoding, type_name)
    shape = (value.height, value.width, channels) if channels > 1 else (value.height, value.width)
    row = value.width * channels * np.dtype(dtype).itemsize
    if value.is_bigendian or value.step != row or value.data.size != value.height * row:
        raise ProtocolError(
            "wire",
            f"read {type_name}",
            f"{value.data.size} bytes for {value.width}×{value.height} {value.encoding}",
            "",
        )
    return ImageReading(_stamped(value.header, stamp), value.data.view(dtype).reshape(shape), value.encoding)


def _decode_compressed(payload: bytes, type_name: str, stamp: Stamper) -> ImageReading:
    value = messages.decode(payload, type_name)
    encoding = value.format.split(";")[0].strip()
    dtype, channels = _pixels(encoding, type_name)
    size = pictures.pixels(value.data.tobytes())
    if size is None or not 0 < size <= pictures.MOST:
        said = "no PNG and no baseline JPEG" if size is None else f"a picture of {size} pixels"
        raise ProtocolError("wire", f"read {type_name}", said, f"At most {pictures.MOST} are read")
    try:
        image = cv2.imdecode(value.data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ProtocolError("wire", f"read {type_name}", f"a damaged picture: {error}", "") from error
    if image is None or image.dtype != dtype or image.ndim != (3 if channels > 1 else 2):
        raise ProtocolError("wire", f"read {type_name}", f"a picture that is not {encoding}", "")
    return ImageReading(_stamped(value.header, stamp), cast("Any", image), encoding)


def _pixels(encoding: str, type_name: str) -> tuple[type, int]:
    try:
        return _CHANNELS[encoding]
    except KeyError:
        raise ProtocolError(
            "wire", f"read {type_name}", f"encoding {encoding!r}", f"Known are {', '.join(_CHANNELS)}"
        ) from None


def _encode_truth(reading: TruthReading, header: Any) -> Any:
    contacts = [
        messages.message(
            "extrinsic_msgs/msg/ContactTruth",
            on=contact.on,
            by=contact.by,
            point=_doubles(contact.point),
            normal=_doubles(contact.normal),
            force=_doubles(contact.force),
            mode=contact.mode,
        )
        for contact in reading.contacts
    ]
    return messages.message(
        messages.TRUTH,
        header=header,
        ee=_doubles(reading.ee),
        go=_doubles(reading.go),
        has_eo=reading.eo is not None,
        eo=np.zeros(3) if reading.eo is None else _doubles(reading.eo),
        wrench=_doubles(reading.wrench),
        contacts=contacts,
    )


def _decode_truth(payload: bytes, type_name: str, stamp: Stamper) -> TruthReading:
    value = messages.decode(payload, type_name)
    contacts = tuple(
        ContactTruth(
            contact.on, contact.by, contact.point.copy(), contact.normal.copy(), contact.force.copy(), contact.mode
        )
        for contact in value.contacts
    )
    eo = value.eo.copy() if value.has_eo else None
    return TruthReading(
        _stamped(value.header, stamp), value.ee.copy(), value.go.copy(), eo, value.wrench.copy(), contacts
    )


def _doubles(values: Any) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64)


_ENCODERS: dict[type, Callable[[Any, Any], Any]] = {
    GripperReading: _encode_gripper,
    TagReading: _encode_tags,
    ImageReading: _encode_image,
    TruthReading: _encode_truth,
}
_DECODERS: dict[str, Callable[[bytes, str, Stamper], Any]] = {
    messages.POSE: _decode_pose,
    messages.WRENCH: _decode_wrench,
    messages.GRIPPER: _decode_gripper,
    messages.DETECTIONS: _decode_tags,
    messages.IMAGE: _decode_image,
    messages.COMPRESSED_IMAGE: _decode_compressed,
    messages.TRUTH: _decode_truth,
}
