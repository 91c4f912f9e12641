"""A recorded run, estimated again from its log: what was estimated then is what is estimated now."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from drivers.wire.log import LogWriter
from drivers.wire.log_reader import LogReader
from experiments import replay, setup
from experiments.exit_codes import ExitCode
from experiments.run_folder import RunFolder
from mechanics.yaml_input import InputError

#: a short run whose controller feels with the fingers, in a lab that is none too good
FELT = (
    "--set",
    "trial.go_pose=tactile",
    "--set",
    "stages.0.parameters.steps=2",
    "--set",
    "stages.1.controllers=[closed_loop]",
    "--set",
    "world.profile=lab",
)
#: a crowded machine sends set-points late and close together: that is not what is looked at here
LATE = [
    f"devices.arm.limits.{name}=1e6" for name in ("speed", "acceleration", "turn_speed_deg", "turn_acceleration_deg")
]


@pytest.fixture(scope="module")
def felt(shared_command):
    finished = shared_command.run("grasped_static", *FELT, out="felt")
    assert finished.results["status"] == "completed", finished.err
    return finished


@pytest.fixture
def copied(felt, tmp_path: Path) -> RunFolder:
    """The run, to be spoiled."""
    return RunFolder(Path(shutil.copytree(felt.folder, tmp_path / "run")))


def test_a_run_in_lockstep_is_estimated_again_to_the_last_bit(felt, shared_command) -> None:
    out = felt.folder.parent / "again.json"
    finished = shared_command.finish(shared_command.start("replay", str(felt.folder), "--check", "--json", str(out)))
    assert finished.code == 0, finished.err
    assert "2 waypoints estimated again, 0 differ" in finished.out
    told = json.loads(out.read_text())
    assert told["same"] and set(told["largest"].values()) == {0.0}
    for waypoint in told["waypoints"]:
        assert waypoint["recorded"] == waypoint["again"] and not waypoint["reason"]
        # from the fingers and from the tags, which never agree to the last bit; and the corner that it stands on
        assert waypoint["again"]["estimated"]["go"] != waypoint["again"]["measured"]["go"]
        assert waypoint["again"]["contact"]["status"] == "ok"


def test_it_is_the_streams_and_not_the_records_that_are_estimated_from(felt, monkeypatch) -> None:
    believed = setup.believed
    monkeypatch.setattr(
        setup, "believed", lambda *given: replace(known := believed(*given), stiffness=known.stiffness / 2)
    )
    found = replay.estimates(RunFolder(felt.folder))
    assert len(found) == 2 and not any(again.same for again in found)
    apart = replay.largest(found)
    # twice as far in the fingers moves where they feel the object; what is measured asks no stiffness
    assert apart["mm"] > 0.01 and all((again.measured.go == again.recorded.measured.go).all() for again in found)  # type: ignore[union-attr]
    out = io.StringIO()
    assert replay.main(RunFolder(felt.folder), None, True, Console(file=out)) is ExitCode.FELL_SHORT
    assert replay.main(RunFolder(felt.folder), None, False, Console(file=out)) is ExitCode.DONE
    assert "2 differ" in out.getvalue()


def test_a_run_in_real_time_is_estimated_again(shared_command) -> None:
    sets = [word for key in ("world.clock=realtime", "health.on_fault=warn", *LATE) for word in ("--set", key)]
    finished = shared_command.run("grasped_static", "--set", "stages.0.parameters.steps=2", *sets, out="realtime")
    assert finished.results["trials"], finished.err
    found = replay.estimates(RunFolder(finished.folder))
    assert {again.recorded.trial for again in found} <= {trial["name"] for trial in finished.results["trials"]}
    assert len(found) >= 2, finished.err
    assert all(value < 1e-6 for value in replay.largest(found).values())


def test_a_log_whose_end_is_missing_is_estimated_as_far_as_it_goes(copied) -> None:
    whole = replay.estimates(copied)
    content = copied.log.read_bytes()
    copied.log.write_bytes(content[: len(content) - 200])  # without its end
    assert len(replay.estimates(copied)) == len(whole) == 2


def test_an_older_log_which_does_not_say_what_was_looked_at_is_refused(copied) -> None:
    reader = LogReader(copied.log)
    old = copied.path / "old.mcap"
    with LogWriter(old) as log:
        for message in reader.messages():
            if message.topic != "run/look":
                log.write(
                    message.topic,
                    message.type_name,
                    message.payload,
                    sequence=message.sequence,
                    publish_ns=message.publish_ns,
                    log_ns=message.log_ns,
                )
    old.replace(copied.log)
    with pytest.raises(InputError, match="does not say when the run looked at its devices"):
        replay.estimates(copied)


def test_a_trial_that_was_run_again_counts_once(copied) -> None:
    shutil.copy(copied.log, copied.path / "log.1.mcap")  # as a resumed run has it
    found = replay.estimates(copied)
    assert [again.recorded.step for again in found] == [0, 1] and all(again.same for again in found)


def test_what_cannot_be_estimated_again_is_named(copied, shared_command) -> None:
    finished = shared_command.finish(shared_command.start("replay", str(copied.path / "nowhere")))
    assert finished.code == 2 and "no run folder" in finished.err
    copied.log.unlink()
    finished = shared_command.finish(shared_command.start("replay", str(copied.path)))
    assert finished.code == 2 and "there is no log in this folder" in finished.err
