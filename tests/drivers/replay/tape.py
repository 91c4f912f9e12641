"""Recordings made by hand: what was said, when it was captured and when it was filed is known to the nanosecond."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.descriptions import DESCRIPTIONS, LoggedStation
from drivers.interfaces import Description
from drivers.replay import Recording
from drivers.wire import messages
from drivers.wire.codec import TYPES, Reading, encode_compressed, encode_reading
from drivers.wire.log import LogWriter
from drivers.wire.streams import Sample
from mechanics.readings import (
    GripperReading,
    ImageReading,
    PoseReading,
    Stamp,
    Status,
    TagDetection,
    TagReading,
    WrenchReading,
)

MS = 1_000_000
#: when the recordings begin [ns]: far from 0, as Unix time is
BEGIN = 1_700_000_000_000_000_000

DEVICES = {
    "arm": Description("arm", "arm", "an arm", "real", "A7", "world", 100.0),
    "hand": Description("hand", "gripper", "a hand", "real", "H7", "hand", 20.0),
    "wrist": Description(
        "wrist", "force_torque", "six axes", "real", "F7", "wrist", 1000.0, (130.0,) * 6, (0.1,) * 6, {"mount": "wrist"}
    ),
    "eye": Description("eye", "tag_camera", "a camera", "real", "C7", "eye", 10.0, extra={"camera": {"width": 8}}),
    "skin": Description(
        "skin", "tactile", "a bubble", "real", "T7", "skin", 30.0, extra={"sensor": "soft_bubble", "finger": "left"}
    ),
}


@dataclass
class Tape:
    """A log under way: `put` files a reading of a device, captured and filed at times of one's own."""

    log: LogWriter
    station: str = "lab"

    def put(self, topic: str, reading: Reading, filed_ns: int | None = None, *, compress: bool = False) -> None:
        """File a reading as the log does that hears it on the bus."""
        type_name, payload = TYPES[type(reading)], encode_reading(reading)
        if compress and isinstance(reading, ImageReading):
            type_name, payload = messages.COMPRESSED_IMAGE, encode_compressed(reading)
        self.raw(topic, type_name, payload, reading.stamp, filed_ns)

    def raw(self, topic: str, type_name: str, payload: bytes, stamp: Stamp, filed_ns: int | None = None) -> None:
        topic = f"{self.station}/{topic}"
        self.log._types.setdefault(topic, type_name)
        filed = stamp.receive_ns if filed_ns is None else filed_ns
        sample = Sample(topic, payload, stamp.sequence, stamp.capture_ns, int(stamp.status), filed)
        self.log._receive(sample, filed)

    def wrench(self, i: int, at_ns: int, late_ns: int = 0, status: Status = Status.OK) -> WrenchReading:
        """The i-th reading of the wrist."""
        reading = WrenchReading(Stamp(at_ns, at_ns + late_ns, i, "wrist", status), np.arange(6.0) + i)
        self.put("wrist/wrench", reading)
        return reading

    def pose(self, i: int, at_ns: int, late_ns: int = 0) -> PoseReading:
        """The i-th of the arm."""
        reading = PoseReading(Stamp(at_ns, at_ns + late_ns, i, "world"), np.array([0.001 * i, 0.25, 0.1]))
        self.put("arm/pose", reading)
        return reading

    def grip(self, i: int, at_ns: int) -> GripperReading:
        """The i-th of the hand."""
        reading = GripperReading(Stamp(at_ns, at_ns, i, "hand"), 0.05, 20.0 + i, True)
        self.put("hand/state", reading)
        return reading

    def tags(self, i: int, at_ns: int) -> TagReading:
        """The i-th of the eye."""
        corners = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]) + i
        reading = TagReading(Stamp(at_ns, at_ns, i, "eye"), (TagDetection(3, corners, 0, 40.0),))
        self.put("eye/detections", reading)
        return reading

    def touch(self, i: int, at_ns: int, status: Status = Status.OK) -> ImageReading:
        """The i-th picture of the skin."""
        depth = (np.arange(48, dtype=np.uint16) * 500 + i).reshape(6, 8)
        reading = ImageReading(Stamp(at_ns, at_ns, i, "skin", status), depth, "16UC1")
        self.put("skin/image", reading)
        return reading

    def describe(self, devices: dict[str, Description], *, lockstep: bool = False) -> None:
        self.log.add_attachment(
            DESCRIPTIONS, "application/json", LoggedStation(self.station, lockstep, devices).as_json()
        )


def opened(path: Path) -> Any:
    """The devices of a recording in lockstep, to be entered; each of its kind's own type, which no checker knows."""
    return Recording(path).devices()


def device(recording: Recording, name: str) -> Any:
    """One of them, likewise."""
    return recording.device(name)
