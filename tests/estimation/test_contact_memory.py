"""Touches told from traces: membranes in closed form, simulated ones with a camera that mixes, and a real recording."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable

import cv2
import numpy as np
import pytest

from drivers.sim.bubble_geometry import camera_of
from drivers.sim.bubble_noise import DepthNoise, NoiseSource
from drivers.sim.bubble_optics import BubbleView, quantised
from drivers.sim.finger import X_EE_FINGER
from drivers.sim.mismatch import load_profile
from estimation.contact_memory import CAMERA_SHARE, ContactMemory, Touch
from estimation.deformation import DepthReader, Unusable
from estimation.tactile_pose import FingerModel, GraspPrior, PoseStatus
from estimation.tactile_pose_strips import RidgeStrips
from mechanics.camera import CameraModel
from mechanics.catalogue import load_object
from mechanics.readings import ImageReading, Stamp
from tests.recordings import DATA, recorded

PERIOD = 1 / 30
PITCH = 1e-3
y, x = np.mgrid[-40.0:41.0, -50.0:51.0] * PITCH
VALID = np.ones(x.shape, bool)


def dent(depth: float, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A touch ``depth`` [m] deep, as wide as a small tip's."""
    return depth * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 0.009**2))


def stamp(k: int, seconds: float | None = None) -> Stamp:
    return Stamp(round(1e9 * (k * PERIOD if seconds is None else seconds)), 0, k, "finger")


def alone(field: np.ndarray) -> bool:
    """What a picture by itself says: 0.9 mm over a third of a square centimetre."""
    return bool((cv2.blur(field, (5, 5)) > 0.9e-3).sum() * PITCH**2 > 3e-5)


class Camera:
    """Adds white noise [m] to what is pressed in, and mixes pictures."""

    def __init__(self, memory: ContactMemory, noise: float = 0.05e-3, share: float = 0.0, seed: int = 0):
        self.memory, self.noise, self.share = memory, noise, share
        self.rng = np.random.default_rng(seed)
        self.k = 0
        self.last: np.ndarray | None = None

    def sees(self, field: np.ndarray, seconds: float | None = None, skipped: int = 0) -> tuple[bool, bool]:
        """Whether a touch is found by the memory, and by the picture alone."""
        picture = field
        for _ in range(1 + skipped):
            picture = field + self.noise * self.rng.standard_normal(field.shape)
            picture = picture if self.last is None else picture + self.share * (self.last - picture)
            self.last = picture
            self.k += 1
        says = alone(picture)
        return self.memory.touch(picture.astype(np.float32), VALID, PITCH, stamp(self.k, seconds), says).found, says

    def plays(self, fields: Iterable[np.ndarray]) -> np.ndarray:
        """As `sees`, (m, 2)."""
        return np.array([self.sees(field) for field in fields])


NONE = 0.0 * x


def test_light_touch_of_a_rested_membrane_is_found_at_once_and_its_end_too() -> None:
    found = Camera(ContactMemory()).plays([NONE] * 20 + [dent(0.5e-3)] * 10 + [NONE] * 20)
    assert found[:, 0].tolist() == [False] * 20 + [True] * 10 + [False] * 20
    assert not found[:, 1].any()


@pytest.mark.parametrize("share", [0.5, 0.55, 0.6, 0.62])
def test_what_a_mixing_camera_still_shows_after_the_release_is_no_touch(share: float) -> None:
    memory = ContactMemory()
    found = Camera(memory, share=share).plays([NONE] * 20 + [dent(4e-3)] * 20 + [NONE] * 20)
    assert found[:, 0].tolist() == [False] * 20 + [True] * 20 + [False] * 20
    assert found[40:42, 1].all()
    assert memory.mixes


def test_a_camera_that_does_not_mix_is_heard_and_its_release_is_not_early() -> None:
    memory = ContactMemory()
    assert memory.mixes  # as long as nothing is known
    leaving = [dent(4e-3 / 3**k) for k in range(3)]
    found = Camera(memory).plays([NONE] * 20 + [dent(8e-3)] * 20 + leaving + [NONE] * 10)
    assert not memory.mixes
    assert found[:, 0].tolist() == [False] * 20 + [True] * 23 + [False] * 10


