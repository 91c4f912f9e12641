"""The only room that knows bytes: ROS 2 messages in CDR, their types and their schemas.

Types are those of ROS 2 Humble, apriltag_msgs, and our own `extrinsic_msgs` where no standard exists; the texts of the
last two lie in ``msg/<package>/<Name>.msg``. A type is named ``package/msg/Name``.
"""

from __future__ import annotations

import struct
from functools import cache
from importlib import resources
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from drivers.errors import ProtocolError

POSE = "geometry_msgs/msg/PoseStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
DETECTIONS = "apriltag_msgs/msg/AprilTagDetectionArray"
GRIPPER = "extrinsic_msgs/msg/GripperState"
TARGET = "extrinsic_msgs/msg/ArmTarget"
TRUTH = "extrinsic_msgs/msg/Truth"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
REPLY = "extrinsic_msgs/msg/Reply"
RESET = "extrinsic_msgs/msg/Reset"
STRING = "std_msgs/msg/String"
FLOAT = "std_msgs/msg/Float64"
INTEGER = "std_msgs/msg/Int64"
EMPTY = "std_msgs/msg/Empty"
DURATION = "builtin_interfaces/msg/Duration"

NANOSECONDS = 1_000_000_000


@cache
def typestore() -> Typestore:
    """Every type this project speaks."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for package in resources.files("drivers.wire").joinpath("msg").iterdir():
        if package.is_dir():
            for file in package.iterdir():
                if file.name.endswith(".msg"):
                    name = f"{package.name}/msg/{file.name.removesuffix('.msg')}"
                    types.update(get_types_from_msg(file.read_text("utf-8"), name))
    store.register(types)
    return store


def message(type_name: str, **fields: Any) -> Any:
    """A message of a type, from its fields. Raises ProtocolError for a type nobody knows."""
    return _known(type_name)(**fields)


def encode(value: Any) -> bytes:
    """CDR (little endian) of a message. Raises ProtocolError where a field does not fit its type."""
    name = value.__msgtype__
    try:
        return bytes(typestore().serialize_cdr(value, name, little_endian=True))
    except (SerdeError, struct.error, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise ProtocolError("wire", f"encode {name}", str(error), "Check the fields against the .msg text") from error


def decode(payload: bytes, type_name: str) -> Any:
    """The message in a CDR payload. Raises ProtocolError, and nothing else, for bytes that are no such message."""
    _known(type_name)
    try:
        return typestore().deserialize_cdr(payload, type_name)
    except (SerdeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise ProtocolError(
            "wire",
            f"decode {type_name}",
            f"{len(payload)} bytes that are no such message: {error}",
            "Sender and receiver must be of the same version",
        ) from error


@cache
def schema_text(type_name: str) -> str:
    """The type's definition with those it needs, in the form of MCAP's ``ros2msg`` schema encoding."""
    _known(type_name)
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def header(stamp_ns: int, frame: str) -> Any:
    """A std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    time = message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def stamp_ns(value: Any) -> int:
    """Time or Duration in nanoseconds. Raises ProtocolError for a fraction of a second or more of nanoseconds."""
    if not 0 <= value.nanosec < NANOSECONDS:
        raise ProtocolError("wire", "read a time stamp", f"{value.nanosec} ns within a second", "")
    return value.sec * NANOSECONDS + value.nanosec


def _known(type_name: str) -> Any:
    try:
        return typestore().types[type_name]
    except KeyError:
        raise ProtocolError(
            "wire", f"speak {type_name}", "no such message type", "Types are named package/msg/Name"
        ) from None
