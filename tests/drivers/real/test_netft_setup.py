"""What a box says of itself, and what else may come instead."""

import pytest
from scipy import constants

from drivers.real.netft_setup import MOST_BYTES, HttpError, SetupError, document_of, parse

SETUP = {
    "cfgcalsn": "FT12345", "scfgfu": "N", "scfgtu": "Nm", "cfgcpf": "1000000", "cfgcpt": "2000000",
    "cfgmr": "130;130;400;10;10;10", "cfgtfx": "0;0;0;0;0;0", "comrdte": "Enabled", "comrdtrate": "1000",
    "comrdtbsiz": "1", "setuserfilter": "4", "setbias": "1;2;3;4;5;6", "mfgdigver": "2.2.59",
}  # fmt: skip


def document(**changed: str | None) -> bytes:
    fields = {name: value for name, value in (SETUP | changed).items() if value is not None}
    body = "".join(f"<{name}>{value}</{name}>" for name, value in fields.items())
    return f'<?xml version="1.0"?><netft>{body}</netft>'.encode()


def test_a_setup_is_read():
    box = parse(document())
    assert (box.serial, box.firmware, box.rate, box.records, box.rdt) == ("FT12345", "2.2.59", 1000.0, 1, True)
    assert box.filter == 73.0
    assert box.full_scale == (130e6, 130e6, 400e6, 20e6, 20e6, 20e6)
    assert (box.force, box.torque) == (1e-6, 0.5e-6)


@pytest.mark.parametrize(
    ("name", "newton"),
    [
        ("N", 1.0),
        ("lbf", constants.lbf),
        ("klbf", 1e3 * constants.lbf),
        ("kN", 1e3),
        ("kgf", constants.kgf),
        ("kg", constants.kgf),
        ("gf", 1e-3 * constants.kgf),
        ("g", 1e-3 * constants.kgf),
    ],
)
def test_every_unit_of_force_becomes_newtons(name, newton):
    assert parse(document(scfgfu=name, cfgcpf="250")).force == pytest.approx(newton / 250, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "newton_metre"),
    [
        ("Nm", 1.0),
        ("N-m", 1.0),
        ("Nmm", 1e-3),
        ("N-mm", 1e-3),
        ("kNm", 1e3),
        ("lbf-in", constants.lbf * constants.inch),
        ("lbf-ft", constants.lbf * constants.foot),
        ("kgf-cm", constants.kgf * 0.01),
        ("kg-cm", constants.kgf * 0.01),
    ],
)
def test_every_unit_of_torque_becomes_newton_metres(name, newton_metre):
    assert parse(document(scfgtu=name, cfgcpt="250")).torque == pytest.approx(newton_metre / 250, rel=1e-12)


def test_what_a_box_does_not_tell_is_unknown():
    names = ("comrdte", "comrdtrate", "comrdtbsiz", "setuserfilter", "cfgmr", "cfgcalsn")
    box = parse(document(**dict.fromkeys(names)))
    assert (box.rdt, box.rate, box.records, box.filter, box.full_scale, box.serial) == (None, None, None, None, (), "")


def test_a_range_about_another_origin_is_none():
    assert parse(document(cfgtfx="0;0;132.71;0;0;0")).full_scale == ()


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"cfgcpf": None}, "cfgcpf"),
        ({"cfgcpt": ""}, "cfgcpt"),
        ({"scfgfu": None}, "scfgfu"),
        ({"scfgfu": "stone"}, "stone"),
        ({"scfgtu": "N"}, "scfgtu"),
        ({"cfgcpf": "0"}, "cfgcpf"),
        ({"cfgcpf": "-1000000"}, "cfgcpf"),
        ({"cfgcpf": "nan"}, "cfgcpf"),
        ({"cfgcpf": "inf"}, "cfgcpf"),
        ({"cfgcpf": "1_000"}, "cfgcpf"),
        ({"cfgcpf": "٣"}, "cfgcpf"),
        ({"cfgcpf": "1,000,000"}, "cfgcpf"),
        ({"cfgcpt": "9" * 4000}, "cfgcpt"),
        ({"comrdtrate": "often"}, "comrdtrate"),
        ({"comrdtbsiz": "1.5"}, "comrdtbsiz"),
        ({"setuserfilter": "-1"}, "setuserfilter"),
    ],
)
def test_a_setup_without_meaning_is_refused_by_name(changed, named):
    with pytest.raises(SetupError, match=named):
        parse(document(**changed))


