"""What goes over the bus: readings with what travels beside them, records, and every other message."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from drivers.wire import messages
from drivers.wire.codec import TYPES, decode_reading, encode_compressed, encode_reading
from drivers.wire.records import STREAMS, decode_record, encode_record
from drivers.wire.streams import ATTACHMENT
from mechanics.friction import Mode
from mechanics.readings import (
    ContactTruth,
    GripperReading,
    ImageReading,
    PoseReading,
    Stamp,
    TagDetection,
    TagReading,
    TruthReading,
    WrenchReading,
)
from mechanics.records import (
    ContactBelief,
    EventRecord,
    LookRecord,
    PhaseRecord,
    PlanarState,
    StatusRecord,
    TrialRecord,
    WaypointRecord,
)
from planning.plan import Plan

STAMP = Stamp(1_500_000_000, 1_500_000_000, 7, "world")
READING_TYPES = (
    messages.POSE,
    messages.WRENCH,
    messages.GRIPPER,
    messages.DETECTIONS,
    messages.IMAGE,
    messages.COMPRESSED_IMAGE,
    messages.TRUTH,
)
MESSAGE_TYPES = (
    messages.REPLY,
    messages.TARGET,
    messages.RESET,
    messages.STRING,
    messages.FLOAT,
    messages.INTEGER,
    messages.DURATION,
    messages.EMPTY,
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/CameraInfo",
    "diagnostic_msgs/msg/DiagnosticArray",
)
RECORD_TYPES = tuple(type_name for _, type_name in STREAMS.values())


def readings() -> list[bytes]:
    """Type, what travels beside it, payload."""
    depth = (np.arange(48, dtype=np.uint16) * 500).reshape(6, 8)
    colour = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    contact = ContactTruth("go", "ground", np.zeros(2), np.array([0.0, 1.0]), np.ones(2), "stick")
    detection = TagDetection(3, np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]), 0, 40.0)
    pictures = [ImageReading(STAMP, depth, "16UC1"), ImageReading(STAMP, colour, "bgr8")]
    readings = [
        PoseReading(STAMP, np.array([0.1, 0.2, 0.3])),
        WrenchReading(STAMP, np.arange(6.0)),
        GripperReading(STAMP, 0.04, 10.0, True),
        TagReading(STAMP, (detection,)),
        *pictures,
        TruthReading(STAMP, np.ones(3), np.zeros(3), None, np.zeros(3), (contact,)),
        TruthReading(STAMP, np.ones(3), np.zeros(3), np.ones(3), np.zeros(3)),
    ]
    found = [(encode_reading(reading), _carrier(reading)) for reading in readings]
    found += [(encode_compressed(picture), messages.COMPRESSED_IMAGE) for picture in pictures]
    beside = ATTACHMENT.pack(7, 1_500_000_000, 0)
    return [bytes([READING_TYPES.index(type_name)]) + beside + payload for payload, type_name in found]


def _carrier(reading: object) -> str:
    """The type that carries a reading."""
    return TYPES[type(reading)]


def take_reading(data: bytes) -> None:
    """Read it, where there is room for what travels beside it."""
    if len(data) < 1 + ATTACHMENT.size:
        return
    sequence, _, status = ATTACHMENT.unpack_from(data, 1)
    type_name = READING_TYPES[data[0] % len(READING_TYPES)]
    decode_reading(type_name, data[1 + ATTACHMENT.size :], sequence, status)


def records() -> list[bytes]:
    """Type and payload of each kind."""
    state = PlanarState(np.ones(3), np.zeros(3), None, np.ones(3))
    belief = ContactBelief("ok", np.ones((2, 2)), np.ones(2))
    records = [
        WaypointRecord(5, "t", 1, state, np.ones(3), state, state, state, belief),
        WaypointRecord(5, "t", 1, state, np.ones(3), state),
        TrialRecord(5, "t", "grasped_static", "open_loop", "completed", "", json.dumps(plan().to_dict())),
        PhaseRecord(5, "t", "preload"),
        EventRecord(5, "warning", "gripper slipped"),
        LookRecord(5, "t", "see", "{}", ("arm", "camera"), (4, 5), (1, 2)),
        StatusRecord(5, "lab/wrist/wrench", 7, 2),
    ]
    return [bytes([RECORD_TYPES.index(STREAMS[type(r)][1])]) + encode_record(r) for r in records]


def take_record(data: bytes) -> None:
    """Read it."""
    if data:
        decode_record(RECORD_TYPES[data[0] % len(RECORD_TYPES)], data[1:])


def others() -> list[bytes]:
    """Type and payload of each."""
    return [bytes([i]) + messages.encode(_filled(type_name)) for i, type_name in enumerate(MESSAGE_TYPES)]


def _filled(type_name: str) -> Any:
    """A message with something in every field, and two of everything that is a sequence."""
    fields = messages.typestore().get_msgdef(type_name).fields
    return messages.message(type_name, **{name: _value(*kind) for name, kind in fields})


def _value(node: Nodetype, kind: Any) -> Any:
    if node is Nodetype.BASE:
        return "ab" if kind[0] == "string" else kind[0] == "bool" or np.dtype(kind[0]).type(1).item()
    if node is Nodetype.NAME:
        return _filled(kind)
    (within, what), size = kind
    values = [_value(within, what) for _ in range(size or 2)]
    return np.array(values, what[0]) if within is Nodetype.BASE and what[0] != "string" else values


def take_other(data: bytes) -> None:
    """Read it, and the time in it."""
    if data:
        value = messages.decode(data[1:], MESSAGE_TYPES[data[0] % len(MESSAGE_TYPES)])
        if value.__msgtype__ == messages.DURATION:
            messages.stamp_ns(value)


@functools.cache
def plan() -> Plan:
    """Two steps with one contact."""
    steps, zeros = 2, np.zeros((2, 3))
    return Plan(
        name="p", skill="grasped_static", planner="lm", X_go_gocf=np.zeros(3), stiffness=np.diag([2e3, 2e3, 3.0]),
        mass=0.1, com=np.zeros(2), gravity=9.81, ee=zeros, go=zeros, eo=None, wrench=zeros, contact_names=("a",),
        contact_points=np.zeros((steps, 1, 2)), contact_normals=np.tile([0.0, 1.0], (steps, 1, 1)),
        contact_forces=np.ones((steps, 1, 2)), contact_modes=((Mode.STICK,),) * steps, contact_mu=np.ones(1),
        preload_ee=zeros, preload_go=zeros, preload_wrench=zeros, unload_ee=zeros, unload_go=zeros, unload_wrench=zeros,
    )  # fmt: skip
