"""Small inputs that ask for much: refused before the room is made or the time spent. Each within the watchdog."""

import io
import json
import struct
import zipfile
import zlib

import numpy as np
import pytest
import zstandard

from drivers.errors import ProtocolError
from drivers.wire import codec, messages
from experiments import files
from mechanics.yaml_input import InputError
from planning.plan_file import PlanFileError
from tests.fuzz.decoders import DECODERS
from tests.fuzz.guard import Watch
from tests.fuzz.on_the_bus import READING_TYPES


def given(name, data):
    """The error of a decoder, or None, within a second and 200 MB."""
    try:
        with Watch().one():
            DECODERS[name].decode(data)
    except DECODERS[name].errors as error:
        return error
    return None


def laughs():
    """Nine levels of ten aliases each: a billion values in half a kilobyte."""
    levels = [b"a: &a [1,1,1,1,1,1,1,1,1,1]\n"]
    for i in range(9):
        levels.append(b"%c: &%c [%s]\n" % (98 + i, 98 + i, b",".join([b"*%c" % (97 + i)] * 10)))
    return b"".join(levels)


YAML = {
    "alias bomb": laughs(),
    "deep lists": b"[" * 200_000,
    "deep mappings": b"{a: " * 60_000,
    "deep blocks": b"a:\n" + b"- " * 120_000,
    "many keys": b"".join(b"k%d: 1\n" % i for i in range(24_000)),
    "many values": b"a: [" + b"1," * 120_000 + b"]",
    "aliases of one": b"a: &x [1]\nb: [" + b"*x," * 80_000 + b"]",
    "more than a file may have": b"a: " + b"x" * 300_000,
    "a number of many digits": b"a: " + b"9" * 200_000,
}


@pytest.mark.parametrize("case", YAML)
def test_yaml_that_grows_is_refused(case):
    assert isinstance(given("yaml", YAML[case]), InputError)


@pytest.mark.parametrize("line", [b"key%d: 1\n", b"'%d': {a: [1]}\n"])
def test_of_thousands_of_faults_some_are_told(line):
    error = given("experiment", b"".join(line % i for i in range(3000)))
    assert isinstance(error, InputError)
    assert len(error.problems) == 51
    assert "there is more that is wrong" in str(error)


def test_a_key_of_many_parts_is_refused():
    with pytest.raises(InputError), Watch().one():
        files.load("grasped_static", sets=["calibration." + ".".join("a" * 60_000) + "=1"])


@pytest.mark.parametrize(
    "type_name", [messages.DETECTIONS, messages.IMAGE, messages.COMPRESSED_IMAGE, messages.TRUTH, *codec.TYPES.values()]
)
@pytest.mark.parametrize("size", [2**32 - 1, 2**31, 2**28])
def test_a_sequence_longer_than_its_payload_is_refused(type_name, size):
    [seed, *_] = [s for s in DECODERS["reading"].seeds() if s[0] == READING_TYPES.index(type_name)]
    for at in range(25, len(seed) - 3):
        given("reading", seed[:at] + struct.pack("<I", size) + seed[at + 4 :])


def compressed(picture, encoding="16UC1"):
    header = messages.header(5, "world")
    data = np.frombuffer(picture, np.uint8)
    return messages.encode(messages.message(messages.COMPRESSED_IMAGE, header=header, format=encoding, data=data))


def chunk(kind, data, length=None):
    size = struct.pack(">I", len(data) if length is None else length)
    return size + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, *between, packed=b""):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(between) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def jpeg(frame, width, height):
    body = struct.pack(">HBHHB", 11, 8, height, width, 1) + b"\x01\x11\x00"
    return b"\xff\xd8\xff" + bytes([frame]) + body + b"\xff\xd9" + bytes(20)


PICTURES = {
    "30 000 pixels square": png(30_000, 30_000, packed=zlib.compress(bytes(60_001 * 100))),
    "a chunk of a gigabyte": png(8, 6, chunk(b"tEXt", b"", length=2**30)),
    "packed text": png(8, 6, chunk(b"zTXt", b"a\x00\x00" + zlib.compress(bytes(2**27)))),
    "an animation": png(8, 6, chunk(b"acTL", struct.pack(">II", 2**31, 0))),
    "a jpeg of 65 535 pixels square": jpeg(0xC0, 65_535, 65_535),
    "a progressive jpeg": jpeg(0xC2, 640, 480),
    "a tiff": b"II*\x00" + bytes(100),
    "nothing": b"",
}


