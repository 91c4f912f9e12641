"""The whole way of a table with an engine that makes its trials up: order, calibrations, files, exit codes."""

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from drivers.errors import DeviceFault
from experiments.exit_codes import ExitCode
from experiments.table import jobs
from experiments.table.jobs import Options
from experiments.table.run import main
from mechanics.yaml_input import InputError
from tests.experiments.table.table_cases import SMALL


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def result(out):
    return json.loads((out / "table.json").read_text())


def test_calibrations_run_first_and_each_run_believes_its_own(made, small, out):
    assert main(str(small), Options(), made.engine(), out) == ExitCode.DONE
    runs = ["static-a-0", "static-a-1", "slow-a-0", "slow-a-1", "slow-b-2", "slow-b-3"]
    expected = [("calibration-0", ["calibration-hand"]), ("calibration-1", ["calibration-rough"]), ("runs-0", runs)]
    assert made.order == expected
    sources = {id: resolved.experiment.calibration.source for id, resolved in made.resolved.items()}
    shelf = out / "calibrations"
    assert sources["calibration-hand"] == str(shelf / "none") and not list((shelf / "none").iterdir())
    assert sources["calibration-rough"] == str(shelf / "hand")
    assert sources["static-a-0"] == str(shelf / "rough")
    assert sources["slow-a-0"] == str(shelf / "none")  # it names none
    assert {job.home for _, campaign in made.campaigns for job in campaign} == {out}  # a table may be moved
    assert "found-by-calibration-rough.yaml" in {file.name for file in (shelf / "rough").iterdir()}


def test_figures_stand_beside_the_papers(made, small, out, capsys):
    main(str(small), Options(seed=4), made.engine(), out)
    found = result(out)
    cells = {
        (row["tags"]["controller"], c["where"]["run"], c["figure"]): c
        for row in found["panels"][0]["rows"]
        for c in row["cells"]
    }
    static = cells["closed_loop", "static", "wrench_N"]
    assert static["measured"]["mean"] == pytest.approx(0.405) and static["measured"]["n"] == 2  # trials 0 and 1
    assert static["paper"] == {"mean": 0.45, "std": 0.18}
    assert (found["seed"], found["part"], found["shortfalls"]) == (4, False, [])
    findings = {one["name"]: one for one in found["findings"]}
    assert findings["done"]["told"] == "12 of 12"
    assert findings["below"]["told"].startswith("2 of 4")
    assert findings["closed − open, slow"]["value"] == pytest.approx(-0.6)
    printed = capsys.readouterr().out
    assert "0.41 ±0.10" in printed and "0.45 ±0.18" in printed and "12 of 12" in printed
    assert "| **closed_loop** | trials | 2 of 2 |" in (out / "table.md").read_text()


def test_trials_are_kept_with_their_tags(made, small, out):
    main(str(small), Options(), made.engine(), out)
    kept = pd.read_parquet(out / "trials.parquet")
    assert len(kept) == 12
    assert set(kept["skill"]) == {"static"} and set(kept["run"]) == {"static", "slow"}


def test_nothing_is_wider_than_100_columns_in_a_file(made, small, out, capsys):
    main(str(small), Options(), made.engine(), out)
    assert max(map(len, capsys.readouterr().out.splitlines()[:-1])) <= 100


def test_a_trial_that_stopped_the_arm_leaves_their_turn_to_the_other_controllers(made, small, out):
    made.ends["static-a-1"] = "stopped"
    main(str(small), Options(runs=("static",)), made.engine(), out)
    assert made.order[-1] == ("runs-0-again", ["static-a-1-closed_loop"])
    findings = {one["name"]: one for one in result(out)["findings"]}
    assert findings["done"]["told"] == "3 of 4"
    assert [(t["controller"], t["status"]) for t in result(out)["incomplete"]] == [("open_loop", "stopped")]


def test_a_calibration_without_an_answer_ends_the_table(made, small, out, capsys):
    made.ends["calibration-rough"] = "fell_short"
    assert main(str(small), Options(), made.engine(), out) == ExitCode.FELL_SHORT
    assert made.order[-1][0] == "calibration-1"
    assert "calibration rough: fell_short: why" in capsys.readouterr().err


def test_calibrations_are_taken_whole_or_not_at_all(made, small, out, monkeypatch):
    """Cut off in the midst of copying them, a table goes on with all of them."""
    files = []

    def cut_off(source, target):
        files.append(source.name)
        if len(files) == 2:
            raise KeyboardInterrupt
        return target and copy(source, target)

    copy = shutil.copy2
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copy2", cut_off)
        with pytest.raises(KeyboardInterrupt):
            main(str(small), Options(), made.engine(), out)
    assert len(files) == 2
    assert main(str(small), Options(), made.engine(), out) == ExitCode.DONE
    found = {file.name for file in (out / "calibrations" / "hand").iterdir()}
    assert found == {file.name for file in (out / "calibration-0/jobs/calibration-hand/calibrations").iterdir()}


def test_a_calibration_that_leaves_no_file_ends_the_table(made, small, out, capsys):
    made.finds_nothing = True
    assert main(str(small), Options(), made.engine(), out) == ExitCode.FELL_SHORT
    assert made.order[-1][0] == "calibration-0"
    assert "calibration hand: fell_short: it has left no calibration file" in capsys.readouterr().err


