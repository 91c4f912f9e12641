"""Who may do what, through a router in TLS mode: who is let in, what is dropped, and what the lease does beside it.

A denied message is dropped without a word. That it did not arrive is known by what was sent after it and did: messages
of a session keep their order through the router.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from drivers.config import TlsConfig
from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, NotConnected
from drivers.interfaces import ArmTarget
from drivers.wire import messages, streams, topics
from drivers.wire.arm_server import ArmServer
from drivers.wire.bus import Bus
from drivers.wire.client import RemoteArm, RemoteForceTorque
from drivers.wire.link import Link
from drivers.wire.router import Router
from drivers.wire.security import make_authority, make_member
from drivers.wire.server import Desk, DeviceServer
from drivers.wire.session import open_session
from drivers.wire.station_bus import station_bus
from drivers.wire.streams import Sample

from .tls_lab import ACCESS, MEMBERS, Lab

COMMANDS = ("acquire", "command", "renew", "release", "hold", "stop", "recover")


@pytest.fixture(autouse=True)
def nobody_in_particular(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EXTRINSIC_IDENTITY", raising=False)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    make_authority(folder / "ca", "the lab")
    make_authority(folder / "elsewhere", "another lab")
    for name in MEMBERS:
        make_member(folder / "ca", folder / name, name, ["127.0.0.1"] if name == "router" else ())
    make_member(folder / "ca", folder / "expired", "runner-alice", days=-1)
    make_member(folder / "elsewhere", folder / "foreign", "runner-alice")
    (folder / "foreign" / "ca.pem").write_bytes((folder / "ca" / "ca.pem").read_bytes())  # it trusts our router
    return folder


@pytest.fixture
def lab(keys: Path, endpoint: str) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(keys, endpoint, stack)


@pytest.fixture
def bench(lab: Lab, fake_arm: Any) -> Iterator[ArmServer]:
    """The arm's server, on the machine that it belongs to."""
    with ArmServer(Desk(lab.bus("device-bench"), "lab"), fake_arm) as server:
        yield server


@pytest.fixture
def shelf(lab: Lab, fake_wrench: Any) -> Iterator[DeviceServer]:
    """The force/torque sensor's server, on another machine."""
    with DeviceServer(Desk(lab.bus("device-shelf"), "lab"), fake_wrench) as server:
        yield server


def target(x: float = 0.1003) -> ArmTarget:
    return ArmTarget(np.array([x, 0.2, 0.3]), np.zeros(3), 0.02)


def soon() -> float:
    return time.monotonic() + 5.0


def heard(bus: Bus, topic: str) -> list[Sample]:
    got: list[Sample] = []
    bus.subscribe(topic).listen(got.append)
    return got


def round_trip(bus: Bus) -> None:
    """Whatever this session sent before has been through the router, and at the arm's machine, by now."""
    bus.request("lab/arm/describe", b"", device="arm", asked="describe")


# -- who is let in ----------------------------------------------------------------------------------------------------


def test_every_member_is_let_in(lab: Lab) -> None:
    for name in MEMBERS[1:]:
        lab.bus(name)


@pytest.mark.parametrize(
    ("who", "said", "remedy"),
    [("expired", "certificate expired", "clock"), ("foreign", "refused", "another lab")],
)
def test_who_is_no_member_is_not_let_in_and_told_why(lab: Lab, who: str, said: str, remedy: str) -> None:
    with pytest.raises(NotConnected, match=said) as caught:
        Bus(lab.endpoint, mode="client", timeout=0.5, shared_memory=False, identity=lab.unchecked(who))
    assert remedy in caught.value.remedy
    assert str(lab.keys / who / "certificate.pem") in caught.value.got


@pytest.mark.parametrize(
    ("mode", "scheme", "trusting"),
    [
        ("client", "tls", True),
        ("peer", "tls", True),
        ("router", "tls", True),
        ("client", "tls", False),
        ("client", "tcp", False),
    ],
)
def test_nobody_is_let_in_without_a_certificate(lab: Lab, mode: Any, scheme: str, trusting: bool) -> None:
    trusted = {"transport/link/tls/root_ca_certificate": str(lab.keys / "ca" / "ca.pem")} if trusting else {}
    with pytest.raises(NotConnected):
        open_session(
            mode,
            lab.endpoint.replace("tls/", f"{scheme}/"),
            listen=False,
            timeout=0.3,
            lease=1.0,
            identity=None,
            settings={"transport/shared_memory/enabled": False, **trusted},
        )


