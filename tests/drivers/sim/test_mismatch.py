"""Each figure of a profile does what it says: by statistics over seeds, readings and trials."""

from __future__ import annotations

from collections.abc import Callable
from math import erf, inf, sqrt
from typing import Any

import numpy as np
import pytest
from scipy.signal import welch
from scipy.stats import kstest

from drivers.config import ForceTorqueConfig, StationConfig, WorldConfig
from drivers.errors import CommandRefused
from drivers.interfaces import ArmTarget
from drivers.scene import Body, TagMount
from drivers.sim.arm import BUILD_UP
from drivers.sim.force_torque import RANGE, Electronics
from drivers.sim.mismatch import ForceTorqueFigures, Lab, Mismatch, load_profile, profile_names
from drivers.sim.world import World
from mechanics import se2
from mechanics.readings import Status
from mechanics.yaml_input import InputError

BUBBLE = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])


def profile(**sections: Any) -> Mismatch:
    """A profile with these sections and nothing else."""
    return Mismatch.model_validate(sections)


def sigma_of(samples: np.ndarray) -> float:
    """Standard deviation about zero, which is what a figure of 1 sigma says."""
    return float(np.sqrt(np.mean(np.square(samples))))


def about(sigma: float, n: int) -> Any:
    """What the standard deviation of ``n`` normal draws may be: within four of its own standard errors."""
    return pytest.approx(sigma, rel=4 / sqrt(2 * n))


@pytest.fixture
def world_of(station: StationConfig, make_scene, monkeypatch) -> Callable[..., World]:
    """A world of a profile, every device open, reset to a seed."""

    def make(figures: Mismatch, seed: int = 0, config: StationConfig = station, **scene: Any) -> World:
        monkeypatch.setattr("drivers.sim.world.load_profile", lambda _name: figures)
        world = World(config)
        for device in world.devices.values():
            device.connect()
        world.reset(seed, make_scene(**scene))
        return world

    return make


def device(world: World, name: str) -> Any:
    return world.devices[name]


def move(world: World, *poses: tuple[float, float, float], seconds: float = 0.3) -> None:
    """One motion to each pose, with a rest after it."""
    arm = device(world, "arm")
    with arm.lease("test"):
        for pose in poses:
            arm.command(ArmTarget(np.array(pose), np.zeros(3), seconds))
            world.advance(seconds + 0.2)


# -- the files -----------------------------------------------------------------------------------------------------


def figures(model: Any, path: str = "") -> dict[str, float]:
    """Every number of a profile by its path."""
    if isinstance(model, dict):
        return {k: v for name, value in model.items() for k, v in figures(value, f"{path}.{name}").items()}
    if isinstance(model, tuple | list):
        return {k: v for i, value in enumerate(model) for k, v in figures(value, f"{path}.{i}").items()}
    return {path: abs(float(model))} if isinstance(model, int | float) else {}


def test_three_profiles_are_shipped():
    assert profile_names() == ["hard", "ideal", "lab"]


def test_ideal_is_the_profile_without_figures():
    assert load_profile("ideal").model_copy(update={"description": ""}) == Mismatch()


def test_hard_is_about_twice_the_lab():
    lab, hard = (figures(load_profile(name).model_dump()) for name in ("lab", "hard"))
    assert lab.keys() == hard.keys()
    ratios = {key: hard[key] / lab[key] for key in lab if lab[key] > 0}
    assert not {key: ratio for key, ratio in ratios.items() if ratio < 1}
    for key in (".stiffness.error", ".friction.error", ".arm.bias.xy_mm.0", ".grasp.offset.angle_deg"):
        assert ratios[key] == 2


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "arm:\n  repeatabilty: {angle_deg: 1}\n",
            r"line 2: arm\.repeatabilty: unknown key(.|\n)*nearest:  repeatability",
        ),
        ("description: mine\nfrictoin: {error: 0.1}\n", r"line 2: frictoin: unknown key(.|\n)*nearest:  friction"),
        ("force_torque:\n  noise: [0.02, 0.02]\n", r"line 2: force_torque\.noise: too few values\n.*a list of 6"),
        ("grasp:\n  spread: 1.5\n", r"line 2: grasp\.spread: the number 1\.5\n.*less than 1"),
        ("force_torque:\n  dropout: -0.1\n", r"line 2: force_torque\.dropout: the number -0\.1"),
        ("membrane:\n  creep: 0.1\n", r"line 1: membrane: .*creep_time"),
    ],
)
def test_a_profile_with_a_wrong_figure_is_refused_with_its_place(tmp_path, text, says):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        load_profile(str(path))
    assert caught.value.problems[0].file == str(path)


