"""Jobs on a scheduler that is there already: retries, failures, restarts; and clean ends, for warnings are errors."""

import json
import os
import signal
from typing import Any

import pytest
from distributed import LocalCluster

from drivers.hosting import HostProcess
from drivers.sim import host_thread
from drivers.sim.host_thread import HostThread
from experiments.campaign import engine
from experiments.campaign.engine import run_jobs
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.frame import trials_frame
from experiments.campaign.jobs import Job, resolve
from experiments.campaign.work import _host as host_of
from experiments.campaign.work import work
from experiments.files import load
from experiments.stages import STAGES
from mechanics.yaml_input import InputError
from planning.errors import InfeasiblePlan

TRIAL = ("stages.0.parameters.steps=2", "stages.1.controllers=[open_loop]")
LEAN = "stages.0.parameters.tangential=[1, 1]"
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


def test_a_simulated_crash_fails_its_job_with_its_reason_and_takes_no_other_down(folder):
    """Station and run share the worker's process, which has to live on."""
    crash = "world.faults=[{kind: crash, after: 2}]"
    wanted = [
        Job("before", "grasped_static", None, TRIAL, {"crash": False}),
        Job("crash", "grasped_static", None, (*TRIAL, crash), {"crash": True}),
        Job("after", "grasped_static", None, (*TRIAL, "seed=1"), {"crash": False}),
    ]
    with cluster(1) as there:
        before, crashed, after = run_jobs(wanted, folder, scheduler=there.scheduler_address, retries=1)
    assert [(job.status, job.attempts) for job in (before, after)] == [("completed", 1)] * 2
    assert (crashed.status, crashed.attempts) == ("failed", 2)
    assert "the device's server has died" in crashed.reason
    assert crashed.run is not None
    assert "the simulated world has crashed" in crashed.run.with_name(f"{crashed.run.name}.log").read_text()
    rows = trials_frame(folder).set_index("job")
    assert rows["status"].to_dict() == {"before": "completed", "crash": "device_failed", "after": "completed"}
    assert "the device's server has died" in rows["reason"]["crash"]


def test_an_exception_that_nobody_has_foreseen_is_the_reason_of_its_job(folder, monkeypatch):
    def defect(_context, _stage):
        raise ZeroDivisionError("by nothing")

    monkeypatch.setitem(STAGES, "plan", defect)
    trial = Job("a", "grasped_static", None, TRIAL, {"k": 1})
    with cluster(1) as there:
        [failed] = run_jobs([trial], folder, scheduler=there.scheduler_address, retries=1)
    assert (failed.status, failed.attempts) == ("failed", 2)
    assert failed.reason.startswith("ZeroDivisionError: by nothing. This is a defect")
    [row] = trials_frame(folder)[["status", "reason"]].to_numpy().tolist()
    assert row == ["failed", failed.reason]


def test_a_folder_of_somebodys_own_beside_the_runs_is_no_run(folder):
    job = prepared(folder, jobs("a")).job("a")
    made = [job.next_run(), job.next_run()]
    for name in ("run.bak", "run.1.old", "run.01", "running"):
        (job.path / name).mkdir()
    assert job.runs() == made
    assert job.next_run().name == "run.2"


@pytest.mark.parametrize(("clock", "host"), [("lockstep", HostThread), ("realtime", HostProcess)])
def test_a_worker_hosts_what_need_not_keep_the_pace_of_the_wall(clock, host):
    assert host_of(load("grasped_static", None, [f"world.clock={clock}"])) is host


def test_no_job_has_been_looked_into_when_one_cannot_be(folder):
    """The workers may be there already: the folder says that nothing was given to them."""
    impossible = Job("no", "grasped_static", None, ("friction.go-ground=0.1", LEAN), {})
    with cluster(1) as there:
        with pytest.raises(InfeasiblePlan, match="needs µ"):
            run_jobs([*jobs("a"), impossible], folder, scheduler=there.scheduler_address)
        assert not there.scheduler.tasks
    assert not folder.exists()


def test_a_worker_whose_station_hangs_ends_once_its_results_are_written(folder, monkeypatch):
    class Ended(Exception):
        pass

    def kill(pid, number):
        raise Ended(pid, number)

    [job] = jobs("hangs")
    campaign = prepared(folder, [job])
    monkeypatch.setattr(host_thread, "stuck", lambda: True)
    monkeypatch.setattr(os, "kill", kill)
    with pytest.raises(Ended) as ended:
        work(str(campaign.job("hangs").path), str(folder.parent))
    assert ended.value.args == (os.getpid(), signal.SIGKILL)
    assert campaign.job("hangs").ended() is not None


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


def test_nobody_samples_the_threads_of_a_worker_that_runs_jobs(folder):
    """In CPython 3.11 that may stop the whole process for ever."""
    with cluster(1) as there:
        (worker,) = there.workers.values()
        assert "profile" in worker.periodic_callbacks
        run_jobs(jobs("good"), folder, scheduler=there.scheduler_address)
        assert not {"profile", "profile-cycle"} & set(worker.periodic_callbacks)