def test_the_touch_goes_on_over_pictures_that_were_lost() -> None:
    for skipped, still in ((0, False), (8, True)):
        camera = Camera(ContactMemory(), share=0.6)
        camera.plays([NONE] * 20 + [dent(8e-3)] * 20)
        camera.share = 0.0  # as if another camera had mixed nine pictures
        assert camera.sees(dent(3e-3), skipped=skipped)[0] is still


def test_creep_after_a_long_hold_is_no_touch_and_one_beside_or_in_it_is() -> None:
    c, T, deep, held = 0.08, 8.0, 0.016, 30.0
    camera = Camera(ContactMemory())
    camera.plays([NONE] * 10)
    now = camera.k * PERIOD
    for _ in range(30):  # one picture a second of what is held
        now += held / 30
        assert camera.sees(dent(deep), now)[0]
    # the standard linear solid: u̇ = (x − u) / T while held, x = u c / (1 + c) without a load
    crept = deep * (1 - np.exp(-held / T))
    traces = [dent(crept * c / (1 + c) * np.exp(-0.2 * k / ((1 + c) * T))) for k in range(80)]
    judged = [camera.sees(trace, now + PERIOD + 0.2 * k) for k, trace in enumerate(traces)]
    assert not any(found for found, _ in judged)
    assert sum(says for _, says in judged) > 4
    trace, now = traces[-1], now + PERIOD + 16.0
    assert camera.sees(trace + dent(0.5e-3, (0.02, 0.01)), now)[0]
    assert camera.sees(trace, now + 0.2)[0] is False
    assert camera.sees(trace + dent(0.6e-3), now + 0.4)[0]


@pytest.mark.parametrize("off", [-0.5e-3, 0.5e-3])
def test_untouched_membrane_that_lies_off_its_reference_is_no_touch_and_a_touch_of_it_is(off: float) -> None:
    camera = Camera(ContactMemory())
    found = camera.plays([NONE + off] * 30 + [dent(0.5e-3) + off] * 30 + [NONE + off] * 30)
    assert found[:, 0].tolist() == [False] * 30 + [True] * 30 + [False] * 30


def test_gas_that_warms_over_a_minute_is_no_touch() -> None:
    camera = Camera(ContactMemory())
    assert not any(camera.sees(NONE + 0.6e-3 * k / 120, 0.5 * k)[0] for k in range(120))


@pytest.mark.parametrize("share", [0.0, 0.6])
@pytest.mark.parametrize("noise", [0.0, 0.3e-3, 1e-3])
def test_noise_is_no_touch_whatever_its_size(noise: float, share: float) -> None:
    assert not Camera(ContactMemory(), noise, share, seed=1).plays([NONE] * 300)[:, 0].any()


def test_the_same_picture_asked_again_is_answered_the_same() -> None:
    once, often = Camera(ContactMemory(), share=0.6), ContactMemory()
    answers = []

    class Often(ContactMemory):
        def touch(self, inward, valid, pitch, stamp, alone) -> Touch:
            answers.append([often.touch(inward, valid, pitch, stamp, alone) for _ in range(3)])
            return answers[-1][0]

    film = [NONE] * 10 + [dent(4e-3)] * 5 + [NONE] * 10
    expected = once.plays(film)[:, 0]
    again = Camera(Often(), share=0.6).plays(film)[:, 0]
    np.testing.assert_array_equal(again, expected)
    assert all(first == second == third for first, second, third in answers)
    assert again.any() and not again.all()


def test_a_picture_older_than_the_last_begins_anew() -> None:
    memory = ContactMemory()
    deep = dent(4e-3).astype(np.float32)
    assert memory.touch(deep, VALID, PITCH, stamp(100), True).found
    half = (0.55 * deep).astype(np.float32)
    assert not memory.touch(half, VALID, PITCH, stamp(101), True).found  # of a mixing camera: a release
    assert memory.touch(half, VALID, PITCH, stamp(0), True).found
    assert not memory.touch(0 * half, VALID, PITCH, stamp(1), False).found


def test_a_membrane_of_which_nothing_is_seen_is_no_touch() -> None:
    memory = ContactMemory()
    blind = np.zeros_like(VALID)
    for k in range(3):
        assert not memory.touch(dent(4e-3).astype(np.float32), blind, PITCH, stamp(k), False).found


