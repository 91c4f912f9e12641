"""Each figure of a profile does what it says: by statistics over seeds, readings and trials."""

from __future__ import annotations

from math import erf, inf, sqrt
from typing import Any

import numpy as np
import pytest

from drivers.config import WorldConfig
from drivers.scene import TagMount
from drivers.sim.mismatch import Lab, Mismatch, load_profile, profile_names
from drivers.sim.world import World
from mechanics import se2
from mechanics.yaml_input import InputError

from .profiles import about, device, move, profile, sigma_of

BUBBLE = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])


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
    holds = {key: ratio for key, ratio in ratios.items() if key.startswith(".fingers.")}  # the more the better
    assert set(holds.values()) == {0.5}
    assert not {key: ratio for key, ratio in ratios.items() if ratio < 1 and key not in holds}
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
    true = world.plant().scene.friction
    # a pair's figure goes with the bodies, whichever role they play: the tall box in hand, nothing on the table
    drawn = lab.friction({"tall_box-ground": 0.33, "tall_box-eo": 0.33, "eo-ground": 0.33})
    assert list(true) == ["go-ground", "go-eo", "eo-ground"]
    assert list(true.values()) == list(drawn.values())
    world.reset(4, make_scene())
    assert (world.plant().coupling.stiffness != lab.stiffness(make_scene().stiffness)).any()


def test_tags_sit_askew_by_the_figure(world_of, tall_box):
    figures = profile(camera={"tag_bias": {"xy_mm": [0.08, 0.04], "angle_deg": 0.1}})
    off = np.array([Lab(figures, seed).tag_bias(3) for seed in range(400)]) / [0.08e-3, 0.04e-3, np.radians(0.1)]
    assert [sigma_of(column) for column in off.T] == [about(1, 400)] * 3
    body = tall_box.model_copy(update={"tags": (TagMount(id=3, size=0.036, pose=(0.0, -0.04, 0.5)),)})
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