def test_an_unknown_profile_is_answered_with_the_nearest():
    with pytest.raises(InputError) as caught:
        load_profile("lba")
    [problem] = caught.value.problems
    assert problem.expected == "one of hard, ideal, lab, or a path" and problem.nearest == "lab"


def test_a_world_may_have_a_profile_of_its_own(station, tmp_path, make_scene):
    path = tmp_path / "mine.yaml"
    path.write_text("membrane: {stiffening: 10}\n")
    world = World(station)
    world.reset(0, make_scene(), WorldConfig(profile=str(path)))
    assert world.plant().membrane.stiffening == 10
    path.write_text("membrane: {stifening: 10}\n")
    with pytest.raises(ValueError, match="nearest:  stiffening"):
        world.reset(0, make_scene(), WorldConfig(profile=str(path)))
    assert world.plant().membrane.stiffening == 10


# -- ideal ---------------------------------------------------------------------------------------------------------


def test_regrasping_in_the_ideal_world_changes_nothing_to_the_bit(world_of):
    def run(regrasps: bool) -> list[bytes]:
        world = world_of(Mismatch(), start=(0.0, 0.125, 0.3))
        out = []
        for trial in range(3):
            if regrasps:
                world.regrasp(trial)
            move(world, (0.001 * trial, 0.12, 0.3), (0.0, 0.14, 0.3))
            truth = world.truth()
            readings = [r.wrench for r in device(world, "wrist_ft").since(-1)]
            out += [a.tobytes() for a in (truth.ee, truth.go, truth.wrench, np.array(readings))]
        return [*out, str(world.now_ns()).encode()]

    assert run(True) == run(False)


def test_the_ideal_plant_is_the_scene(world_of, make_scene):
    world = world_of(Mismatch())
    scene = make_scene()
    assert world.plant().scene == scene
    assert world.plant().membrane.is_linear and min(world.plant().finger_limit) == inf


# -- stiffness, friction, the tags' seats: constant for a seed -----------------------------------------------------


def test_stiffness_is_off_by_the_figure_in_each_entry():
    labs = [Lab(profile(stiffness={"error": 0.025}), seed) for seed in range(400)]
    true = np.array([lab.stiffness(BUBBLE) for lab in labs])
    off = true / BUBBLE - 1
    for i in range(3):
        for j in range(3):
            assert sigma_of(off[:, i, j]) == about(0.025, 400)
    np.testing.assert_array_equal(true, true.transpose(0, 2, 1))
    # entries are independent: six normal draws
    correlation = np.corrcoef(off[:, *np.triu_indices(3)].T)
    assert np.abs(correlation - np.eye(6)).max() < 0.25


def test_a_true_stiffness_is_positive_definite_however_large_its_error():
    gel = np.array([[5060.26, -1261.90, -158.71], [-1261.90, 9998.16, 334.56], [-158.71, 334.56, 37.6311]])
    lab = profile(stiffness={"error": 0.29})
    assert min(np.linalg.eigvalsh(Lab(lab, seed).stiffness(gel))[0] for seed in range(300)) > 0


def test_friction_is_off_by_the_figure_pair_by_pair():
    nominal = {"go-ground": 0.33, "go-eo": 0.5}
    labs = [Lab(profile(friction={"error": 0.03}), seed).friction(nominal) for seed in range(400)]
    for pair, mu in nominal.items():
        assert sigma_of(np.array([lab[pair] / mu - 1 for lab in labs])) == about(0.03, 400)
    assert len({round(lab["go-ground"] / 0.33 - lab["go-eo"] / 0.5, 12) for lab in labs}) == 400
    # a pair's figure does not hang on which other pairs there are
    assert Lab(profile(friction={"error": 0.03}), 5).friction({"go-eo": 0.5})["go-eo"] == labs[5]["go-eo"]


