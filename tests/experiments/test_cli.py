"""The command's own behaviour: help, status, what it refuses, how it ends."""

import signal

import pytest

COMMANDS = ("run", "check", "serve", "status", "report", "replay")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(command, name):
    finished = command.finish(command.start(name, "--help"))
    assert finished.code == 0
    assert f"Example: extrinsic {name} " in finished.out


def test_status_of_a_station_that_is_not_running_says_where_it_looked(command):
    finished = command.finish(command.start("status", "sim", "--set", f"bus.endpoint={command.endpoint}"))
    assert finished.code == 3
    assert finished.out.count(f"nothing listens at {command.endpoint}") == 7


def test_status_shows_every_device_alive_with_its_rate_in_real_time(command):
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}", "--set", "world.clock=realtime")
    assert "serving" in host.stderr.readline()
    finished = command.finish(command.start("status", "sim", "--set", f"bus.endpoint={command.endpoint}"))
    assert finished.code == 0, finished.out + finished.err
    for device in ("arm", "gripper", "wrist_ft", "table_ft", "camera", "finger_left", "finger_right"):
        [row] = [line for line in finished.out.splitlines() if line.strip().startswith(device)]
        assert " yes " in row
    host.send_signal(signal.SIGINT)
    assert command.finish(host).code == 0


def test_serving_on_a_taken_port_is_refused_with_a_reason(command):
    first = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    assert "serving" in first.stderr.readline()
    second = command.finish(command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}"))
    assert second.code == 3
    assert command.endpoint.split("/")[1] in second.err


def test_a_second_run_cannot_take_a_station_that_is_in_use(command):
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    assert "serving" in host.stderr.readline()
    first = command.start_run("grasped_static", out="first")
    while "open_loop" not in first.stderr.readline():
        assert first.poll() is None
    second = command.run("grasped_static", out="second")
    assert second.code == 3
    assert "commands arm" in second.err
    assert command.finish(first, "first").code == 0  # undisturbed


def test_an_existing_run_is_never_overwritten(command):
    (command.folder / "run").mkdir()
    (command.folder / "run" / "thing").write_text("mine")
    finished = command.run("grasped_static")
    assert finished.code == 2
    assert "new or an empty folder" in finished.err
    assert (command.folder / "run" / "thing").read_text() == "mine"


def test_a_folder_that_is_no_run_has_no_report(command):
    finished = command.finish(command.start("report", "."))
    assert finished.code == 2
    assert "experiment.yaml" in finished.err


def test_ctrl_c_before_anything_started_ends_with_130_and_leaves_nothing(command):
    process = command.start_run("grasped_static")
    process.send_signal(signal.SIGINT)  # within the first milliseconds, while Python still starts
    finished = command.finish(process)
    assert finished.code in (130, -signal.SIGINT)  # before our first line runs it is the interpreter's own end
    assert not (command.folder / "run" / "report.html").exists()
