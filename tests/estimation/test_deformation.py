"""The deformation field of depth pictures that are made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.deformation import Deformation, DepthReader, Unusable
from estimation.tactile_pose import FingerModel, PoseStatus
from mechanics.camera import CameraModel
from mechanics.readings import ImageReading, Stamp, Status

WIDTH, HEIGHT, FOCAL = 224, 171, 186.4
K = np.array([[FOCAL, 0, 111.5], [0, FOCAL, 85.0], [0, 0, 1]])
#: the camera 100 mm above the finger's frame, looking down on it; its x is the finger's y
X_FC = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.1], [0, 0, 0, 1]], float)
FINGER_IN_EE = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
ray_x, ray_y = (column - 111.5) / FOCAL, (row - 85.0) / FOCAL


def sphere(radius: float = 0.08) -> np.ndarray:
    """Depth [m] of a ball's inside whose apex is 100 mm away: where rays meet it, in closed form."""
    # |z (rx, ry, 1) − (0, 0, c)| = radius, the farther root
    c, a = 0.1 - radius, 1 + ray_x**2 + ray_y**2
    return (c + np.sqrt(c * c - a * (c * c - radius**2))) / a


def tilted_face(deep: float = 0.012, tilt=(0.05, -0.03)) -> np.ndarray:
    """Depth [m] of the plane z = deep + tilt · (x, y) of the finger's frame."""
    # a point at depth d is (d ry, d rx, 0.1 − d) in F
    return (0.1 - deep) / (1 + tilt[0] * ray_y + tilt[1] * ray_x)


def encoded(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth * 1e4).astype(np.uint16)


def reading(picture: np.ndarray, status: Status = Status.OK) -> ImageReading:
    return ImageReading(Stamp(0, 0, 0, "finger", status), picture, "16UC1")


UNTOUCHED = encoded(sphere())


@pytest.fixture(scope="module")
def reader() -> DepthReader:
    camera = CameraModel(WIDTH, HEIGHT, K, X_WC=X_FC)
    return DepthReader(FingerModel("soft_bubble", camera, FINGER_IN_EE, UNTOUCHED, {"depth_unit": 1e-4}))


def pressed(noise: float = 0.3e-3, seed: int = 0, **face) -> np.ndarray:
    """A face in the ball, as one that is a plane where it is nearer than the ball."""
    depth = np.minimum(sphere(), tilted_face(**face))
    return encoded(depth + noise * np.random.default_rng(seed).standard_normal(depth.shape))


def test_face_is_found_with_its_tilt_and_the_pixels_noise(reader: DepthReader) -> None:
    field = reader.read(reading(pressed(deep=0.012, tilt=(0.05, -0.03))))
    assert isinstance(field, Deformation)
    assert field.plane[0] == pytest.approx(0.012, abs=5e-5)
    np.testing.assert_allclose(field.plane[1:], (0.05, -0.03), atol=2e-3)
    assert field.noise == pytest.approx(0.3e-3, rel=0.1)
    assert field.alike == pytest.approx(1.0, abs=0.5)  # white
    on_face = tilted_face() < sphere() - 2e-3
    off_face = tilted_face() > sphere() + 2e-3
    assert field.flat[on_face].mean() > 0.95 and field.flat[off_face].mean() < 0.01
    assert np.median(np.abs(field.beyond[on_face])) < 0.3e-3
    np.testing.assert_allclose(field.inward[on_face], (sphere() - tilted_face())[on_face], atol=2e-3)


def test_points_of_the_face_and_pixels_are_each_others_inverse(reader: DepthReader) -> None:
    field = reader.read(reading(pressed()))
    assert isinstance(field, Deformation)
    depth = tilted_face()
    # by the camera's own geometry: a pixel's ray, as far as the face
    expected = np.stack((depth * ray_y, depth * ray_x), axis=-1)[40:130:10, 60:160:10]
    pixels = np.stack((column, row), axis=-1)[40:130:10, 60:160:10].astype(float)
    np.testing.assert_allclose(field.points(pixels), expected, atol=1e-4)
    np.testing.assert_allclose(field.pixels(expected), pixels, atol=0.2)
    assert field.pitch == pytest.approx(0.088 / FOCAL, rel=0.02)


def test_curvature_of_the_untouched_ball_is_two_over_its_radius(reader: DepthReader) -> None:
    field = reader.read(reading(pressed()))
    assert isinstance(field, Deformation)
    assert field.curvature(np.zeros(2)) == pytest.approx(2 / 0.08, rel=0.1)


