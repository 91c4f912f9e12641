"""What a real tag camera does to its pictures: the finger in front, lens, blur, exposure, noise, delay."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import shapely

from drivers.config import GripperConfig, StationConfig, TactileConfig, TagCameraConfig, WorldConfig
from drivers.scene import Body, Scene, TagMount
from drivers.sim.mismatch import CameraFigures, Mismatch, load_profile
from drivers.sim.screen import Screen
from drivers.sim.tag_camera import SimTagCamera, TagRenderer
from drivers.sim.world import World
from estimation.tag_pose import estimate_planar_pose
from mechanics.camera import CameraModel, TagGeometry

ORIGIN = np.zeros(3)
SMALL = {"kind": "tag_camera", "position": (0.0, -0.5, 0.0), "look_at": (0.0, 0.0, 0.0)}
CONFIG = TagCameraConfig.model_validate(SMALL | {"width": 320, "height": 240, "focal": 800})
STATION = TagCameraConfig.model_validate(
    {"kind": "tag_camera", "position": (0, -0.55, 0.07), "look_at": (0, 0, 0.07), "focal": 1400}
)
BOX_TAG = TagMount(id=10, size=0.036, pose=(0, -0.04, 0), height=0.01)


class FakeWorld:
    """A clock, a profile, tags, and what stands in front of them."""

    lockstep = True

    def __init__(self, camera: CameraFigures | None = None, tags=(), screens=(), twists=None):
        self.profile = Mismatch(camera=camera or CameraFigures())
        self.tags, self.fingers, self.twists = list(tags), list(screens), twists or {}

    def now_ns(self) -> int:
        return 1_000_000_000

    def visible_tags(self):
        return self.tags

    def tag_twists(self):
        return self.twists

    def screens(self):
        return self.fingers


def opened(world: FakeWorld, config: TagCameraConfig = CONFIG, seed: int = 0) -> SimTagCamera:
    camera = SimTagCamera("camera", config, world)
    camera.connect()
    camera.restart(np.random.default_rng(seed))
    return camera


def picture(world: FakeWorld, config: TagCameraConfig = CONFIG, seed: int = 0) -> np.ndarray:
    camera = opened(world, config, seed)
    camera.capture()
    image = camera.image()
    assert image is not None
    camera.close()
    return image.image.astype(float)


# -- the finger --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("X_W", [(0, 0, 0), (0.02, -0.01, 0.5), (-0.03, 0.02, -1.2), (0.09, 0.05, 0.3)], ids=str)
def test_a_screen_covers_the_outline_of_its_box(X_W) -> None:
    camera = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 800, 320, 240)
    screen = Screen(np.array(X_W, float), (0.03, 0.02))
    grey = TagRenderer(camera).paint([], [screen])
    z = (
        np.exp(1j * X_W[2]) * np.array([-0.03 - 0.02j, 0.03 - 0.02j, 0.03 + 0.02j, -0.03 + 0.02j])
        + X_W[0]
        + 1j * X_W[1]
    )
    R, t = camera.X_WC[:3, :3].T, -camera.X_WC[:3, :3].T @ camera.X_WC[:3, 3]
    seen = [
        cv2.projectPoints(
            np.stack((z.real, np.full(4, -h), z.imag), axis=-1), cv2.Rodrigues(R)[0], t, camera.K, np.zeros(5)
        )[0].reshape(-1, 2)
        for h in (0.010, 0.060)
    ]
    hull = shapely.MultiPoint(np.concatenate(seen)).convex_hull
    frame = shapely.box(-0.5, -0.5, 319.5, 239.5)
    hidden = (128 - grey) / (128 - 70)
    assert hidden.sum() == pytest.approx(shapely.intersection(hull, frame).area, rel=1e-4)
    y, x = np.mgrid[:240, :320]
    within = np.asarray(shapely.contains_xy(hull.buffer(-0.8), x, y))
    beyond = ~np.asarray(shapely.contains_xy(hull.buffer(0.8), x, y))
    np.testing.assert_allclose(grey[within], 70)
    np.testing.assert_allclose(grey[beyond], 128)


def test_a_tag_behind_the_finger_is_not_seen_and_one_in_front_is() -> None:
    finger = Screen(np.array([0.0, 0.0, 0.0]), (0.04, 0.04))
    for height, seen in ((0.01, []), (0.07, [5])):
        world = FakeWorld(tags=[(TagMount(id=5, size=0.036, height=height), ORIGIN)], screens=[finger])
        assert [tag.id for tag in opened(world).capture().detections] == seen


@pytest.mark.parametrize("fingers", ["gripper", "soft_bubble", "gelslim"])
def test_the_fingers_do_not_hide_the_tag_of_the_tall_box(fingers: str, make_scene: Callable[..., Scene]) -> None:
    devices: dict = {"camera": STATION, "gripper": GripperConfig(kind="gripper")}
    if fingers != "gripper":
        devices["finger"] = TactileConfig.model_validate({"kind": "tactile", "sensor": fingers, "finger": "left"})
    world = World(StationConfig(name="sim", world=WorldConfig(), devices=devices))
    box = Body(
        name="tall_box",
        vertices=((-0.025, -0.07345), (0.025, -0.07345), (0.025, 0.07345), (-0.025, 0.07345)),
        mass=0.1,
        tags=(BOX_TAG,),
    )
    camera = world.devices["camera"]
    assert isinstance(camera, SimTagCamera)
    camera.connect()
    for x in (-0.08, 0.0, 0.08):
        for angle in np.deg2rad((-45, -25, 0, 25, 45)):
            reach = 0.1185 * np.cos(angle) + 0.025 * abs(np.sin(angle)) + 0.003  # lowest corner just over the table
            world.reset(0, make_scene(grasped=box, start=(x, reach, angle)))
            assert [tag.id for tag in camera.capture().detections] == [10], (x, angle)
            corners = camera.latest().detections[0].corners
            assert len(world.screens()) == 1
            plain = TagRenderer(camera.camera).render(world.visible_tags()).astype(int)
            image = camera.image()
            assert image is not None
            low, high = np.floor(corners.min(axis=0)).astype(int) - 2, np.ceil(corners.max(axis=0)).astype(int) + 3
            around = np.s_[low[1] : high[1], low[0] : high[0]]
            if angle == 0:
                np.testing.assert_array_equal(image.image[around], plain[around])


def test_a_station_without_gripper_and_fingers_has_nothing_in_the_way(make_scene) -> None:
    world = World(StationConfig(name="sim", world=WorldConfig(), devices={"camera": STATION}))
    world.reset(0, make_scene())
    assert world.screens() == []


# -- the picture -------------------------------------------------------------------------------------------------------


def test_a_profile_without_figures_leaves_the_picture_exactly_as_it_is() -> None:
    tags = [(TagMount(id=3, size=0.04), np.array([0.01, 0.005, 0.2]))]
    camera = CameraModel.looking_at(CONFIG.position, CONFIG.look_at, 800, 320, 240)
    np.testing.assert_array_equal(picture(FakeWorld(tags=tags)), TagRenderer(camera).render(tags))


def test_blur_is_a_gaussian_of_its_standard_deviation() -> None:
    tags = [(TagMount(id=3, size=0.05), ORIGIN)]
    sharp, soft = (picture(FakeWorld(CameraFigures(blur_px=b), tags)) for b in (0.0, 1.5))

    def spread(image: np.ndarray) -> float:
        """Variance of the steepness across the tag's left border, white to black."""
        # 50 mm are 80 px about the middle: the lower border is black from 119.5 on, in a margin of 10 px
        weight = -np.diff(image[154, 113:127])
        at = np.arange(len(weight))
        mean = (weight * at).sum() / weight.sum()
        return float((weight * (at - mean) ** 2).sum() / weight.sum())

    assert spread(soft) - spread(sharp) == pytest.approx(1.5**2, rel=0.1)