def test_depth_is_that_of_the_deepest_place() -> None:
    memory = ContactMemory()
    for k in range(20):
        memory.touch(NONE.astype(np.float32), VALID, PITCH, stamp(k), False)
    touch = memory.touch((0.4 * dent(4e-3)).astype(np.float32), VALID, PITCH, stamp(20), True)
    # a picture that mixes 60 % of an untouched one shows 40 % of 4 mm; averaged over 4 mm it is (9² / (9² + 4²)) of it
    assert touch.found and touch.deepest == pytest.approx(4e-3 * 81 / 97, rel=0.03)


@pytest.mark.parametrize(
    "figures", [{"camera_share": 1.0}, {"camera_share": -0.1}, {"creep": -0.1}, {"creep_time": 0.0}, {"least": 0.0}]
)
def test_figures_that_no_membrane_has_are_refused(figures: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="contact memory"):
        ContactMemory(**figures)


# -- the simulated Soft Bubble -----------------------------------------------------------------------------------------

BUBBLE = load_profile("lab").bubble
BEFORE, HELD, AFTER = 12, 8, 20


def touches(figures: DepthNoise, share: float, seed: int) -> tuple[np.ndarray, list[PoseStatus]]:
    """How deep [m] a tip of 4 mm presses, picture by picture, and what is made of them; the membrane creeps."""
    rng = np.random.default_rng(seed)
    camera = camera_of(224, 171)
    view = BubbleView(camera)
    noise = NoiseSource(figures, (171, 224), rng, PERIOD)
    bare = view.reference.copy()
    finger = FingerModel(
        "soft_bubble", camera.model_in_finger(), np.array(X_EE_FINGER["left"]), quantised(noise.spoil(bare, None)),
        {"depth_unit": 1e-4},
    )  # fmt: skip
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    tip = rng.uniform(-0.012, 0.012, 2) + 0.004 * np.stack((np.cos(around), np.sin(around)), axis=1)
    way = np.arange(1, 7) * rng.uniform(0.7e-3, 0.9e-3)
    pressed = [np.nan_to_num(bare - view.depth(tip, depth)) for depth in way]
    film = [0 * bare] * BEFORE + pressed + [pressed[-1]] * HELD + pressed[::-1] + [0 * bare] * AFTER
    method = RidgeStrips(finger, load_object("tall_box").polygon)
    prior = GraspPrior(np.array([0.0, -0.045, 0.0]))
    crept, mixed, statuses = 0 * bare, None, []
    for k, field in enumerate(film):
        shown = np.maximum(field, 0.08 / 1.08 * crept)
        crept = shown + (crept - shown) * np.exp(-(1.0 if len(way) < k - BEFORE < len(way) + HELD else PERIOD) / 8.0)
        picture = noise.spoil(bare - shown, k * PERIOD)
        mixed = picture if mixed is None else picture + share * (mixed - picture)
        statuses.append(method.estimate(ImageReading(stamp(k), quantised(mixed), "16UC1"), prior).status)
    return np.array([field.max() for field in film]), statuses


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("figures", "share"), [(BUBBLE.time_of_flight, 0.0), (BUBBLE.stereo, 0.6)], ids=["plain", "mixing"]
)
def test_simulated_touches_are_found_and_releases_are_clean(figures: DepthNoise, share: float, seed: int) -> None:
    deep, statuses = touches(figures, share, seed)
    found = np.array([status is not PoseStatus.NO_CONTACT for status in statuses])
    assert not found[deep == 0].any()
    assert found[deep > 1e-3].all()
    assert set(statuses) == {PoseStatus.NO_CONTACT, PoseStatus.NO_EDGE}


# -- a real Soft Bubble ------------------------------------------------------------------------------------------------

FOLDER, real = DATA / "softbubble", recorded("softbubble")
#: frames with a touch, and the one that nobody labelled
TOUCHED, UNLABELLED = set(range(62, 110)), 61


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """Depth (150, 120, 160) [m] at every fourth pixel, NaN where there is none."""
    with np.load(FOLDER / "depth_quarter_all150.npz") as file:
        depth = file["z_m"].astype(float)
    return np.where((depth <= 0) | (depth > 0.2), np.nan, depth)