def test_a_folder_that_holds_something_else_is_refused_and_left_as_it_is(made, small, out):
    out.mkdir()
    (out / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="something there already, and no table"):
        main(str(small), Options(), made.engine(), out)
    assert [file.name for file in out.iterdir()] == ["mine.txt"] and not made.campaigns


def test_a_folder_of_another_seed_is_refused_and_of_the_same_goes_on(made, small, out):
    main(str(small), Options(runs=("static",), trials=1), made.engine(), out)
    with pytest.raises(InputError, match="another table was begun there"):
        main(str(small), Options(1, runs=("static",), trials=1), made.engine(), out)
    assert main(str(small), Options(runs=("static",), trials=1), made.engine(), out) == ExitCode.DONE
    assert result(out)["part"] is True


def test_a_device_that_failed_for_good_is_exit_code_3(made, small, out):
    made.ends["slow-b-3"] = "failed"
    assert main(str(small), Options(), made.engine(), out) == ExitCode.DEVICE_FAILED


def test_a_scheduler_that_does_not_answer_leaves_nothing_behind(made, small, out, monkeypatch):
    monkeypatch.setattr("experiments.campaign.engine.PATIENCE", 0.5)
    with pytest.raises(InputError, match="nothing answers there"):
        main(str(small), Options(), replace(made.engine(), scheduler="tcp://127.0.0.1:9"), out)
    assert not out.exists()


def test_a_trial_that_the_tables_counts_ask_for_makes_exit_code_1(made, small, out, capsys):
    made.status["static-a-1"] = "slipped"
    assert main(str(small), Options(), made.engine(), out) == ExitCode.FELL_SHORT
    assert "2 of 12 trials were not completed; 2 of them had to be" in capsys.readouterr().err


@pytest.mark.parametrize(("status", "code"), [("lost_contact", ExitCode.DONE), ("infeasible", ExitCode.FELL_SHORT)])
def test_a_deviation_that_no_count_asks_about_is_a_result_and_what_was_not_run_is_none(
    made, small, out, capsys, status, code
):
    small.write_text(SMALL.replace("  - {name: done, of: trials completed}\n", ""))
    made.status["static-a-1"] = status
    assert main(str(small), Options(), made.engine(), out) == code
    said = capsys.readouterr().err
    assert "2 of 12 trials were not completed" in said
    assert ("no count of the table asks for" in said) == (code is ExitCode.DONE)


def test_a_file_that_cannot_be_written_is_refused_before_the_start(made, small, out):
    with pytest.raises(InputError, match=r"/proc/nope/x\.json: --json: cannot be written"):
        main(str(small), Options(), made.engine(), out, Path("/proc/nope/x.json"))
    assert not out.exists() and not made.campaigns


def test_a_table_that_cannot_be_kept_is_shown_and_says_where_its_trials_are(made, small, out, monkeypatch, capsys):
    def full(path, data):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("experiments.table.run.write_json", full)
    with pytest.raises(DeviceFault, match=rf"No space left on device.*in {out}"):
        main(str(small), Options(), made.engine(), out)
    assert "12 of 12" in capsys.readouterr().out


def test_saved_plans_are_executed_again_with_the_stiffness_of_other_fingers(made, small, out):
    entry = "{name: stiff, experiment: grasped_static, station: sim_gelslim, plans_of: static, set: {sensor: gelslim}}"
    small.write_text(SMALL.replace("paper:\n", f"  - {entry}\npaper:\n"))
    main(str(small), Options(runs=("stiff",)), made.engine(), out)
    assert [name for name, _ in made.order[2:]] == ["runs-0", "runs-1"]
    (stage,) = made.resolved["stiff-a-0"].experiment.stages
    assert stage.restiffen and stage.plan == str(out / "runs-0" / "jobs" / "static-a-1" / "run" / "plans" / "press.npz")
    assert len(pd.read_parquet(out / "plans.parquet")) == 2


@pytest.mark.parametrize(("least", "code"), [(2, ExitCode.DONE), (3, ExitCode.FELL_SHORT)])
def test_with_check_a_target_that_is_missed_is_a_line_and_exit_code_1(
    made, small, out, monkeypatch, tmp_path, capsys, least, code
):
    targets = tmp_path / "targets.yaml"
    wanted = {"below": {"at_least": least, "source": "because"}}
    targets.write_text(json.dumps({"sim": {}, "estimation": {}, "planning": {}, "tables": {"small": wanted}}))
    monkeypatch.setattr("experiments.table.run.TARGETS", targets)
    assert main(str(small), Options(), made.engine(), out, check=True) == code
    assert ("short: below: 2 of 4" in capsys.readouterr().err) == (code is ExitCode.FELL_SHORT)
    assert main(str(small), Options(), made.engine(), out.with_name("other")) == ExitCode.DONE  # unless asked


def test_every_target_of_a_shipped_table_is_something_that_the_table_finds():
    """By name; what is judged once for each run or sensor has it behind the comma."""
    from experiments.bench.figures import TARGETS, Targets
    from mechanics.yaml_input import parse, read_yaml

    for name, targets in parse(Targets, read_yaml(TARGETS)).tables.items():
        table = jobs.load_table(name)[0]
        values = {*(run.name for run in table.runs), "soft_bubble", "gelslim"}
        known = {one.name for one in (*table.counts, *table.figures)}
        known |= {
            ", ".join([one.name, *([value] if one.each else [])]) for one in table.comparisons for value in values
        }
        assert set(targets) <= known
