"""`extrinsic sweep`: what it refuses before a start, and a whole sweep that loses a worker, is interrupted and goes on.

What is written to a job's log tells when it runs: the log is a pipe here, and its job waits until the test reads.
"""

import json
import os
import signal
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd
import psutil
import pytest
from rich.console import Console
from typer.testing import CliRunner

from drivers.wire.log_reader import LogReader
from drivers.wire.session import listening
from experiments import runner
from experiments.calibrate import store
from experiments.calibrate.models import ElasticityCalibration
from experiments.campaign import engine
from experiments.campaign.folder import CampaignFolder
from experiments.campaign.grid import parse_grid, sweep_jobs
from experiments.campaign.jobs import resolve
from experiments.cli import app
from experiments.files import load
from experiments.ports import free_endpoint

# two commands with their workers and simulated stations, one after the other
pytestmark = pytest.mark.timeout(900)

SETS = ["stages.0.parameters.steps=2", "stages.1.controllers=[open_loop]"]
GRID = "world.stiffness_scale=0.9,1,1.1"
ARGUMENTS = ["sweep", "grasped_static", "--out", "sweep", "--grid", GRID, *(a for s in SETS for a in ("--set", s))]


# -- refused before anything is started ------------------------------------------------------------------------------


def refused(*arguments, experiment="grasped_static"):
    """Exit code and what was said of a sweep that must not start."""
    ended = CliRunner().invoke(app, ["sweep", experiment, "--out", "sweep", *arguments])
    assert not Path("sweep").exists()
    return ended.exit_code, ended.output


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("elsewhere")
class TestRefused:
    def test_a_key_that_does_not_exist(self):
        code, said = refused("--grid", "trial.rampp=0.3,0.5")
        assert code == 2
        assert "trial.rampp=0.3" in said
        assert "nearest:  trial.ramp" in said

    def test_a_task_without_a_plan(self):
        code, said = refused("--grid", "friction.go-ground=0.9,0.1", "--set", "stages.0.parameters.tangential=[1, 1]")
        assert code == 5
        assert "friction.go-ground=0.1" in said
        assert "needs µ" in said

    def test_a_shape_without_a_feasible_contact(self):
        grid = ["--grid", "extrinsic_object=triangle", "--grid", "friction.eo-ground=0.1"]
        code, said = refused(*grid, experiment="extrinsic_pivoting")
        assert code == 5
        assert "extrinsic_object=triangle" in said

    def test_a_calibration_of_another_sensor(self):
        of = load("grasped_static")
        origin = store.origin(of, ("finger_left",), ("go",), "run")
        origin = origin.model_copy(update={"devices": {"finger_left": "bubble-7"}, "made": datetime.now(UTC)})
        K, zero = ((2500.0, 0.0, 0.0), (0.0, 2000.0, 0.0), (0.0, 0.0, 3.0)), (0.0, 0.0, 0.0)
        made = ElasticityCalibration(
            origin=origin,
            sensor="soft_bubble",
            stiffness=K,
            deviation=(zero, zero, zero),
            amplitude=0.002,
            initial=K,
            offset=zero,
            residual=zero,
            chi2=1.0,
            method="errors_in_variables",
            samples=200,
        )
        store.save(Path("given"), made)
        code, said = refused("--grid", "calibration.source=none,given")
        assert code == 2
        assert "calibration.source=given" in said
        assert "bubble-7" in said

    def test_a_scheduler_that_does_not_answer(self, monkeypatch):
        monkeypatch.setattr(engine, "PATIENCE", 0.5)
        code, said = refused("--scheduler", "tcp://127.0.0.1:9")
        assert code == 2
        assert "tcp://127.0.0.1:9" in said
        assert "dask scheduler" in said

    def test_a_summary_that_could_not_be_written(self):
        code, said = refused("--json", "/proc/nope/x.json")
        assert code == 2
        assert "/proc/nope/x.json: --json: cannot be written" in said

    def test_workers_beside_a_scheduler(self):
        assert refused("--scheduler", "tcp://127.0.0.1:9", "--workers", "3")[0] == 2


# -- one sweep, with all that can happen to it -----------------------------------------------------------------------


class Pipe:
    """A job's log as a pipe: its worker waits until it is opened here, and its lines are the events to act on."""

    def __init__(self, path):
        self.path = path
        path.parent.mkdir(exist_ok=True, parents=True)
        os.mkfifo(path)

    def __enter__(self):
        self._file = self.path.open()
        return self

    def __exit__(self, *_):
        self._file.close()
        self.path.unlink()

    def wait_for(self, part):
        for line in self._file:
            if part in line:
                return
        raise AssertionError(f"{self.path} never said {part!r}")

    def wait_for_end(self):
        """Until its writer is gone."""
        self._file.read()

    def writer(self, among):
        """The process that writes it."""
        return next(process for process in among if str(self.path) in _open_files(process.pid))


def _open_files(pid):
    return [str(entry.readlink()) for entry in Path(f"/proc/{pid}/fd").iterdir()]


def ended(folder):
    return {path.name for path in (folder / "jobs").iterdir() if CampaignFolder(folder).job(path.name).ended()}


