from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from drivers.errors import ProtocolError
from drivers.wire import codec, messages
from drivers.wire.codec import TYPES, Reading, decode_reading, encode_reading
from drivers.wire.records import STREAMS, Record, decode_record, encode_record
from mechanics.readings import (
    ContactTruth,
    GripperReading,
    ImageReading,
    PoseReading,
    Stamp,
    Status,
    TagDetection,
    TagReading,
    TruthReading,
    WrenchReading,
)
from mechanics.records import (
    ContactBelief,
    EventRecord,
    LookRecord,
    PhaseRecord,
    PlanarState,
    StatusRecord,
    TrialRecord,
    WaypointRecord,
)
from mechanics.task_plane import TaskPlane

STOCK = get_typestore(Stores.ROS2_HUMBLE)
numbers = st.floats(-1e6, 1e6)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
captures = st.integers(0, 2**31 * 10**9 - 1)


def vectors(size: int, values: st.SearchStrategy[float] = numbers) -> st.SearchStrategy[np.ndarray]:
    return st.lists(values, min_size=size, max_size=size).map(np.array)


@st.composite
def stamps(draw: st.DrawFn) -> Stamp:
    capture = draw(captures)
    return Stamp(capture, capture, draw(st.integers(0, 2**40)), draw(names), draw(st.sampled_from(Status)))


@st.composite
def poses(draw: st.DrawFn) -> PoseReading:
    angle = draw(st.floats(-math.pi, math.pi, exclude_min=True))
    return PoseReading(draw(stamps()), np.array([draw(numbers), draw(numbers), angle]))


wrenches = st.builds(WrenchReading, stamps(), vectors(6, st.floats(allow_nan=False)))
grippers = st.builds(GripperReading, stamps(), numbers, numbers, st.booleans())
detections = st.builds(
    TagDetection,
    st.integers(0, 586),
    vectors(8).map(lambda v: v.reshape(4, 2)),
    st.integers(0, 2),
    st.floats(0, 255, width=32),
    st.none() | st.integers(0, 2**20).map(lambda n: n / 2**20),  # it travels in 32 bits
)
tags = st.builds(TagReading, stamps(), st.lists(detections, max_size=4).map(tuple))
contacts = st.builds(
    ContactTruth, names, names, vectors(2), vectors(2), vectors(2), st.sampled_from(["stick", "slip+", "slip-"])
)
truths = st.builds(
    TruthReading,
    stamps(),
    vectors(3),
    vectors(3),
    st.none() | vectors(3),
    vectors(3),
    st.lists(contacts, max_size=3).map(tuple),
)


@st.composite
def images(draw: st.DrawFn) -> ImageReading:
    encoding = draw(st.sampled_from(["mono8", "bgr8", "16UC1"]))
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    shape = (height, width, 3) if encoding == "bgr8" else (height, width)
    dtype = np.uint16 if encoding == "16UC1" else np.uint8
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return ImageReading(draw(stamps()), rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True), encoding)


readings = st.one_of(poses(), wrenches, grippers, tags, truths, images())


