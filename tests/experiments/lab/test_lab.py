"""`extrinsic lab`: what it makes, what it refuses, and the whole chain of processes through a router in TLS mode."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from drivers.config import StationConfig
from drivers.errors import CommandRefused, NotConnected
from drivers.interfaces import ArmTarget
from drivers.station import Station
from drivers.status import station_certificates, station_status
from experiments.files import load_station
from experiments.lab.commands import app
from experiments.lab.folder import read_access
from experiments.ports import free_endpoint
from experiments.tables import status_table

ROOT = Path(__file__).parents[3]
STATION = """
name: lab1
world: {{clock: lockstep}}
bus: {{endpoint: {endpoint}, tls: {{folder: lab}}, lease: 1.0}}
devices:
  arm: {{kind: arm}}
  gripper: {{kind: gripper}}
  wrist_ft: {{kind: force_torque, mount: wrist}}
"""
SCENE = {
    "grasped": {
        "name": "go",
        "vertices": [(-0.025, -0.07), (0.025, -0.07), (0.025, 0.07), (-0.025, 0.07)],
        "mass": 0.1,
    },
    "grasp": (0.0, 0.045, 0.0),
    "stiffness": ((2000.0, 0, 0), (0, 2000.0, 0), (0, 0, 3.0)),
    "friction": {"go-ground": 0.33},
    "start": (0.0, 0.2, 0.0),
}
"""A box in the arm's hand, above the table."""