def test_the_plant_has_the_true_stiffness_and_friction(world_of, make_scene):
    figures = profile(stiffness={"error": 0.05}, friction={"error": 0.05})
    world = world_of(figures, seed=3)
    lab = Lab(figures, 3)
    np.testing.assert_array_equal(world.plant().coupling.stiffness, lab.stiffness(make_scene().stiffness))
    assert world.plant().scene.friction == lab.friction(make_scene().friction)
    world.reset(4, make_scene())
    assert (world.plant().coupling.stiffness != lab.stiffness(make_scene().stiffness)).any()


def test_tags_sit_askew_by_the_figure(world_of, tall_box):
    figures = profile(camera={"tag_bias": {"xy_mm": [0.08, 0.04], "angle_deg": 0.1}})
    off = np.array([Lab(figures, seed).tag_bias(3) for seed in range(400)]) / [0.08e-3, 0.04e-3, np.radians(0.1)]
    assert [sigma_of(column) for column in off.T] == [about(1, 400)] * 3
    body = tall_box.model_copy(update={"tag": TagMount(id=3, size=0.036, pose=(0.0, -0.04, 0.5))})
    world = world_of(figures, grasped=body)
    [(seen, pose)] = world.visible_tags()
    np.testing.assert_allclose(
        se2.between(np.array([0.0, -0.04, 0.5]), np.array(seen.pose)), Lab(figures, 0).tag_bias(3), atol=1e-15
    )
    np.testing.assert_array_equal(pose, world.truth().go)


def test_membrane_and_finger_limits_reach_the_plant(world_of):
    figures = profile(membrane={"stiffening": 26.7}, fingers={"force_limit": 12.0})
    plant = world_of(figures).plant()
    assert plant.membrane == figures.membrane and plant.finger_limit == (12.0, inf)


# -- the grasp: anew in each trial ---------------------------------------------------------------------------------

GRASP = {"offset": {"xy_mm": [1.45, 1.0], "angle_deg": 1.8}, "spread": 0.25}
SIZES = np.array([1.45e-3, 1.0e-3, np.radians(1.8)])


@pytest.mark.parametrize("seed", [0, 1, 17])
def test_eight_trials_go_through_the_eight_octants(seed):
    lab = Lab(profile(grasp=GRASP), seed)
    offsets = np.array([lab.grasp_offset(trial) for trial in range(16)])
    for eight in (offsets[:8], offsets[8:]):
        assert len({tuple(np.sign(offset)) for offset in eight}) == 8
    assert len(np.unique(offsets[:, 0])) == 16


def test_the_order_of_the_octants_is_the_seeds():
    signs = {
        tuple(np.sign(Lab(profile(grasp=GRASP), seed).grasp_offset(trial)).tobytes() for trial in range(8))
        for seed in range(20)
    }
    assert len(signs) == 20


def test_sizes_of_the_grasp_spread_evenly_about_the_figure():
    lab = Lab(profile(grasp=GRASP), 0)
    ratio = np.abs([lab.grasp_offset(trial) for trial in range(400)]) / SIZES
    for column in ratio.T:
        assert kstest(column, "uniform", (0.75, 0.5)).pvalue > 1e-4
    assert np.abs(np.corrcoef(ratio.T) - np.eye(3)).max() < 0.2


def test_a_new_grasp_moves_the_object_in_the_fingers_by_the_draw_in_no_time(world_of):
    figures = profile(grasp=GRASP)
    world = world_of(figures)
    world.advance(0.1)
    before, now = world.truth(), world.now_ns()
    world.regrasp(2)
    assert world.now_ns() == now
    offset = Lab(figures, 0).grasp_offset(2)
    gocf = se2.compose(se2.compose(world.truth().go, np.array([0.0, 0.045, 0.0])), offset)
    nominal = se2.compose(before.go, np.array([0.0, 0.045, 0.0]))
    # the frame in which the fingers rest is where it was; the object under it has moved. What the other lever of the
    # weight turns is a third of a degree
    np.testing.assert_allclose(gocf[:2], nominal[:2], atol=5e-5)
    assert abs(gocf[2] - nominal[2]) < np.radians(0.5)


def test_after_a_new_grasp_the_object_hangs_at_rest(world_of):
    figures = profile(
        grasp=GRASP, membrane={"stiffening": 26.7, "hysteresis": 0.2, "yield_length": 6e-4}, stiffness={"error": 0.05}
    )
    world = world_of(figures)
    world.advance(0.1)
    world.regrasp(5)
    before = world.truth()
    world.advance(0.5)
    np.testing.assert_allclose(world.truth().go, before.go, atol=1e-9)