def same(a: object, b: object) -> bool:
    """Equality of readings field by field; arrays by value, shape and type."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    fields = getattr(type(a), "__dataclass_fields__", None)
    if fields is not None:
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in fields)
    return a == b


def returned(reading: Reading) -> Reading:
    stamp = reading.stamp
    return decode_reading(TYPES[type(reading)], encode_reading(reading), stamp.sequence, int(stamp.status))


@given(st.one_of(wrenches, grippers, tags, truths, images()))
def test_a_reading_comes_back_as_it_was_sent(reading: Reading) -> None:
    assert same(returned(reading), reading)


@given(poses())
def test_a_pose_comes_back_to_the_last_digits(reading: PoseReading) -> None:
    back = returned(reading)
    assert isinstance(back, PoseReading)
    assert back.stamp == reading.stamp
    assert np.array_equal(back.pose[:2], reading.pose[:2])
    assert abs(math.remainder(back.pose[2] - reading.pose[2], 2 * math.pi)) < 1e-15


@given(poses())
def test_a_pose_on_the_bus_is_the_task_planes_embedding(reading: PoseReading) -> None:
    message = messages.decode(encode_reading(reading), messages.POSE).pose
    position, turn = message.position, message.orientation
    X = np.asarray(TaskPlane().pose_to_se3(reading.pose))
    assert np.allclose((position.x, position.y, position.z), X[:3, 3], rtol=0, atol=1e-12)
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    assert np.allclose(rotation, X[:3, :3], rtol=0, atol=1e-12)


@given(st.one_of(poses(), wrenches))
def test_the_direct_path_writes_the_bytes_of_a_stock_ros_serialiser(reading: Reading) -> None:
    type_name = TYPES[type(reading)]
    payload = encode_reading(reading)
    assert bytes(STOCK.serialize_cdr(STOCK.deserialize_cdr(payload, type_name), type_name)) == payload


@given(st.one_of(poses(), wrenches))
def test_big_endian_messages_of_others_are_read(reading: Reading) -> None:
    type_name = TYPES[type(reading)]
    message = STOCK.deserialize_cdr(encode_reading(reading), type_name)
    swapped = bytes(STOCK.serialize_cdr(message, type_name, little_endian=False))
    assert same(
        decode_reading(type_name, swapped, reading.stamp.sequence, int(reading.stamp.status)), returned(reading)
    )


@given(st.sampled_from([*TYPES.values(), messages.COMPRESSED_IMAGE]), st.binary(max_size=300))
def test_garbage_is_a_protocol_error_and_nothing_else(type_name: str, payload: bytes) -> None:
    for head in (b"", b"\x00\x01\x00\x00"):
        try:
            reading = decode_reading(type_name, head + payload, 0)
        except ProtocolError:
            continue
        assert reading.stamp.capture_ns % 10**9 < 10**9  # by chance it was a message: then it is a whole one


@given(readings, st.data())
def test_a_message_cut_short_is_never_a_reading(reading: Reading, data: st.DataObject) -> None:
    payload = encode_reading(reading)
    cut = data.draw(st.integers(0, len(payload) - 4))  # up to three bytes may be padding
    with pytest.raises(ProtocolError):
        decode_reading(TYPES[type(reading)], payload[:cut], 0)


@given(readings, st.data())
def test_a_flipped_byte_never_raises_anything_else(reading: Reading, data: st.DataObject) -> None:
    payload = bytearray(encode_reading(reading))
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        decode_reading(TYPES[type(reading)], bytes(payload), 0)
    except ProtocolError as error:
        assert error.device == "wire"


def test_a_pose_out_of_the_plane_is_refused() -> None:
    message = messages.decode(encode_reading(PoseReading(Stamp(0, 0, 0, "world"), np.zeros(3))), messages.POSE)
    message.pose.position.y = 0.01
    with pytest.raises(ProtocolError, match="task plane"):
        decode_reading(messages.POSE, messages.encode(message), 0)


def test_an_unknown_status_is_refused() -> None:
    payload = encode_reading(WrenchReading(Stamp(0, 0, 0, "ft"), np.zeros(6)))
    with pytest.raises(ProtocolError):
        decode_reading(messages.WRENCH, payload, 0, status=99)


def test_depth_survives_compression_exactly() -> None:
    depth = np.random.default_rng(0).integers(0, 65535, (48, 64), np.uint16)
    payload = codec.encode_compressed(ImageReading(Stamp(5, 5, 0, "bubble"), depth, "16UC1"))
    back = decode_reading(messages.COMPRESSED_IMAGE, payload, 0)
    assert isinstance(back, ImageReading)
    assert back.encoding == "16UC1"
    assert np.array_equal(back.image, depth)


def test_a_camera_picture_survives_compression_within_a_few_grey_levels() -> None:
    ramp = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    back = decode_reading(
        messages.COMPRESSED_IMAGE, codec.encode_compressed(ImageReading(Stamp(5, 5, 0, "camera"), ramp, "mono8")), 0
    )
    assert isinstance(back, ImageReading)
    assert np.abs(back.image.astype(int) - ramp).max() <= 4


@pytest.mark.parametrize("goodness", [0.0, math.nan, -1.0, 1.5, math.inf])
def test_a_goodness_that_is_none_of_ours_tells_no_ambiguity(goodness: float) -> None:
    value = messages.decode(
        encode_reading(TagReading(Stamp(0, 0, 0, "camera"), (TagDetection(3, np.eye(4, 2), 0, 50.0, 0.5),))),
        messages.DETECTIONS,
    )
    assert value.detections[0].goodness == 0.5
    value.detections[0].goodness = goodness
    read = decode_reading(messages.DETECTIONS, messages.encode(value), 0)
    assert isinstance(read, TagReading) and read.detections[0].ambiguity is None


def test_a_tags_homography_takes_its_square_to_its_corners() -> None:
    corners = np.array([[10.0, 90.0], [95.0, 85.0], [80.0, 12.0], [15.0, 8.0]])
    reading = TagReading(Stamp(0, 0, 0, "camera"), (TagDetection(3, corners, 0, 50.0),))
    found = messages.decode(encode_reading(reading), messages.DETECTIONS).detections[0]
    H = found.homography.reshape(3, 3)
    for (x, y), corner in zip([(-1, -1), (1, -1), (1, 1), (-1, 1)], corners, strict=True):
        u, v, s = H @ (x, y, 1)
        assert np.allclose((u / s, v / s), corner)
    u, v, s = H @ (0, 0, 1)
    assert (found.centre.x, found.centre.y) == pytest.approx((u / s, v / s))


states = st.builds(PlanarState, vectors(3), st.none() | vectors(3), st.none() | vectors(3), vectors(3))
beliefs = st.integers(0, 4).flatmap(
    lambda count: st.builds(
        ContactBelief, names, vectors(2 * count).map(lambda values: values.astype(float).reshape(-1, 2)), vectors(count)
    )
)
whole_numbers = st.integers(-(2**63), 2**63 - 1)
records = st.one_of(
    st.builds(
        WaypointRecord,
        captures,
        names,
        st.integers(0, 10**6),
        states,
        vectors(3),
        states,
        st.none() | states,
        st.none() | states,
        st.none() | beliefs,
    ),
    st.builds(TrialRecord, captures, names, names, names, names, names, names),
    st.builds(PhaseRecord, captures, names, names),
    st.builds(EventRecord, captures, names, names),
    st.lists(st.tuples(names, whole_numbers, whole_numbers), max_size=4).flatmap(
        lambda reads: st.builds(
            LookRecord, captures, names, names, names, *(st.just(tuple(read[i] for read in reads)) for i in range(3))
        )
    ),
    st.builds(StatusRecord, captures, names, whole_numbers, st.sampled_from([int(status) for status in Status])),
)


@given(records)
def test_a_record_comes_back_as_it_was_written(
    record: Record,
) -> None:
    assert same(decode_record(STREAMS[type(record)][1], encode_record(record)), record)


@given(st.sampled_from([type_name for _, type_name in STREAMS.values()]), st.binary(max_size=200))
def test_a_garbled_record_is_a_protocol_error(type_name: str, payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode_record(type_name, b"\x00\x01\x00\x00\xff\xff\xff\xff\xff\xff\xff\xff" + payload)


def test_an_unknown_type_is_named() -> None:
    with pytest.raises(ProtocolError, match="no_such/msg/Thing"):
        messages.decode(b"", "no_such/msg/Thing")


def test_a_field_that_does_not_fit_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError):
        messages.encode(messages.message(messages.FLOAT, data="seven"))