def test_a_router_of_another_lab_is_not_trusted(lab: Lab) -> None:
    own = replace(lab.unchecked("foreign"), ca=lab.keys / "elsewhere" / "ca.pem")
    with pytest.raises(NotConnected, match="the router's certificate cannot be trusted"):
        Bus(lab.endpoint, mode="client", timeout=0.5, shared_memory=False, identity=own)


@pytest.mark.parametrize("whose", ["device-bench", "runner-alice"])
def test_nobody_takes_anothers_place_by_the_id_of_its_session(
    lab: Lab, bench: ArmServer, fake_arm: Any, whose: str
) -> None:
    alice = lab.arm("runner-alice")
    taken = {"device-bench": bench.desk.bus, "runner-alice": alice._link.bus}[whose].zid
    with pytest.raises(NotConnected):
        open_session(
            "client",
            lab.endpoint,
            listen=False,
            timeout=0.3,
            lease=1.0,
            identity=lab.identity("viewer-wall"),
            settings={"transport/shared_memory/enabled": False, "id": taken},
        )
    with alice.lease("alice"):
        alice.command(target())
    assert len(fake_arm.targets) == 1


def test_a_certificate_that_expires_ends_the_connection(lab: Lab, bench: ArmServer, keys: Path) -> None:
    short = keys / "viewer-short"
    make_member(keys / "ca", short, "viewer-wall", days=2 / 86400)  # type: ignore[arg-type]
    bus = lab.bus("viewer-short")
    watch = bus.watch(topics.alive("lab", "arm"))
    assert watch.seen(5.0)
    assert watch.wait(20.0)


@pytest.mark.parametrize(("days", "warned"), [(365, False), (29, True)])
def test_who_joins_is_told_when_the_certificate_ends_within_a_month(
    lab: Lab, tmp_path: Path, caplog: pytest.LogCaptureFixture, days: int, warned: bool
) -> None:
    make_member(lab.keys / "ca", tmp_path / "runner-alice", "runner-alice", days=days)
    tls = TlsConfig(folder=str(tmp_path))
    own = lab.config.model_copy(update={"bus": lab.config.bus.model_copy(update={"tls": tls})})
    station_bus(own, "runner").close()
    assert ("runner-alice ends in 28 days" in caplog.text or "in 29 days" in caplog.text) is warned


# -- who may read -----------------------------------------------------------------------------------------------------


def test_a_viewer_reads_streams_and_what_devices_say_of_themselves(
    lab: Lab, bench: ArmServer, shelf: DeviceServer, fake_wrench: Any
) -> None:
    link = Link(lab.bus("viewer-wall"), "lab")
    sensor = RemoteForceTorque("wrist_ft", link, lockstep=False)
    arm = RemoteArm("arm", link, lockstep=False)
    sensor.connect(5.0)
    arm.connect(5.0)
    assert shelf._streams["wrench"].wait_matched(5.0)
    fake_wrench.push(1, time.time_ns())
    assert sensor.latest(5.0).stamp.sequence == 1
    assert arm.describe().kind == "arm"
    assert arm.lease_holders() == []
    assert arm.safety()["stopped"] == ""
    sensor.close()
    arm.close()


def test_the_machine_of_the_arm_hears_the_sensor_of_another_machine(
    lab: Lab, bench: ArmServer, shelf: DeviceServer, fake_wrench: Any
) -> None:
    got = heard(bench.desk.bus, "lab/wrist_ft/wrench")
    assert shelf._streams["wrench"].wait_matched(5.0)
    fake_wrench.push(7)
    assert bench.desk.bus.subscribe("lab/wrist_ft/wrench").wait(7, None, soon())
    assert [sample.sequence for sample in got] == [7]


def test_a_revoked_member_reads_nothing(lab: Lab, bench: ArmServer, shelf: DeviceServer, fake_wrench: Any) -> None:
    bob, alice = lab.bus("runner-bob"), lab.bus("runner-alice")
    got, witness = heard(bob, "lab/wrist_ft/wrench"), heard(alice, "lab/wrist_ft/wrench")
    watch = bob.watch(topics.alive("lab", "arm"))
    assert shelf._streams["wrench"].wait_matched(5.0)
    for i in range(50):
        fake_wrench.push(i)
    assert alice.subscribe("lab/wrist_ft/wrench").wait(49, None, soon())
    assert len(witness) == 50
    assert got == []
    with pytest.raises(DeviceTimeout, match="nobody serves lab/arm/describe"):
        bob.request("lab/arm/describe", b"", device="arm", asked="describe", timeout=0.5)
    assert not watch.seen(0.0)