def test_what_a_trial_draws_does_not_hang_on_what_ran_before(world_of):
    figures = load_profile("lab")

    def poses_after(*trials: int) -> tuple[np.ndarray, np.ndarray]:
        world = world_of(figures)
        for trial in trials:
            world.regrasp(trial)
            move(world, (0.001 * trial, 0.29, 0.02 * trial))
        world.regrasp(3)
        move(world, (0.01, 0.29, 0.0), (0.0, 0.3, 0.0))
        return world.truth().ee, world.truth().go

    (ee, go), (ee_later, go_later) = poses_after(), poses_after(0, 7)
    np.testing.assert_allclose(ee_later, ee, atol=1e-12)
    # what is left is the membrane's memory of how the hand was held when it closed
    np.testing.assert_allclose(go_later, go, atol=5e-4)
    np.testing.assert_allclose(go_later[:2], go[:2], atol=5e-5)


def test_other_trials_and_other_seeds_grasp_otherwise(world_of):
    world = world_of(load_profile("lab"))
    poses = []
    for seed, trial in ((0, 0), (0, 1), (0, 8), (1, 0)):
        world.reset(seed, world.scene)
        world.regrasp(trial)
        poses.append(se2.between(world.truth().ee, world.truth().go))
    assert min(np.abs(a - b).max() for i, a in enumerate(poses) for b in poses[:i]) > 1e-5


def test_a_new_grasp_that_would_hit_the_table_is_refused_and_changes_nothing(world_of):
    world = world_of(profile(grasp={"offset": {"xy_mm": [0, 5]}}), start=(0.0, 0.122, 0.0))
    before = world.truth()
    low = next(trial for trial in range(8) if Lab(world.profile, 0).grasp_offset(trial)[1] > 0)
    with pytest.raises(CommandRefused, match="go and ground would overlap"):
        world.regrasp(low)
    world.advance(0.01)
    np.testing.assert_allclose(world.truth().go, before.go, atol=1e-12)
    with pytest.raises(CommandRefused, match="Trials count from 0"):
        world.regrasp(-1)


def test_the_true_wrench_is_about_the_grasp_centre_that_plans_speak_of(world_of):
    world = world_of(profile(grasp=GRASP))
    world.regrasp(0)
    truth = world.truth()
    # only the weight: its moment about the point 45 mm up the object's axis, wherever the fingers truly hold it
    lever = truth.go[0] - se2.compose(truth.go, np.array([0.0, 0.045, 0.0]))[0]
    np.testing.assert_allclose(truth.wrench, [0.0, 0.981, lever * 0.981], atol=1e-9)


def test_handling_leaves_strains_that_fill_the_yield_ellipsoid_evenly():
    lab = Lab(profile(membrane={"hysteresis": 0.2, "yield_length": 6e-4}), 0)
    strains = np.array([lab.membrane_strain(trial) for trial in range(500)])
    # the share of a ball within r is r³
    assert kstest(np.linalg.norm(strains, axis=1) ** 3, "uniform").pvalue > 1e-4
    assert np.abs(strains.mean(axis=0)).max() < 4 * sqrt(1 / 5 / 500)
    assert not Lab(Mismatch(), 0).membrane_strain(0).any()


# -- the arm -------------------------------------------------------------------------------------------------------


def test_bias_stands_between_the_reported_and_the_true_pose(world_of):
    figures = profile(arm={"bias": {"xy_mm": [0.3, 0.25], "angle_deg": 0.2}})
    size = np.array([0.3e-3, 0.25e-3, np.radians(0.2)])
    biases = np.array([Lab(figures, seed).arm_bias for seed in range(400)]) / size
    assert [sigma_of(column) for column in biases.T] == [about(1, 400)] * 3
    world = world_of(figures, seed=7)
    for pose in ((0.0, 0.3, 0.0), (0.05, 0.32, 0.2)):
        move(world, pose)
        off = world.truth().ee - device(world, "arm").latest().pose
        np.testing.assert_allclose(off, Lab(figures, 7).arm_bias, atol=1e-12)
        np.testing.assert_allclose(device(world, "arm").latest().pose, pose, atol=1e-12)


