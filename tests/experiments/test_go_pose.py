"""Where controllers learn the grasped object's pose from: ``trial.go_pose``, and what `extrinsic check` says of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.calibrate import store
from experiments.calibrate.models import ElasticityCalibration
from experiments.check import check
from experiments.files import Resolved, load
from experiments.setup import go_pose

K = ((2500.0, -100.0, 10.0), (-100.0, 2000.0, -12.0), (10.0, -12.0, 3.0))
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def resolved(*sets: str) -> Resolved:
    return load("grasped_static", None, list(sets))


def identified(of: Resolved, sensor: str = "soft_bubble") -> None:
    """Leave the fingers' elasticity with the object of the experiment where its station looks for it."""
    found = ElasticityCalibration(
        origin=store.origin(of, ("arm", "wrist_ft"), ("go",), "run"), sensor=sensor, stiffness=K,
        deviation=(ZERO, ZERO, ZERO), amplitude=0.002, initial=K, offset=ZERO, residual=ZERO, chi2=1.0,
        method="errors_in_variables", samples=200,
    )  # fmt: skip
    store.save(store.folder_of(of), found)


def source(of: Resolved) -> str:
    return go_pose(of, store.load(of))


def told(of: Resolved) -> str:
    [line] = [line for line in check(of, feasible=False) if line.startswith("controllers learn")]
    return line


def test_nothing_calibrated_means_tags() -> None:
    assert source(resolved()) == "tags"
    assert told(resolved()).endswith("from its tag: the fingers' elasticity with it is not identified")


def test_an_identified_elasticity_means_the_fingers() -> None:
    identified(resolved())
    assert source(resolved()) == "tactile"
    assert "from the fingers" in told(resolved())


def test_another_sensors_elasticity_is_of_no_use() -> None:
    identified(resolved(), sensor="gelslim")
    assert source(resolved()) == "tags"


def test_a_run_without_calibrations_takes_tags_whatever_lies_there() -> None:
    identified(resolved())
    assert source(resolved("calibration.source=none")) == "tags"


def test_a_station_without_fingers_takes_tags() -> None:
    identified(resolved())
    of = resolved()
    devices = {name: device for name, device in of.station.devices.items() if device.kind != "tactile"}
    bare = of.station.model_copy(update={"devices": devices})
    assert source(replace(of, station=bare)) == "tags"
    assert "no tactile fingers" in told(replace(of, station=bare))


@pytest.mark.parametrize("asked", ["tags", "tactile"])
def test_what_is_asked_for_stays(asked: str) -> None:
    assert source(resolved(f"trial.go_pose={asked}")) == asked
    identified(resolved())
    assert source(resolved(f"trial.go_pose={asked}")) == asked
    assert told(resolved(f"trial.go_pose={asked}")).endswith("as asked")


def test_a_run_that_identifies_it_first_goes_over_to_the_fingers() -> None:
    stages = "[{stage: plan, name: p, skill: grasped_static}, {stage: calibrate_elasticity}, "
    stages += "{stage: execute, plan: p, controllers: [closed_loop]}]"
    assert told(resolved(f"stages={stages}")).endswith("from its tag, and from the fingers after stage 2")
