"""The bring-up of a device: what its checklist says of a device that is well, and of one that is not."""

from __future__ import annotations

import json
import shutil
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
from rich.console import Console

from drivers.config import SIMULATED, StationConfig
from drivers.device_host import DeviceHost
from drivers.emulators.netft_box import NetFtBox
from drivers.wire.station_bus import station_bus
from experiments.check_device.checklist import STEPS, check_device, exit_code
from experiments.check_device.findings import Verdict
from experiments.check_device.person import AtTerminal, Nobody
from experiments.exit_codes import ExitCode
from tests.experiments.check_devices import Hand, findings, station
from tests.experiments.check_devices import found as look

RATE = 100.0  # Hz; a crowded machine keeps up with it


def test_every_kind_has_a_checklist():
    assert set(STEPS) == set(SIMULATED)


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        ([Verdict.GOOD, Verdict.SKIPPED], ExitCode.DONE),
        ([Verdict.GOOD, Verdict.SHORT], ExitCode.FELL_SHORT),
        ([Verdict.SHORT, Verdict.FAILED], ExitCode.DEVICE_FAILED),
    ],
)
def test_the_worst_step_makes_the_exit_code(verdicts, code):
    assert exit_code(verdicts) is code


# -- force/torque ------------------------------------------------------------------------------------------------------


class Transducer:
    """What acts on a transducer's tool side, in its own axes, with noise."""

    def __init__(self) -> None:
        self.load = np.zeros(6)
        self._random = np.random.default_rng(0)

    def __call__(self) -> np.ndarray:
        return self.load + self._random.normal(0, 0.01, 6)


@contextmanager
def force_torque(felt, drop: float = 0.0, **more) -> Iterator[StationConfig]:
    with NetFtBox(felt, rate=RATE) as box:
        box.drop = drop
        device = {
            "kind": "force_torque",
            "driver": "ati_netft",
            "mount": "wrist",
            "address": box.address,
            "port": box.port,
            "http_port": box.http_port,
            "rate": RATE,
            "timeout": 5.0,
        }
        yield station("wrist_ft", device | more)


def test_a_sensor_that_is_well_passes_every_step_that_needs_no_hand():
    with force_torque(Transducer()) as config:
        found = findings(config, "wrist_ft")
    assert {name for name, finding in found.items() if finding.verdict is Verdict.SKIPPED} == {"push"}
    assert exit_code([finding.verdict for finding in found.values()]) is ExitCode.DONE, found
    assert "alone, in this process" in found["reach"].measured
    assert "serial FT00042" in found["describe"].measured
    sigma = np.array(list(found["noise"].figures["sigma"].values()))
    np.testing.assert_allclose(sigma, 0.01, rtol=0.4)


# a transducer that hangs with its Z down, half a turn about X from the frame of its readings: its own axes when pushed
HANGING = {"down": (2, 1.0), "to the right": (0, 1.0), "away from the viewer": (1, -1.0)}


def pushing(transducer: Transducer, axes: dict[str, tuple[int, float]]) -> Hand:
    def push(request: str) -> bool:
        for words, (axis, sign) in axes.items():
            if words in request:
                transducer.load = np.zeros(6)
                transducer.load[axis] = 10 * sign
        return True

    return Hand(push)


def test_a_push_down_is_negative_in_z_where_the_axes_are_turned_as_they_hang():
    transducer = Transducer()
    with force_torque(transducer, rotation_deg=(180.0, 0.0, 0.0)) as config:
        found = look("push", config, "wrist_ft", pushing(transducer, HANGING))
    assert found.verdict is Verdict.GOOD, found
    assert "down: -fz" in found.measured
    assert "to the right: +fx" in found.measured
    assert "away from the viewer: +fy" in found.measured


@pytest.mark.parametrize("mirrored", [False, True])
def test_pushes_that_are_felt_along_other_axes_tell_how_the_sensor_is_turned(mirrored):
    transducer = Transducer()
    axes = {words: (axis, -sign if mirrored else sign) for words, (axis, sign) in HANGING.items()}
    with force_torque(transducer) as config:
        found = look("push", config, "wrist_ft", pushing(transducer, axes))
    assert found.verdict is Verdict.SHORT
    [said] = [found.remedy[found.remedy.index("rotation_deg: ") + 14 : found.remedy.index(", reversed")]]
    reversed_too = "reversed: true" in found.remedy
    assert reversed_too is mirrored
    with force_torque(transducer, rotation_deg=tuple(json.loads(said)), reversed=reversed_too) as config:
        transducer.load[:] = 0
        assert look("push", config, "wrist_ft", pushing(transducer, axes)).verdict is Verdict.GOOD