def test_holes_are_filled_and_not_taken_for_measured(reader: DepthReader) -> None:
    picture = pressed()
    picture[80:84, 100:106] = 0
    field = reader.read(reading(picture))
    assert isinstance(field, Deformation)
    assert not field.valid[80:84, 100:106].any()
    assert np.abs(field.beyond[80:84, 100:106]).max() < 0.5e-3


def test_a_pixel_that_jumps_is_not_taken_for_measured(reader: DepthReader) -> None:
    picture = pressed()
    picture[90, 110] += 50
    field = reader.read(reading(picture))
    assert isinstance(field, Deformation)
    assert not field.valid[90, 110] and abs(field.beyond[90, 110]) < 0.5e-3


def of_another_moment(rows=slice(70, None)) -> np.ndarray:
    picture = pressed()
    picture[rows] = UNTOUCHED[rows]
    return picture


def block_of_another_moment() -> np.ndarray:
    picture = pressed()
    picture[60:110, 90:150] = UNTOUCHED[60:110, 90:150]
    return picture


def with_rows(value: int, rows: int = 12) -> np.ndarray:
    picture = pressed()
    picture[60 : 60 + rows] = value
    return picture


def garbage() -> np.ndarray:
    picture = pressed()
    picture[40:100, 60:120] = np.random.default_rng(0).integers(0, 65535, (60, 60))
    return picture


@pytest.mark.parametrize(
    ("picture", "status"),
    [
        (UNTOUCHED, PoseStatus.NO_CONTACT),
        (pressed(deep=0.003), PoseStatus.NO_EDGE),
        (np.zeros_like(UNTOUCHED), PoseStatus.BLANK),
        (np.full_like(UNTOUCHED, 900), PoseStatus.BLANK),
        (np.full_like(UNTOUCHED, 65535), PoseStatus.BLANK),
        (with_rows(65535), PoseStatus.SATURATED),
        (with_rows(0), PoseStatus.TORN),
        (with_rows(0, 4), PoseStatus.TORN),
        (of_another_moment(), PoseStatus.TORN),
        (of_another_moment(slice(70, 85)), PoseStatus.TORN),
        (block_of_another_moment(), PoseStatus.TORN),
        (garbage(), PoseStatus.TORN),
        (UNTOUCHED[:100], PoseStatus.UNTRUSTED),
        (UNTOUCHED.astype(np.uint8), PoseStatus.UNTRUSTED),
    ],
    ids=[
        "untouched", "shallow", "no depth", "one depth", "all at the end", "rows at the end", "rows missing",
        "four rows missing", "half of another moment", "rows of another moment", "block of another moment", "garbage",
        "other size", "other type",
    ],
)  # fmt: skip
def test_a_picture_of_no_use_says_why(reader: DepthReader, picture: np.ndarray, status: PoseStatus) -> None:
    found = reader.read(reading(picture))
    assert isinstance(found, Unusable)
    assert found.status is status and found.reason


@pytest.mark.parametrize(
    ("said", "status"),
    [
        (Status.STALE, PoseStatus.UNTRUSTED),
        (Status.INVALID, PoseStatus.UNTRUSTED),
        (Status.SATURATED, PoseStatus.SATURATED),
        (Status.NO_CONTACT, PoseStatus.NO_CONTACT),
    ],
)
def test_what_a_reading_says_of_itself_is_believed(reader: DepthReader, said: Status, status: PoseStatus) -> None:
    found = reader.read(reading(pressed(), said))
    assert isinstance(found, Unusable) and found.status is status


def test_a_whole_picture_is_not_called_torn_whatever_its_noise(reader: DepthReader) -> None:
    for seed in range(10):
        noise = (0.05e-3, 0.3e-3, 0.6e-3)[seed % 3]
        picture = pressed(noise=noise, seed=seed, deep=0.01 + 5e-4 * seed, tilt=(0.02 * (seed % 3 - 1), 0.03))
        assert isinstance(reader.read(reading(picture)), Deformation)


def test_a_finger_whose_pictures_are_no_depths_is_refused() -> None:
    camera = CameraModel(WIDTH, HEIGHT, K, X_WC=X_FC)
    with pytest.raises(ValueError, match="depth"):
        DepthReader(FingerModel("gelslim", camera, FINGER_IN_EE, np.zeros((HEIGHT, WIDTH, 3), np.uint8)))
