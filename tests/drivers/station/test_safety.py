"""The arm's gates on a whole station: what stops it, who may stop it, and how that shows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from control.motion import Mover
from drivers import safety
from drivers.config import StationConfig
from drivers.errors import CommandRefused, DeviceTimeout, NotConnected
from drivers.interfaces import ArmTarget
from drivers.station import Devices, Station
from drivers.status import station_status
from drivers.wire import messages, topics
from drivers.wire.client import RemoteArm
from drivers.wire.codec import encode_reading
from drivers.wire.log_reader import LogReader
from mechanics.readings import Stamp, WrenchReading

from .cases import HEIGHT, scene, station

PERIOD = 0.02  # of the set-points [s]
SPEED = 0.05  # [m/s]
#: height of the ee at which the held box touches the table
TOUCH = 0.045 + HEIGHT / 2


def limited(**limits: float) -> StationConfig:
    return station(arm={"kind": "arm", "limits": limits})


def opened(config: StationConfig) -> Iterator[Devices]:
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        devices.simulation.reset(0, scene())
        devices.clock.sleep(0.05)
        yield devices


@pytest.fixture
def devices(config: StationConfig) -> Iterator[Devices]:
    yield from opened(config)


def descend(devices: Devices, metres: float, speed: float = SPEED) -> None:
    """Go down by some metres at an even speed, gently at first."""
    begin = y = float(devices.arm.latest().pose[1])
    v = 0.0
    while y > begin - metres:
        v = min(speed, v + 2.0 * PERIOD)
        y -= v * PERIOD
        devices.arm.command(ArmTarget(np.array([0.0, y, 0.0]), np.array([0.0, -v, 0.0]), PERIOD))
        devices.clock.sleep(PERIOD)


def test_pressing_on_the_table_stops_the_arm_and_the_force_stays_within_a_fifth_beyond_its_limit() -> None:
    for devices in opened(limited(force=15)):
        with devices.arm.lease("test"), pytest.raises(CommandRefused, match=r"wrist_ft measures 1[5-8]\.\d N"):
            descend(devices, 0.2 - TOUCH + 0.03)
        devices.clock.sleep(0.2)
        begin = devices.clock.now_ns() - 1_000_000_000
        felt = [float(np.linalg.norm(r.wrench[:3])) for r in devices.force_torque("wrist").since(begin)]
        assert 15 < max(felt) < 1.2 * 15
        over = next(i for i, force in enumerate(felt) if force > 15)
        poses = [r.pose[1] for r in devices.arm.since(begin)]
        assert len(set(poses[-10:])) == 1, "it rests"
        assert max(felt[over + 5 :]) <= felt[over] * 1.02, "within two control periods nothing is pressed any further"


def test_after_recovery_the_arm_can_leave_what_it_pressed_on() -> None:
    config = limited(force=15)
    for devices in opened(config):
        with devices.arm.lease("test"), pytest.raises(CommandRefused, match="stopped"):
            descend(devices, 0.2 - TOUCH + 0.03)
        assert "wrist_ft measures" in safety.recover(config)[0].reason
        y = float(devices.arm.latest().pose[1])
        with devices.arm.lease("test"):
            devices.arm.command(ArmTarget(np.array([0.0, y + 0.03, 0.0]), np.zeros(3), 1.0))
            devices.clock.sleep(1.5)
        assert devices.arm.latest().pose[1] == pytest.approx(y + 0.03, abs=1e-6)


def test_a_stop_from_elsewhere_needs_no_lease_and_tells_the_commander_who_asked(
    devices: Devices, config: StationConfig
) -> None:
    with devices.arm.lease("test"):
        descend(devices, 0.005)
        [state] = safety.stop(config)
        assert state.reason.startswith("`extrinsic stop` by ")
        with pytest.raises(CommandRefused, match=r"`extrinsic stop` by .* See why, then recover it"):
            descend(devices, 0.001)
        assert safety.recover(config)[0].reason == state.reason
        devices.arm.command(ArmTarget(np.array([0.0, 0.195, 0.0]), np.zeros(3), 0.5))


def test_recovering_an_arm_that_was_not_stopped_changes_nothing(devices: Devices, config: StationConfig) -> None:
    assert safety.recover(config)[0].reason == ""


def test_a_stop_without_a_station_says_what_to_do(config: StationConfig) -> None:
    with pytest.raises(NotConnected):
        safety.stop(config)


def test_without_its_force_the_arm_does_not_move(devices: Devices) -> None:
    assert devices.simulation is not None
    with devices.arm.lease("test"):
        descend(devices, 0.005)
        devices.simulation.inject({"kind": "drop", "device": "wrist_ft", "value": 1.0 - 1e-9})
        with pytest.raises(DeviceTimeout, match="wrist_ft: watch over the arm"):
            descend(devices, 0.01)


def test_the_wrench_that_an_estimator_publishes_is_a_second_witness(devices: Devices) -> None:
    key = topics.key(devices.config.name, topics.ESTIMATOR, "wrench")
    publisher = devices.bus.publisher(key, messages.WRENCH)
    try:
        assert publisher.wait_matched(5.0)
        stamp = Stamp(devices.clock.now_ns(), 0, 0, "world")
        reading = WrenchReading(stamp, np.array([0.0, 0, 45, 0, 0, 0]))
        stopped = devices.bus.subscribe(topics.key(devices.config.name, "arm", "safety"))
        told: list[str] = []
        stop = stopped.listen(lambda s: told.append(messages.decode(s.payload, messages.DIAGNOSTICS).status[0].message))
        publisher.put(encode_reading(reading), 0, stamp.capture_ns)
        assert stopped.wait(0, None, time.monotonic() + 5)
        stop()
        assert "estimator measures 45.0 N" in told[-1]
        with devices.arm.lease("test"), pytest.raises(CommandRefused, match="estimator"):
            descend(devices, 0.001)
    finally:
        publisher.close()


def test_refusals_are_counted_shown_and_logged(devices: Devices, config: StationConfig, tmp_path: Path) -> None:
    arm = devices.arm
    assert isinstance(arm, RemoteArm)
    with devices.log(tmp_path / "log.mcap"), arm.lease("test"):
        for _ in range(3):
            with pytest.raises(CommandRefused, match="speed"):
                arm.command(ArmTarget(np.array([0.04, 0.2, 0.0]), np.zeros(3), 0.1))
        arm.command(ArmTarget(np.array([0.01, 0.2, 0.0]), np.zeros(3), 1.0))
        [row] = [row for row in station_status(config, 0.1) if row.name == "arm"]
    assert "refused 3 of 4 set-points (motion 3), the last: arm: command a set-point: refused: speed of 0.4" in row.note
    logged = [
        messages.decode(m.payload, messages.DIAGNOSTICS).status[0]
        for m in LogReader(tmp_path / "log.mcap").messages({"sim/arm/safety"})
    ]
    assert {value.key: value.value for value in logged[-1].values}["refused by motion"] == "3"


def test_a_commander_that_falls_silent_in_mid_motion_is_stopped(devices: Devices) -> None:
    with devices.arm.lease("test"):
        descend(devices, 0.005)
        devices.clock.sleep(1.2)
        with pytest.raises(CommandRefused, match="no set-point for 1 s in the midst of a motion"):
            descend(devices, 0.001)


@pytest.mark.timeout(60)
def test_in_real_time_a_motion_goes_on_from_rest_after_the_arm_was_held_because_its_commander_was() -> None:
    limits = {"acceleration": 2.0, "hold_after": 0.1, "stop_after": 20.0}
    told: list[str] = []
    with Station(station("realtime", arm={"kind": "arm", "limits": limits})).connect() as devices:
        assert devices.simulation is not None
        devices.simulation.reset(0, scene())
        arm = devices.arm
        assert isinstance(arm, RemoteArm)
        here = arm.latest(2.0).pose
        halfway = here + np.array([0.02, 0.02, 0.0])

        def tick() -> None:
            """Nothing is heard of the commander from about half the way on, until the arm is held for it."""
            if not told and mover.pose[0] > halfway[0] and not told.append("silent"):
                while not arm.safety()["held"]:
                    pass

        with arm.lease("test"):
            mover = Mover(arm, devices.clock, 50.0, here, SPEED, tick, event=lambda _, said: told.append(said))
            mover.ramp(here + np.array([0.04, 0.04, 0.3]), 1.0)
            mover.rest(0.3)
        assert arm.latest().pose == pytest.approx(here + np.array([0.04, 0.04, 0.3]), abs=1e-4)
        assert told[1].startswith("halted in the midst of a motion")
        assert all(said.startswith("halted") for said in told[1:])  # once more on a machine that does other things
        assert arm.safety()["refused"]["motion"] == len(told) - 1 and not arm.safety()["held"]


def test_a_reset_of_the_world_begins_the_gates_anew_but_keeps_a_stop(devices: Devices, config: StationConfig) -> None:
    assert devices.simulation is not None
    with devices.arm.lease("test"):
        descend(devices, 0.02)
    devices.simulation.reset(0, scene())
    devices.clock.sleep(0.05)
    with devices.arm.lease("test"):
        descend(devices, 0.005)
    safety.stop(config)
    devices.simulation.reset(0, scene())
    devices.clock.sleep(0.05)
    with devices.arm.lease("test"), pytest.raises(CommandRefused, match="stopped"):
        descend(devices, 0.005)
