"""A run beside sensors that are not well: it waits for them at its checkpoints, or ends, as the YAML says."""

from __future__ import annotations

import json

import pytest

from drivers.wire.log_reader import LogReader

QUICK = ("--set", "stages.0.parameters.steps=3", "--set", "stages.1.controllers=[open_loop]")


def faults(*found: dict) -> tuple[str, str]:
    return "--set", f"world.faults={json.dumps(found)}"


def events(finished) -> list[str]:
    return [json.loads(line)["text"] for line in (finished.folder / "events.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("after", [0.9, 3.0, 4.0])  # twice in the midst of a motion, which has to end meanwhile
def test_a_trial_that_a_sensor_cut_off_is_run_again_once_the_sensor_is_back(command, after):
    silence = faults({"kind": "freeze", "device": "wrist_ft", "after": after, "duration": 3.0})
    finished = command.run("grasped_static", *QUICK, *silence)
    assert finished.code == 0, finished.out + finished.err
    assert [trial["status"] for trial in finished.results["trials"]] == ["completed"]
    told = events(finished)
    assert any("device_failed: wrist_ft: watch over the arm" in text for text in told)
    assert any("the trial is run again" in text for text in told)


def test_a_trial_is_run_again_though_nobody_sees_what_its_sensor_had(command):
    # a camera has no stream in lockstep, where it is asked for its pictures
    blip = faults({"kind": "freeze", "device": "camera", "after": 4.0, "duration": 2.0})
    finished = command.run("grasped_static", *QUICK, *blip)
    assert finished.code == 0, finished.out + finished.err
    assert [trial["status"] for trial in finished.results["trials"]] == ["completed"]
    assert any("camera is well again: the trial is run again" in text for text in events(finished))


@pytest.mark.parametrize(
    ("kind", "said"), [("freeze", "no reading for"), ("disconnect", "the device's server has died")]
)
def test_a_run_waits_at_a_checkpoint_and_goes_on(command, kind, said):
    # no trial asks the gripper for anything; one whose server has died is opened again
    fault = faults({"kind": kind, "device": "gripper", "after": 2.0, "duration": 20.0})
    finished = command.run("grasped_static", *QUICK, *fault, "--set", "stages.1.trials=2")
    assert finished.code == 0, finished.out + finished.err
    assert [trial["status"] for trial in finished.results["trials"]] == ["completed"] * 2
    told = events(finished)
    assert any(text.startswith(f"paused, for 30 s at most: gripper: {said}") for text in told)
    assert any(text.startswith("goes on after") for text in told)
    heard = [message.publish_ns for message in LogReader(finished.folder / "log.mcap").messages({"sim/gripper/state"})]
    assert max(heard) - min(heard) > 20e9, "what it says after that is in the log, too"


@pytest.mark.parametrize("device", ["arm", "gripper"])
def test_an_arm_that_vanished_is_not_waited_for_and_a_sensor_no_longer_than_the_limit(command, device):
    gone = faults({"kind": "disconnect", "device": device, "after": 2.0})
    sets = ("--set", "stages.1.trials=2", "--set", "health.limit=3")
    finished = command.run("grasped_static", *QUICK, *gone, *sets)
    assert finished.code == 3, finished.out + finished.err
    assert device in finished.results["reason"]


@pytest.mark.parametrize(("how", "code"), [("pause", 3), ("warn", 0)])
def test_what_does_not_come_back_ends_the_run_or_is_a_warning(command, how, code):
    silence = faults({"kind": "freeze", "device": "gripper", "after": 2.0})
    sets = ("--set", "stages.1.trials=2", "--set", f"health.on_fault={how}", "--set", "health.limit=3")
    finished = command.run("grasped_static", *QUICK, *silence, *sets)
    assert finished.code == code, finished.out + finished.err
    if how == "pause":
        assert "gripper: be well at a checkpoint" in finished.results["reason"]
        assert "--resume" in finished.results["reason"]
        assert len(finished.results["trials"]) == 1
    else:
        assert any(text.startswith("not well: gripper") for text in events(finished))
        assert len(finished.results["trials"]) == 2


def test_a_rehearsal_takes_the_place_of_the_trials_and_of_what_touches_things(command):
    finished = command.run("extrinsic_pivoting", "--rehearse", "--speed", "0.5")
    assert finished.code == 0, finished.out + finished.err
    assert finished.results["trials"] == []
    [row] = finished.results["rehearsals"]
    assert row["status"] == "completed"
    assert row["lift"] > 0.1  # above the pentagon, and more
    assert "tip-rehearsal" in finished.out


def test_a_rehearsal_ends_with_a_failed_device_and_runs_no_later_stage(command):
    bump = faults({"kind": "bias", "device": "wrist_ft", "after": 4.0, "value": 5.0})
    finished = command.run("grasped_static", "--rehearse", *bump)
    assert finished.code == 3, finished.out + finished.err
    assert finished.results["rehearsals"][0]["status"] == "device_failed"


def test_a_stop_from_another_shell_ends_the_run_with_4_and_keeps_its_data(command):
    run = command.start_run("grasped_static", *QUICK, "--set", "stages.1.trials=30")
    at = ("--set", f"bus.endpoint={command.endpoint}")
    assert any("open_loop 2" in line for line in run.stderr), "the second trial has begun"
    stopped = command.finish(command.start("stop", "sim", *at))
    assert stopped.code == 0, stopped.err
    assert "arm is stopped: `extrinsic stop` by " in stopped.out
    finished = command.finish(run)
    assert finished.code == 4, finished.out + finished.err
    assert "`extrinsic stop` by" in finished.results["reason"]
    assert finished.results["trials"][0]["status"] == "completed"
    assert finished.results["trials"][-1]["status"] == "stopped"


def test_recovering_a_station_that_is_not_there_says_so(command):
    finished = command.finish(command.start("recover", "sim", "--set", f"bus.endpoint={command.endpoint}"))
    assert finished.code == 3
    assert command.endpoint in finished.err
