"""A picture is decoded where it is whole, and refused where a piece is missing."""

import struct

import cv2
import numpy as np
import pytest

from drivers.errors import ProtocolError
from drivers.real.jpeg import decoded
from tests.drivers.real.cameras import jpeg

NOISE = np.random.default_rng(1).integers(0, 256, (120, 160, 3), np.uint8)
SCENE = np.asarray(cv2.GaussianBlur(NOISE, (0, 0), 3), np.uint8)
WHOLE = jpeg(SCENE)


def test_a_whole_picture_is_what_was_taken():
    np.testing.assert_allclose(decoded("camera", WHOLE).astype(int), SCENE, atol=16)
    grey = decoded("camera", WHOLE, grey=True)
    assert grey.shape == SCENE.shape[:2]
    np.testing.assert_allclose(grey.astype(int), cv2.cvtColor(SCENE, cv2.COLOR_BGR2GRAY), atol=6)


def test_padding_behind_a_picture_is_no_harm():
    np.testing.assert_array_equal(decoded("camera", WHOLE + bytes(900)), decoded("camera", WHOLE))


def test_a_picture_is_not_turned_by_what_it_says_of_itself():
    orientation = struct.pack("<2sHIHHHIHHI", b"II", 42, 8, 1, 0x112, 3, 1, 6, 0, 0)  # 6: to be turned by 90°
    segment = b"Exif\0\0" + orientation
    said = WHOLE[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + WHOLE[2:]
    turned = cv2.imdecode(np.frombuffer(said, np.uint8), cv2.IMREAD_COLOR)
    assert turned is not None and turned.shape == (160, 120, 3)  # so the picture does say so
    np.testing.assert_array_equal(decoded("camera", said), decoded("camera", WHOLE))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 0.9, 0.999])
def test_a_picture_that_was_cut_short_is_refused(share):
    with pytest.raises(ProtocolError, match="camera: read a picture"):
        decoded("camera", WHOLE[: int(share * len(WHOLE))])


def test_two_pictures_in_one_are_refused():
    with pytest.raises(ProtocolError, match="piece missing"):
        decoded("camera", WHOLE[: len(WHOLE) // 2] + WHOLE)


def test_a_picture_that_claims_a_gigapixel_is_refused_before_there_is_room_for_it():
    frame = WHOLE.index(b"\xff\xc0")
    claims = bytearray(WHOLE)
    claims[frame + 5 : frame + 9] = struct.pack(">HH", 60_000, 60_000)
    with pytest.raises(ProtocolError, match="3600000000 pixels"):
        decoded("camera", bytes(claims))


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"hello", bytes(1000), cv2.imencode(".png", SCENE)[1].tobytes()])
def test_what_is_no_jpeg_is_refused(data):
    with pytest.raises(ProtocolError):
        decoded("camera", data)
