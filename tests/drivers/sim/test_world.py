"""The world in process: time, reset, truth, and the sensors' rates and signs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.config import ForceTorqueConfig, StationConfig, WorldConfig
from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout
from drivers.interfaces import ArmTarget
from drivers.scene import Body, TagMount
from drivers.sim.device import Ticker
from drivers.sim.world import World
from mechanics.readings import Status

WEIGHT = 0.1 * 9.81


@pytest.fixture
def world(station: StationConfig, make_scene) -> World:
    """A world with its scene set, and every device open."""
    world = World(station)
    for each in world.devices.values():
        each.connect()
    world.reset(0, make_scene())
    return world


def device(world: World, name: str) -> Any:
    return world.devices[name]


def target(pose, twist=(0.0, 0.0, 0.0), duration=0.1) -> ArmTarget:
    return ArmTarget(np.array(pose, float), np.array(twist, float), duration)


def planar(reading) -> np.ndarray:
    """(fx, fy, τ) of a sensor whose plane is x–z, with a counter-clockwise torque about −y."""
    fx, _, fz, _, ty, _ = reading.wrench
    return np.array([fx, fz, -ty])


# -- time ----------------------------------------------------------------------------------------------------------


def test_time_is_a_whole_number_of_steps_and_nothing_is_lost(world):
    assert world.now_ns() == 0
    assert [world.advance(0.0025) for _ in range(4)] == [2, 3, 2, 3]
    assert world.now_ns() == 10_000_000
    world.sleep(0.0)
    assert world.now_ns() == 10_000_000


@pytest.mark.parametrize("seconds", [-0.001, math.nan, math.inf])
def test_time_cannot_run_backward_or_be_undefined(world, seconds):
    with pytest.raises(ValueError, match="cannot advance"):
        world.advance(seconds)


@given(rate=st.floats(0.5, 1000), steps=st.integers(1, 5000))
def test_ticker_counts_exactly(rate, steps):
    ticker = Ticker(rate, 1_000_000)
    ticks = sum(ticker.due() for _ in range(steps))
    assert abs(ticks - rate * steps / 1000) <= 1 + 1e-5 * steps


def test_ticker_at_a_third_of_the_steps_is_even():
    ticker = Ticker(30.0, 1_000_000)
    at = [i for i in range(1, 1001) if ticker.due()]
    assert len(at) == 30 and at[:4] == [34, 67, 100, 134]


def test_streams_have_their_rate_and_count_from_zero(world):
    world.advance(0.25)
    assert world.counts() == {"arm": 25, "gripper": 5, "wrist_ft": 250, "table_ft": 250}
    readings = device(world, "arm").since(-1)
    assert [r.stamp.sequence for r in readings] == list(range(25))
    assert [r.stamp.capture_ns for r in readings] == [10_000_000 * i for i in range(1, 26)]


def test_rate_above_the_steps_is_refused(station):
    slow = station.model_copy(update={"world": WorldConfig(timestep=0.002)})
    with pytest.raises(ValueError, match=r"wrist_ft\.rate: 1000 Hz is faster than the world steps"):
        World(slow)


def test_realtime_world_stamps_unix_time(station, make_scene):
    world = World(station.model_copy(update={"world": WorldConfig(clock="realtime")}))
    assert not world.lockstep
    world.reset(0, make_scene())
    start = world.now_ns()
    assert start > 1_600_000_000 * 10**9
    world.advance(0.5)
    assert world.now_ns() - start == 500_000_000


# -- the scene -----------------------------------------------------------------------------------------------------


def test_without_a_scene_devices_describe_themselves_and_say_what_is_missing(station):
    world = World(station)
    for each in world.devices.values():
        each.describe()
        each.connect()
    for ask in (
        world.truth,
        lambda: world.advance(0.1),
        world.visible_tags,
        device(world, "arm").latest,
        device(world, "wrist_ft").latest,
        device(world, "wrist_ft").tare,
        lambda: device(world, "arm").command(target((0, 0, 0))),
    ):
        with pytest.raises(DeviceFault, match="no scene yet"):
            ask()


def test_impossible_scene_leaves_the_world_as_it_was(world, make_scene):
    world.advance(0.1)
    before = world.truth()
    with pytest.raises(ValueError, match="overlap"):
        world.reset(1, make_scene(start=(0.0, 0.0, 0.0)), WorldConfig(stiffness_scale=0.5))
    after = world.truth()
    assert after.stamp == before.stamp
    np.testing.assert_array_equal(after.go, before.go)


def test_scene_may_come_as_a_dict(world, make_scene):
    world.reset(3, make_scene(start=(0.1, 0.4, 0.0)).model_dump())
    np.testing.assert_allclose(world.truth().ee, [0.1, 0.4, 0.0])


def test_reset_starts_every_stream_again(world, make_scene):
    world.advance(0.1)
    device(world, "wrist_ft").tare()
    world.reset(0, make_scene())
    assert world.now_ns() == 0
    with pytest.raises(DeviceTimeout, match="since the reset"):
        device(world, "wrist_ft").latest()
    world.advance(0.01)
    reading = device(world, "wrist_ft").latest()
    assert reading.stamp.sequence == 9 and reading.stamp.capture_ns == 10_000_000
    # untared
    assert reading.wrench[2] == pytest.approx(-WEIGHT * np.cos(0.3))


def test_reset_can_change_the_stiffness(world, make_scene):
    world.reset(0, make_scene())
    nominal = world.truth()
    world.reset(0, make_scene(), WorldConfig(stiffness_scale=0.5))
    # twice as soft hangs twice as low, less what the turning of the go adds
    sag, soft = (t.ee[1] - t.go[1] - 0.045 for t in (nominal, world.truth()))
    assert soft == pytest.approx(2 * sag, rel=1e-3)


def test_two_worlds_tell_the_same_truth_to_the_bit(station, make_scene):
    def run():
        world = World(station)
        arm = device(world, "arm")
        for each in world.devices.values():
            each.connect()
        world.reset(7, make_scene(start=(0.0, 0.123, 0.3)))
        out = []
        with arm.lease("test"):
            for i in range(50):
                arm.command(target((1e-4 * i, 0.123 - 1e-4 * i, 0.3), (0.005, -0.005, 0.0), 0.02))
                world.sleep(0.02)
                truth = world.truth()
                out += [truth.ee, truth.go, truth.wrench, *(c.force for c in truth.contacts)]
                out += [r.wrench for r in device(world, "wrist_ft").since(world.now_ns() - 20_000_000)]
        return [a.tobytes() for a in out], len(world.truth().contacts)

    first, second = run(), run()
    assert first == second
    assert first[1] == 1


def test_truth_has_the_planned_parts(world, make_scene):
    eo = Body(name="hbox", vertices=((-0.06, -0.03), (0.06, -0.03), (0.06, 0.03), (-0.06, 0.03)), mass=0.5)
    world.reset(0, make_scene(extrinsic=eo, extrinsic_pose=(0.3, 0.03, 0.0)))
    world.advance(0.2)
    truth = world.truth()
    assert truth.stamp.capture_ns == world.now_ns()
    assert truth.eo is not None
    np.testing.assert_allclose(truth.eo, [0.3, 0.03, 0.0], atol=5e-6)
    np.testing.assert_allclose(truth.wrench[:2], [0.0, WEIGHT], atol=1e-9)
    assert [(c.on, c.by) for c in truth.contacts] == [("eo", "ground")] * 2


def test_visible_tags_ride_on_their_bodies(station, make_scene, tall_box):
    tags = (TagMount(id=10, size=0.04), TagMount(id=11, size=0.04, pose=(0.1, 0.0, 0.0)))
    world = World(station.model_copy(update={"table_tags": tags}))
    own = TagMount(id=3, size=0.036, pose=(0.0, -0.04, 0.0)), TagMount(id=4, size=0.02, pose=(0.0, 0.05, 0.0))
    world.reset(0, make_scene(grasped=tall_box.model_copy(update={"tags": own})))
    seen = {mount.id: pose for mount, pose in world.visible_tags()}
    assert sorted(seen) == [3, 4, 10, 11]
    np.testing.assert_array_equal(seen[3], world.truth().go)
    np.testing.assert_array_equal(seen[4], world.truth().go)
    np.testing.assert_array_equal(seen[11], [0.0, 0.0, 0.0])


def test_station_without_a_world_and_unknown_profile_are_refused(station):
    with pytest.raises(ValueError, match="no simulated world"):
        World(station.model_copy(update={"world": None}))
    with pytest.raises(ValueError, match=r"no profile 'idael'\s+expected: one of hard, ideal, lab, or a path\n"):
        World(station.model_copy(update={"world": WorldConfig(profile="idael")}))


# -- force/torque --------------------------------------------------------------------------------------------------


def test_wrist_reads_the_weight_pulling_down_on_the_sensor(world):
    world.advance(0.01)
    reading = device(world, "wrist_ft").latest()
    truth = world.truth()
    # the sensor sits at (0.01, 0.08) in ee, which is upright, and its own axes are turned by 0.3 rad
    sensor = truth.ee[:2] + np.array([0.01, 0.08])
    along_x, along_y = -WEIGHT * np.sin(0.3), -WEIGHT * np.cos(0.3)
    # a weight to the right of the sensor turns it clockwise
    torque = -WEIGHT * (truth.go[0] - sensor[0])
    np.testing.assert_allclose(planar(reading), [along_x, along_y, torque], atol=1e-9)
    assert reading.stamp.frame == "wrist_ft" and reading.stamp.status is Status.OK
    np.testing.assert_array_equal(reading.wrench[[1, 3, 5]], 0.0)


def test_wrist_at_the_ee_reads_minus_the_true_wrench_when_pressed(station, make_scene):
    here = ForceTorqueConfig(kind="force_torque", mount="wrist")
    world = World(station.model_copy(update={"devices": station.devices | {"wrist_ft": here}}))
    for each in world.devices.values():
        each.connect()
    world.reset(0, make_scene(start=(0.0, 0.123, 0.0)))
    with device(world, "arm").lease("test"):
        device(world, "arm").command(target((0.0, 0.1175, 0.0), duration=0.5))
        world.advance(1.0)
    truth = world.truth()
    assert truth.wrench[1] < -0.5, "the fingers press the go down"
    fx, fy, tau = planar(device(world, "wrist_ft").latest())
    np.testing.assert_allclose([fx, fy], -truth.wrench[:2], atol=1e-12)
    assert fy > 0, "the table pushes the sensor up"
    # about the ee: the torque about the grasp centre and the force's lever from there
    c, s = np.cos(truth.go[2]), np.sin(truth.go[2])
    lever = truth.go[:2] + np.array([-s * 0.045, c * 0.045]) - truth.ee[:2]
    assert tau == pytest.approx(-truth.wrench[2] + lever[0] * fy - lever[1] * fx, abs=1e-12)


def test_table_reads_what_stands_on_it(world, make_scene):
    eo = Body(name="hbox", vertices=((-0.06, -0.03), (0.06, -0.03), (0.06, 0.03), (-0.06, 0.03)), mass=0.5)
    world.reset(0, make_scene(extrinsic=eo, extrinsic_pose=(0.3, 0.03, 0.0)))
    world.advance(0.3)
    # the sensor's origin is at x = 0.05: the block stands 0.25 m to its right and turns it clockwise
    weight = 0.5 * 9.81
    reading = device(world, "table_ft").latest()
    np.testing.assert_allclose(planar(reading), [0.0, -weight, -0.25 * weight], atol=1e-4)


def test_table_and_wrist_balance_the_weight(station, make_scene):
    """Up and down along the chain: what the wrist pushes and the go weighs, the table bears."""
    level = ForceTorqueConfig(kind="force_torque", mount="wrist", pose=(0.0, 0.1, 0.0))
    world = World(station.model_copy(update={"devices": station.devices | {"wrist_ft": level}}))
    for each in world.devices.values():
        each.connect()
    world.reset(0, make_scene(start=(0.0, 0.123, 0.0)))
    with device(world, "arm").lease("test"):
        device(world, "arm").command(target((0.001, 0.1175, 0.0), duration=0.5))
        world.advance(1.0)
    wrist, table = planar(device(world, "wrist_ft").latest()), planar(device(world, "table_ft").latest())
    np.testing.assert_allclose(table[:2], -wrist[:2] - np.array([0.0, WEIGHT]), atol=1e-4)


def test_tare_zeroes_the_present_load(world):
    wrist = device(world, "wrist_ft")
    with pytest.raises(DeviceTimeout):
        wrist.tare()
    world.advance(0.05)
    wrist.tare()
    world.advance(0.05)
    np.testing.assert_allclose(wrist.latest().wrench, 0.0, atol=1e-12)


def test_overload_is_clipped_and_marked(world, make_scene):
    heavy = Body(name="iron", vertices=((-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)), mass=50.0)
    world.reset(0, make_scene(extrinsic=heavy, extrinsic_pose=(0.05, 0.05, 0.0)))
    world.advance(0.2)
    reading = device(world, "table_ft").latest()
    assert reading.stamp.status is Status.SATURATED
    assert reading.wrench[2] == -400.0


# -- gripper --------------------------------------------------------------------------------------------


def test_gripper_reports_what_it_holds(world):
    gripper = device(world, "gripper")
    world.advance(0.1)
    assert gripper.latest().holding
    gripper.release()
    world.advance(0.3)
    reading = gripper.latest()
    assert not reading.holding and reading.width == 0.08
    gripper.grasp(20.0)
    world.advance(0.1)
    assert not gripper.latest().holding, "the go has fallen out of reach"
    with pytest.raises(CommandRefused, match="force"):
        gripper.grasp(-1.0)


def test_friction_can_have_changed_since_the_laboratory_was_calibrated(world, make_scene):
    scene = make_scene()
    world.reset(0, scene, WorldConfig(friction_scale={"go-ground": 0.9}))
    assert world._actual(world.scene).friction == pytest.approx(
        scene.friction | {"go-ground": 0.9 * scene.friction["go-ground"]}
    )
