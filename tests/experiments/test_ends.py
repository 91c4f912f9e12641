"""However a run ends, the arm is held, the log is closed and readable, and the exit code says how."""

import os
import re
import signal
import time

import pytest
from mcap.reader import make_reader

from drivers.station import Station
from experiments.files import load_station


def wait_for_line(process, part, timeout=60):
    """Read the run's standard error until a line has ``part``: the event to act on."""
    deadline = time.monotonic() + timeout
    lines = []
    while time.monotonic() < deadline:
        line = process.stderr.readline()
        lines.append(line)
        if part in line:
            return
        if not line and process.poll() is not None:
            break
    raise AssertionError(f"never said {part!r}: {''.join(lines)}")


def topics_of(path):
    with path.open("rb") as file:
        reader = make_reader(file)
        return {channel.topic for _, channel, _ in reader.iter_messages()}


@pytest.mark.parametrize("moment", ["plan", "open the station", "open_loop", "closed_loop"])
def test_ctrl_c_closes_in_order(command, moment):
    process = command.start_run("grasped_static")
    wait_for_line(process, moment)
    process.send_signal(signal.SIGINT)
    finished = command.finish(process)
    assert finished.code == 130
    assert finished.results["status"] == "interrupted"
    topics = topics_of(finished.folder / "log.mcap")
    assert "run/event" in topics
    assert (finished.folder / "report.html").exists()


def test_ctrl_c_leaves_the_arm_held_and_free_for_the_next(command):
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    wait_for_line(host, "serving")
    process = command.start_run("grasped_static")
    wait_for_line(process, "open_loop")
    process.send_signal(signal.SIGINT)
    assert command.finish(process).code == 130
    with Station(load_station("sim", [f"bus.endpoint={command.endpoint}"])).connect() as devices:
        devices.clock.sleep(0.1)
        before = devices.arm.latest()
        devices.clock.sleep(0.5)
        after = devices.arm.latest()
        assert after.stamp.capture_ns > before.stamp.capture_ns
        assert after.pose == pytest.approx(before.pose, abs=0)
        devices.arm.acquire("next")
        devices.arm.release()


def test_a_second_ctrl_c_does_not_cut_the_closing_short(command):
    process = command.start_run("grasped_static")
    wait_for_line(process, "open_loop")
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    finished = command.finish(process)
    assert finished.code == 130
    assert topics_of(finished.folder / "log.mcap")


def test_a_host_that_dies_ends_the_run_within_two_seconds(command):
    host = command.start("serve", "sim", "--set", f"bus.endpoint={command.endpoint}")
    wait_for_line(host, "serving")
    process = command.start_run("grasped_static")
    wait_for_line(process, "open_loop")
    died = time.monotonic()
    os.kill(host.pid, signal.SIGKILL)
    wait_for_line(process, "error:")
    noticed = time.monotonic() - died
    finished = command.finish(process)
    assert noticed < 2.0
    assert finished.code == 3
    assert finished.results["status"] == "device_failed"
    [named] = re.findall(r"device_failed: (\w+): .*has died", finished.err)
    assert named in ("arm", "gripper", "wrist_ft", "table_ft", "world", "camera")
    assert topics_of(finished.folder / "log.mcap")
    assert finished.results["trials"][0]["status"] == "device_failed"


def test_an_infeasible_plan_ends_with_its_own_code(command):
    finished = command.run(
        "grasped_static", "--set", "friction={go-ground: 0.1}", "--set", "stages.0.parameters.tangential=[1, 1]"
    )
    assert finished.code == 5
    assert "µ" in finished.err
    assert finished.results["status"] == "infeasible"
