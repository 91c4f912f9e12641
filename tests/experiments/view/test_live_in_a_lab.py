"""Looking on at a station behind a router in TLS mode: a viewer's certificate shows everything and moves nothing."""

from __future__ import annotations

import json
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from drivers.config import StationConfig
from drivers.errors import DeviceTimeout, NotConnected
from drivers.onlooker import Onlooker
from drivers.station import Devices, Station
from drivers.wire import messages, topics
from drivers.wire.client import RemoteArm
from drivers.wire.link import Link
from drivers.wire.log_reader import Logged
from drivers.wire.station_bus import station_bus
from tests.experiments.lab.test_lab import SCENE, Bench, bench, step  # noqa: F401

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def lab(bench: Bench) -> Bench:  # noqa: F811
    """A lab that is up: its router, and one machine with every device."""
    bench("init", "--runner", "alice", "--viewer", "wall", "--viewer", "guest")
    bench.router()
    bench.serve()
    return bench


@pytest.fixture
def wall(lab: Bench) -> StationConfig:
    """The station as the machine on the wall knows it, where no other keys lie than the viewer's."""
    own = lab.folder / "wall" / "lab"
    own.mkdir(parents=True)
    shutil.copytree(lab.lab / "viewer-wall", own / "viewer-wall")
    return of(lab.config, own)


def of(config: StationConfig, folder: Path) -> StationConfig:
    """The station with keys from a ``folder``, and little patience."""
    assert config.bus.tls is not None
    tls = config.bus.tls.model_copy(update={"folder": str(folder)})
    return config.model_copy(update={"bus": config.bus.model_copy(update={"tls": tls, "timeout": 5.0})})


@contextmanager
def alice(lab: Bench, monkeypatch: pytest.MonkeyPatch) -> Iterator[Devices]:
    """The runner, with a box in the arm's hand."""
    with monkeypatch.context() as patch:
        patch.setenv("EXTRINSIC_IDENTITY", "runner-alice")
        station = Station(lab.config).connect()
    with station as devices:
        assert devices.simulation is not None
        devices.simulation.reset(0, SCENE)
        devices.clock.sleep(0.1)
        yield devices


def seen(onlooker: Onlooker, devices: Devices, wanted: set[str]) -> list[Logged]:
    """What the onlooker is shown while the station's time goes on, until it has seen all that is ``wanted``."""
    got: list[Logged] = []
    for _ in range(400):
        devices.clock.sleep(0.05)
        got += onlooker.take(0.05)
        if wanted <= {logged.topic for logged in got}:
            return got
    raise AssertionError(f"never seen: {wanted - {logged.topic for logged in got}}")