@pytest.fixture(scope="module")
def story(shared_command):
    """A worker is killed at the first job, Ctrl-C comes when that one is done and the second waits, and a new start."""
    home = shared_command.folder
    folder = home / "sweep"
    told = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        jobs = sweep_jobs("grasped_static", None, SETS, parse_grid([GRID]), ())
        campaign, resolved = CampaignFolder(folder), resolve(jobs)
        campaign.keep(campaign.agree(jobs, resolved), jobs, resolved)

    first, held = (Pipe(campaign.job(job.id).path / "run.log") for job in jobs[:2])
    sweep = shared_command.start(*ARGUMENTS, "--workers", "2")
    with first:
        first.wait_for("open_loop")
        here = psutil.Process(sweep.pid)
        worker = first.writer(here.children())
        told["beside it"] = worker.children(recursive=True)
        ports = [place.laddr.port for place in worker.net_connections("tcp") if place.status == psutil.CONN_LISTEN]
        worker.send_signal(signal.SIGKILL)
        first.wait_for_end()
        worker.wait(60)
        told["stations"] = ports
        told["listening"] = [port for port in ports if listening(f"tcp/127.0.0.1:{port}")]

    for line in iter(sweep.stderr.readline, ""):
        told.setdefault("said", []).append(line)
        if jobs[0].id in line:
            break
    told["ended"] = ended(folder)
    group = [process for process in here.children() if os.getpgid(process.pid) == os.getpgid(sweep.pid)]
    everybody = here.children(recursive=True)
    for process in (here, *group):  # as a terminal does
        process.send_signal(signal.SIGINT)
    told["interrupted"] = shared_command.finish(sweep, timeout=400)
    told["left"] = psutil.wait_procs(everybody, timeout=60)[1]
    told["summary"] = json.loads((folder / "summary.json").read_text())
    told["kept"] = ended(folder)
    told["rows"] = len(pd.read_parquet(folder / "trials.parquet"))
    held.path.unlink()

    told["first runs"] = [run.name for run in campaign.job(jobs[0].id).runs()]
    told["again"] = shared_command.finish(shared_command.start(*ARGUMENTS, "--json", "summary.json"), timeout=400)
    return folder, jobs, told


def test_a_killed_worker_loses_nothing_and_its_station_goes_with_it(story):
    _, jobs, told = story
    assert not told["beside it"]  # a worker hosts its station itself
    assert told["stations"]
    assert not told["listening"]
    assert jobs[0].id in told["ended"]
    assert told["first runs"][:2] == ["run", "run.1"]
    assert "completed, at attempt " in told["said"][-1]


def test_ctrl_c_ends_in_order_and_keeps_what_is_done(story):
    _, jobs, told = story
    assert told["interrupted"].code == 130, told["interrupted"].err
    assert "Traceback" not in told["interrupted"].err
    assert not told["left"]
    assert jobs[1].id not in told["ended"]
    assert told["summary"]["status"] == "interrupted"
    assert told["summary"]["ended"] == told["rows"] == len(told["kept"])
    assert told["ended"] <= told["kept"]


def test_a_sweep_that_is_started_again_runs_what_is_missing(story):
    folder, jobs, told = story
    assert told["again"].code == 0, told["again"].err
    assert f"{len(told['kept'])} of 3 jobs are done already" in told["again"].err
    assert [run.name for run in CampaignFolder(folder).job(jobs[0].id).runs()] == told["first runs"]
    assert ended(folder) == {job.id for job in jobs}
    frame = pd.read_parquet(folder / "trials.parquet")
    assert frame["world.stiffness_scale"].tolist() == [0.9, 1.0, 1.1]
    assert frame["status"].tolist() == ["completed"] * 3
    summary = json.loads((folder.parent / "summary.json").read_text())
    assert [cell["n"] for cell in summary["cells"]] == [1, 1, 1]
    assert told["again"].out.count("open_loop") == 3


def test_the_figures_are_those_of_runs_one_by_one(story, tmp_path, monkeypatch):
    folder, jobs, _ = story
    monkeypatch.chdir(tmp_path)
    for scale, job in zip((0.9, 1, 1.1), jobs, strict=True):
        alone = load(
            "grasped_static", None, [*SETS, f"world.stiffness_scale={scale}", f"bus.endpoint={free_endpoint()}"]
        )
        outcome = runner.run(alone, tmp_path / job.id, Console(quiet=True))
        swept = CampaignFolder(folder).job(job.id).ended()
        assert swept is not None
        assert outcome.results["trials"] == swept[1]["trials"]
        assert outcome.results["log"] == swept[1]["log"]
        assert said(outcome.folder.path) == said(swept[0])


def said(run):
    """What the station said in a run and where the trial's waypoints were, by topic, as bytes."""
    found = {}
    for message in LogReader(run / "log.mcap").messages():
        if message.topic not in ("run/trial", "sim/arm/target"):  # the time of planning, the name of the commander
            found.setdefault(message.topic, []).append((message.sequence, message.log_ns, message.payload))
    assert sum(len(messages) for messages in found.values()) > 1000
    return found


def test_nothing_is_run_again_and_another_sweep_is_refused(story, monkeypatch):
    folder, _, _ = story
    monkeypatch.chdir(folder.parent)
    before = sorted(folder.glob("jobs/*/run*"))
    assert CliRunner().invoke(app, ARGUMENTS).exit_code == 0
    other = CliRunner().invoke(app, [*ARGUMENTS, "--seeds", "1"])
    assert other.exit_code == 2
    assert "another sweep lies there" in other.output
    assert sorted(folder.glob("jobs/*/run*")) == before