@pytest.mark.parametrize("case", PICTURES)
def test_a_picture_is_measured_before_it_is_unpacked(case):
    with pytest.raises(ProtocolError), Watch().one():
        codec.decode_reading(messages.COMPRESSED_IMAGE, compressed(PICTURES[case]), 0)


def test_a_frame_s_name_of_a_megabyte_is_not_kept():
    """What is remembered to be quick must be no place to leave gigabytes in."""
    values = struct.pack("<6d", *range(6))
    before = codec._frame.cache_info().currsize, codec._layout.cache_info().currsize
    for i in range(4):
        name = b"%07d" % i + b"x" * 2**20 + b"\x00"
        padding = bytes(-(12 + len(name)) % 8)
        payload = b"\x00\x01\x00\x00" + struct.pack("<iII", 1, 2, len(name)) + name + padding + values
        assert codec.decode_reading(messages.WRENCH, payload, 0).stamp.frame.startswith(f"{i:07d}")
    assert (codec._frame.cache_info().currsize, codec._layout.cache_info().currsize) == before


def archive(members, packing=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packing) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return out.getvalue()


def header(shape, kind="<f8"):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


ARCHIVES = {
    "an array of a terabyte": archive({"ee": header((2**37, 1)), "plan": header((), "<U2")}),
    "text of a terabyte": archive({"plan": header((), "<U999999999")}),
    "a gigabyte of nothing": archive({"ee": header((2**27, 1)) + bytes(2**28), "plan": b""}),
    "objects": archive({"plan": header((1,), "|O") + b"cos\nsystem\n."}),
}


@pytest.mark.parametrize("case", ARCHIVES)
def test_a_plan_file_is_measured_before_room_is_made_for_it(case):
    assert isinstance(given("plan_file", ARCHIVES[case]), PlanFileError)


def test_json_that_is_too_deep_is_no_plan_no_results_and_no_campaign():
    deep = b"[" * 200_000
    assert given("plan_json", deep) is None
    assert isinstance(given("results", b'{"status": "completed", "trials": ' + deep), InputError)
    assert isinstance(given("campaign", deep + b"\n\n" + deep), InputError)
    nested = json.loads("[" * 900 + "]" * 900)
    results = {"status": "completed", "reason": "", "trials": [], "timing": nested}
    assert isinstance(given("results", json.dumps(results).encode()), InputError)


def mcap(*records):
    body = b"".join(struct.pack("<BQ", kind, len(data)) + data for kind, data in records)
    return b"\x89MCAP0\r\n" + body


def packed(size, data, crc=0):
    return 6, struct.pack("<QQQII", 0, 0, size, crc, 4) + b"zstd" + struct.pack("<Q", len(data)) + data


def many_messages(size):
    record = struct.pack("<BQ", 5, 22) + bytes(22)
    return record * (size // len(record))


LOGS = {
    "a chunk of four gigabytes of zeros": lambda: mcap(packed(2**32, zstandard.compress(bytes(2**27)))),
    "a chunk that unpacks to more than it says": lambda: mcap(packed(100, zstandard.compress(bytes(2**27)))),
    "a chunk whose frame says more than it has": lambda: mcap(
        packed(2**26, b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + b"\x01\x00\x00")
    ),
    "a record longer than the file": lambda: b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, 2**63),
    "an attachment longer than its record": lambda: mcap((9, struct.pack("<QQII", 0, 0, 0, 0) + b"\xff" * 7 + b"\x7f")),
    "a channel with a name of four gigabytes": lambda: mcap((4, struct.pack("<HHI", 1, 0, 2**32 - 1))),
    "fifty megabytes of zeros": lambda: b"\x89MCAP0\r\n" + bytes(50_000_000),
    "a hundred thousand messages in four kilobytes": lambda: mcap(
        packed(31 * 100_000, zstandard.compress(many_messages(31 * 100_000)))
    ),
}


@pytest.mark.parametrize("case", LOGS)
@pytest.mark.parametrize("name", ["log", "log_repair"])
def test_a_log_that_asks_for_much_is_read_as_far_as_it_is_one(name, case):
    given(name, LOGS[case]())