REPEAT = {"repeatability": {"xy_mm": [0.05, 0.04], "angle_deg": 0.03}}
REPEAT_SI = np.array([0.05e-3, 0.04e-3, np.radians(0.03)])


def test_each_motion_ends_elsewhere_within_the_repeatability(world_of):
    world = world_of(profile(arm=REPEAT))
    arm, plant, off = device(world, "arm"), world.plant(), []
    plant.step = lambda *_: None  # only the arm is asked
    with arm.lease("test"):
        for i in range(300):
            arm.command(ArmTarget(np.array([0.01 * (i % 2), 0.3, 0.0]), np.zeros(3), 0.2))
            world.advance(0.21)
            off.append(np.subtract(arm.true_pose, arm.pose))
    off = np.array(off) / REPEAT_SI
    assert [sigma_of(column) for column in off.T] == [about(1, 300)] * 3
    assert np.abs(np.mean(off[1:] * off[:-1], axis=0)).max() < 4 / sqrt(300), "motions are independent"


def test_while_the_arm_rests_its_error_stays(world_of):
    world = world_of(profile(arm=REPEAT))
    move(world, (0.01, 0.3, 0.0))
    first = world.truth().ee
    move(world, (0.01, 0.3, 0.0), (0.01, 0.3, 0.0))
    np.testing.assert_array_equal(world.truth().ee, first)
    device(world, "arm").hold()
    world.advance(0.1)
    np.testing.assert_array_equal(world.truth().ee, first)


def test_a_streamed_motion_is_one_motion(world_of):
    world = world_of(profile(arm=REPEAT))
    arm, draws = device(world, "arm"), []
    arm._leave_rest = lambda leave=arm._leave_rest: (draws.append(1), leave())
    goal = np.zeros(3)
    with arm.lease("test"):
        for i in range(1, 51):
            s = i / 50
            goal = np.array([0.02 * s * s * (3 - 2 * s), 0.3, 0.0])
            arm.command(ArmTarget(goal, np.array([0.02 * 6 * s * (1 - s), 0.0, 0.0]), 0.02))
            world.advance(0.02)
        for _ in range(10):
            arm.command(ArmTarget(goal, np.zeros(3), 0.02))
            world.advance(0.02)
    assert len(draws) == 1


def test_the_true_twist_is_the_rate_of_the_true_pose(world_of):
    world = world_of(profile(arm=REPEAT | {"lag": 0.02}))
    arm, path = device(world, "arm"), []
    with arm.lease("test"):
        arm.command(ArmTarget(np.array([0.002, 0.301, 0.01]), np.zeros(3), 0.3))
        for _ in range(600):
            arm.advance(0.001)
            path.append((arm.true_pose, arm.true_twist))
    poses, twists = np.array(path).transpose(1, 0, 2)
    steps = np.diff(poses, axis=0) / 0.001
    np.testing.assert_allclose(0.5 * (twists[1:] + twists[:-1]), steps, atol=0.01 * np.abs(twists).max())
    # and nothing jumps: no step is longer than the fastest speed allows
    assert np.abs(steps).max() <= 1.05 * np.abs(twists).max()


def test_repeatability_is_paired_over_the_trials_of_one_number(world_of):
    world = world_of(profile(arm=REPEAT))

    def ends(trial: int) -> np.ndarray:
        world.regrasp(trial)
        out = []
        for x in (0.01, 0.02, 0.0):
            move(world, (x, 0.3, 0.0))
            out.append(world.truth().ee)
        return np.array(out)

    first, other, again = ends(4), ends(5), ends(4)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_lagging_arm_follows_as_a_first_order_system(world_of):
    lag, speed = 0.02, 0.05
    world = world_of(profile(arm={"lag": lag}))
    arm, reported = device(world, "arm"), []
    with arm.lease("test"):
        # the aim runs along v (2 t² − t³): at t = 1 its derivatives are v, −2 v and −6 v
        arm.command(ArmTarget(np.array([speed, 0.3, 0.0]), np.array([speed, 0.0, 0.0]), 1.0))
        for _ in range(1000):
            arm.advance(0.001)
            reported.append(arm.pose[0])
        aim = arm._aim[0]
        assert aim - reported[-1] == pytest.approx(speed * lag * (1 + 2 * lag - 6 * lag**2), rel=1e-4)
        # the set-point stops; what is left decays with the time constant, and never overshoots
        left = []
        for _ in range(800):
            arm.advance(0.001)
            left.append(arm._aim[0] - arm.pose[0])
    assert left[20] / left[0] == pytest.approx(np.exp(-1), rel=1e-6)
    assert min(left) >= 0 and left[-1] == 0
    np.testing.assert_array_equal(arm.true_pose, arm.pose)