def test_a_push_that_is_not_felt_is_no_direction():
    with force_torque(Transducer()) as config:
        found = look("push", config, "wrist_ft", Hand(lambda _: True))
    assert found.verdict is Verdict.SHORT
    assert "nothing" in found.measured
    assert "harder" in found.remedy


def test_a_saturated_sensor_falls_short():
    transducer = Transducer()
    transducer.load[2] = 1000.0  # of 400 N
    with force_torque(transducer) as config:
        found = look("values", config, "wrist_ft")
    assert found.verdict is Verdict.SHORT
    assert "saturated" in found.measured


def test_a_stuck_sensor_falls_short():
    with force_torque(lambda: (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)) as config:
        found = look("values", config, "wrist_ft")
    assert found.verdict is Verdict.SHORT
    assert "1 different" in found.measured


def test_lost_packets_are_counted():
    with force_torque(Transducer(), drop=0.2) as config:
        found = look("gaps", config, "wrist_ft")
    assert found.verdict is Verdict.SHORT
    assert 10 < found.figures["lost"] < 80  # of 200


def test_a_device_that_is_not_there_fails_with_its_address_and_a_remedy():
    with socket.socket() as closed:  # bound, and nobody listens
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
        device = {"kind": "force_torque", "driver": "ati_netft", "mount": "wrist", "address": "127.0.0.1"}
        found = findings(station("wrist_ft", device | {"http_port": port}), "wrist_ft")
    assert list(found) == ["reach"]
    assert found["reach"].verdict is Verdict.FAILED
    assert f"127.0.0.1:{port}" in found["reach"].measured
    assert "cable" in found["reach"].remedy


@contextmanager
def served(config: StationConfig) -> Iterator[None]:
    with station_bus(config, "device") as bus, ThreadPoolExecutor(1) as pool:
        host, ready = DeviceHost(config, bus), threading.Event()
        serving = pool.submit(host.run, ready.set)
        try:
            assert ready.wait(30)
            yield
        finally:
            host.stop()
            serving.result(10)


def test_a_device_that_is_served_is_checked_over_the_bus_and_others_keep_their_zero():
    transducer = Transducer()
    transducer.load[0] = 5.0
    with force_torque(transducer) as config, served(config):
        found = findings(config, "wrist_ft")
        assert config.bus.endpoint in found["reach"].measured
        assert found["tare"].verdict is Verdict.SKIPPED
        assert look("load", config, "wrist_ft").figures["wrench"]["fx"] == pytest.approx(5.0, abs=0.1)
        assert look("tare", config, "wrist_ft", Nobody(agreed=True)).verdict is Verdict.GOOD
        assert look("load", config, "wrist_ft").figures["wrench"]["fx"] == pytest.approx(0.0, abs=0.1)


def test_the_findings_are_told_and_written(tmp_path):
    console = Console(file=(tmp_path / "said").open("w"), width=200)
    with force_torque(Transducer()) as config:
        code = check_device(config, "wrist_ft", Nobody(), console, json_file=tmp_path / "found.json")
    console.file.close()
    written = json.loads((tmp_path / "found.json").read_text())
    assert (code, written["exit_code"]) == (ExitCode.DONE, 0)
    assert (written["schema"], written["device"], written["kind"]) == (1, "wrist_ft", "force_torque")
    said = (tmp_path / "said").read_text()
    for row in written["steps"]:
        assert row["verdict"] in ("good", "skipped")
        assert row["measured"] in said
        assert row["look"] in said
    [rate] = [row for row in written["steps"] if row["step"] == "rate"]
    assert rate["figures"]["rate_Hz"] == pytest.approx(RATE, rel=0.05)


