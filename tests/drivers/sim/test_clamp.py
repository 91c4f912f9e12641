"""A body that is fixed to the table, and another scene on the same table, in the simulated world."""

import numpy as np
import pytest

from drivers.errors import CommandRefused
from drivers.interfaces import ArmTarget
from drivers.scene import Scene
from drivers.sim.world import World
from experiments import files, setup
from mechanics import se2


@pytest.fixture
def world() -> World:
    resolved = files.load("grasped_static")
    world = World(resolved.station)
    world.reset(0, setup.scene(resolved))
    world.advance(0.1)
    return world


def _move(world: World, by: tuple[float, float, float], seconds: float = 0.5) -> None:
    arm = world._arm
    assert arm is not None
    arm.connect()
    arm.acquire("test")
    start = arm.pose
    steps = round(seconds / 0.02)
    for i in range(1, steps + 1):
        pose = np.array(start) + np.array(by) * i / steps
        arm.command(ArmTarget(pose, np.zeros(3), 0.02, i))
        world.advance(0.02)
    arm.release()
    world.advance(0.5)


def test_a_clamped_object_stays_and_the_fingers_pull_with_their_stiffness_alone(world: World) -> None:
    before = world.truth().go
    world.clamp("go")
    _move(world, (0.003, 0.002, 0.05))
    truth = world.truth()
    np.testing.assert_array_equal(truth.go, before)
    x = se2.between(se2.compose(truth.go, np.array(world.scene.grasp)), truth.ee)
    np.testing.assert_allclose(truth.wrench, np.array(world.scene.stiffness) @ x, rtol=1e-6)


def test_what_pulls_at_a_clamped_object_loads_the_table_that_it_is_fixed_to(world: World) -> None:
    world.clamp("go")
    _move(world, (0.003, -0.002, 0.0))
    truth = world.truth()
    weight = np.array([0.0, world.scene.grasped.mass * -world.scene.gravity])
    np.testing.assert_allclose(world.plant().ground_wrench()[:2], truth.wrench[:2] + weight, atol=1e-6)
    about = truth.ee[:2]  # any point serves
    lever = se2.compose(truth.go, np.array(world.scene.grasp))[:2] - about
    torque = truth.wrench[2] + lever[0] * truth.wrench[1] - lever[1] * truth.wrench[0]
    torque += (truth.go[0] - about[0]) * weight[1]
    assert world.plant().ground_wrench(about)[2] == pytest.approx(torque, abs=1e-6)


def test_an_object_that_is_freed_hangs_in_the_fingers_again(world: World) -> None:
    world.clamp("go")
    _move(world, (0.003, 0.0, 0.0))
    world.clamp(None)
    world.advance(1.0)
    weight = world.scene.grasped.mass * world.scene.gravity
    np.testing.assert_allclose(world.truth().wrench[:2], [0.0, weight], atol=1e-6)


def test_what_is_not_there_cannot_be_clamped(world: World) -> None:
    with pytest.raises(CommandRefused, match="no body 'eo'"):
        world.clamp("eo")


def _with_another(world: World, **changes: object) -> Scene:
    return world.scene.model_copy(update=changes)


def test_another_object_comes_into_the_fingers_while_time_runs_on(world: World) -> None:
    scene, then = world.scene, world.now_ns()
    heavier = scene.grasped.model_copy(update={"mass": 2 * scene.grasped.mass})
    world.rearrange(_with_another(world, grasped=heavier))
    assert world.now_ns() == then
    world.advance(0.2)
    assert world.truth().wrench[1] == pytest.approx(2 * scene.grasped.mass * scene.gravity, rel=1e-6)
    assert world.now_ns() == then + 200_000_000


def test_an_arrangement_that_cannot_be_leaves_everything_as_it_was(world: World) -> None:
    go = world.truth().go
    inside = world.scene.grasped.model_copy(update={"name": "eo"})
    impossible = _with_another(
        world,
        extrinsic=inside,
        extrinsic_pose=tuple(go.tolist()),
        friction={"go-ground": 0.3, "go-eo": 0.3, "eo-ground": 0.3},
    )
    with pytest.raises(CommandRefused, match="overlap"):
        world.rearrange(impossible)
    np.testing.assert_array_equal(world.truth().go, go)
    assert world.scene.extrinsic is None


def test_an_object_has_the_friction_of_its_own_whether_it_is_held_or_stands() -> None:
    resolved = files.load("grasped_static", sets=["world.profile=lab"])
    world = World(resolved.station)
    scene = setup.scene(resolved)
    eo = scene.grasped.model_copy(update={"name": "eo"})
    both = scene.model_copy(
        update={
            "extrinsic": eo,
            "extrinsic_pose": (0.2, 0.0734, 0.0),
            "friction": {"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 0.33},
        }
    )
    world.reset(0, both)
    standing = world.plant().scene.friction["eo-ground"]
    world.rearrange(scene.model_copy(update={"grasped": eo}))
    assert world.plant().scene.friction["go-ground"] == standing != 0.33
