"""A station that crashes, and faults in real time and by the station file."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from drivers.config import (
    BusConfig,
    ForceTorqueConfig,
    GripperConfig,
    StationConfig,
    TactileConfig,
    TagCameraConfig,
    WorldConfig,
)
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.fault import Fault
from drivers.station import Station
from mechanics.readings import Status

from .fault_cases import wait_until_gone

# -- crash -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["crash"])
def test_after_a_crash_every_device_is_a_fault_within_two_seconds(backend, fault, endpoint, scene):
    with backend(station(endpoint)) as own:
        own.simulation.reset(0, scene)
        own.clock.sleep(0.2)
        own.simulation.inject({"kind": fault})
        begin = time.monotonic()
        for device in own.devices.values():
            wait_until_gone(device)
        with pytest.raises(DeviceFault):
            own.clock.sleep(0.1)
        assert time.monotonic() - begin < 2.0


def station(endpoint, **world) -> StationConfig:
    return StationConfig(
        name="bench",
        world=WorldConfig(**world),
        bus=BusConfig(endpoint=endpoint),
        devices={
            "wrist_ft": ForceTorqueConfig(kind="force_torque", mount="wrist"),
            "gripper": GripperConfig(kind="gripper"),
        },
    )


# -- in real time, and by the station file -----------------------------------------------------------------------------


def test_in_real_time_a_device_that_fell_silent_is_a_timeout(endpoint, scene):
    faults = (Fault(kind="freeze", device="wrist_ft", after=0.3),)
    with Station(station(endpoint, clock="realtime", faults=faults)).connect() as devices:
        assert devices.simulation is not None
        wrist = devices.force_torque("wrist")
        devices.simulation.reset(0, scene)
        wrist.latest()
        devices.clock.sleep(0.5)
        with pytest.raises(DeviceTimeout, match="wrist_ft"):
            wrist.latest(timeout=0.2)
        assert devices.gripper.latest().stamp.status is Status.OK
        devices.simulation.clear_faults()
        wrist.latest()


def test_in_real_time_pictures_come_at_their_rates_and_a_fault_shows_in_the_stream(endpoint, scene):
    """By events: each stream is listened to until ten frames have come. The machine may be slow, time may not be."""
    config = StationConfig(
        name="bench",
        world=WorldConfig(clock="realtime"),
        bus=BusConfig(endpoint=endpoint),
        devices={
            "camera": TagCameraConfig(
                kind="tag_camera", width=320, height=240, focal=300.0, position=(0, -0.5, 0.2), look_at=(0, 0, 0.2)
            ),
            "gel": TactileConfig(kind="tactile", sensor="gelslim", finger="left", width=160, height=120),
        },
    )
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        devices.simulation.reset(0, scene)
        heard = {device: Heard(device, 10) for device in (devices.camera, devices.tactile("left"))}
        for device, frames in heard.items():
            stamps = frames.wait()
            rate = {"camera": 10.0, "gel": 30.0}[device.name]
            assert device.describe().rate == rate
            # what does not get through is counted, and what comes is in order
            sequences = [stamp.sequence for stamp in stamps]
            assert np.all(np.diff(sequences) >= 1)
            periods = np.diff([stamp.capture_ns for stamp in stamps]) * 1e-9
            assert np.all(periods > 0)
            per_frame = periods.sum() / (sequences[-1] - sequences[0])
            assert 1 / 3 < per_frame * rate < 3
            assert {stamp.status for stamp in stamps} == {Status.OK}
        devices.simulation.inject({"kind": "saturate", "device": "gel", "value": 60.0})
        saturated = Heard(devices.tactile("left"), 1, Status.SATURATED)
        assert saturated.wait()[-1].status is Status.SATURATED


class Heard:
    """The stamps of a stream from now on, until ``count`` of them have the status."""

    def __init__(self, device, count, status=Status.OK):
        self.stamps, self._count, self._status = [], count, status
        self._enough = threading.Event()
        self._stop = device.listen(self._take)

    def _take(self, reading):
        self.stamps.append(reading.stamp)
        if [stamp.status for stamp in self.stamps].count(self._status) >= self._count:
            self._enough.set()

    def wait(self):
        assert self._enough.wait(20.0), f"only {self.stamps}"
        self._stop()
        return self.stamps[:]
