"""The simulated GelSlim: where its markers and edges lie, what it says of itself, and its noise."""

import json

import cv2
import numpy as np
import pytest
import shapely
from scipy.ndimage import gaussian_filter1d

from drivers.config import TactileConfig
from drivers.errors import NotConnected
from drivers.sim.gel import Face, GelPad
from drivers.sim.gel_noise import GelNoise
from drivers.sim.gelslim import SimGelSlim
from mechanics.readings import Status

from .finger_cases import BOARD, BOX, HEXAGON, FakeWorld, config, opened, pose, view


def moved(X: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 2) by complex numbers: a pose is z -> e^{iθ} z + (x + iy)."""
    z = np.exp(1j * X[2]) * (points[:, 0] + 1j * points[:, 1]) + complex(X[0], X[1])
    return np.stack((z.real, z.imag), axis=-1)


def pixels_of(sensor: SimGelSlim, p_ee: np.ndarray, height: float) -> np.ndarray:
    """Where points (n, 2) of the ee's plane appear that lie ``height`` above the gel at rest, by OpenCV's camera."""
    extra = json.loads(json.dumps(sensor.describe().extra))
    X_ee_F, X_F_C = np.array(extra["X_ee_finger"]), np.array(extra["camera"]["X_WC"])
    in_space = np.stack((p_ee[:, 0], np.zeros(len(p_ee)), p_ee[:, 1]), axis=-1)  # ee: X right, Y away, Z up
    in_space = in_space + height * X_ee_F[:3, 2]
    X_C_ee = np.linalg.inv(X_ee_F @ X_F_C)
    found, _ = cv2.projectPoints(
        in_space,
        cv2.Rodrigues(X_C_ee[:3, :3])[0],
        X_C_ee[:3, 3],
        np.array(extra["camera"]["K"]),
        np.array(extra["camera"]["distortion"]),
    )
    return found.reshape(-1, 2)


def markers_in_ee(sensor: SimGelSlim) -> np.ndarray:
    extra = sensor.describe().extra
    points = np.array(extra["markers_mm"]) / 1e3
    return (points @ np.array(extra["X_ee_finger"])[:3, :2].T)[:, [0, 2]]


def inside(points: np.ndarray, outline: np.ndarray, margin: float) -> np.ndarray:
    return np.asarray(shapely.contains_xy(shapely.Polygon(outline).buffer(-margin), points), dtype=bool)


def well_in_picture(pixels: np.ndarray, image: np.ndarray, margin: int = 9) -> np.ndarray:
    height, width = image.shape[:2]
    low, high = pixels.min(axis=1), (pixels - (width, height)).max(axis=1)
    return (low > margin) & (high < -1 - margin)


def ink_at(image: np.ndarray, pixels: np.ndarray, reach: int = 6) -> np.ndarray:
    """Centroids (n, 2) of what is darker than its surroundings, about ``pixels``; the background is a fitted plane."""
    grey = image.mean(axis=2)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    rim = np.hypot(x, y) >= reach - 0.7
    plane = np.stack((np.ones_like(x), x, y), axis=-1).reshape(-1, 3).astype(float)
    out = []
    for column, row in np.rint(pixels).astype(int):
        patch = grey[row - reach : row + reach + 1, column - reach : column + reach + 1]
        level = plane @ np.linalg.lstsq(plane[rim.ravel()], patch[rim], rcond=None)[0]
        ink = 1 - patch / level.reshape(patch.shape)
        ink[ink < 0.02] = 0
        assert ink.max() > 0.2, "there is no marker here"
        out.append((column + (ink * x).sum() / ink.sum(), row + (ink * y).sum() / ink.sum()))
    return np.array(out)


# -- markers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("finger", ["left", "right"])
def test_markers_of_the_untouched_gel_are_where_the_description_says(finger: str) -> None:
    sensor = opened(FakeWorld(), finger)
    image = sensor.reference()
    expected = pixels_of(sensor, markers_in_ee(sensor), 0.0)
    expected = expected[well_in_picture(expected, image)]
    assert len(expected) > 200
    assert np.abs(ink_at(image, expected) - expected).max() < 0.1


@pytest.mark.parametrize("finger", ["left", "right"])
@pytest.mark.parametrize(
    "shear", [pose(), pose(1.2, 0, 0), pose(0, -0.9, 0), pose(0, 0, 4), pose(-0.7, 0.5, -3)], ids=str
)
@pytest.mark.parametrize(("outline", "rest"), [(BOARD, pose()), (BOX, pose(3, 2, 20))], ids=["covered", "box"])
def test_markers_under_the_face_move_by_exactly_the_shear(finger, shear, outline, rest) -> None:
    sensor = opened(FakeWorld(view(outline, rest, shear)), finger)
    image = sensor.capture().image
    material = markers_in_ee(sensor)
    material = material[inside(material, moved(rest, outline), 0.0025)]
    expected = pixels_of(sensor, moved(shear, material), 0.0008)
    seen = well_in_picture(expected, image)
    assert seen.sum() > 40
    # the polygon's edges must not lie in the windows in which the ink is weighed: hence the margin of 2.5 mm
    assert np.abs(ink_at(image, expected[seen]) - expected[seen]).max() < 0.1


def test_a_shear_dies_away_around_the_face() -> None:
    shear = pose(1.0, 0, 0)
    sensor = opened(FakeWorld(view(HEXAGON, pose(), shear)))
    gel = sensor.capture().image
    material = markers_in_ee(sensor)
    distance = np.asarray(shapely.distance(shapely.Polygon(HEXAGON), shapely.points(material)))
    guess = pixels_of(sensor, material + np.exp(-distance / sensor.pad.reach)[:, None] * shear[:2], 0.0)
    far = (distance > 0.004) & well_in_picture(guess, gel)
    rest = pixels_of(sensor, material, 0.0)[far]
    motion = np.linalg.norm(ink_at(gel, guess[far]) - rest, axis=1) * sensor.describe().extra["mm_per_px"]
    near, away = distance[far] < 0.006, distance[far] > 0.015
    assert near.sum() >= 8
    assert away.sum() >= 8
    assert 0.25 < np.median(motion[near]) < 0.6
    assert motion[away].max() < 0.06
    assert motion.max() < 1.0


def test_a_pressed_face_pushes_the_markers_around_it_outward() -> None:
    sensor = opened(FakeWorld(view(HEXAGON, pose(), None)))
    gel = sensor.capture().image
    material = markers_in_ee(sensor)
    distance = np.asarray(shapely.distance(shapely.Polygon(HEXAGON), shapely.points(material)))
    rest = pixels_of(sensor, material, 0.0)
    near = (distance > 0.0035) & (distance < 0.006) & well_in_picture(rest, gel)
    outward = rest[near] - pixels_of(sensor, np.zeros((1, 2)), 0.0)
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    push = ((ink_at(gel, rest[near]) - rest[near]) * outward).sum(axis=1)
    assert push.min() > 0.02
    assert push.max() < 0.6


# -- edges -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("finger", ["left", "right"])
@pytest.mark.parametrize("rest", [pose(0, -1, 0), pose(3, 0.5, 7.3), pose(-4, -2, -17), pose(1, 2, 45)], ids=str)
def test_the_contact_patch_ends_where_the_face_ends(finger: str, rest: np.ndarray) -> None:
    sensor = opened(FakeWorld(view(BOX, rest)), finger)
    change = np.abs(sensor.capture().image.astype(float) - sensor.reference()).max(axis=2)
    corners = moved(rest, BOX)
    checked = 0
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        share = np.linspace(0, 1, 400)[:, None]
        edge = start + share * (end - start)
        length = np.linalg.norm(end - start)
        edge = edge[(share[:, 0] * length > 0.002) & ((1 - share[:, 0]) * length > 0.002)]
        out = (end - start)[::-1] * (1, -1) / length  # counter-clockwise: outward is to the right
        at, beyond = (pixels_of(sensor, edge + step * out, 0.0008) for step in (0, 1e-4))
        keep = well_in_picture(at, change, 14)
        if keep.sum() < 60:
            continue
        normal = (beyond - at)[keep]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        s = np.arange(-6, 10.01, 0.05)
        where = (at[keep][:, None] + s[:, None] * normal[:, None]).astype(np.float32)
        profile = np.median(cv2.remap(change, where[..., 0], where[..., 1], cv2.INTER_LINEAR), axis=0)
        assert profile.max() > 25
        rise = np.interp(0.5 * profile.max(), profile[: profile.argmax()], s[: profile.argmax()])
        assert abs(rise) < 0.5, f"edge {checked}"
        checked += 1
    assert checked >= 2


def test_the_wall_is_an_exponential_under_a_gaussian_blur() -> None:
    pad, step = GelPad(), 1e-6
    s = np.arange(-2e-3, 6e-3, step)
    blurred = gaussian_filter1d(np.minimum(1, np.exp(-s / pad.wall)), pad.rounding / step, truncate=8)
    share, slope = pad.profile(s)
    inner = slice(1300, -1300)
    np.testing.assert_allclose(share[inner], blurred[inner], atol=1e-6)
    np.testing.assert_allclose(slope[inner], np.gradient(blurred, step)[inner], atol=1e-2)  # of 1200 per metre


def test_distances_from_a_face_are_those_of_its_polygon() -> None:
    outline = np.array([(0, 0), (30, 0), (30, 10), (12, 10), (12, 35), (0, 35)]) * 1e-3
    rng = np.random.default_rng(1)
    X_face_P = np.array([0.004, -0.003, 0.4])
    points = rng.uniform(-0.03, 0.05, (20000, 2))
    in_face = moved(X_face_P, points)
    near = shapely.distance(shapely.Polygon(outline), shapely.points(in_face)) < 0.02
    points, in_face = points[near], in_face[near]
    polygon = shapely.Polygon(outline)
    expected = np.asarray(shapely.distance(polygon.exterior, shapely.points(in_face)))
    expected[shapely.contains_xy(polygon, in_face)] *= -1
    distance, gradient = Face(outline).distance(X_face_P, points)
    error = np.abs(distance - expected)
    corner = shapely.distance(shapely.MultiPoint(outline), shapely.points(in_face)) < 0.002
    assert np.median(error) < 5e-6
    assert (
        error[~corner & (expected > -0.003) & (expected < 0.01)].max() < 8e-5
    )  # at the crease before the inner corner
    assert error.max() < 1.5e-4
    smooth = ~corner & (expected > 0) & (in_face[:, 1] < 0)
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])  # of the face's −y into P
    below = smooth & (in_face[:, 0] > 0.001) & (in_face[:, 0] < 0.029) & (in_face[:, 1] < -0.0003)
    np.testing.assert_allclose(gradient[below], np.broadcast_to(turn @ (0, -1), (below.sum(), 2)), atol=1e-4)


# -- the device --------------------------------------------------------------------------------------------------------


def test_without_contact_the_picture_is_the_reference() -> None:
    world = FakeWorld()
    sensor = opened(world)
    reference = sensor.reference()
    np.testing.assert_array_equal(sensor.capture().image, reference)
    world.felt = view(BOX, pose(), held=False)
    dropped = sensor.capture()
    np.testing.assert_array_equal(dropped.image, reference)
    assert dropped.stamp.status is Status.NO_CONTACT
    world.felt = view(BOX, pose())
    assert np.abs(sensor.capture().image.astype(int) - reference).max() > 40


def test_a_face_that_covers_the_gel_leaves_its_shading_as_it_is() -> None:
    sensor = opened(FakeWorld(view(BOARD, pose())))
    gel, reference = (
        cv2.morphologyEx(i, cv2.MORPH_CLOSE, np.ones((15, 15))) for i in (sensor.capture().image, sensor.reference())
    )
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(gel[inner].astype(int) - reference[inner]).mean() < 2


def test_the_pictures_of_the_fingers_are_taken_from_opposite_sides() -> None:
    rest = pose(6, -3, 0)  # right of the middle for who looks along +Y
    columns = {}
    for finger in ("left", "right"):
        sensor = opened(FakeWorld(view(HEXAGON, rest)), finger)
        change = np.abs(sensor.capture().image.astype(float) - sensor.reference()).max(axis=2)
        columns[finger], rows = np.nonzero(change.T > 20)[0].mean(), np.nonzero(change > 20)[0].mean()
        assert rows > 119.5 + 10
    assert columns["left"] > 159.5 + 20
    assert columns["right"] < 159.5 - 20


def test_readings_are_stamped_and_buffered() -> None:
    world = FakeWorld()
    with SimGelSlim("finger", config(), world) as sensor:
        first = sensor.capture()
        world.time = 8
        second = sensor.capture()
        assert sensor.latest() is second
        assert sensor.since(3) == [second]
        assert (first.stamp.sequence, first.stamp.capture_ns, first.stamp.frame) == (0, 3, "finger")
        assert (second.stamp.sequence, second.stamp.capture_ns) == (1, 8)
        assert (second.encoding, second.image.shape, second.image.dtype) == ("bgr8", (240, 320, 3), np.uint8)
        sensor.restart(np.random.default_rng(0))
        assert sensor.capture().stamp.sequence == 0
        assert sensor.gaps == 0


def test_a_sensor_that_is_not_open_says_so() -> None:
    sensor = SimGelSlim("finger", config(), FakeWorld())
    for ask in (sensor.capture, sensor.reference):
        with pytest.raises(NotConnected, match="finger"):
            ask()


def test_its_description_names_finger_scale_and_marker_grid() -> None:
    description = SimGelSlim("finger", config("right"), FakeWorld()).describe()
    extra = json.loads(json.dumps(description.extra))
    assert (description.kind, description.backend, description.rate) == ("tactile", "sim", 0.0)
    assert (extra["sensor"], extra["finger"], extra["encoding"]) == ("gelslim", "right", "bgr8")
    assert extra["mm_per_px"] == pytest.approx(45.2 / 320)
    markers = np.unique(np.array(extra["markers_mm"])[:, 0])
    np.testing.assert_allclose(np.diff(markers), 2.3)


def test_a_gel_is_not_pressed_deeper_than_it_goes() -> None:
    with pytest.raises(ValueError, match=r"devices\.finger\.indentation: 12 mm .* at most 1\.2 mm"):
        SimGelSlim("finger", config(indentation=0.012), FakeWorld())


def test_the_usual_indentation_is_the_sensors() -> None:
    usual = {
        sensor: TactileConfig.model_validate({"kind": "tactile", "sensor": sensor, "finger": "left"}).indentation
        for sensor in ("gelslim", "soft_bubble")
    }
    assert usual == {"gelslim": 0.0008, "soft_bubble": 0.012}


# -- noise -------------------------------------------------------------------------------------------------------------


def frames(seed: int, n: int, **noise: float) -> tuple[np.ndarray, np.ndarray]:
    """``n`` frames of the untouched gel and the reference."""
    sensor = opened(FakeWorld(noise=GelNoise(**noise)))
    sensor.restart(np.random.default_rng(seed))
    return np.stack([sensor.capture().image for _ in range(n)]).astype(float), sensor.reference().astype(float)


def test_the_same_seed_gives_the_same_noise() -> None:
    figures = {"noise": 3.0, "exposure": 0.02, "bias": 2.0}
    first, again, other = (frames(seed, 2, **figures)[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first[0], first[1])


def test_pixel_noise_has_the_standard_deviation_asked_for() -> None:
    pictures, reference = frames(1, 8, noise=4.0)
    within = (reference > 30) & (reference < 225)
    assert (pictures - reference)[:, within].std() == pytest.approx(4.0, rel=0.03)
    assert abs((pictures - reference)[:, within].mean()) < 0.05


def test_a_bias_stays_for_the_epoch_and_is_in_the_reference() -> None:
    plain = frames(1, 1)[0][0]
    offsets = []
    for seed in range(40):
        pictures, reference = frames(seed, 2, bias=5.0)
        np.testing.assert_array_equal(pictures[0], pictures[1])
        np.testing.assert_array_equal(pictures[0], reference)
        offsets.append((pictures[0] - plain)[100:140, 140:180].mean(axis=(0, 1)))
    assert np.std(offsets) == pytest.approx(5.0, rel=0.25)


def test_exposure_scales_whole_frames() -> None:
    pictures, reference = frames(2, 40, exposure=0.03)
    middle = np.s_[80:160, 100:220]
    ratio = [p[middle].mean() / reference[middle].mean() for p in pictures]
    assert np.std(ratio) == pytest.approx(0.03, rel=0.3)


def test_vignetting_takes_its_share_of_light_from_the_corners() -> None:
    plain, vignetted = (frames(0, 1, vignetting=v)[0][0] for v in (0.0, 0.4))
    bright = plain[:3, :3] > 20
    assert (vignetted / np.maximum(plain, 1))[:3, :3][bright].mean() == pytest.approx(0.6, abs=0.03)
    assert np.abs(vignetted - plain)[118:122, 158:162].max() <= 1
