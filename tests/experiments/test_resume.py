"""A run that was cut off, at whatever moment, goes on where it was and ends with the figures of an undisturbed one."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from drivers.sim.host_thread import HostThread
from drivers.wire.log_reader import LogReader
from experiments import runner
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.resume import refuse_besides, resume
from experiments.run_lock import RunLock
from mechanics.yaml_input import InputError

DOOMED = Path(__file__).with_name("doomed.py")
#: short, and with everything that a run may depend on: noise and walks, fingers that feel, a calibration
EXPERIMENT = """
experiment:
  name: short
  seed: 3
  grasped_object: tall_box
  calibration: {{source: none}}
  trial: {{go_pose: tactile, corrections: 1, tactile_frames: 1}}
  stages:
    - {{stage: plan, name: press, skill: grasped_static, parameters: {{angle_deg: 15, force: [3, 4], steps: 2}}}}
    - {{stage: calibrate_force_torque, orientations: 5, seconds: 0.1}}
    - {{stage: execute, plan: press, controllers: [open_loop, closed_loop], trials: 2}}
station: {station}
"""


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with the experiment, as the current folder."""
    folder, before = tmp_path_factory.mktemp("resumed"), Path.cwd()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    station = load("grasped_static", None, ["world.profile=lab", f"bus.endpoint={endpoint}"]).station
    (folder / "short.yaml").write_text(EXPERIMENT.format(station=json.dumps(station.model_dump(mode="json"))))
    os.chdir(folder)
    yield folder
    os.chdir(before)


def in_order(run, experiment="short.yaml"):
    return runner.run(load(experiment), Path(run), Console(quiet=True), HostThread)


def gone_on_with(run, *arguments):
    return resume(Path(run), *arguments, console=Console(quiet=True), host=HostThread)


def killed(run, moment, experiment="short.yaml"):
    """Begin or resume ``run`` in a process that is killed at ``moment``."""
    ended = subprocess.run(
        [sys.executable, DOOMED, run, experiment, moment], capture_output=True, text=True, timeout=100, check=False
    )
    assert ended.returncode == -signal.SIGKILL, f"{ended.returncode}: {ended.stderr}"


@pytest.fixture(scope="module")
def undisturbed(here):
    outcome = in_order("undisturbed")
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    return outcome


def figures(results):
    """What has to be the same to the last bit."""
    plans = [{key: plan[key] for key in ("name", "loss", "queries", "steps", "believed")} for plan in results["plans"]]
    tool = {name: (found["tool_mass"], found["tool_centre"]) for name, found in results["calibration"].items()}
    return {"plans": plans, "calibration": tool, "trials": results["trials"], "status": results["status"]}


def stamps(log):
    """When each reading of a sensor of 1 kHz was taken [ns]."""
    return np.array([message.publish_ns for message in LogReader(log).messages(["sim/table_ft/wrench"])])


def names(results):
    return [trial["name"] for trial in results["trials"]]


