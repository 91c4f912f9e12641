import json

import cv2
import numpy as np
import pytest

from drivers.config import TagCameraConfig
from drivers.errors import NotConnected
from drivers.scene import TagMount
from drivers.sim.mismatch import CameraFigures, Mismatch
from drivers.sim.screen import Screen
from drivers.sim.tag_camera import SimTagCamera, TagRenderer
from drivers.tags import TagDetector, tag_bitmap
from mechanics.camera import CameraModel, tag_corners

ORIGIN = np.zeros(3)
STRAIGHT = np.array([0.0, 0.0, 0.0, 0.0, 0.0])
CURVED = np.array([-0.25, 0.08, 0.001, -0.002, 0.0])


def camera_of(width: int = 400, height: int = 300, distortion: np.ndarray = STRAIGHT) -> CameraModel:
    return CameraModel.looking_at((0.03, -0.45, 0.09), (0.0, 0.0, 0.05), 1000, width, height, distortion)


def embedded(mount: TagMount, X_W_body: np.ndarray, p_T: np.ndarray) -> np.ndarray:
    """World points of points in the tag, by complex numbers: a pose is z -> e^{iθ} z + (x + iy)."""
    z = p_T[..., 0] + 1j * p_T[..., 1]
    for x, y, theta in (mount.pose, X_W_body):
        z = np.exp(1j * theta) * z + complex(x, y)
    return np.stack((z.real, np.full(z.shape, -mount.height), z.imag), axis=-1)


def projected(camera: CameraModel, p_W: np.ndarray) -> np.ndarray:
    R_CW = camera.X_WC[:3, :3].T
    t = -R_CW @ camera.X_WC[:3, 3]
    pixels, _ = cv2.projectPoints(p_W.reshape(-1, 1, 3), cv2.Rodrigues(R_CW)[0], t, camera.K, camera.distortion)
    return pixels.reshape(-1, 2)


def true_corners(camera: CameraModel, mount: TagMount, X_W_body: np.ndarray) -> np.ndarray:
    return projected(camera, embedded(mount, X_W_body, tag_corners(mount.size)))


def sampled(camera: CameraModel, mount: TagMount, X_W_body: np.ndarray, n: int = 10) -> np.ndarray:
    """The picture by brute force: the mean of n × n rays per pixel, without lens distortion."""
    corners = np.array([(-4.0, 4), (4, 4), (4, -4), (-4, -4)], np.float32)  # cells, y down
    H = cv2.getPerspectiveTransform(true_corners(camera, mount, X_W_body).astype(np.float32), corners)
    axes = [(np.arange(size * n) + 0.5) / n - 0.5 for size in (camera.width, camera.height)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(1, -1, 2)
    cell = np.floor(cv2.perspectiveTransform(grid, H)[0] + 5).astype(int)
    on = ((cell >= 0) & (cell < 10)).all(axis=1)
    cell = np.clip(cell, 0, 9)
    grey = np.where(on, np.where(tag_bitmap(mount.id)[cell[:, 1], cell[:, 0]] > 0, 235.0, 20.0), 128.0)
    return grey.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))


def test_each_pixel_is_the_mean_over_its_square() -> None:
    camera = camera_of(160, 140)
    mount, X_W_body = TagMount(id=42, size=0.03, pose=(0.01, -0.02, 0.2), height=0.01), np.array([-0.01, 0.07, 0.3])
    expected = sampled(camera, mount, X_W_body)
    assert expected.min() < 30 and expected.max() > 225
    difference = TagRenderer(camera).render([(mount, X_W_body)]) - expected
    assert np.abs(difference).max() < 8.0  # the samples' own error on an edge: a tenth of a pixel's grey over n
    assert np.sqrt(np.mean(difference**2)) < 0.8
    assert abs(difference.mean()) < 0.02


