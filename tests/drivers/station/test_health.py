"""What is noticed of a station's sensors, fault by fault, and within which time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.health import StationHealth
from drivers.sim.mismatch import load_profile
from drivers.station import Devices, Station

from .cases import scene, station

#: where a profile has the figures of each device
FIGURES = {"arm": "arm", "wrist_ft": "force_torque", "gripper": "gripper"}


@pytest.fixture
def devices() -> Iterator[Devices]:
    config = station()
    assert config.world is not None
    noisy = config.model_copy(update={"world": config.world.model_copy(update={"profile": "lab"})})
    with Station(noisy).connect() as opened:
        assert opened.simulation is not None
        opened.simulation.reset(0, scene())
        opened.clock.sleep(0.1)
        yield opened


@pytest.fixture
def health(devices: Devices) -> StationHealth:
    made = StationHealth(devices)
    assert made.ailments() == []
    return made


def told(health: StationHealth) -> dict[str, tuple[str, str]]:
    return {ailment.device: (ailment.kind, ailment.text) for ailment in health.ailments()}


def test_nothing_is_wrong_with_a_station_that_is_well(devices: Devices, health: StationHealth) -> None:
    for _ in range(60):
        assert health.ailments() == []
        devices.clock.sleep(0.02)


def test_age_and_rate_of_every_stream_are_told(devices: Devices, health: StationHealth) -> None:
    devices.clock.sleep(0.5)
    told = health.streams()
    # the profile's latencies, and at most a period more
    for name, rate in (("arm", 100.0), ("wrist_ft", 1000.0), ("gripper", 20.0)):
        latency = getattr(load_profile("lab"), FIGURES[name]).latency
        age, heard = told[name]["age_s"], told[name]["rate_Hz"]
        assert age is not None and heard is not None
        assert latency <= age <= latency + 1.0 / rate
        assert heard == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize("device", ["arm", "wrist_ft", "gripper"])
def test_a_silent_sensor_is_noticed_after_three_of_its_periods(
    devices: Devices, health: StationHealth, device: str
) -> None:
    assert devices.simulation is not None
    period = 1.0 / devices[device].describe().rate
    devices.simulation.inject({"kind": "freeze", "device": device})
    devices.clock.sleep(2 * period)
    assert health.ailments() == []
    devices.clock.sleep(2 * period)
    assert told(health)[device][0] == "age"


@pytest.mark.parametrize(
    ("fault", "kind", "words"),
    [
        ({"kind": "drop", "device": "wrist_ft", "value": 0.5}, "rate", "not at 1000 Hz"),
        ({"kind": "saturate", "device": "wrist_ft", "value": 0.5}, "status", "saturated"),
        ({"kind": "stuck", "device": "wrist_ft"}, "status", "stuck"),
        ({"kind": "disconnect", "device": "wrist_ft"}, "gone", "died"),
    ],
)
def test_each_fault_is_named_and_its_end_is_noticed_too(
    devices: Devices, health: StationHealth, fault: dict, kind: str, words: str
) -> None:
    assert devices.simulation is not None
    devices.simulation.inject(fault)
    devices.clock.sleep(0.6)
    found = told(health)
    assert found.keys() == {"wrist_ft"}
    assert found["wrist_ft"][0] == kind
    assert words in found["wrist_ft"][1]
    if kind != "gone":  # what has gone has to be opened again
        devices.simulation.clear_faults()
        devices.clock.sleep(1.0)
        assert health.ailments() == []
