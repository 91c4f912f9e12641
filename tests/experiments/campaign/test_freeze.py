"""A campaign ends with the calibrations and plan files that it began with, whatever happens to them meanwhile."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import FrictionCalibration
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.jobs import Job, resolve
from experiments.files import load
from experiments.planning.files import plan_files, save_plan
from experiments.planning.make import make

FRICTION_STAGE = "stages=[{stage: calibrate_friction, pair: go-ground}]"


@pytest.fixture(autouse=True)
def _somewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def calibrate(mu):
    """As a run on this station does that finds ``mu``."""
    of = load("grasped_static")
    origin = store.origin(of, ("table_ft",), ("go",), "run")
    made = FrictionCalibration(origin=origin, pair="go-ground", mu=mu, interval=(mu - 0.01, mu + 0.01), samples=500)
    store.save(store.folder_of(of), made)


def kept(*sets):
    """The experiment of a job as its worker loads it, on any later start."""
    job = Job("a", "grasped_static", None, sets)
    campaign, resolved = CampaignFolder(Path("sweep")), resolve([job])
    campaign.keep(campaign.agree([job], resolved), [job], resolved)
    return load(str(campaign.job("a").experiment))


def known_mu(resolved):
    found = store.load(resolved).friction(resolved)
    return found["go-ground"].mu if found else None


def test_a_later_calibration_is_not_taken():
    calibrate(0.41)
    kept()
    calibrate(0.55)
    assert known_mu(load("grasped_static")) == 0.55
    assert known_mu(kept()) == 0.41


def test_a_calibration_that_was_not_there_at_the_start_is_not_taken():
    kept()
    calibrate(0.41)
    assert known_mu(kept()) is None


def test_a_job_that_calibrates_begins_with_what_is_known_and_writes_to_a_folder_of_its_own():
    calibrate(0.41)
    resolved = kept(FRICTION_STAGE)
    assert known_mu(resolved) == 0.41
    assert store.folder_of(resolved) == Path("sweep/jobs/a/calibrations").absolute()


def test_without_any_calibration_its_own_folder_is_there_and_empty():
    resolved = kept(FRICTION_STAGE)
    assert known_mu(resolved) is None
    assert store.folder_of(resolved).is_dir()


def test_plan_files_are_copied():
    of = load("grasped_static", None, ["stages.0.parameters.steps=2"])
    stage: Any = of.experiment.stages[0]
    plan = make(of, stage, setup.believed(of, store.load(of)))
    file = save_plan(plan, Path())
    resolved = kept(f"stages=[{{stage: execute, plan: {file}, controllers: [open_loop]}}]")
    Path(file).unlink()
    [copied] = plan_files(resolved).values()
    np.testing.assert_array_equal(copied.ee, plan.ee)


def test_two_folders_of_one_name_are_kept_apart():
    for place, mu in (("a", 0.41), ("b", 0.55)):
        calibrate(mu)
        Path(place).mkdir()
        Path("calibrations").rename(f"{place}/calibrations")
    folders = [next(Path(place).glob("calibrations/*")) for place in "ab"]
    assert folders[0].name == folders[1].name
    wanted = [Job(f.parts[0], "grasped_static", None, (f"calibration.source={f}",), {}) for f in folders]
    campaign, resolved = CampaignFolder(Path("sweep")), resolve(wanted)
    campaign.keep(campaign.agree(wanted, resolved), wanted, resolved)
    assert [known_mu(load(str(campaign.job(job.id).experiment))) for job in wanted] == [0.41, 0.55]


@pytest.mark.parametrize("leave", [True, False], ids=["copied", "moved"])
def test_a_campaign_goes_on_in_another_place_with_what_lies_there(leave):
    """``home`` is where what its jobs read lies, as a table's calibrations do."""
    calibrate(0.41)
    Path("first").mkdir()
    Path("calibrations").rename("first/calibrations")

    def begun(home):
        source = next((home / "calibrations").iterdir()).absolute()
        sets = (f"calibration.source={source}",)
        job = Job("a", "grasped_static", None, sets, {}, home=home.absolute())
        campaign, resolved = CampaignFolder(home / "runs"), resolve([job])
        campaign.keep(campaign.agree([job], resolved), [job], resolved)
        return load(str(campaign.job("a").experiment))

    begun(Path("first"))
    shutil.copytree("first", "second")
    if not leave:
        shutil.rmtree("first")
    resolved = begun(Path("second"))
    assert Path(resolved.experiment.calibration.source).is_relative_to(Path("second/runs").absolute())
    assert known_mu(resolved) == 0.41