@pytest.mark.timeout(300)  # five processes, each with its imports
def test_a_run_killed_over_and_over_ends_with_the_figures_of_an_undisturbed_one(here, undisturbed):
    kept = {}
    for moment in ("plan", "calibration", "contact:3", "end", "trial"):
        killed("often", moment)
        for log in Path("often").glob("log*.mcap"):
            assert log.read_bytes()[: len(kept.get(log, b""))] == kept.get(log, b""), f"{log} was written to again"
            kept[log] = log.read_bytes()
    cut_off_ns = json.loads(Path("often/results.json").read_text())["progress"]["t_ns"]
    outcome = gone_on_with("often")
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    results = json.loads(outcome.folder.results.read_text())
    assert figures(results) == figures(undisturbed.results)
    assert [taken["finished_trials"] for taken in results["resumed"]] == [0, 0, 1, 1, 2]
    assert [taken["log"] for taken in results["resumed"]] == [f"log.{n}.mcap" for n in range(1, 6)]
    assert all(log.read_bytes() == before for log, before in kept.items())
    with (outcome.folder.path / "log.5.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == sum(results["log"]["messages"].values()) > 0
    # the log of a finished trial is whole but for what was under way, and the next one follows it in the station's time
    before, after = (stamps(outcome.folder.path / f"log.{n}.mcap") for n in (4, 5))
    assert cut_off_ns - 0.01e9 < before[-1] <= cut_off_ns
    assert cut_off_ns - 0.2e9 < after[0] < cut_off_ns  # it wakes up for 0.2 s
    assert np.all(np.diff(before) > 0) and np.all(np.diff(after) > 0)
    assert outcome.folder.report.is_file()


def test_a_trial_alone_has_the_figures_that_it_has_in_a_run(here, undisturbed):
    """Other trials before it, under whatever law, have no say in it; nor has the time of the day."""
    resolved = load("short.yaml", None, ["stages.2.first=1", "stages.2.trials=1", "stages.2.controllers=[closed_loop]"])
    alone = runner.run(resolved, Path("alone"), Console(quiet=True), HostThread)
    [trial] = alone.results["trials"]
    assert trial == undisturbed.results["trials"][-1]


def test_a_finished_run_says_so_and_ends_as_it_did(here, undisturbed, capsys):
    before = undisturbed.folder.results.read_bytes()
    outcome = resume(undisturbed.folder.path, console=Console())
    assert outcome.exit_code is ExitCode.DONE
    assert "finished already, as completed" in capsys.readouterr().out
    assert undisturbed.folder.results.read_bytes() == before
    assert not (undisturbed.folder.path / "log.1.mcap").exists()


def test_a_run_that_another_process_still_runs_is_refused_with_its_number(undisturbed):
    with RunLock(undisturbed.folder.path), pytest.raises(InputError, match=f"still runs, as process {os.getpid()} on "):
        gone_on_with(undisturbed.folder.path)


def test_a_lock_goes_with_the_process_that_held_it(tmp_path):
    code = "import os, sys; from pathlib import Path; from experiments.run_lock import RunLock\n"
    code += "with RunLock(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    ended = subprocess.run([sys.executable, "-c", code, tmp_path], check=False, timeout=60)
    assert ended.returncode == -signal.SIGKILL
    with RunLock(tmp_path):
        pass


def test_another_experiment_than_the_run_s_is_refused_and_the_difference_is_named(undisturbed, here):
    assert gone_on_with("undisturbed", "short.yaml").exit_code is ExitCode.DONE
    Path("other.yaml").write_text(Path("short.yaml").read_text().replace("seed: 3", "seed: 4"))
    with pytest.raises(InputError, match=r"experiment\.seed is 3 in the run, and 4 here"):
        gone_on_with("undisturbed", "other.yaml")
    with pytest.raises(InputError, match="--station"):
        gone_on_with("undisturbed", None, "sim")


def test_settings_and_a_place_are_refused_because_the_run_has_its_own():
    refuse_besides({"--set": [], "--out": None, "--rehearse": False})
    for option, given in (("--set", ["seed=1"]), ("--out", Path("elsewhere")), ("--speed", 0.2)):
        with pytest.raises(InputError, match=f"--resume without {option}"):
            refuse_besides({"--set": [], option: given})


def test_a_plan_that_has_gone_from_the_folder_is_named_before_anything_is_started(here, undisturbed):
    run = Path("robbed")
    run.mkdir()
    (run / "experiment.yaml").write_bytes(undisturbed.folder.experiment.read_bytes())
    results = undisturbed.results | {"status": "interrupted", "trials": undisturbed.results["trials"][:1]}
    results["progress"] = {"stage": 2, "trials": 0, "t_ns": 0}
    (run / "results.json").write_text(json.dumps(results))
    with pytest.raises(InputError, match=r"robbed/plans/press\.npz"):
        gone_on_with(run)
    assert json.loads((run / "results.json").read_text()) == results
    assert not list(run.glob("log*"))


def test_what_is_no_run_cannot_be_resumed(tmp_path):
    with pytest.raises(InputError, match="no run folder"):
        gone_on_with(tmp_path)


@pytest.mark.parametrize("half", ["", '{"schema": 1, "status": "run'])
def test_a_run_whose_results_were_not_written_begins_anew_in_its_folder(here, undisturbed, half):
    """Killed before its first results: an experiment and a log lie there."""
    run = Path(f"half-{len(half)}")
    run.mkdir()
    (run / "experiment.yaml").write_bytes(undisturbed.folder.experiment.read_bytes())
    (run / "log.mcap").write_bytes(b"")
    (run / "results.json").write_text(half)
    done = Path("undisturbed/plans/press.npz").read_bytes()
    (run / "plans").mkdir()
    (run / "plans" / "press.npz").write_bytes(done[: len(done) // 2] if half else done)
    if half:  # one of them to its end, and the others to where a run has begun
        outcome = gone_on_with(run)
        assert figures(outcome.results) == figures(undisturbed.results)
    else:
        killed(str(run), "calibration")
    assert (run / "log.mcap").read_bytes() == b""
    assert (run / "log.1.mcap").stat().st_size > 0
    assert (Path(run) / "plans" / "press.npz").read_bytes()[:2] == b"PK"


def test_a_station_that_dies_ends_the_run_in_order_and_the_run_goes_on_from_there(here, undisturbed, monkeypatch):
    """The host's process is killed in contact, in the third trial."""
    from drivers.hosting import HostProcess
    from experiments.context import RunContext
    from mechanics.records import PhaseRecord

    write, seen = RunContext.write, 0

    def kills(context, record):
        nonlocal seen
        write(context, record)
        seen += isinstance(record, PhaseRecord) and record.phase == "preload"
        if seen == 3 and isinstance(record, PhaseRecord):
            os.kill(context.opened.host.pid, signal.SIGKILL)

    with monkeypatch.context() as patched:
        patched.setattr(RunContext, "write", kills)
        outcome = runner.run(load("short.yaml"), Path("orphan"), Console(quiet=True), HostProcess)
    assert outcome.exit_code is ExitCode.DEVICE_FAILED
    assert outcome.results["status"] == "device_failed"
    assert names(outcome.results) == names(undisturbed.results)[:3]
    assert outcome.results["trials"][-1]["status"] == "device_failed"
    reader = LogReader("orphan/log.mcap")
    assert sum(1 for _ in reader.messages()) > 0 and reader.complete
    outcome = gone_on_with("orphan")
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    assert figures(outcome.results) == figures(undisturbed.results)
    assert outcome.results["resumed"][0]["finished_trials"] == 2