@pytest.fixture(scope="module")
def film(depth: np.ndarray) -> tuple[FingerModel, list[ImageReading]]:
    """The finger with what it shows in frames 0 to 59 as its reference, and all frames at their times."""

    def encoded(picture: np.ndarray) -> np.ndarray:
        return np.rint(np.nan_to_num(picture) * 1e4).astype(np.uint16)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any depth
        untouched = encoded(np.nanmedian(depth[:60], axis=0))
    every_fourth = np.array([[434 / 4, 0, 313.7 / 4], [0, 434 / 4, 247.5 / 4], [0, 0, 1]])
    X_FC = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.1], [0, 0, 0, 1]], float)
    finger = FingerModel(
        "soft_bubble", CameraModel(160, 120, every_fourth, X_WC=X_FC), np.array(X_EE_FINGER["left"]), untouched,
        {"depth_unit": 1e-4},
    )  # fmt: skip
    times = np.array([row[0] for row in json.loads((FOLDER / "data.json").read_text())])
    stamps = [stamp(k, seconds) for k, seconds in enumerate(times - times[0])]
    return finger, [ImageReading(s, encoded(frame), "16UC1") for s, frame in zip(stamps, depth, strict=True)]


def frames(reader: DepthReader, pictures: list[ImageReading]) -> tuple[set[int], set[int]]:
    """Frames with a touch, and those without; each is one of them."""
    touched, none = set(), set()
    for k, picture in enumerate(pictures):
        found = reader.read(picture)
        assert isinstance(found, Unusable)  # a touch 5 mm deep by something round: no face
        assert found.status in (PoseStatus.NO_EDGE, PoseStatus.NO_CONTACT)
        (touched if found.status is PoseStatus.NO_EDGE else none).add(k)
    return touched, none


class Kept(ContactMemory):
    """A memory that keeps what it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = []

    def touch(self, inward, valid, pitch, stamp, alone) -> Touch:
        self.asked.append((inward, valid, pitch, stamp, alone))
        return super().touch(inward, valid, pitch, stamp, alone)


@real
def test_contact_is_seen_in_the_frames_of_the_recording_that_have_it_and_in_no_other(film) -> None:
    finger, pictures = film
    memory = Kept()
    reader = DepthReader(finger, memory)
    touched, none = frames(reader, pictures)
    assert touched - {UNLABELLED} == TOUCHED
    assert none - {UNLABELLED} == set(range(150)) - TOUCHED - {UNLABELLED}
    # and not on a knife's edge: the same with other figures
    others = [ContactMemory(**figures) for figures in (
        {"camera_share": 0.5}, {"camera_share": 0.64}, {"least": 0.15e-3}, {"least": 0.35e-3}, {"creep": 0.0},
        {"creep": 0.2}, {"creep_time": 2.0}, {"creep_time": 30.0},
    )]  # fmt: skip
    for other in others:
        assert {k for k, asked in enumerate(memory.asked) if other.touch(*asked).found} - {UNLABELLED} == TOUCHED


@real
def test_a_picture_of_the_recording_alone_does_not_tell_the_first_touch_from_the_trace(film) -> None:
    finger, pictures = film
    touched, _ = frames(DepthReader(finger), pictures[58:68] + pictures[104:116])
    assert touched == set(range(63 - 58, 10 + 110 - 104))


@real
def test_the_recording_says_itself_how_much_its_camera_mixes(depth: np.ndarray) -> None:
    # from the untouched frames alone: noise that is mixed is as alike from frame to frame as the share of the last one
    noise = depth[:60, 10:110, 10:150]
    steady = np.isfinite(noise).all(axis=0)
    noise = noise[:, steady] - np.mean(noise[:, steady], axis=0)
    noise = noise[:, np.abs(noise).max(axis=0) < 1e-3]
    likeness = [np.mean(noise[lag:] * noise[:-lag]) / np.mean(noise**2) for lag in (1, 2, 3)]
    np.testing.assert_allclose(likeness, CAMERA_SHARE ** np.arange(1, 4), atol=0.06)
    # what is left at the place of the touch goes at that rate too: it is the camera's memory, not the membrane's
    left = np.mean(np.mean(depth[:60], axis=0) - depth[110:113], axis=(1, 2), where=touched_there())
    np.testing.assert_allclose(left[1:] / left[:-1], CAMERA_SHARE, atol=0.07)


def touched_there() -> np.ndarray:
    """Pixels (120, 160) about the deepest one of the recorded touch."""
    return np.hypot(*(np.mgrid[:120, :160] - np.reshape((70.5, 64.0), (2, 1, 1)))) < 4
