"""A run that was killed is mended from what it left: every log opens, results.json and the report say how it ended."""

import json
import random
import shutil
import signal
import subprocess
from contextlib import suppress
from datetime import datetime, timedelta

import pytest
from mcap.reader import SeekingReader

from drivers.errors import DeviceFault
from drivers.wire.log import LogWriter
from drivers.wire.log_reader import LogReader
from experiments.repair import repair
from experiments.report.collect import collect
from experiments.report.logged import read_logs
from experiments.run_folder import RunFolder
from experiments.run_lock import RunLock
from mechanics.records import TrialRecord
from mechanics.yaml_input import InputError

ONE = ("--set", "stages.1.controllers=[open_loop]", "--set", "stages.1.trials=2")
MANY = (*ONE[:-1], "stages.1.trials=12")
#: of a row, what only the run itself knew
OWN = {"go_pose", "law", "witness", "finger_slip", "deviation", "rebuilt"}


@pytest.fixture(scope="module")
def finished(shared_command):
    """A run that nothing disturbed."""
    done = shared_command.run("grasped_static", *ONE)
    assert done.code == 0, done.err
    return done


def without(row, keys):
    return {key: value for key, value in row.items() if key not in keys}


def contents(folder):
    files = (path for path in folder.path.rglob("*") if path.is_file() and path.name != ".lock")
    return {path.name: path.read_bytes() for path in files}


def running(folder, trials):
    """Leave results.json as it lies there while the run still goes on."""
    results = json.loads(folder.results.read_text())
    for key in ("log", "health", "finished"):
        results.pop(key, None)
    results.update(status="running", trials=results["trials"][:trials])
    folder.results.write_text(json.dumps(results))


def position_of(folder, topic, number):
    """Where the chunk begins that has the message of a topic with this number; everything before it is whole."""
    with folder.log.open("rb") as file:
        reader = SeekingReader(file)
        summary = reader.get_summary()
        assert summary is not None
        times = [m.log_time for _, _, m in reader.iter_messages([topic])]
        return next(c.chunk_start_offset for c in summary.chunk_indexes if c.message_end_time >= times[number])


def test_a_healthy_run_is_left_as_it_is(run):
    before = contents(run)
    repaired = repair(run.path)
    assert repaired.healthy
    assert "nothing to mend" in repaired.lines()[0]
    assert contents(run) == before


def test_the_rows_made_from_the_log_are_those_that_the_run_wrote(run, finished):
    run.results.unlink()
    repaired = repair(run.path)
    assert len(repaired.rebuilt) == 2
    rebuilt, original = json.loads(run.results.read_text()), finished.results
    known = [without(row, OWN) for row in original["trials"]]
    assert [without(row, OWN) for row in rebuilt["trials"]] == known
    for key in ("schema", "experiment", "station", "profile", "seed", "started", "provenance"):
        assert rebuilt[key] == original[key], key
    how = {"optimiser", "backend", "form", "believed", "time_s"}
    assert [without(row, how) for row in rebuilt["plans"]] == [without(row, how) for row in original["plans"]]
    assert rebuilt["status"] == "interrupted"
    assert "cut off" in rebuilt["reason"]


def test_a_log_of_before_tells_when_its_run_began_to_the_second(run, finished, monkeypatch):
    monkeypatch.setattr("experiments.repair.BEGUN", "no log carries this")
    run.results.unlink()
    repair(run.path)
    rebuilt = json.loads(run.results.read_text())
    began, told = (datetime.fromisoformat(results["started"]) for results in (finished.results, rebuilt))
    assert (
        timedelta(0) <= told - began < timedelta(seconds=60)
    )  # the log was begun after the run, and before its trials
    assert rebuilt["provenance"] is None


def test_a_torn_log_is_mended_and_the_report_reads_it(run, finished):
    run.log.write_bytes(run.log.read_bytes()[:-30])
    running(run, trials=1)
    run.report.unlink()
    repaired = repair(run.path)
    results = json.loads(run.results.read_text())
    assert results["status"] == "interrupted"
    assert results["trials"][0] == finished.results["trials"][0]  # what the run had written stays as it was
    assert [row["name"] for row in results["trials"]] == [row["name"] for row in finished.results["trials"]]
    assert repaired.rebuilt == (finished.results["trials"][1]["name"],)
    assert run.logs() == [run.path / "log.repaired.mcap"]
    data = collect(run)
    assert [trial["status"] for trial in data["trials"]] == ["completed", "completed"]
    assert data["log"]["file"] == "log.repaired.mcap"
    assert "mended" in data["log"]["ending"]
    assert "mended" in run.report.read_text()
    told = "\n".join(repaired.lines())
    assert "at most 0.5 s" in told
    assert f"{sum(LogReader(run.log).counts().values())} messages" in told


def test_to_repair_twice_changes_nothing(run):
    run.log.write_bytes(run.log.read_bytes()[:-30])
    running(run, trials=1)
    repair(run.path)
    before = contents(run)
    again = repair(run.path)
    assert contents(run) == before
    assert again.done_before
    assert "mended before" in again.lines()[-1]


def test_a_trial_that_was_cut_off_has_no_row_and_is_named(run, finished):
    content = run.log.read_bytes()
    run.log.write_bytes(content[: position_of(run, "run/trial", 3)])  # its end is missing
    running(run, trials=1)
    repaired = repair(run.path)
    results = json.loads(run.results.read_text())
    last = finished.results["trials"][1]["name"]
    assert [row["name"] for row in results["trials"]] == [finished.results["trials"][0]["name"]]
    assert repaired.cut_off == (last,)
    assert last in results["reason"]
    assert f"{last} was cut off" in "\n".join(repaired.lines())