def test_a_lagging_arm_that_is_stopped_stays_where_it_is(world_of):
    world = world_of(profile(arm={"lag": 0.05} | REPEAT))
    arm = device(world, "arm")
    with arm.lease("test"):
        arm.command(ArmTarget(np.array([0.05, 0.3, 0.0]), np.zeros(3), 0.3))
        world.advance(BUILD_UP / 2)
        arm.stop()
        here = arm.true_pose
        world.advance(0.2)
        assert arm.true_pose == here and arm.true_twist == (0.0, 0.0, 0.0)
        arm.recover()


# -- force/torque --------------------------------------------------------------------------------------------------


def digits(
    n: int, seed: int = 0, load: tuple[float, ...] = (0.0,) * 6, *, rate: float = 1000.0, **given: Any
) -> np.ndarray:
    """``n`` readings (n, 6) of one sensor under a load that stays."""
    electronics = Electronics(ForceTorqueFigures.model_validate(given), rate, np.random.default_rng(seed))
    return np.array([electronics.read(np.array(load))[0] for _ in range(n)])


def test_a_sensor_without_figures_reads_the_load_to_the_bit():
    load = (0.1, -0.2, 0.3, 1e-3, 2e-3, 1 / 3)
    np.testing.assert_array_equal(digits(3, load=load), [load] * 3)


def test_noise_has_its_size_in_each_axis_and_is_white():
    sizes = (0.02, 0.03, 0.04, 4e-4, 5e-4, 6e-4)
    n = 16384
    read = digits(n, noise=sizes)
    assert [sigma_of(column) for column in read.T] == [about(size, n) for size in sizes]
    correlation = np.corrcoef(read.T)
    assert np.abs(correlation - np.eye(6)).max() < 4 / sqrt(n)
    # flat: each octave of the spectrum holds 2 σ² / rate per hertz
    frequency, density = welch(read[:, 0], 1000.0, nperseg=512)
    for low in (4, 8, 16, 32, 64, 128, 250):
        band = density[(frequency >= low) & (frequency < 2 * low)]
        averages = len(band) * 2 * n / 512
        assert band.mean() == pytest.approx(2 * 0.02**2 / 1000, rel=4 / sqrt(averages / 2))


def test_drift_is_a_walk_that_reaches_its_figure_in_half_a_minute():
    ends, middles = [], []
    for seed in range(300):
        walk = digits(300, seed, rate=10.0, drift_force=0.05, drift_torque=0.002)
        ends.append(walk[-1])
        middles.append(walk[74])
    figure = np.repeat([0.05, 0.002], 3)
    assert sigma_of(np.array(ends) / figure) == about(1, 1800)
    # a quarter of the time: half of the way
    assert sigma_of(np.array(middles) / figure) == about(0.5, 1800)
    slope = np.diff(np.log(welch(digits(16384, drift_force=0.05)[:, 0], 1000.0, nperseg=4096)[1][[4, 256]]))[0]
    assert slope / np.log(256 / 4) == pytest.approx(-2, abs=0.4), "a walk's spectrum falls with the square"


def test_bias_and_gain_are_one_sensors_own():
    load = (10.0, 20.0, 30.0, 1.0, 2.0, 3.0)
    gains = np.array([digits(2, seed, load, gain_error=0.005) for seed in range(300)]) / load - 1
    np.testing.assert_array_equal(gains[:, 0], gains[:, 1])
    assert sigma_of(gains[:, 0]) == about(0.005, 1800)
    biases = np.array([digits(2, seed, bias_force=0.04, bias_torque=0.002) for seed in range(300)])
    np.testing.assert_array_equal(biases[:, 0], biases[:, 1])
    assert sigma_of(biases[:, 0, :3]) == about(0.04, 900) and sigma_of(biases[:, 0, 3:]) == about(0.002, 900)


