"""Key expressions: ``<station>/<device>/<stream or verb>``, and ``<station>/<device>/<stream>/view`` for who looks on.

Nothing outside `drivers` knows a key. A stream is a publication, a verb a query. The key of a stream is its ROS 2 topic
name without the leading slash.
"""

from __future__ import annotations

from drivers.config import StationConfig
from drivers.wire import messages

ESTIMATOR = "estimator"
"""Whoever estimates from the fingers; its wrench, where it publishes one, is a second witness of the arm's gates."""

WORLD = "world"
"""The pseudo-device that stands for the station itself: its description, its clock and, in simulation, its truth."""

STREAMS: dict[str, dict[str, str]] = {
    "arm": {"pose": messages.POSE, "target": messages.TARGET, "safety": messages.DIAGNOSTICS},
    "gripper": {"state": messages.GRIPPER},
    "force_torque": {"wrench": messages.WRENCH},
    "tag_camera": {"detections": messages.DETECTIONS, "image": messages.COMPRESSED_IMAGE},
    "tactile": {"image": messages.COMPRESSED_IMAGE, "reference": messages.IMAGE},
    "tactile/soft_bubble": {"image": messages.IMAGE, "reference": messages.IMAGE},
    WORLD: {"truth": messages.TRUTH},
}
"""Streams by kind of device, with their types; the first carries the device's readings.

A tactile finger that measures depth sends it as it is, so that every ROS viewer draws it; colour is compressed. The
picture of the untouched finger, without loss, is published each time that somebody asks for it.
"""


def key(station: str, device: str, part: str) -> str:
    """The key of a device's stream or verb."""
    return f"{station}/{device}/{part}"


def view(topic: str) -> str:
    """The decimated sibling of a stream, for who looks on: the same type, the newest message now and then.

    A log and control take the stream itself.
    """
    return f"{topic}/view"


def device_and_stream(topic: str) -> tuple[str, str]:
    """What a station's topic is of: the device, or whoever else speaks on the bus, and the stream. A view's, as well.

    Of any other topic the last two words, the first empty where there is only one.
    """
    device, _, stream = topic.removesuffix("/view").rpartition("/")
    return device.rpartition("/")[2], stream


def alive(station: str, device: str) -> str:
    """The liveliness token that a device's server holds."""
    return f"{station}/{device}/alive"


def lease(station: str, device: str, holder: str) -> str:
    """The liveliness token that an arm's commander holds; ``holder`` may be ``*``."""
    return f"{station}/{device}/holder/{holder}"


def holder_of(token: str) -> str:
    """The holder that a `lease` token names."""
    return token.rsplit("/", 1)[1]


def streams_of(kind: str, sensor: str = "") -> dict[str, str]:
    """The streams of a device by its kind and, where it has one, the sensor in it."""
    return STREAMS.get(f"{kind}/{sensor}", STREAMS[kind])


def streams(config: StationConfig) -> dict[str, str]:
    """Every stream of a station with its type."""
    devices = {name: streams_of(device.kind, getattr(device, "sensor", "")) for name, device in config.devices.items()}
    if config.world is not None:
        devices[WORLD] = STREAMS[WORLD]
    return {
        key(config.name, name, stream): type_name
        for name, types in devices.items()
        for stream, type_name in types.items()
    }


def discovery(zid: str, topic: str, type_name: str) -> str:
    """The liveliness token by which zenoh's ROS 2 bridge announces a publication (reliable, volatile, keep last)."""
    hidden = topic.replace("/", "§")
    hidden_type = type_name.replace("/", "§")
    return f"@/{zid}/@ros2_lv/MP/{hidden}/{hidden_type}/:1::0,10"
