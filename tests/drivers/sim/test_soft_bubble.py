"""A simulated Soft Bubble: what its pictures show, seen only through what it says of itself."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field

import numpy as np
import pytest

from drivers.config import TactileConfig
from drivers.errors import NotConnected
from drivers.sim.bubble_geometry import DOME, camera_of
from drivers.sim.bubble_noise import BubbleNoise, DepthNoise, NoiseSource
from drivers.sim.finger import FingerView
from drivers.sim.soft_bubble import SimSoftBubble, view_of
from mechanics.camera import CameraModel
from mechanics.readings import Status

BOX = np.array([[-0.025, -0.07345], [0.025, -0.07345], [0.025, 0.07345], [-0.025, 0.07345]])
STEREO = DepthNoise(noise_mm=0.05, correlation_px=6, memory=0.075, roughness_mm=0.1, dropout=0.05)
PROFILE = BubbleNoise(time_of_flight=DepthNoise(noise_mm=0.3), stereo=STEREO)


@dataclass
class Profile:
    bubble: BubbleNoise = field(default_factory=BubbleNoise)


@dataclass
class Hand:
    """A world that is nothing but an object between two fingers."""

    pose: tuple[float, float, float] = (0.0, -0.045, 0.0)
    outline: np.ndarray = field(default_factory=lambda: BOX)
    held: bool = True
    profile: Profile = field(default_factory=Profile)
    lockstep: bool = True
    now: int = 0

    def now_ns(self) -> int:
        self.now += 33_333_333
        return self.now

    def finger_view(self) -> FingerView:
        return FingerView(self.outline, np.array(self.pose), np.zeros(3), self.held)


def finger(hand: Hand, side: str = "left", width: int = 224, height: int = 171, indentation: float = 0.014):
    config = TactileConfig.model_validate(
        {"kind": "tactile", "sensor": "soft_bubble", "finger": side}
        | {"width": width, "height": height, "indentation": indentation}
    )
    view_of(config)  # compiled once per installation
    device = SimSoftBubble(f"finger_{side}", config, hand)
    device.connect()
    return device


@pytest.fixture
def hand() -> Hand:
    return Hand()


def corners_in_finger(hand: Hand, X_ee_finger: np.ndarray) -> np.ndarray:
    """The object's vertices (N, 2) in a finger's x and y, by the matrices of the description."""
    x, y, theta = hand.pose
    z = (hand.outline[:, 0] + 1j * hand.outline[:, 1]) * np.exp(1j * theta) + complex(x, y)
    p_ee = np.stack((z.real, np.zeros(len(z)), z.imag, np.ones(len(z))))  # the plane's y is the ee's Z
    return (np.linalg.inv(X_ee_finger) @ p_ee)[:2].T


@pytest.mark.parametrize("size", [(224, 171), (640, 480)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_edge_is_in_the_picture_where_the_description_puts_it(side: str, size: tuple[int, int]) -> None:
    hand = Hand(pose=(0.003, -0.047, 0.12))
    device = finger(hand, side, *size)
    said = device.describe().extra
    camera = CameraModel.from_dict(said["camera"])
    corners = corners_in_finger(hand, np.array(said["X_ee_finger"]))
    depth = device.capture().image * said["depth_unit"]
    reference = device.reference() * said["depth_unit"]
    pressed = reference - depth
    # the object's upper end, as pixels of the face's plane; the membrane bends just there
    end = corners[np.argsort(corners[:, 1])[-2:]]
    inward = corners.mean(axis=0) - end.mean(axis=0)
    inward /= np.linalg.norm(inward)
    height = said["indentation_mm"] * 1e-3
    found = []
    for share in (0.4, 0.45, 0.5, 0.55, 0.6):
        point = end[0] + share * (end[1] - end[0])
        s = np.arange(-0.004, 0.004, 1e-4)
        p = point - s[:, None] * inward
        pixels = camera.project(np.column_stack((p, np.full(len(s), height))))
        columns, rows = np.rint(pixels).astype(int).T
        values = depth[rows, columns]
        # two straight lines meet at the edge: flat on the face, rising beyond
        rest = [
            np.abs(np.concatenate([part - np.polyval(np.polyfit(at, part, 1), at) for at, part in pieces])).sum()
            for k in range(10, len(s) - 10)
            for pieces in [((s[:k], values[:k]), (s[k:], values[k:]))]
        ]
        found.append(s[10 + int(np.argmin(rest))])
    assert pressed.max() > 0.9 * height
    assert abs(np.mean(found)) < (0.6e-3 if size[0] == 224 else 0.4e-3)


def test_face_is_seen_at_its_distance(hand: Hand) -> None:
    device = finger(hand)
    said = device.describe()
    image = device.capture().image
    camera = CameraModel.from_dict(said.extra["camera"])
    column, row = np.rint(camera.project([0.0, 0.0, said.extra["indentation_mm"] * 1e-3])).astype(int)
    assert image[row - 20 : row + 20, column - 20 : column + 20] == pytest.approx((0.1 - 0.014) * 1e4, abs=0.5)
    assert said.extra["dome"]["apex_depth"] == said.range[1] == 0.1


def test_picture_of_nothing_is_the_ellipsoid(hand: Hand) -> None:
    hand.held = False
    for size in ((224, 171), (640, 480)):
        device = finger(hand, "left", *size)
        reading = device.capture()
        assert reading.stamp.status is Status.NO_CONTACT
        np.testing.assert_array_equal(reading.image, device.reference())
        said = device.describe().extra
        K, dome = np.array(said["camera"]["K"]), said["dome"]
        shift = -said["camera"]["X_WC"][1][3]
        row, column = np.nonzero(reading.image)
        z = reading.image[row, column] * 1e-4
        x, y = (column - K[0, 2]) / K[0, 0] * z - shift, (row - K[1, 2]) / K[1, 1] * z
        rise = z - (dome["apex_depth"] - dome["height"])
        on = (x / dome["a"]) ** 2 + (y / dome["b"]) ** 2 + (rise / dome["height"]) ** 2
        slope = 2 / dome["height"] * 1e-4 * 4  # what half a step of depth may do, also along an inclined ray
        assert np.abs(on - 1).max() < slope
        assert (reading.image == 0).any() == (size[0] == 640)  # the stereo camera sees beyond the rim


def test_right_finger_sees_the_mirror_image_of_the_left_ones(hand: Hand) -> None:
    hand.pose = (0.004, -0.046, 0.1)
    left = finger(hand, "left").capture().image
    right = finger(hand, "right").capture().image
    hand.pose = (-0.004, -0.046, -0.1)  # the box is symmetric
    mirrored = finger(hand, "right").capture().image
    assert np.abs(left.astype(int) - mirrored).max() <= 1
    assert np.abs(left.astype(int) - right[::-1]).max() <= 1
    assert np.abs(left.astype(int) - right).max() > 5


def test_letting_go_brings_the_reference_back(hand: Hand) -> None:
    device = finger(hand)
    pressed = device.capture().image
    hand.held = False
    empty = device.capture()
    assert empty.stamp.status is Status.NO_CONTACT
    np.testing.assert_array_equal(empty.image, device.reference())
    hand.held = True
    again = device.capture()
    assert again.stamp.status is Status.OK
    np.testing.assert_array_equal(again.image, pressed)


def test_equal_seeds_give_equal_pictures_whatever_went_before(hand: Hand) -> None:
    hand.profile.bubble = PROFILE
    device = finger(hand)
    images = []
    for pose in ((0.0, -0.045, 0.0), (0.01, -0.05, 0.3)):
        hand.pose = pose
        device.capture()
        device.restart(np.random.default_rng(7))
        hand.pose, hand.now = (0.002, -0.044, 0.05), 0
        images.append([device.capture().image for _ in range(2)])
        assert device.latest().stamp.sequence == 1
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0][0] != images[0][1]).mean() > 0.5
    device.restart(np.random.default_rng(8))
    assert (device.capture().image != images[0][0]).mean() > 0.5


def test_description_needs_no_connection_and_goes_through_json(hand: Hand) -> None:
    device = SimSoftBubble(
        "f", TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", width=640, height=480), hand
    )
    said = asdict(device.describe())
    assert json.loads(json.dumps(said))["extra"] == said["extra"]
    assert "RealSense" in said["model"] and said["rate"] == 0
    with pytest.raises(NotConnected):
        device.capture()


def test_indentation_through_the_whole_dome_is_refused(hand: Hand) -> None:
    config = TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", indentation=0.03)
    deep = config.model_copy(update={"indentation": 0.05})
    with pytest.raises(ValueError, match=r"devices\.f\.indentation: 50 mm .* usually 12"):
        SimSoftBubble("f", deep, hand)


# -- noise -------------------------------------------------------------------------------------------------------------


def flat(figures: DepthNoise, frames: int, shape=(171, 224), period: float = 1 / 30) -> np.ndarray:
    """Frames (n, h, w) [mm] of a wall at 90 mm, less the wall."""
    source = NoiseSource(figures, shape, np.random.default_rng(3), period)
    wall = np.full(shape, 0.09)
    return np.array([source.spoil(wall, k * period) - wall for k in range(frames)]) * 1e3


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).mean() / np.sqrt((a * a).mean() * (b * b).mean()))


def test_white_noise_has_its_size_and_no_neighbours() -> None:
    noise = flat(DepthNoise(noise_mm=0.3), 20)
    assert noise.std() == pytest.approx(0.3, rel=0.01)
    assert abs(correlation(noise[:, :, 1:], noise[:, :, :-1])) < 0.01
    assert abs(correlation(noise[1:], noise[:-1])) < 0.01


def test_correlated_noise_agrees_to_a_third_at_its_length_and_keeps_its_size() -> None:
    noise = flat(DepthNoise(noise_mm=0.05, correlation_px=6, memory=0.075), 60)
    assert noise.std() == pytest.approx(0.05, rel=0.05)
    assert noise[0].std() == pytest.approx(0.05, rel=0.05)
    for a, b in ((noise[:, :, 6:], noise[:, :, :-6]), (noise[:, 6:], noise[:, :-6])):
        assert correlation(a, b) == pytest.approx(np.exp(-1), abs=0.05)
    for frames in (1, 2, 5):
        expected = np.exp(-frames / 30 / 0.075)
        assert correlation(noise[frames:], noise[:-frames]) == pytest.approx(expected, abs=0.06)


def test_what_is_constant_stays_and_is_all_that_the_reference_has() -> None:
    figures = DepthNoise(noise_mm=0.05, roughness_mm=0.1, dropout=0.05)
    source = NoiseSource(figures, (171, 224), np.random.default_rng(0))
    wall = np.full((171, 224), 0.09)
    still = source.spoil(wall, None)
    np.testing.assert_array_equal(still, source.spoil(wall, None))
    blind = np.isnan(still)
    assert blind.mean() == pytest.approx(0.05, abs=0.002)
    assert np.nanstd(still) == pytest.approx(1e-4, rel=0.03)
    frames = np.array([source.spoil(wall, k / 30) for k in range(200)])
    assert (np.isnan(frames) == blind).all()
    np.testing.assert_allclose(frames.mean(axis=0)[~blind], still[~blind], atol=6 * 5e-5 / np.sqrt(200))


def test_jumps_are_as_many_and_as_large_as_they_should_be() -> None:
    noise = flat(DepthNoise(jumps=0.001), 20)
    far = np.abs(noise[np.abs(noise) > 1e-3])
    assert far.size == pytest.approx(0.001 * noise.size, rel=0.15)
    assert far.min() > 1.9 and far.max() < 8.1


def test_no_figures_no_noise() -> None:
    assert np.abs(flat(DepthNoise(), 3)).max() < 1e-5  # the rounding of 32 bits


@pytest.mark.parametrize(("size", "noise"), [((224, 171), 0.3), ((640, 480), 0.05)])
def test_each_camera_has_its_own_noise(hand: Hand, size: tuple[int, int], noise: float) -> None:
    hand.profile.bubble, hand.held = PROFILE, False
    device = finger(hand, "left", *size)
    frames = np.array([device.capture().image for _ in range(30)]) * 0.1
    spread = frames[:, :, 30:-30].std(axis=0)[frames[:, :, 30:-30].min(axis=0) > 0]
    # rounding adds a step's twelfth; a pixel in the middle of a step may not move at all
    assert np.sqrt((spread**2).mean()) == pytest.approx(np.hypot(noise, 0.1 / np.sqrt(12)), rel=0.2)


def test_cameras_are_those_that_were_measured() -> None:
    pico, real_sense = camera_of(224, 171), camera_of(640, 480)
    assert 2 * np.degrees(np.arctan(112 / pico.focal)) == pytest.approx(62)
    assert (real_sense.focal, real_sense.shift, DOME.top) == (434.0, 0.021, 0.041)
    assert (pico.kind, real_sense.kind) == ("time_of_flight", "stereo")