def test_warming_moves_zero_and_gain_together_in_all_axes():
    warm: dict[str, Any] = {"temperature_walk": 1.0, "temperature_force": 0.02, "temperature_torque": 0.001}
    after_a_minute = np.array([digits(600, seed, rate=10.0, **warm)[-1] for seed in range(200)])
    # the product of two independent normal figures: coefficient by temperature
    assert sigma_of(after_a_minute[:, :3]) == pytest.approx(0.02, rel=0.25)
    assert sigma_of(after_a_minute[:, 3:]) == pytest.approx(0.001, rel=0.25)
    axes = digits(600, 1, rate=10.0, **warm)
    assert np.linalg.matrix_rank(axes, tol=1e-9) == 1, "one temperature"
    figures: dict[str, Any] = {"temperature_walk": 1.0, "temperature_gain": 5e-4}
    gains = np.array([digits(600, seed, (10.0,) * 6, rate=10.0, **figures)[-1] for seed in range(200)]) / 10 - 1
    assert sigma_of(gains) == pytest.approx(5e-4, rel=0.25)


def test_digits_are_whole_steps_and_hold_the_load_between_them():
    steps = (0.025, 0.025, 0.05, 0.00125, 0.00125, 0.00125)
    load = (1.013, -0.511, 2.03, 0.0101, 0.0009, -0.0006)
    np.testing.assert_allclose(
        digits(1, load=load, resolution=steps)[0], [1.025, -0.5, 2.05, 0.01, 0.00125, -0.0], atol=1e-12
    )
    noisy = digits(20000, load=load, resolution=steps, noise=[0.02, 0.02, 0.03, 1e-3, 1e-3, 1e-3])
    np.testing.assert_allclose(noisy / steps, np.rint(noisy / steps), atol=1e-6)
    # noise of a step's size carries the mean through the steps, and a rounding adds step²/12 to its variance
    assert (np.abs(noisy.mean(axis=0) - load) < 0.03 * np.array(steps)).all()
    assert noisy[:, 0].std() == pytest.approx(sqrt(0.02**2 + 0.025**2 / 12), rel=0.02)


def test_full_scale_is_reported_even_where_only_the_bias_reaches_it():
    electronics = Electronics(ForceTorqueFigures(bias_force=1.0), 1000.0, np.random.default_rng(0))
    bias = electronics.read(np.zeros(6))[0]
    axis = int(np.argmax(bias[:3]))
    assert bias[axis] > 0
    load = np.zeros(6)
    load[axis] = RANGE[axis] - 0.5 * bias[axis]
    read, saturated = electronics.read(load)
    assert saturated and read[axis] == RANGE[axis]


def test_a_saturated_reading_says_so(world_of):
    heavy = Body(name="iron", vertices=((-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)), mass=50.0)
    figures = profile(force_torque={"noise": [0.02] * 6})
    world = world_of(figures, extrinsic=heavy, extrinsic_pose=(0.05, 0.05, 0.0))
    world.advance(0.3)
    reading = device(world, "table_ft").latest()
    assert reading.stamp.status is Status.SATURATED and reading.wrench[2] == -RANGE[2]


def test_the_tools_weight_hangs_on_the_wrist_alone(station, world_of):
    level = ForceTorqueConfig(kind="force_torque", mount="wrist", pose=(0.0, 0.2, 0.0))
    config = station.model_copy(update={"devices": station.devices | {"wrist_ft": level}})
    tool = {"tool_mass": 1.1, "tool_centre_mm": [5, 90]}
    readings = {}
    for name, figures in (("bare", Mismatch()), ("tool", profile(force_torque=tool))):
        world = world_of(figures, config=config, start=(0.0, 0.3, 0.5))
        world.advance(0.01)
        readings[name] = device(world, "wrist_ft").latest().wrench, device(world, "table_ft").latest().wrench
    weight = readings["tool"][0] - readings["bare"][0]
    # the sensor leans by 0.5 rad to the left, the tool hangs 110 mm under it and 5 mm to its right
    np.testing.assert_allclose(weight[[0, 2]], 1.1 * 9.81 * np.array([-np.sin(0.5), -np.cos(0.5)]), atol=1e-12)
    lever = np.cos(0.5) * 0.005 + np.sin(0.5) * 0.11
    assert -weight[4] == pytest.approx(-lever * 1.1 * 9.81)
    np.testing.assert_array_equal(readings["tool"][1], readings["bare"][1])


