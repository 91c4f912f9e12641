"""Jobs on a scheduler that is there already: retries, failures, restarts; and clean ends, for warnings are errors."""

import json
from typing import Any

import pytest
from distributed import LocalCluster

from experiments.campaign import engine
from experiments.campaign.engine import run_jobs
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.jobs import Job, resolve
from mechanics.yaml_input import InputError

PLAN_ONLY = "stages=[{stage: plan, name: press, skill: grasped_static, parameters: {steps: 2}}]"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path / "campaign"


def cluster(workers) -> Any:  # what it says it is when entered holds for its asynchronous use alone
    threads = {"processes": False, "threads_per_worker": 1, "protocol": "tcp", "memory_limit": 0}
    return LocalCluster(n_workers=workers, dashboard_address="127.0.0.1:0", **threads)


def jobs(*names):
    return [Job(name, "grasped_static", None, (PLAN_ONLY, f"experiment.name={name}"), {"name": name}) for name in names]


def prepared(folder, wanted):
    campaign, resolved = CampaignFolder(folder), resolve(wanted)
    campaign.keep(campaign.agree(wanted, resolved), wanted, resolved)
    return campaign


def test_a_job_that_fails_is_tried_again_and_takes_no_other_down(folder):
    wanted = jobs("good", "bad")
    prepared(folder, wanted).job("bad").experiment.write_text("nonsense: true\n")
    with cluster(1) as there:
        good, bad = run_jobs(wanted, folder, scheduler=there.scheduler_address, retries=1)
        assert (good.status, good.attempts) == ("completed", 1)
        assert (bad.status, bad.attempts) == ("failed", 2)
        assert "nonsense" in bad.reason

        # the next start tries again what failed, leaves alone what ended, and overwrites nothing
        campaign = CampaignFolder(folder)
        campaign.job("bad").experiment.write_text(campaign.job("good").experiment.read_text())
        good, bad = run_jobs(wanted, folder, scheduler=there.scheduler_address, retries=1)
        assert (good.status, good.attempts) == ("completed", 1)
        assert (bad.status, bad.attempts) == ("completed", 3)
        assert bad.run is not None
        assert bad.run.name == "run.2"
        assert json.loads((bad.run / "results.json").read_text())["plans"]
        assert campaign.job("bad").failure is None


def test_a_scheduler_that_does_not_answer_is_refused_before_anything_is_written(folder, monkeypatch):
    monkeypatch.setattr(engine, "PATIENCE", 0.5)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9(.|\n)*within 0\.5 s(.|\n)*dask scheduler"):
        run_jobs(jobs("a"), folder, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(InputError, match=r"tcp://host:port"):
        run_jobs(jobs("a"), folder, scheduler="nowhere://a:1")
    assert not folder.exists()


def test_a_scheduler_without_workers_is_refused(folder, monkeypatch):
    monkeypatch.setattr(engine, "PATIENCE", 0.5)
    with cluster(0) as empty, pytest.raises(InputError, match=r"no worker(.|\n)*dask worker tcp://"):
        run_jobs(jobs("a"), folder, scheduler=empty.scheduler_address)
    assert not folder.exists()


def test_another_campaign_in_the_folder_is_refused_with_the_difference(folder):
    prepared(folder, jobs("a", "b"))
    for other, difference in ((jobs("a"), "a job b, too"), (jobs("a", "b", "c"), "no job c")):
        with pytest.raises(InputError, match=difference):
            run_jobs(other, folder)
    changed = [Job(job.id, job.experiment, None, (*job.sets, "trial.ramp=0.7"), job.tags) for job in jobs("a", "b")]
    with pytest.raises(InputError, match="another experiment or station"):
        run_jobs(changed, folder)


def test_a_folder_with_anything_else_in_it_is_refused(folder):
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="no sweep"):
        run_jobs(jobs("a"), folder)


def test_two_jobs_of_one_id_are_refused(folder):
    with pytest.raises(InputError, match="two jobs"):
        run_jobs(jobs("a", "a"), folder)