def test_another_station_on_the_same_router_is_nobodys(lab: Lab) -> None:
    """Members are of one station: what is not its own has no rule, and is dropped."""
    bench, alice = lab.bus("device-bench"), lab.bus("runner-alice")
    got = heard(alice, "other/arm/pose")
    bench.token("lab/arm/alive")
    bench.publisher("other/arm/pose", messages.POSE).put(b"x", 0, 0)
    assert alice.watch("lab/arm/alive").seen(5.0)
    assert got == []


def test_a_viewer_looks_on_and_the_arm_hears_of_nobody_else(lab: Lab, bench: ArmServer, fake_arm: Any) -> None:
    """Through the router, too, a view is made while somebody looks on, and only for those who may."""
    publisher, view = bench._streams["pose"], topics.view("lab/arm/pose")
    assert publisher.view is not None
    refused = heard(lab.bus("runner-bob"), view)
    wall = lab.bus("viewer-wall")
    round_trip(wall)
    assert not streams.matching(publisher.view._publisher)
    got = heard(wall, view)
    assert publisher.view.wait_matched(5.0)
    forged = lab.bus("device-shelf").publisher(view, messages.POSE)
    forged.put(b"forged", 1000, 0)
    for i in range(1000):  # at the view's own rate, whenever it is time for the next
        fake_arm.push(i)
        if wall.subscribe(view).wait(0, None, time.monotonic() + 0.01):
            break
    assert got and all(sample.payload != b"forged" for sample in got)
    assert publisher.count == 0, "nobody takes the stream itself"
    assert refused == []


# -- who may command --------------------------------------------------------------------------------------------------


def test_a_runner_takes_the_lease_and_moves_the_arm(lab: Lab, bench: ArmServer, fake_arm: Any) -> None:
    arm = lab.arm("runner-alice")
    with arm.lease("alice"):
        arm.command(target())
        assert arm.lease_holders() == ["alice"]
    assert [t.pose[0] for t in fake_arm.targets] == [0.1003]
    arm.stop()
    assert fake_arm.stopped
    arm.recover()
    assert not fake_arm.stopped


@pytest.mark.parametrize("who", ["viewer-wall", "runner-bob", "device-shelf"])
def test_nobody_else_can_command(lab: Lab, bench: ArmServer, fake_arm: Any, who: str) -> None:
    bus = lab.bus(who)
    payload = messages.encode(messages.message(messages.STRING, data="x"))
    with pytest.raises(DeviceTimeout, match=f"nobody serves lab/arm/stop.*{who} may"):
        bus.request("lab/arm/stop", payload, device="arm", asked="stop", timeout=0.3)
    for verb in COMMANDS:  # and without asking first whether anybody serves it
        for key in (f"lab/arm/{verb}", f"lab/*/{verb}", f"*/arm/{verb}", f"**/{verb}"):
            bus.session.get(key, zenoh.handlers.FifoChannel(8), payload=payload, timeout=1.0)
    if who != "runner-bob":  # who can ask nothing at all
        round_trip(bus)
    alice = lab.arm("runner-alice")
    with alice.lease("alice"):
        alice.command(target())
        alice.hold()
    assert fake_arm.did == ["acquire", "hold", "release"], "what alice asked for, and nothing else"
    assert not fake_arm.stopped
    assert len(fake_arm.targets) == 1


@pytest.mark.parametrize("who", ["runner-carol", "runner-bob"])
def test_a_held_lease_cannot_be_taken(lab: Lab, bench: ArmServer, fake_arm: Any, who: str) -> None:
    alice = lab.arm("runner-alice")
    with alice.lease("alice"):
        other = RemoteArm("arm", Link(lab.bus(who), "lab"), lockstep=False)
        if who == "runner-carol":
            other.connect(5.0)
            with pytest.raises(CommandRefused, match="alice has it"):
                other.acquire("carol")
            other.close()
        else:
            with pytest.raises(NotConnected, match="no server"):  # it does not even see the arm
                other.connect(0.5)
        alice.command(target())
        assert alice.lease_holders() == ["alice"]
    assert len(fake_arm.targets) == 1


@pytest.mark.parametrize("who", ["viewer-wall", "runner-bob", "device-shelf"])
def test_nobody_else_can_feign_the_end_of_a_lease(lab: Lab, bench: ArmServer, fake_arm: Any, who: str) -> None:
    """A lease ends with its holder's token: a stranger's token of the same name must not exist for the arm."""
    alice, bus = lab.arm("runner-alice"), lab.bus(who)
    seen: list[str] = []
    tokens = bench.desk.bus.session.liveliness().declare_subscriber(
        "lab/arm/holder/*", lambda sample: seen.append(f"{sample.kind} {sample.key_expr}")
    )
    with alice.lease("alice"):
        holder = alice._holder
        assert holder is not None
        bus.token(topics.lease("lab", "arm", holder))()
        bus.token(topics.lease("lab", "arm", "eve~0~1"))()
        if who != "runner-bob":
            round_trip(bus)
        alice.command(target())
        assert alice.lease_holders() == ["alice"]
        assert not any("eve" in token for token in seen)
        assert not any("DELETE" in token for token in seen)
    tokens.undeclare()


