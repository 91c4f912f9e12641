"""Keys and certificates: judged by OpenSSL, through Python's ssl, which has no part in making them."""

from __future__ import annotations

import re
import ssl
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.config import BusConfig, StationConfig, TlsConfig
from drivers.errors import NotConnected
from drivers.wire import security
from drivers.wire.bus import Bus
from drivers.wire.router import Router
from drivers.wire.security import make_authority, make_member, read_identity, renew_member
from drivers.wire.station_bus import certificates, find_identity, is_loopback, station_bus
from mechanics.yaml_input import Document, InputError, parse

FILES = ("ca.pem", "certificate.pem", "key.pem")


@pytest.fixture(autouse=True)
def nobody_in_particular(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EXTRINSIC_IDENTITY", raising=False)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    make_authority(tmp_path / "ca", "test lab")
    make_member(tmp_path / "ca", tmp_path / "router", "router", ["127.0.0.1", "router.lab"])
    make_member(tmp_path / "ca", tmp_path / "runner-alice", "runner-alice")
    return tmp_path


def identity(folder: Path) -> security.Identity:
    return read_identity(*(folder / name for name in FILES))


def handshake(client: Path, server: Path, host: str = "router.lab") -> str:
    """The name that the server learns of its client, both being shown and checking certificates."""
    contexts = []
    for folder, purpose in ((server, ssl.Purpose.CLIENT_AUTH), (client, ssl.Purpose.SERVER_AUTH)):
        context = ssl.create_default_context(purpose, cafile=folder / "ca.pem")
        context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")
        contexts.append(context)
    contexts[0].verify_mode = ssl.CERT_REQUIRED
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    there = contexts[0].wrap_bio(to_server, to_client, server_side=True)
    here = contexts[1].wrap_bio(to_client, to_server, server_hostname=host)
    done: set[ssl.SSLObject] = set()
    for _ in range(10):
        for end in (here, there):
            try:
                end.do_handshake()
                done.add(end)
            except ssl.SSLWantReadError:
                continue
        if len(done) == 2:
            break
    certificate = there.getpeercert()
    assert certificate is not None
    return dict(part[0] for part in certificate["subject"])["commonName"]  # type: ignore[misc, index]


def test_members_of_one_lab_believe_each_other(lab: Path) -> None:
    assert handshake(lab / "runner-alice", lab / "router") == "runner-alice"
    assert handshake(lab / "runner-alice", lab / "router", "127.0.0.1") == "runner-alice"


def test_a_router_at_another_address_is_not_believed(lab: Path) -> None:
    with pytest.raises(ssl.SSLCertVerificationError, match=r"not valid for 'elsewhere\.lab'"):
        handshake(lab / "runner-alice", lab / "router", "elsewhere.lab")


def test_a_member_of_another_lab_is_not_believed(lab: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    make_authority(other / "ca", "test lab")
    make_member(other / "ca", other / "runner-alice", "runner-alice")
    (other / "runner-alice" / "ca.pem").write_bytes((lab / "ca" / "ca.pem").read_bytes())
    with pytest.raises(ssl.SSLError, match="verify failed"):
        handshake(other / "runner-alice", lab / "router")


@pytest.mark.parametrize(("client", "server"), [("router", "router"), ("runner-alice", "runner-alice")])
def test_a_router_is_no_runner_and_a_runner_no_router(lab: Path, client: str, server: str) -> None:
    with pytest.raises(ssl.SSLCertVerificationError, match="unsuitable certificate purpose"):
        handshake(lab / client, lab / server)


def test_keys_and_their_folders_are_for_their_owner_alone(lab: Path) -> None:
    for folder in ("ca", "router", "runner-alice"):
        assert stat.S_IMODE((lab / folder).stat().st_mode) == 0o700
        assert stat.S_IMODE((lab / folder / "key.pem").stat().st_mode) == 0o600


def test_an_authority_is_never_overwritten(lab: Path) -> None:
    before = [(lab / "ca" / name).read_bytes() for name in ("ca.pem", "key.pem")]
    with pytest.raises(FileExistsError):
        make_authority(lab / "ca", "again")
    assert [(lab / "ca" / name).read_bytes() for name in ("ca.pem", "key.pem")] == before


def test_an_identity_tells_its_name_its_role_and_its_end(lab: Path) -> None:
    found = identity(lab / "runner-alice")
    assert (found.name, found.role) == ("runner-alice", "runner")
    assert security.days_left(found.expires) in (364, 365)
    assert security.days_left(found.ca_expires) in (3649, 3650)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_key_that_others_can_read_is_refused_with_the_command_that_helps(lab: Path, mode: int) -> None:
    key = lab / "runner-alice" / "key.pem"
    key.chmod(mode)
    with pytest.raises(NotConnected, match=re.escape(f"chmod 600 {key}")):
        identity(lab / "runner-alice")
    key.chmod(0o600)
    identity(lab / "runner-alice")


def test_nobody_is_signed_with_a_key_that_others_can_read(lab: Path) -> None:
    (lab / "ca" / "key.pem").chmod(0o644)
    with pytest.raises(NotConnected, match="chmod 600"):
        make_member(lab / "ca", lab / "runner-eve", "runner-eve")
    assert not (lab / "runner-eve").exists()


def _expired(lab: Path) -> None:
    renew_member(lab / "ca", lab / "runner-alice", days=-1)


def _foreign_ca(lab: Path) -> None:
    make_authority(lab / "other", "test lab")
    (lab / "runner-alice" / "ca.pem").write_bytes((lab / "other" / "ca.pem").read_bytes())


def _foreign_key(lab: Path) -> None:
    (lab / "runner-alice" / "key.pem").write_bytes((lab / "router" / "key.pem").read_bytes())


def _missing(lab: Path) -> None:
    (lab / "runner-alice" / "certificate.pem").unlink()


def _garbled(lab: Path) -> None:
    (lab / "runner-alice" / "certificate.pem").write_text("no certificate")


def _garbled_key(lab: Path) -> None:
    (lab / "runner-alice" / "key.pem").write_text("no key")


@pytest.mark.parametrize(
    ("harm", "said", "remedy"),
    [
        (_expired, r"certificate\.pem: it expired at 20", "lab renew"),
        (_foreign_ca, r"certificate\.pem: another authority signed it", "ca.pem of its own lab"),
        (_foreign_key, r"key\.pem: it is not the key of .*certificate\.pem", "as a whole"),
        (_missing, r"certificate\.pem: No such file", "bus.tls"),
        (_garbled, r"certificate\.pem: it is no certificate", "Copy"),
        (_garbled_key, r"key\.pem: it is no private key", "Copy"),
    ],
)
def test_what_is_wrong_with_a_member_is_said_with_its_file(
    lab: Path, harm: Callable[[Path], None], said: str, remedy: str
) -> None:
    harm(lab)
    with pytest.raises(NotConnected, match=said) as caught:
        identity(lab / "runner-alice")
    assert remedy in caught.value.remedy


def test_a_renewed_certificate_is_for_the_same_key_and_the_same_hosts(lab: Path) -> None:
    renew_member(lab / "ca", lab / "router", days=700)
    assert security.days_left(identity(lab / "router").expires) in (699, 700)
    assert handshake(lab / "runner-alice", lab / "router", "router.lab") == "runner-alice"


def test_an_expired_certificate_can_be_renewed(lab: Path) -> None:
    renew_member(lab / "ca", lab / "runner-alice", days=-1)
    renew_member(lab / "ca", lab / "runner-alice")
    assert handshake(lab / "runner-alice", lab / "router") == "runner-alice"


# -- which member a process is ----------------------------------------------------------------------------------------


def test_a_process_is_the_only_member_of_its_role(lab: Path) -> None:
    tls = TlsConfig(folder=str(lab))
    assert find_identity(tls, "runner").name == "runner-alice"
    assert find_identity(tls, "router").name == "router"
    assert find_identity(tls, "viewer").name == "runner-alice"  # who may command may look
    with pytest.raises(NotConnected, match="device's certificate"):
        find_identity(tls, "device")


def test_of_several_members_one_is_named(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tls = TlsConfig(folder=str(lab))
    make_member(lab / "ca", lab / "runner-bob", "runner-bob")
    make_member(lab / "ca", lab / "device-bench", "device-bench")
    with pytest.raises(NotConnected, match=r"runner-alice, runner-bob.*EXTRINSIC_IDENTITY"):
        find_identity(tls, "runner")
    monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-bob")
    assert find_identity(tls, "runner").name == "runner-bob"
    assert find_identity(tls, "device").name == "device-bench"  # a runner serves nothing
    monkeypatch.setenv("EXTRINSIC_IDENTITY", "runner-eve")
    with pytest.raises(NotConnected, match="not there"):
        find_identity(tls, "runner")


def test_keys_from_elsewhere_are_three_files(lab: Path) -> None:
    files = {name.split(".")[0]: str(lab / "runner-alice" / name) for name in FILES}
    assert find_identity(TlsConfig(**files), "runner").name == "runner-alice"


def test_every_certificate_is_listed_with_the_days_that_it_has_left(lab: Path) -> None:
    renew_member(lab / "ca", lab / "runner-alice", days=-1)
    renew_member(lab / "ca", lab / "router", days=20)
    listed = dict(certificates(TlsConfig(folder=str(lab))))
    assert listed["runner-alice"] in (-1, -2)
    assert listed["router"] in (19, 20)
    assert listed["test lab"] in (3649, 3650)


# -- what a station file may say --------------------------------------------------------------------------------------


def test_a_tls_endpoint_means_a_router_and_any_other_none() -> None:
    assert BusConfig(endpoint="tls/router.lab:7447", tls=TlsConfig(folder="lab")).mode == "client"
    assert BusConfig(endpoint="tcp/127.0.0.1:7447").mode == "peer"


@pytest.mark.parametrize(
    ("bus", "said"),
    [
        ({"endpoint": "tls/router.lab:7447"}, "a tls endpoint needs keys"),
        ({"tls": {"folder": "lab"}}, "keys are of no use at a tcp endpoint"),
        ({"endpoint": "tls/r:1", "tls": {"folder": "lab"}, "mode": "peer"}, "go round the router"),
        ({"endpoint": "tls/r:1", "tls": {"folder": "lab"}, "insecure": True}, "not insecure"),
        ({"endpoint": "tls/r:1", "tls": {"ca": "ca.pem"}}, "no complete set of keys"),
        ({"endpoint": "tls/r:1", "tls": {"folder": "lab", "key": "k"}}, "no complete set of keys"),
        ({"endpoint": "tls/r:1", "tls": {}}, "no complete set of keys"),
    ],
)
def test_a_bus_that_makes_no_sense_is_refused_in_words(bus: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse(BusConfig, Document(bus, {}, "lab1.yaml"))
    with pytest.raises(ValidationError):
        BusConfig.model_validate(bus)


@pytest.mark.parametrize(
    ("endpoint", "own"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.8.8.8:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.4:7447", False),
        ("tcp/localhost.example.org:7447", False),
        ("tls/router.lab:7447", False),
    ],
)
def test_only_this_machine_can_reach_loopback(endpoint: str, own: bool) -> None:
    assert is_loopback(endpoint) is own


def open_station(port: int, **bus: object) -> StationConfig:
    return StationConfig.model_validate(
        {
            "name": "sim",
            "bus": {"endpoint": f"tcp/0.0.0.0:{port}", **bus},
            "devices": {"arm": {"kind": "arm"}},
        }
    )


def test_listening_to_strangers_without_keys_is_refused(endpoint: str) -> None:
    config = open_station(int(endpoint.rpartition(":")[2]))
    with pytest.raises(InputError, match="whoever reaches it may command the arm"):
        station_bus(config, "device")


def test_listening_to_strangers_is_possible_by_an_explicit_word_and_a_warning(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    with station_bus(open_station(int(endpoint.rpartition(":")[2]), insecure=True), "device") as bus:
        assert isinstance(bus, Bus)
    assert "INSECURE" in caplog.text


def test_a_router_that_cannot_listen_says_where(lab: Path, endpoint: str) -> None:
    from drivers.wire.access import Access

    config = StationConfig.model_validate(
        {
            "name": "sim",
            "bus": {"endpoint": endpoint.replace("tcp/", "tls/"), "tls": {"folder": str(lab)}, "timeout": 1.0},
            "devices": {"arm": {"kind": "arm"}},
        }
    )
    access = Access(station="sim")
    with (
        Router(config, access, identity(lab / "router")),
        pytest.raises(NotConnected, match=re.escape(config.bus.endpoint)),
        Router(config, access, identity(lab / "router")),
    ):
        pass