def test_a_tag_on_the_pixel_grid_is_drawn_cell_by_cell() -> None:
    camera = CameraModel.looking_at((0, -0.5, 0), (0, 0, 0), 1000, 200, 160)  # 2 px per mm
    mount = TagMount(id=3, size=0.048)  # cells of 12 px; the middle of the picture is a pixel's edge
    image = TagRenderer(camera).render([(mount, ORIGIN)])
    cells = np.where(np.kron(tag_bitmap(3), np.ones((12, 12))) > 0, 235, 20)
    np.testing.assert_array_equal(image[20:140, 40:160], cells)
    assert (np.delete(image, np.s_[40:160], axis=1) == 128).all()


@pytest.mark.parametrize(("distortion", "bound"), [(STRAIGHT, 0.004), (CURVED, 0.01)])
def test_detected_corners_are_the_projected_ones(distortion: np.ndarray, bound: float) -> None:
    camera = camera_of(640, 480, distortion)
    renderer, detector = TagRenderer(camera), TagDetector(camera=camera)
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(25):
        mount = TagMount(id=int(rng.integers(587)), size=0.036, pose=(0.0, -0.02, 0.1), height=rng.uniform(0, 0.02))
        X_W_body = rng.uniform((-0.08, 0.02, -0.7), (0.08, 0.11, 0.7))
        (tag,) = detector.detect(renderer.render([(mount, X_W_body)]))
        assert tag.id == mount.id
        errors.append(tag.corners - true_corners(camera, mount, X_W_body))
    assert np.sqrt(np.mean(np.square(errors))) < bound
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.25 * bound


def test_a_curved_edge_is_straightened_before_it_is_fitted() -> None:
    camera = camera_of(640, 480, CURVED)
    mount, X_W_body = TagMount(id=0, size=0.06), np.array([0.09, 0.11, 0.1])  # in the corner, where the lens bends most
    picture = TagRenderer(camera).render([(mount, X_W_body)])
    true = true_corners(camera, mount, X_W_body)
    plain, straightened = (TagDetector(camera=c).detect(picture)[0].corners - true for c in (None, camera))
    assert np.abs(straightened).max() < 0.02
    assert np.abs(plain).max() > 0.1


def test_the_tag_in_front_hides_the_one_behind() -> None:
    camera = camera_of()
    behind, front = TagMount(id=1, size=0.04), TagMount(id=2, size=0.03, height=0.02)
    renderer = TagRenderer(camera)
    X_W_body = np.array([0.0, 0.05, 0.0])
    both = [
        renderer.render(tags)
        for tags in ([(behind, X_W_body), (front, X_W_body)], [(front, X_W_body), (behind, X_W_body)])
    ]
    np.testing.assert_array_equal(both[0], both[1])
    assert [d.id for d in TagDetector().detect(both[0])] == [2]


@pytest.mark.parametrize("x0, y0", [(150, 130), (-180, 130), (150, -170), (-180, -170), (-500, 0)])
def test_a_tag_that_leaves_the_picture_is_cut_where_the_picture_ends(x0: int, y0: int) -> None:
    whole = camera_of(800, 600)
    K = whole.K.copy()
    K[:2, 2] -= (200 + x0, 150 + y0)
    part = CameraModel(
        400, 300, K, STRAIGHT, whole.X_WC
    )  # the window of the large picture that starts at (200 + x0, …)
    tags = [(TagMount(id=9, size=0.05, pose=(0, 0, 0.4)), np.array([0.0, 0.05, 0.2]))]
    padded = np.pad(TagRenderer(whole).render(tags), 600, constant_values=128)
    expected = padded[600 + 150 + y0 :, 600 + 200 + x0 :][:300, :400]
    np.testing.assert_array_equal(TagRenderer(part).render(tags), expected)


def test_a_tag_behind_the_camera_is_not_seen() -> None:
    image = TagRenderer(camera_of()).render([(TagMount(id=1, size=0.04, height=0.6), ORIGIN)])
    assert (image == 128).all()