# -- who may publish and answer ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("who", ["device-shelf", "viewer-wall", "runner-alice", "runner-bob"])
def test_nobody_publishes_for_a_device_but_its_own_machine(lab: Lab, bench: ArmServer, who: str, fake_arm: Any) -> None:
    bus, reader = lab.bus(who), lab.bus("runner-carol")
    got = heard(reader, "lab/arm/pose")
    assert bench._streams["pose"].wait_matched(5.0)
    forged = bus.publisher("lab/arm/pose", messages.POSE)
    for i in range(20):
        forged.put(b"forged", 1000 + i, 0)
        bus.session.put("lab/*/pose", b"forged")
        bus.session.delete("lab/arm/pose")
    if who != "runner-bob":
        round_trip(bus)
    fake_arm.push(5)
    assert reader.subscribe("lab/arm/pose").wait(5, None, soon())
    assert [sample.sequence for sample in got] == [5]
    assert reader.subscribe("lab/arm/pose").foreign == 0


@pytest.mark.parametrize("who", ["device-shelf", "viewer-wall", "runner-carol", "runner-bob"])
def test_nobody_answers_for_a_device_but_its_own_machine(lab: Lab, who: str) -> None:
    impostor, alice = lab.bus(who), lab.bus("runner-alice")
    impostor.serve("lab/arm/command", lambda query: query.reply(b"forged"))
    impostor.serve("lab/arm/describe", lambda query: query.reply(b"forged"))
    impostor.session.declare_queryable("lab/**", lambda query: query.reply("lab/arm/command", b"forged"))
    impostor.token("lab/arm/alive")
    impostor.token("lab/world/alive")
    for key in ("lab/arm/command", "lab/arm/describe"):
        with pytest.raises(DeviceTimeout, match="nobody serves"):
            alice.request(key, b"", device="arm", asked="ask", timeout=0.3)
    assert not alice.watch("lab/arm/alive").seen(0.1)
    assert not alice.watch("lab/world/alive").seen(0.0)


@pytest.mark.parametrize(("who", "heard_of"), [("runner-carol", 30), ("viewer-wall", 0), ("device-shelf", 0)])
def test_a_runner_publishes_what_it_estimates_and_nobody_else_does(lab: Lab, who: str, heard_of: int) -> None:
    bench, bus = lab.bus("device-bench"), lab.bus(who)
    key = topics.key("lab", topics.ESTIMATOR, "wrench")
    got = heard(bench, key)
    publisher = bus.publisher(key, messages.WRENCH)
    if heard_of:
        assert publisher.wait_matched(5.0)
    for i in range(30):
        publisher.put(b"x", i, 0)
    bench.serve("lab/arm/describe", lambda query: query.reply(b"here"))
    round_trip(bus) if who != "device-shelf" else round_trip(lab.bus("viewer-wall"))
    if heard_of:
        assert bench.subscribe(key).wait(29, None, soon())
    assert len(got) == heard_of


# -- when the router goes ---------------------------------------------------------------------------------------------


def test_when_the_router_goes_the_arm_is_held_and_its_commander_told(lab: Lab, bench: ArmServer, fake_arm: Any) -> None:
    alice = lab.arm("runner-alice")
    alice.acquire("alice")
    alice.command(target())
    fake_arm.released.clear()
    lab.router.close()
    assert fake_arm.released.wait(10.0)
    with pytest.raises((DeviceFault, DeviceTimeout)):
        alice.command(target(0.1006))
    assert len(fake_arm.targets) == 1


def test_commands_go_on_after_the_router_was_started_again(lab: Lab, bench: ArmServer, fake_arm: Any) -> None:
    lab.arm("runner-alice")
    lab.router.close()
    back = threading.Event()
    with Router(lab.config, ACCESS, lab.identity("router")):
        bus = lab.bus("runner-carol")
        bus.session.liveliness().declare_subscriber("lab/arm/alive", lambda _: back.set(), history=True)
        assert back.wait(20.0)
        arm = RemoteArm("arm", Link(bus, "lab"), lockstep=False)
        arm.connect(5.0)
        with arm.lease("carol"):
            arm.command(target())
        arm.close()
    assert len(fake_arm.targets) == 1