def test_a_viewers_certificate_shows_the_scene_and_every_stream_while_a_runner_works(
    lab: Bench, wall: StationConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Onlooker(wall) as onlooker, alice(lab, monkeypatch) as devices, devices.arm.lease("alice"):
        scene = onlooker.scene()
        assert scene is not None and scene.grasped is not None
        assert scene.grasped.mass == SCENE["grasped"]["mass"]
        devices.arm.command(step())
        streams = {"lab1/arm/pose", "lab1/arm/target", "lab1/wrist_ft/wrench", "lab1/world/truth"}
        got = seen(onlooker, devices, streams)
        poses = [logged.value() for logged in got if logged.topic == "lab1/arm/pose"]
        assert np.allclose(poses[-1].pose[:2], [0.0005, 0.2], atol=2e-3)  # type: ignore[union-attr]
        assert not onlooker.gone


#: what moves, stops or changes something, of every device
COMMANDS = (
    *(("arm", verb) for verb in ("acquire", "command", "renew", "release", "hold", "stop", "recover")),
    *(("gripper", verb) for verb in ("grasp", "release")),
    ("wrist_ft", "tare"),
    *((topics.WORLD, verb) for verb in ("reset", "advance", "restage", "inject", "clear_faults")),
)


def test_a_viewers_certificate_commands_nothing(
    lab: Bench, wall: StationConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the viewer's program sends beside what it may ask: commands, tokens, set-points of its own making."""
    with alice(lab, monkeypatch) as devices, Onlooker(wall) as onlooker, station_bus(wall, "viewer") as bus:
        assert bus.identity is not None and bus.identity.name == "viewer-wall"
        link = Link(bus, "lab1")
        with pytest.raises(DeviceTimeout, match=r"nobody serves lab1/arm/stop.*viewer-wall may"):
            link.ask("arm", "stop", timeout=0.5)
        for device, verb in COMMANDS:  # without asking first whether anybody serves it
            handler = zenoh.handlers.FifoChannel(8)
            bus.session.get(topics.key("lab1", device, verb), handler, payload=b"{}", timeout=1.0)
        bus.token(topics.lease("lab1", "arm", "viewer-wall"))
        target = "lab1/arm/target"
        forged = [bus.publisher(topic, messages.TARGET) for topic in (target, topics.view(target))]
        for publisher in forged:
            publisher.put(b"forged", 1, 1)
        # messages of a session keep their order through the router: by now the others would have come
        assert json.loads(link.ask("arm", "describe").text)["name"] == "arm"
        assert devices.simulation is not None
        before = devices.simulation.truth().ee[0]
        with devices.arm.lease("alice"):  # nobody holds it, nothing has stopped it
            assert isinstance(devices.arm, RemoteArm) and len(devices.arm.lease_holders()) == 1
            devices.arm.command(step())
            devices.clock.sleep(0.3)
            assert devices.simulation.truth().ee[0] - before == pytest.approx(0.0005, abs=1e-4)
            got = seen(onlooker, devices, {target})
        assert all(logged.payload != b"forged" for logged in got)


def test_a_machine_with_a_viewers_keys_alone_starts_no_run(wall: StationConfig) -> None:
    with pytest.raises(NotConnected, match=r"runner's certificate.*viewer-wall"), Station(wall).connect():
        pass


def test_the_command_shows_a_lab_with_a_viewers_certificate_alone(
    lab: Bench, wall: StationConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from tests.experiments.view.test_recorded import Saved

    at = ("--set", f"bus.tls.folder={lab.folder / 'wall' / 'lab'}", "--save", str(lab.folder / "live.rrd"))
    view = lab.start("experiments.cli", "view", "lab1.yaml", *at, until="looking on at lab1")
    assert view.stderr is not None
    with alice(lab, monkeypatch) as devices:
        until(view, devices, "lab1 is on show")
        for _ in range(20):
            devices.clock.sleep(0.05)
    view.send_signal(signal.SIGINT)
    assert view.wait(30) == 0
    paths = Saved(lab.folder / "live.rrd").paths
    assert {"/station/scene/plane/truth/go/outline", "/station/sensors/wrist_ft/force"} <= paths


def until(view: subprocess.Popen[str], devices: Devices, said: str) -> None:
    """Let the station's time go on until the command has ``said`` something."""
    assert view.stderr is not None
    for _ in range(400):
        devices.clock.sleep(0.05)
        if select.select([view.stderr], [], [], 0.05)[0]:
            line = view.stderr.readline()
            assert line, "it has ended"
            if said in line:
                return
    raise AssertionError(f"never said: {said}")


def test_a_viewer_who_was_revoked_sees_nothing_and_is_told(
    bench: Bench,  # noqa: F811
    tmp_path: Path,
) -> None:
    bench("init", "--viewer", "guest")
    kept = tmp_path / "elsewhere"
    shutil.copytree(bench.lab / "viewer-guest", kept / "viewer-guest")
    bench("revoke", "viewer-guest")
    bench.router()
    bench.serve()
    config = of(bench.config, kept)
    with pytest.raises(NotConnected, match="revoked sees nothing"), Onlooker(config, timeout=1.0):
        pass


def test_a_machine_without_a_viewers_certificate_is_told_how_to_get_one(
    bench: Bench,  # noqa: F811
    tmp_path: Path,
) -> None:
    bench("init")
    bench.router()
    (tmp_path / "nothing").mkdir()
    onlooker = Onlooker(of(bench.config, tmp_path / "nothing"))
    with pytest.raises(NotConnected, match=r"viewer's certificate.*there is none") as caught, onlooker:
        pass
    assert "extrinsic lab" in caught.value.remedy
