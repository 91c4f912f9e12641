"""Tactile fingers over the bus: depth as it is, colour compressed, a reference on request."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.errors import DeviceTimeout
from drivers.interfaces import Description, TactileSensor
from drivers.wire import messages, topics
from drivers.wire.bus import Bus
from drivers.wire.client import RemoteTactile
from drivers.wire.link import Link
from drivers.wire.server import Desk, DeviceServer
from mechanics.readings import ImageReading, Stamp, Status

DEPTH = np.random.default_rng(0).integers(0, 1000, (171, 224), np.uint16)
COLOUR = np.full((120, 160, 3), (30, 120, 200), np.uint8)


class FakeFinger(TactileSensor):
    """Gives the same picture over and over."""

    def __init__(self, sensor: str, picture: np.ndarray):
        super().__init__("finger")
        self.sensor, self.picture, self.sequence = sensor, picture, 0
        self.lose = False

    def describe(self) -> Description:
        return Description("finger", "tactile", "fake", "fake", "0", "finger", extra={"sensor": self.sensor})

    def capture(self, timeout: float = 2.0) -> ImageReading:
        now = 1000 * (self.sequence + 1)
        encoding = "16UC1" if self.picture.dtype == np.uint16 else "bgr8"
        reading = ImageReading(Stamp(now, now, self.sequence, "finger", Status.NO_CONTACT), self.picture, encoding)
        self.sequence += 1
        if not self.lose:
            self._push(reading)
        return reading

    def reference(self) -> np.ndarray:
        return self.picture[::-1]

    def _open(self, timeout: float) -> None: ...

    def _shut(self) -> None: ...


@pytest.mark.parametrize(
    ("sensor", "picture", "type_name"),
    [("soft_bubble", DEPTH, messages.IMAGE), ("gelslim", COLOUR, messages.COMPRESSED_IMAGE)],
)
def test_frames_and_reference_cross_the_bus(
    desk: Desk, link: Link, joined: Bus, sensor: str, picture: np.ndarray, type_name: str
) -> None:
    device = FakeFinger(sensor, picture)
    with DeviceServer(desk, device), RemoteTactile("finger", link, lockstep=False) as remote:
        raw = joined.subscribe(topics.key("lab", "finger", "image"))
        payloads: list[bytes] = []
        stop = raw.listen(lambda sample: payloads.append(sample.payload))
        for sequence in range(3):
            got = remote.capture()
            assert (got.stamp.sequence, got.stamp.status, got.stamp.frame) == (sequence, Status.NO_CONTACT, "finger")
            assert got.image.dtype == picture.dtype and got.image.shape == picture.shape
            # depth is exact; even colour is compressed to within a few grey levels
            assert np.abs(got.image.astype(int) - picture).max() <= (0 if sensor == "soft_bubble" else 3)
        assert remote.latest().stamp.sequence == 2 and remote.gaps == 0
        np.testing.assert_array_equal(remote.reference(), picture[::-1])  # without loss for either
        assert messages.decode(payloads[-1], type_name) is not None
        stop()


def test_frame_that_is_lost_ends_in_a_timeout_and_the_next_one_counts_it(desk: Desk, link: Link) -> None:
    device = FakeFinger("soft_bubble", DEPTH)
    with DeviceServer(desk, device), RemoteTactile("finger", link, lockstep=False) as remote:
        remote.capture()
        device.lose = True
        with pytest.raises(DeviceTimeout, match="did not arrive"):
            remote.capture(timeout=0.3)
        device.lose = False
        assert remote.capture().stamp.sequence == 2
        assert remote.gaps == 1


@pytest.mark.parametrize(("sensor", "form"), [("soft_bubble", messages.IMAGE), ("gelslim", messages.COMPRESSED_IMAGE)])
def test_log_knows_the_type_of_a_fingers_stream(sensor: str, form: str) -> None:
    config = StationConfig.model_validate(
        {"name": "lab", "devices": {"finger": {"kind": "tactile", "sensor": sensor, "finger": "left"}}}
    )
    # the untouched picture without loss, whatever the finger measures
    assert topics.streams(config) == {"lab/finger/image": form, "lab/finger/reference": messages.IMAGE}