def test_a_value_that_stands_there_twice_is_refused():
    with pytest.raises(SetupError, match="cfgcpf"):
        parse(document().replace(b"</netft>", b"<cfgcpf>1</cfgcpf></netft>"))


BOMB = b'<?xml version="1.0"?><!DOCTYPE n [<!ENTITY a "aaaaaaaaaa">' + b"".join(
    b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10) for i in range(9)
)
BOMB += b"]><netft><cfgcpf>&j;</cfgcpf></netft>"
FOREIGN = b'<!DOCTYPE n [<!ENTITY x SYSTEM "file:///etc/hostname">]><netft><prodname>&x;</prodname></netft>'


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(BOMB, id="a billion laughs"),
        pytest.param(FOREIGN, id="a file of ours"),
        pytest.param(b"<!DOCTYPE netft>" + document(), id="a document type"),
        pytest.param(document()[:-20], id="cut off"),
        pytest.param(b"", id="nothing"),
        pytest.param(b"<html><body>Login</body>", id="another page"),
        pytest.param(b"<html><body>Login</body></html>", id="another page that is XML"),
        pytest.param(bytes(range(256)), id="no text"),
        pytest.param(b'<?xml version="1.0" encoding="martian"?><netft/>', id="an unknown encoding"),
        pytest.param(b'<?xml version="1.0" encoding="utf-7"?><netft/>', id="an encoding of many bytes"),
        pytest.param(b"<a>" * 40_000, id="deep"),
        pytest.param(b"<a>" * 40_000 + b"</a>" * 40_000, id="deep and whole"),
    ],
)
def test_what_is_no_setup_is_refused(data):
    with pytest.raises(SetupError):
        parse(data)


def answer(body: bytes, status: str = "200 OK", *headers: str) -> bytes:
    lines = "".join(f"{header}\r\n" for header in headers)
    return f"HTTP/1.1 {status}\r\n{lines}\r\n".encode() + body


def test_an_answer_holds_its_document():
    assert document_of(answer(b"<netft/>", "200 OK", "Content-Length: 8")) == b"<netft/>"
    assert document_of(answer(b"<netft/>")) == b"<netft/>"
    chunked = answer(b"3\r\n<ne\r\n5\r\ntft/>\r\n0\r\n\r\n", "200 OK", "Transfer-Encoding: chunked")
    assert document_of(chunked) == b"<netft/>"


@pytest.mark.parametrize(
    "data",
    [
        answer(b"", "500 Internal Server Error"),
        answer(b"", "404 Not Found"),
        answer(b"", "301 Moved", "Location: http://127.0.0.1/"),
        answer(b"<ne", "200 OK", "Content-Length: 8"),
        answer(b"<ne", "200 OK", f"Content-Length: {10**30}"),
        answer(b"ffffffffffffffffff\r\n<ne", "200 OK", "Transfer-Encoding: chunked"),
        b"",
        b"SSH-2.0-OpenSSH_9.2\r\n",
        bytes(range(256)) * 20,
        b"HTTP/1.1 200 OK\r\n" + b"a" * 100_000,
    ],
)
def test_what_is_no_whole_answer_is_refused(data):
    with pytest.raises(HttpError):
        document_of(data)


def test_a_whole_answer_is_small():
    assert len(document()) < MOST_BYTES < 2**20