def test_noise_and_exposure_have_their_standard_deviations() -> None:
    flat = np.stack([picture(FakeWorld(CameraFigures(noise=5.0)), seed=s) for s in range(3)])
    assert (flat - 128).std() == pytest.approx(5.0, rel=0.02)
    camera, means = opened(FakeWorld(CameraFigures(exposure=0.03))), []
    for _ in range(60):
        camera.capture()
        image = camera.image()
        assert image is not None
        means.append(image.image.mean())
    assert np.std(means) / 128 == pytest.approx(0.03, rel=0.25)


def test_the_same_seed_gives_the_same_frames() -> None:
    figures = CameraFigures(noise=3.0, exposure=0.02, blur_px=0.6, focal_error=0.001)
    tags = [(TagMount(id=3, size=0.04), ORIGIN)]
    first, again, other = (picture(FakeWorld(figures, tags), seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_what_moves_while_the_shutter_is_open_is_smeared_about_its_place() -> None:
    tags = [(TagMount(id=3, size=0.05), ORIGIN)]
    figures = CameraFigures(exposure_time=0.01)
    still = picture(FakeWorld(figures, tags, twists={3: np.array([0.001, 0, 0])}))
    moving = picture(FakeWorld(figures, tags, twists={3: np.array([0.4, 0, 0])}))  # 4 mm: 6.4 px
    np.testing.assert_array_equal(still, picture(FakeWorld(tags=tags)))
    columns = np.arange(320)
    ink = [(128.0 - image).mean(axis=0) for image in (still, moving)]
    centre = [(i * columns).sum() / i.sum() for i in ink]
    assert centre[1] == pytest.approx(centre[0], abs=0.05)
    spread = [(i * (columns - c) ** 2).sum() / i.sum() for i, c in zip(ink, centre, strict=True)]
    assert spread[1] - spread[0] == pytest.approx(6.4**2 / 12, rel=0.1)  # of a uniform motion, in five pieces


# -- lens and link -----------------------------------------------------------------------------------------------------


def test_the_camera_describes_itself_as_it_was_calibrated() -> None:
    figures = CameraFigures(distortion=(-0.1, 0.05, 0.001, -0.002, 0.01), distortion_error=0.05, focal_error=0.01)
    camera = opened(FakeWorld(figures))
    model = CameraModel.from_dict(camera.describe().extra["camera"])
    np.testing.assert_array_equal(model.distortion, figures.distortion)
    np.testing.assert_array_equal(model.K, CameraModel.looking_at(CONFIG.position, CONFIG.look_at, 800, 320, 240).K)
    truly = []
    for seed in range(60):
        camera.restart(np.random.default_rng(seed))
        truly.append(camera._renderer.camera)
    assert np.std([true.K[0, 0] / 800 for true in truly]) == pytest.approx(0.01, rel=0.25)
    bend = [true.distortion[0] / -0.1 for true in truly]
    assert np.std(bend) == pytest.approx(0.05, rel=0.25)


def test_a_frame_arrives_late_by_the_latency_and_keeps_its_capture_time() -> None:
    stamp = opened(FakeWorld(CameraFigures(latency=0.04))).capture().stamp
    assert (stamp.capture_ns, stamp.receive_ns) == (1_000_000_000, 1_040_000_000)


def test_frames_that_are_lost_leave_gaps() -> None:
    camera = opened(FakeWorld(CameraFigures(dropout=0.3)))
    stamps = [camera.capture().stamp.sequence for _ in range(100)]
    assert camera.gaps == stamps[-1] - stamps[0] - 99
    assert 20 < camera.gaps < 75  # 43 are expected


def test_poses_in_the_lab_are_good_to_a_tenth_of_a_millimetre_and_of_a_degree() -> None:
    figures = load_profile("lab").camera
    geometry = TagGeometry(BOX_TAG.id, BOX_TAG.size, BOX_TAG.pose, BOX_TAG.height)
    rng = np.random.default_rng(7)
    errors = []
    for seed in range(10):
        X_W_go = rng.uniform((-0.08, 0.075, -0.4), (0.08, 0.11, 0.4))
        camera = opened(FakeWorld(figures, [(BOX_TAG, X_W_go)]), STATION, seed)
        model = CameraModel.from_dict(camera.describe().extra["camera"])
        found = estimate_planar_pose(model, camera.capture().detections, [geometry])
        assert found is not None
        errors.append(found.pose - X_W_go)
        camera.close()
    worst = np.abs(errors).max(axis=0)
    assert worst[:2].max() < 1e-4
    assert np.rad2deg(worst[2]) < 0.1