# -- the person --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("typed", "ready", "agreed"), [("", True, False), ("s", False, False), ("y", True, True), (None, False, False)]
)
def test_a_person_at_the_terminal_has_to_say_yes(monkeypatch, tmp_path, typed, ready, agreed):
    def answer(*_: object) -> str:
        if typed is None:  # Ctrl-D
            raise EOFError
        return typed

    monkeypatch.setattr("builtins.input", answer)
    with (tmp_path / "said").open("w") as file:
        person = AtTerminal(Console(file=file))
        assert person.ready("Push") is ready
        assert person.confirm("Move?") is agreed


def test_the_command_refuses_a_device_that_the_station_has_not(command):
    finished = command.finish(command.start("check-device", "sim", "wrist"))
    assert finished.code == 2
    assert "wrist_ft" in finished.err


def test_the_command_refuses_a_step_that_the_kind_has_not(command):
    finished = command.finish(command.start("check-device", "sim", "wrist_ft", "--step", "pusch"))
    assert finished.code == 2
    assert "push" in finished.err


def test_the_command_checks_a_simulated_device_and_says_what_it_leaves_out(command):
    finished = command.finish(command.start("check-device", "sim", "gripper", "--json", "found.json"))
    assert finished.code == 0, finished.out + finished.err
    lines = finished.out.splitlines()
    [cycle] = [i for i, line in enumerate(lines) if line.startswith("cycle")]
    assert lines[cycle + 1].split()[0] == "skipped"
    assert "--move" in lines[cycle + 1]
    assert json.loads((command.folder / "found.json").read_text())["exit_code"] == 0


def test_findings_that_could_not_be_written_are_refused_before_anything_is_opened(command):
    finished = command.finish(command.start("check-device", "sim", "gripper", "--json", "nowhere/found.json"))
    assert finished.code == 2
    assert "nowhere" in finished.err
    assert "reach" not in finished.out


def test_a_world_that_is_served_is_joined_and_given_a_first_scene(command):
    bus = ("--set", f"bus.endpoint={command.endpoint}")
    host = command.start("serve", "sim", "--set", "world.clock=realtime", *bus)
    assert "serving" in host.stderr.readline()
    steps = [word for step in ("values", "tags", "reprojection") for word in ("--step", step)]
    finished = command.finish(command.start("check-device", "sim", "camera", "--yes", *steps, *bus))
    assert finished.code == 0, finished.out + finished.err
    assert "over the bus" in finished.out
    assert "4 of 4 of the table" in finished.out


def test_a_world_that_stands_still_is_refused_with_the_way_to_serve_it(command):
    bus = ("--set", f"bus.endpoint={command.endpoint}")
    host = command.start("serve", "sim", *bus)
    assert "serving" in host.stderr.readline()
    finished = command.finish(command.start("check-device", "sim", "camera", "--yes", *bus))
    assert finished.code == 3
    assert "world.clock=realtime" in finished.out


def test_through_a_router_a_runner_checks_all_of_it_and_who_may_only_look_leaves_out_what_commands(command):
    port = command.endpoint.rpartition(":")[2]
    with force_torque(Transducer()) as config:
        told = config.model_dump(mode="json", exclude={"world"}) | {"name": "lab1"}
        told["bus"] = {"endpoint": f"tls/localhost:{port}", "tls": {"folder": "lab"}}
        (command.folder / "lab1.yaml").write_text(json.dumps(told))
        members = ("--machine", "bench=wrist_ft", "--runner", "alice")
        assert command.finish(command.start("lab", "init", "lab1.yaml", *members)).code == 0
        for words, said in ((("lab", "router", "lab1.yaml"), "routing"), (("serve", "lab1.yaml"), "serving wrist_ft")):
            process = command.start(*words)
            while said not in (line := process.stderr.readline()):
                assert line, f"{words} has ended"
        check = ("check-device", "lab1.yaml", "wrist_ft", "--yes", "--step", "tare")
        runner = command.finish(command.start(*check))
        assert runner.code == 0, runner.out + runner.err
        assert f"over the bus, at tls/localhost:{port}" in runner.out
        assert "are left" in runner.out
        shutil.rmtree(command.folder / "lab" / "runner-alice")
        looking = command.finish(command.start(*check))
        assert looking.code == 0, looking.out + looking.err
        assert "may only look" in looking.out