def test_the_tool_is_known_as_well_as_it_was_weighed(world_of):
    known = []
    for seed in range(40):
        world = world_of(profile(force_torque={"tool_mass": 1.1, "tool_error": 0.01}), seed=seed)
        known.append(device(world, "wrist_ft").describe().extra["tool"]["mass"] / 1.1 - 1)
        assert "tool" not in device(world, "table_ft").describe().extra
    assert sigma_of(np.array(known)) == about(0.01, 40)
    assert "tool" not in device(world_of(Mismatch()), "wrist_ft").describe().extra


# -- on the way ----------------------------------------------------------------------------------------------------


def test_dropouts_are_gaps_that_the_receiver_counts(world_of):
    world = world_of(profile(force_torque={"dropout": 0.02}))
    wrist = device(world, "wrist_ft")
    world.advance(4.0)
    sequences = [reading.stamp.sequence for reading in wrist.since(-1)]
    missing = sequences[-1] + 1 - len(sequences)
    # 4000 readings: the count lost is binomial
    assert abs(missing - 80) < 4 * sqrt(4000 * 0.02 * 0.98)
    assert wrist.gaps == missing - sequences[0]
    assert device(world, "arm").gaps == 0


def test_a_loss_changes_nothing_of_what_is_not_lost(world_of):
    noisy = {"noise": [0.02] * 6}

    def run(**more: float) -> dict[int, bytes]:
        world = world_of(profile(force_torque=noisy | more))
        world.advance(0.5)
        return {r.stamp.sequence: r.wrench.tobytes() for r in device(world, "wrist_ft").since(-1)}

    whole, lossy = run(), run(dropout=0.1)
    assert len(lossy) < len(whole) and lossy.items() <= whole.items()


@pytest.mark.parametrize("section", ["arm", "gripper", "force_torque"])
def test_a_late_reading_keeps_its_capture_time(world_of, section):
    name = "wrist_ft" if section == "force_torque" else section
    world = world_of(profile(**{section: {"latency": 0.005}}))
    late, arrivals = device(world, name), []
    late.listen(lambda reading: arrivals.append((world.now_ns(), reading.stamp)))
    period = round(1e9 / late.rate)
    world.advance(0.2)
    assert len(arrivals) == (200_000_000 - 5_000_000) // period
    for i, (now, stamp) in enumerate(arrivals):
        assert stamp.sequence == i
        assert stamp.capture_ns == (i + 1) * period
        assert stamp.receive_ns == now == stamp.capture_ns + 5_000_000
    for other in set(world.devices) - {name}:
        readings = [r for r in device(world, other).since(-1) if section != "force_torque" or "ft" not in other]
        assert all(r.stamp.receive_ns == r.stamp.capture_ns for r in readings)


def test_what_is_on_its_way_at_a_reset_never_arrives(world_of, make_scene):
    world = world_of(profile(arm={"latency": 0.05}))
    world.advance(0.04)
    world.reset(0, make_scene())
    world.advance(0.065)
    assert [r.stamp.sequence for r in device(world, "arm").since(-1)] == [0]


# -- whole worlds --------------------------------------------------------------------------------------------------


def test_two_worlds_of_one_seed_differ_in_nothing_and_of_two_seeds_in_all(world_of):
    def run(seed: int) -> np.ndarray:
        world = world_of(load_profile("lab"), seed=seed)
        world.regrasp(1)
        move(world, (0.001, 0.29, 0.1))
        truth = world.truth()
        return np.concatenate([truth.ee, truth.go, truth.wrench, device(world, "wrist_ft").latest().wrench[[0, 2, 4]]])

    first = run(0)
    np.testing.assert_array_equal(run(0), first)
    assert (run(1) != first).sum() >= len(first) - 2  # two readings may fall on the same digit


def test_normal_is_meant_where_one_sigma_is_said():
    """Two thirds within one, as `1 sigma` says: not a uniform or a fixed size."""
    off = np.array([Lab(profile(arm={"bias": {"xy_mm": [1, 1]}}), seed).arm_bias[0] for seed in range(600)]) / 1e-3
    assert np.mean(np.abs(off) < 1) == pytest.approx(erf(1 / sqrt(2)), abs=4 * sqrt(0.68 * 0.32 / 600))