class FakeWorld:
    """A clock, a profile, a set of tags, and what stands in front of them."""

    lockstep = True

    def __init__(self, **figures) -> None:
        self.profile = Mismatch(camera=CameraFigures(**figures))
        self.fingers: list[Screen] = []
        self.twists: dict[int, np.ndarray] = {}
        self.tags: list[tuple[TagMount, np.ndarray]] = [
            (TagMount(id=i, size=0.04, pose=(x, -0.04, 0.0)), ORIGIN) for i, x in enumerate((-0.15, -0.05, 0.05, 0.15))
        ]
        self.time = 5

    def now_ns(self) -> int:
        return self.time

    def visible_tags(self) -> list[tuple[TagMount, np.ndarray]]:
        return self.tags

    def tag_twists(self) -> dict[int, np.ndarray]:
        return self.twists

    def screens(self) -> list[Screen]:
        return self.fingers


CONFIG = TagCameraConfig.model_validate(
    {"kind": "tag_camera", "position": (0.0, -0.45, 0.03), "look_at": (0.0, 0.0, 0.03)}
)


def test_a_capture_reports_what_the_detector_finds_in_its_picture() -> None:
    world = FakeWorld()
    with SimTagCamera("camera", CONFIG, world) as camera:
        assert camera.image() is None
        first = camera.capture()
        world.time = 7
        world.tags.append((TagMount(id=100, size=0.036, pose=(0, -0.04, 0)), np.array([0.02, 0.08, 0.3])))
        second = camera.capture()
        picture = camera.image()
        assert picture is not None
        assert camera.latest() is second and camera.since(5) == [second]
    assert [d.id for d in first.detections] == [0, 1, 2, 3]
    assert [d.id for d in second.detections] == [0, 1, 2, 3, 100]
    assert [(r.stamp.sequence, r.stamp.capture_ns) for r in (first, second)] == [(0, 5), (1, 7)]
    assert (picture.stamp, picture.encoding, picture.image.shape) == (second.stamp, "mono8", (720, 1280))
    assert picture.image.dtype == np.uint8
    again = TagDetector().detect(picture.image.astype(np.uint8))
    for seen, found in zip(second.detections, again, strict=True):
        np.testing.assert_array_equal(seen.corners, found.corners)


def test_its_description_holds_the_camera_model() -> None:
    description = SimTagCamera("camera", CONFIG, FakeWorld()).describe()
    assert (description.kind, description.backend, description.rate) == ("tag_camera", "sim", 0.0)
    model = CameraModel.from_dict(json.loads(json.dumps(description.extra))["camera"])
    np.testing.assert_allclose(model.project((0.0, 0.0, 0.03)), (639.5, 359.5), atol=1e-9)
    assert (model.width, model.height, model.K[0, 0]) == (1280, 720, 1400)


def test_a_camera_that_is_not_open_says_so() -> None:
    camera = SimTagCamera("camera", CONFIG, FakeWorld())
    with pytest.raises(NotConnected, match="camera: capture"):
        camera.capture()
    camera.connect()
    camera.close()
    camera.close()
    with pytest.raises(NotConnected):
        camera.capture()


def test_after_a_restart_sequence_numbers_start_again_without_a_gap() -> None:
    with SimTagCamera("camera", CONFIG, FakeWorld()) as camera:
        camera.capture()
        camera.capture()
        camera.restart()
        assert camera.image() is None
        assert camera.capture().stamp.sequence == 0
        assert camera.gaps == 0


def test_noise_comes_from_the_generator_given() -> None:
    pictures = []
    for seed in (1, 1, 2):
        config = CONFIG.model_copy(update={"width": 320, "height": 240})
        with SimTagCamera("camera", config, FakeWorld(noise=4.0)) as camera:
            camera.restart(np.random.default_rng(seed))
            camera.capture()
            picture = camera.image()
        assert picture is not None
        pictures.append(picture.image)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])
    flat = pictures[0][:60].astype(float)  # above the tags
    assert flat.std() == pytest.approx(4.0, rel=0.05)