class Bench:
    """The current folder, with the station file ``lab1.yaml``. Every process started here is stopped by `stop`."""

    def __init__(self, folder: Path):
        self.folder, self.lab = folder, folder / "lab"
        self._started: list[subprocess.Popen[str]] = []
        endpoint = free_endpoint().replace("tcp/", "tls/")
        (folder / "lab1.yaml").write_text(STATION.format(endpoint=endpoint))

    @property
    def config(self) -> StationConfig:
        return load_station("lab1.yaml")

    def __call__(self, verb: str, *arguments: str, code: int = 0) -> Result:
        result = CliRunner().invoke(app, [verb, "lab1.yaml", *arguments])
        assert result.exit_code == code, result.output
        return result

    def start(self, program: str, *arguments: str, until: str) -> subprocess.Popen[str]:
        """Start a typer app of ours as a process, and return when it says that it is ready."""
        process = subprocess.Popen(
            [sys.executable, "-c", f"from {program} import app; app()", *arguments],
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._started.append(process)
        assert process.stderr is not None
        said = []
        while until not in (line := process.stderr.readline()):
            said.append(line)
            assert line, "".join(said)
        return process

    def router(self) -> subprocess.Popen[str]:
        return self.start("experiments.lab.commands", "router", "lab1.yaml", until="routing at")

    def serve(self) -> subprocess.Popen[str]:
        return self.start("experiments.cli", "serve", "lab1.yaml", until="serving")

    @staticmethod
    def end(process: subprocess.Popen[str]) -> None:
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0

    def stop(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.communicate(timeout=10)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("EXTRINSIC_IDENTITY", raising=False)
    bench = Bench(tmp_path)
    yield bench
    bench.stop()


def step() -> ArmTarget:
    return ArmTarget(np.array([0.0005, 0.2, 0.0]), np.zeros(3), 0.1)


# -- the whole chain --------------------------------------------------------------------------------------------------


def test_from_a_new_lab_to_an_arm_that_moves_and_a_runner_who_may_no_more(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench("init", "--runner", "alice", "--runner", "bob", "--viewer", "wall")
    config = bench.config
    router, host = bench.router(), None
    with pytest.raises(NotConnected, match="extrinsic serve"):
        monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-alice")
        quick = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": 0.5})})
        with Station(quick).connect():
            pass
    host = bench.serve()
    with Station(config).connect() as devices:
        assert devices.host is None, "a runner starts no host of its own where there is a router"
        assert devices.simulation is not None
        devices.simulation.reset(0, SCENE)
        devices.clock.sleep(0.1)
        with devices.arm.lease("alice"):
            before = devices.simulation.truth().ee[0]
            devices.arm.command(step())
            devices.clock.sleep(0.3)
            moved = devices.simulation.truth().ee[0] - before
            assert moved == pytest.approx(0.0005, abs=1e-4)

            monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-bob")
            with Station(config).connect() as others, pytest.raises(CommandRefused, match="alice has it"):
                others.arm.acquire("bob")

            monkeypatch.setenv("EXTRINSIC_IDENTITY", "viewer-wall")
            rows = station_status(config, seconds=0.1)
            assert all(row.alive for row in rows), rows
            [arm] = [row for row in rows if row.kind == "arm"]
            assert "commanded by alice" in arm.note
    bench("revoke", "runner-bob")
    bench.end(router)
    bench.router()
    monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-alice")
    with Station(config).connect() as devices, devices.arm.lease("alice"):
        pass  # the host is back by itself
    stolen = bench.lab / "revoked" / "runner-bob"
    stolen.rename(bench.lab / "runner-bob")  # bob has kept his keys
    monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-bob")
    quick = config.model_copy(update={"bus": config.bus.model_copy(update={"timeout": 0.5})})
    with pytest.raises(NotConnected, match="revoked sees nothing"), Station(quick).connect():
        pass
    assert not any(row.alive for row in station_status(quick, seconds=0.1))
    bench.end(host)


def test_a_machine_that_serves_what_is_not_its_own_is_told(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench("init", "--machine", "bench=arm,gripper", "--machine", "shelf=wrist_ft")
    bench.router()
    monkeypatch.setenv("EXTRINSIC_IDENTITY", "device-bench")
    bench.start("experiments.cli", "serve", "lab1.yaml", until="lets nobody hear wrist_ft: device-bench may not")


def test_without_a_router_a_station_of_a_lab_says_how_to_start_one(bench: Bench) -> None:
    bench("init")
    with pytest.raises(NotConnected, match="extrinsic lab router"), Station(bench.config).connect():
        pass


# -- what init makes --------------------------------------------------------------------------------------------------


def test_a_new_lab_has_a_folder_for_each_member_and_the_routers_rules(bench: Bench) -> None:
    bench("init", "--machine", "bench=arm,gripper", "--machine", "shelf=wrist_ft", "--runner", "alice")
    folders = {path.name for path in bench.lab.iterdir() if path.is_dir()}
    assert folders == {"ca", "router", "device-bench", "device-shelf", "runner-alice", "viewer-lab1"}
    access = read_access(bench.config, bench.lab)
    assert access.machines == {"bench": ("arm", "gripper", "world"), "shelf": ("wrist_ft",)}
    assert stat.S_IMODE(bench.lab.stat().st_mode) == 0o700
    for key in bench.lab.glob("*/key.pem"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_zenoh_itself_reads_the_configurations(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    import zenoh

    bench("init")
    router = zenoh.Config.from_file(str(bench.lab / "router" / "zenoh.json5"))
    assert '"default_permission":"deny"' in router.get_json("access_control")
    client = zenoh.Config.from_file(str(bench.lab / "runner-lab1" / "zenoh.json5"))
    assert client.get_json("mode") == '"client"'
    assert client.get_json("transport/link/tls/enable_mtls") == "true"
    sessions = []
    for config, name in ((router, "router"), (client, "runner-lab1")):
        config.insert_json5("transport/shared_memory/enabled", "false")
        monkeypatch.chdir(bench.lab / name)
        sessions.append(zenoh.open(config))
    try:
        assert sessions[1].info.routers_zid() == [sessions[0].zid()]
    finally:
        for session in reversed(sessions):
            session.close()


def test_an_authority_is_never_made_over_another(bench: Bench) -> None:
    bench("init")
    before = {path: path.read_bytes() for path in bench.lab.rglob("*.pem")}
    assert "never overwritten" in bench("init", code=2).output
    assert {path: path.read_bytes() for path in bench.lab.rglob("*.pem")} == before


def test_an_init_that_fails_leaves_nothing(bench: Bench) -> None:
    assert "no device 'grippr'" in bench("init", "--machine", "bench=arm,grippr", code=2).output
    assert sorted(path.name for path in bench.folder.iterdir()) == ["lab1.yaml"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--machine", "bench"), "names no machine with its devices"),
        (("--machine", "a=arm", "--machine", "b=arm"), "arm is served by a already"),
        (("--machine", "a=arm", "--machine", "a=gripper"), "stands twice"),
        (("--machine", "*=arm"), "'*' is no name"),
        (("--runner", "Alice"), "runners"),
        (("--runner", "../eve"), "runners"),
        (("--viewer", "a b"), "viewers"),
    ],
)
def test_names_that_cannot_be_are_refused(bench: Bench, arguments: tuple[str, ...], said: str) -> None:
    assert said in bench("init", *arguments, code=2).output
    assert not bench.lab.exists()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_labs_keys_are_not_committed(bench: Bench) -> None:
    bench("init")
    subprocess.run(["git", "init", "-q"], check=True)
    status = subprocess.run(["git", "status", "--porcelain", "-uall"], check=True, capture_output=True, text=True)
    assert status.stdout.split() == ["??", "lab1.yaml"]


# -- later ------------------------------------------------------------------------------------------------------------


def test_one_more_member_is_signed_by_the_same_authority(bench: Bench) -> None:
    bench("init", "--machine", "bench=arm,gripper")
    ca = (bench.lab / "ca" / "ca.pem").read_bytes()
    said = bench("add", "--machine", "shelf=wrist_ft", "--runner", "bob", "--viewer", "kiosk").output
    assert "once the router has been started again" in said
    for name in ("device-shelf", "runner-bob", "viewer-kiosk"):
        assert (bench.lab / name / "ca.pem").read_bytes() == ca
    assert read_access(bench.config, bench.lab).runners == ("lab1", "bob")
    assert "bob" in (bench.lab / "router" / "zenoh.json5").read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--runner", "lab1"), "there is a runner-lab1 already"),
        (("--machine", "shelf=arm"), "arm is served by lab1 already"),
        (("--machine", "shelf=camera"), "no device 'camera'"),
        ((), "nobody was named"),
    ],
)
def test_a_member_who_cannot_be_added_is_refused(bench: Bench, arguments: tuple[str, ...], said: str) -> None:
    bench("init")
    before = sorted(bench.lab.rglob("*"))
    assert said in bench("add", *arguments, code=2).output
    assert sorted(bench.lab.rglob("*")) == before


def test_the_name_of_a_revoked_member_is_not_given_out_again(bench: Bench) -> None:
    bench("init", "--runner", "bob")
    bench("revoke", "runner-bob")
    assert "was revoked" in bench("add", "--runner", "bob", code=2).output
    assert "revoked already" in bench("revoke", "runner-bob", code=2).output
    said = bench("revoke", "runner-lab", code=2).output
    assert "viewer-lab1" in said


def test_the_devices_of_a_revoked_machine_can_go_to_another(bench: Bench) -> None:
    bench("init", "--machine", "bench=arm,gripper,wrist_ft")
    bench("revoke", "device-bench")
    bench("add", "--machine", "bench2=arm,gripper,wrist_ft")
    assert read_access(bench.config, bench.lab).machines == {"bench2": ("arm", "gripper", "wrist_ft", "world")}


def test_a_lab_is_one_stations(bench: Bench) -> None:
    bench("init")
    file = bench.folder / "lab1.yaml"
    file.write_text(file.read_text().replace("name: lab1", "name: lab2"))
    assert "the lab of station 'lab1'" in bench("add", "--runner", "bob", code=2).output


def test_the_router_refuses_to_start_without_keys(bench: Bench) -> None:
    assert "there is no lab/router/access.yaml" in bench("router", code=2).output
    bench("init")
    (bench.lab / "router" / "key.pem").chmod(0o644)
    assert "chmod 600 lab/router/key.pem" in bench("router", code=3).output


def test_certificates_near_their_end_are_shown_and_renewed(bench: Bench) -> None:
    bench("init", "--days", "20")
    config = bench.config
    assert {days for name, days in station_certificates(config) if name != "lab1 lab"} <= {19, 20}
    assert "lab renew" in _shown(config)
    bench("renew")
    assert {days for name, days in station_certificates(config) if name != "lab1 lab"} <= {364, 365}
    assert "lab renew" not in _shown(config)
    assert station_certificates(load_station("sim")) == []


def _shown(config: StationConfig) -> str:
    from rich.console import Console

    console = Console(width=200)
    with console.capture() as captured:
        console.print(status_table([], station_certificates(config)))
    return captured.get()


# -- strangers --------------------------------------------------------------------------------------------------------


def test_serving_strangers_without_keys_is_refused_before_anything_starts(bench: Bench) -> None:
    everywhere = f"bus.endpoint={free_endpoint().replace('127.0.0.1', '0.0.0.0')}"
    process = subprocess.run(
        [sys.executable, "-c", "from experiments.cli import app; app()", "serve", "sim", "--set", everywhere],
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert process.returncode == 2, process.stderr
    assert "may command the arm" in process.stderr
    assert "--insecure" in process.stderr
    assert "serving" not in process.stderr


def test_a_run_starts_no_host_that_strangers_could_reach() -> None:
    from mechanics.yaml_input import InputError

    config = load_station("sim", [f"bus.endpoint={free_endpoint().replace('127.0.0.1', '0.0.0.0')}"])
    with pytest.raises(InputError, match="may command the arm"), Station(config).connect():
        pass