def test_of_a_run_that_went_on_every_log_is_read_in_its_order_and_no_trial_stands_twice(run, finished):
    content = run.log.read_bytes()
    shutil.copy(run.log, run.path / "log.1.mcap")
    run.log.write_bytes(content[: position_of(run, "run/trial", 1)])
    repair(run.path)
    assert [log.name for log in run.logs()] == ["log.repaired.mcap", "log.1.mcap"]
    assert [trial["name"] for trial in collect(run)["trials"]] == [row["name"] for row in finished.results["trials"]]


def test_of_a_trial_that_was_run_again_in_one_log_the_last_attempt_counts(run, finished):
    """As where a sensor cut the first off: what the run itself keeps is the second."""
    name = finished.results["trials"][0]["name"]
    with LogWriter(run.path / "log.1.mcap") as log:
        for t_ns, status in ((0, ""), (5, "device_failed"), (10, "")):
            log.write_record(TrialRecord(t_ns, name, "grasped_static", "open_loop", status=status))
        log.write_record(TrialRecord(15, name, "grasped_static", "open_loop", status="completed"))
    (run.path / "log.mcap").unlink()
    trials = [(trial.begin.capture_ns, trial.end and trial.end.status) for trial in read_logs(run, 25.0).trials]
    assert trials == [(10, "completed")]


def test_a_run_whose_results_were_lost_is_repaired_and_goes_on_to_its_end(run, finished, shared_command):
    run.results.write_text("{")
    log = run.path / "log.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.6)])
    repair(run.path)
    assert json.loads(run.results.read_text())["timing"]["execute_wall_s"] is None
    gone_on = shared_command.finish(shared_command.start("run", "--resume", str(run.path)))
    assert gone_on.code == 0, gone_on.err
    ended = json.loads(run.results.read_text())
    assert ended["status"] == "completed"
    assert [trial["name"] for trial in ended["trials"]] == [trial["name"] for trial in finished.results["trials"]]


def test_logs_are_counted_not_spelt(tmp_path):
    for name in ("log.10.mcap", "log.2.mcap", "log.mcap", "log.2.repaired.mcap", "log.x.mcap", "catalog.mcap"):
        (tmp_path / name).touch()
    folder = RunFolder(tmp_path)
    assert [log.name for log in folder.logs()] == ["log.mcap", "log.2.repaired.mcap", "log.10.mcap"]
    assert [log.name for log in folder.written_logs()] == ["log.mcap", "log.2.mcap", "log.10.mcap"]


def test_a_missing_experiment_is_taken_from_the_log(run):
    before = run.experiment.read_bytes()
    run.experiment.unlink()
    repair(run.path)
    assert run.experiment.read_bytes() == before


def test_results_that_nobody_can_read_are_kept_aside(run):
    run.results.write_text('{"status": "comp')
    repair(run.path)
    assert (run.path / "results.damaged.json").read_text() == '{"status": "comp'
    assert len(json.loads(run.results.read_text())["trials"]) == 2


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n"])
def test_a_run_killed_before_anything_was_logged_has_results_and_a_report(run, content):
    run.log.write_bytes(content)
    running(run, trials=0)
    repair(run.path)
    results = json.loads(run.results.read_text())
    assert (results["status"], results["trials"]) == ("interrupted", [])
    assert run.report.is_file()


def test_a_run_that_still_goes_on_is_not_touched(run):
    run.log.write_bytes(run.log.read_bytes()[:-30])
    running(run, trials=1)
    before = contents(run)
    with RunLock(run.path), pytest.raises(InputError, match="still runs"):
        repair(run.path)
    assert contents(run) == before


def test_what_is_no_run_folder_is_said(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match="no run folder"):
            repair(path)
    assert not list(tmp_path.iterdir())


def test_another_file_in_the_mended_log_s_place_is_not_overwritten(run):
    run.log.write_bytes(run.log.read_bytes()[:-30])
    (run.path / "log.repaired.mcap").write_bytes(b"precious")
    results = run.results.read_bytes()
    with pytest.raises(DeviceFault, match="is another"):
        repair(run.path)
    assert (run.path / "log.repaired.mcap").read_bytes() == b"precious"
    assert run.results.read_bytes() == results


def test_a_run_killed_at_any_moment_is_mended(command, finished):
    """By SIGKILL, some time between its first trial's begin and its last one's end."""
    process = command.start_run("grasped_static", *MANY, out="killed")
    folder = RunFolder(command.folder / "killed")
    assert any("open_loop 1" in line for line in process.stderr), "its first trial has begun"
    with suppress(subprocess.TimeoutExpired):  # some time later
        process.wait(random.uniform(0.0, 1.0))
    process.send_signal(signal.SIGKILL)
    assert process.wait(10) == -signal.SIGKILL
    repaired = repair(folder.path)
    results = json.loads(folder.results.read_text())
    assert results["status"] == "interrupted"
    [log] = folder.logs()
    with log.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        kept = [message.data for _, _, message in reader.iter_messages(log_time_order=False)]
    assert kept == [message.payload for message in LogReader(folder.log).messages()]
    told = [value for _, value in LogReader(log).values(["run/trial"])]
    ends = {value.trial for value in told if isinstance(value, TrialRecord) and value.status}
    assert ends <= {row["name"] for row in results["trials"]}
    undisturbed = {row["name"]: row for row in finished.results["trials"]}
    for row in results["trials"]:  # lockstep: a trial is the same, whatever becomes of the run
        if row["name"] in undisturbed:
            assert without(row, OWN) == without(undisturbed[row["name"]], OWN)
    assert folder.report.is_file()
    assert not repaired.healthy
