"""Calibration files: where they lie, which a run takes, which it refuses by name, and what it then believes."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import (
    ClockCalibration,
    Delay,
    ElasticityCalibration,
    ForceTorqueCalibration,
    FrictionCalibration,
    TagCalibration,
)
from experiments.files import Resolved, load
from experiments.planning import make
from mechanics.yaml_input import InputError

K = ((2500.0, -100.0, 10.0), (-100.0, 2000.0, -12.0), (10.0, -12.0, 3.0))
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def resolved(*sets: str) -> Resolved:
    return load("grasped_static", None, list(sets))


def elasticity(of: Resolved) -> ElasticityCalibration:
    return ElasticityCalibration(
        origin=store.origin(of, ("arm", "wrist_ft"), ("go",), "run"),
        sensor="soft_bubble",
        stiffness=K,
        deviation=(ZERO, ZERO, ZERO),
        amplitude=0.002,
        initial=K,
        offset=ZERO,
        residual=ZERO,
        chi2=1.0,
        method="errors_in_variables",
        samples=200,
    )


def friction(of: Resolved, mu: float = 0.41) -> FrictionCalibration:
    return FrictionCalibration(
        origin=store.origin(of, ("table_ft",), ("go",), "run"),
        pair="go-ground",
        mu=mu,
        interval=(0.4, 0.42),
        samples=500,
    )


def test_each_simulated_laboratory_has_a_folder_of_its_own() -> None:
    assert store.folder_of(resolved()) == Path("calibrations/sim-ideal-0")
    assert store.folder_of(resolved("world.profile=lab", "seed=3")) == Path("calibrations/sim-lab-3")
    assert store.folder_of(resolved("world.stiffness_scale=0.8")) == Path("calibrations/sim-ideal-x0.8-0")
    assert store.folder_of(resolved("calibration.source=mine")) == Path("mine")


def test_a_file_reads_back_as_it_was_written() -> None:
    of = resolved()
    for made in (elasticity(of), friction(of)):
        assert store.read(store.save(Path("c"), made)) == made


def test_a_run_believes_what_was_calibrated_and_the_catalogue_for_the_rest() -> None:
    of = resolved()
    folder = store.folder_of(of)
    for made in (
        elasticity(of),
        friction(of),
        ForceTorqueCalibration(
            origin=store.origin(of, ("wrist_ft",), (), "run"),
            device="wrist_ft",
            tool_mass=1.25,
            tool_centre=(0.01, 0.08),
            deviation=ZERO,
            residual=0.0,
            samples=9,
        ),
        TagCalibration(
            origin=store.origin(of, ("camera",), ("go",), "run"), id=10, pose=(1e-3, 0.0, 0.1), deviation=ZERO
        ),
        ClockCalibration(
            origin=store.origin(of, ("arm", "camera"), (), "run"), delays={"camera": Delay(delay=0.03, deviation=1e-3)}
        ),
    ):
        store.save(folder, made)
    known = setup.believed(of, store.load(of))
    np.testing.assert_array_equal(known.stiffness, K)
    assert known.friction == {"go-ground": 0.41}
    assert known.tool is not None and known.tool[0] == 1.25
    assert known.delays == {"camera": 0.03}
    assert [(tag.id, tag.pose) for tag in known.tags["go"]] == [(10, (1e-3, 0.0, 0.1))]
    nominal = setup.believed(of, store.Calibrations())
    np.testing.assert_array_equal(nominal.stiffness, of.sensor.stiffness)
    assert nominal.friction == of.friction and nominal.tool is None and nominal.camera is None


def test_the_planner_plans_with_the_calibrated_figures() -> None:
    of = resolved()
    store.save(store.folder_of(of), elasticity(of))
    stage = of.experiment.stages[0]
    task = make.task(of, stage, setup.believed(of, store.load(of)))  # type: ignore[arg-type]
    np.testing.assert_array_equal(task.problem.stiffness, K)


def test_nothing_is_taken_where_the_experiment_says_none_or_nothing_lies_there() -> None:
    of = resolved()
    assert list(store.load(of)) == []
    store.save(store.folder_of(of), elasticity(of))
    assert list(store.load(resolved("calibration.source=none"))) == []
    with pytest.raises(InputError, match="no folder nowhere"):
        store.load(resolved("calibration.source=nowhere"))


def refused(made: ElasticityCalibration | FrictionCalibration, by: Resolved) -> str:
    file = store.save(Path("given"), made)
    with pytest.raises(InputError) as caught:
        store.load(by)
    said = str(caught.value)
    assert str(file) in said and "calibration.source=none" in said
    return said


def changed(made: ElasticityCalibration, /, **origin: object) -> ElasticityCalibration:
    return made.model_copy(update={"origin": made.origin.model_copy(update=origin)})


def test_a_file_of_another_serial_station_world_or_age_is_refused_by_name() -> None:
    of = resolved("calibration.source=given")
    made = elasticity(of)
    assert "serial 'ATI-7', the station's 'wrist_ft' is 'sim'" in refused(
        changed(made, devices={"wrist_ft": "ATI-7"}), of
    )
    assert "no device 'wrist_ft2'" in refused(changed(made, devices={"wrist_ft2": "sim"}), of)
    assert "it is of station 'lab7'" in refused(changed(made, station="lab7"), of)
    assert "profile lab" in refused(changed(made, world={"profile": "lab", "seed": 0, "stiffness_scale": 1.0}), of)
    assert "40 days old" in refused(changed(made, made=datetime.now(UTC) - timedelta(days=40.2)), of)
    older = resolved("calibration.source=given", "calibration.max_age_days=50")
    store.save(Path("given"), changed(made, made=datetime.now(UTC) - timedelta(days=40.2)))
    assert store.load(older).elasticity(older) is not None


def test_what_an_experiment_calibrates_anew_may_be_as_old_and_as_foreign_as_it_likes() -> None:
    """To calibrate again is what a refusal asks for."""
    again = "stages=[{stage: calibrate_elasticity}]"
    of = resolved("calibration.source=given")
    old = changed(elasticity(of), made=datetime.now(UTC) - timedelta(days=400), devices={"wrist_ft": "ATI-7"})
    file = store.save(Path("given"), old)
    assert list(store.load(resolved("calibration.source=given", again))) == []
    with pytest.raises(InputError, match="400 days old"):  # what it does not make is refused as ever
        store.load(resolved("calibration.source=given", "stages=[{stage: calibrate_force_torque}]"))
    store.save(Path("given"), elasticity(of))
    assert len(list(Path("given").iterdir())) == 2, "the old one lies beside it"
    known = store.load(resolved("calibration.source=given", again))
    assert known.files["elasticity-soft_bubble-tall_box"] == file, "one that is in order is known meanwhile"


def test_a_file_of_an_object_of_the_same_name_and_another_shape_is_refused() -> None:
    of = resolved("calibration.source=given")
    made = changed(elasticity(of), objects={"go": "tall_box 00000000"})
    assert "of the object 'tall_box 00000000'" in refused(made, of)


def test_calibrations_of_another_object_stay_out_of_the_way() -> None:
    of = resolved()
    store.save(store.folder_of(of), elasticity(of))
    store.save(store.folder_of(of), friction(of))
    other = resolved("grasped_object=z", "grasp.centre_mm=[0, 0]")
    assert list(store.load(other)) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("kind: weather\n", "no kind of calibration"),
        ("- 1\n", "mapping"),
        ("kind: friction\nmu: 0.3\n", "missing"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused_with_its_place(text: str, says: str) -> None:
    of = resolved()
    folder = store.folder_of(of)
    folder.mkdir(parents=True)
    (folder / "force_torque.yaml").write_text(text)
    with pytest.raises(InputError, match=says):
        store.load(of)


def test_a_stiffness_that_cannot_be_inverted_is_refused() -> None:
    of = resolved()
    file = store.save(store.folder_of(of), elasticity(of))
    file.write_text(file.read_text().replace("2500.0", "-2500.0", 1))
    with pytest.raises(InputError, match="positive definite"):
        store.load(of)


def test_what_was_calibrated_before_is_kept_beside_the_new() -> None:
    of = resolved()
    for mu in (0.3, 0.31, 0.32):
        store.save(Path("c"), friction(of, mu))
    found = {store.read(file).mu for file in Path("c").iterdir()}  # type: ignore[union-attr]
    assert found == {0.3, 0.31, 0.32}
    newest = store.read(Path("c/friction-tall_box-ground.yaml"))
    assert isinstance(newest, FrictionCalibration) and newest.mu == 0.32
