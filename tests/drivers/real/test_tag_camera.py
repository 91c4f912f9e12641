"""The AprilTag camera on an MJPEG stream: tags of known poses, through JPEG, back to their poses.

The pictures are made by OpenCV's own perspective warp of printed tags, not by the simulated camera's renderer.
"""

import json
import threading
import time
from dataclasses import asdict

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from drivers.config import StationConfig, TagCameraConfig
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.errors import DeviceFault, NotConnected, ProtocolError
from drivers.real.tag_camera import DRIVER, RealTagCamera, RealTagCameraConfig
from drivers.tags import tag_bitmap
from drivers.wire.codec import decode_reading, encode_reading
from drivers.wire.messages import DETECTIONS
from estimation.tag_pose import estimate_planar_pose
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import TagReading
from mechanics.yaml_input import Refusal

WIDTH, HEIGHT = 640, 480
PLACE = {"position": (0.0, -0.5, 0.2), "look_at": (0.0, 0.0, 0.2), "focal": 700.0}
MODEL = CameraModel.looking_at(PLACE["position"], PLACE["look_at"], PLACE["focal"], WIDTH, HEIGHT)
#: three tags on one object, in its own frame
BUNDLE = [
    TagGeometry(3, 0.04, (0.0, 0.03, 0.0), 0.01),
    TagGeometry(5, 0.04, (-0.03, -0.03, 0.4), 0.01),
    TagGeometry(7, 0.03, (0.03, -0.03, -0.2), 0.015),
]
_FINE = 4  # pictures are warped so much larger, and shrunk by area


@pytest.fixture(autouse=True)
def no_thread_is_left_running():
    yield
    left = [t.name for t in threading.enumerate() if {"frames", "reader", "mjpeg"} & set(t.name.split())]
    assert not left


def photograph(bodies, noise=2.0, seed=0):
    """Grey picture (h, w, 3) of tags on bodies, [(tags, X_W_B)], by `cv2.warpPerspective`."""
    grey = np.full((HEIGHT * _FINE, WIDTH * _FINE), 128, np.uint8)
    # pixel centres at integers, in the small picture as in the large one
    larger = np.array([[_FINE, 0, (_FINE - 1) / 2], [0, _FINE, (_FINE - 1) / 2], [0, 0, 1.0]])
    for tags, (x, y, theta) in bodies:
        for tag in tags:
            cells, print_px = tag_bitmap(tag.id), 32
            page = np.kron(np.where(cells > 127, 230, 25).astype(np.uint8), np.ones((print_px, print_px), np.uint8))
            half = tag.size / 2 * 10 / 8
            c, s = np.cos(tag.pose[2]), np.sin(tag.pose[2])
            page_B = np.array([[-half, half], [half, half], [half, -half], [-half, -half]]) @ [[c, s], [-s, c]]
            c, s = np.cos(theta), np.sin(theta)
            page_W = (page_B + tag.pose[:2]) @ [[c, s], [-s, c]] + (x, y)
            world = np.column_stack((page_W[:, 0], np.full(4, -tag.height), page_W[:, 1]))
            pixels = MODEL.project(world)
            end = len(page) - 0.5
            corners = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32)
            H = larger @ cv2.getPerspectiveTransform(corners, pixels.astype(np.float32))
            size = (WIDTH * _FINE, HEIGHT * _FINE)
            warped = cv2.warpPerspective(page, H, size, flags=cv2.INTER_LINEAR)
            mask = cv2.warpPerspective(np.full_like(page, 255), H, size, flags=cv2.INTER_NEAREST)
            grey = np.where(mask > 0, warped, grey)
    small = grey.reshape(HEIGHT, _FINE, WIDTH, _FINE).mean(axis=(1, 3))
    small += np.random.default_rng(seed).normal(0, noise, small.shape)
    return cv2.cvtColor(np.clip(np.rint(small), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def posed(camera, detections, tags):
    found = estimate_planar_pose(camera, detections, tags)
    assert found is not None
    return found


def config(**fields):
    usual = {"kind": "tag_camera", "backend": "real", "driver": "tag_camera", "address": "http://127.0.0.1:1/x"}
    place = {} if "X_WC" in fields else PLACE
    return RealTagCameraConfig.model_validate({**usual, "width": WIDTH, "height": HEIGHT, **place, **fields})


class Scene:
    """What is before the camera: ``show`` bodies, and the emulated camera sends them."""

    def __init__(self):
        self.picture = photograph([])

    def show(self, *bodies):
        self.picture = photograph(list(bodies))


@pytest.fixture
def scene():
    return Scene()


@pytest.fixture
def emulator(scene):
    with MjpegCamera(lambda: scene.picture, 20, quality=90) as emulator:
        yield emulator


@pytest.fixture
def camera(emulator):
    with RealTagCamera("camera", config(address=emulator.address, rate=20.0, silence=0.5)) as camera:
        yield camera


@pytest.mark.parametrize("pose", [(0.0, 0.2, 0.0), (0.06, 0.25, 0.5), (-0.05, 0.15, -1.2)])
def test_a_tags_pose_comes_through_the_stream(scene, camera, pose):
    scene.show(([BUNDLE[0]], pose))
    reading = camera.capture()
    assert [tag.id for tag in reading.detections] == [3]
    found = posed(MODEL, reading.detections, BUNDLE)
    np.testing.assert_allclose(found.pose[:2], pose[:2], atol=1e-4)
    assert abs(found.pose[2] - pose[2]) < np.radians(0.2)


def test_several_tags_on_one_object_give_one_pose_and_a_surer_one(scene, camera):
    pose = (0.02, 0.22, 0.3)
    scene.show((BUNDLE, pose))
    reading = camera.capture()
    assert [tag.id for tag in reading.detections] == [3, 5, 7]
    whole = posed(MODEL, reading.detections, BUNDLE)
    np.testing.assert_allclose(whole.pose[:2], pose[:2], atol=5e-5)
    assert abs(whole.pose[2] - pose[2]) < np.radians(0.1)
    assert whole.n_tags == 3 and not whole.rejected
    alone = posed(MODEL, reading.detections[:1], BUNDLE)
    assert np.all(np.diag(whole.covariance) < 0.7 * np.diag(alone.covariance))


def test_each_detection_says_how_ambiguous_its_pose_in_space_is_also_over_the_wire(scene, camera):
    scene.show((BUNDLE, (0.0, 0.2, 0.0)))
    reading = camera.capture()
    assert all(tag.ambiguity is not None and 0 <= tag.ambiguity <= 1 for tag in reading.detections)
    read = decode_reading(DETECTIONS, encode_reading(reading), reading.stamp.sequence)
    assert isinstance(read, TagReading)
    for sent, got in zip(reading.detections, read.detections, strict=True):
        assert got.ambiguity == pytest.approx(sent.ambiguity, abs=1e-6)


def test_the_picture_behind_the_newest_reading_is_kept(scene, camera):
    scene.show((BUNDLE, (0.0, 0.2, 0.0)))
    reading = camera.capture()
    picture = camera.image()
    assert (picture.encoding, picture.image.shape) == ("mono8", (HEIGHT, WIDTH))
    assert picture.stamp.sequence >= reading.stamp.sequence
    heard = []
    stop = camera.listen(lambda reading: heard.append((reading.stamp, camera.image().stamp)))
    camera.capture()
    stop()
    assert heard and all(of_reading == of_picture for of_reading, of_picture in heard)
    np.testing.assert_allclose(picture.image.astype(int), scene.picture[..., 0], atol=20)


def ids_before(camera, seconds=20.0):
    """The ids of each picture from now on."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        yield {tag.id for tag in camera.capture().detections}


def test_tags_that_come_beside_others_or_jump_or_go_are_seen(scene, camera):
    scene.show(([BUNDLE[0]], (0.0, 0.2, 0.0)))
    assert any(ids == {3} for ids in ids_before(camera))
    scene.show(([BUNDLE[0]], (0.0, 0.2, 0.0)), ([TagGeometry(9, 0.04)], (0.12, 0.2, 0.0)))
    assert any(ids == {3, 9} for ids in ids_before(camera))
    scene.show(([BUNDLE[0]], (-0.1, 0.25, 0.7)))
    assert any(ids == {3} for ids in ids_before(camera))
    found = posed(MODEL, camera.capture().detections, BUNDLE)
    np.testing.assert_allclose(found.pose, (-0.1, 0.25, 0.7), atol=3e-3)
    scene.show()
    assert any(ids == set() for ids in ids_before(camera))


def test_a_camera_that_stands_on_its_side_is_turned(scene, emulator):
    pose = (0.03, 0.22, 0.3)
    scene.show((BUNDLE, pose))
    scene.picture = np.ascontiguousarray(np.rot90(scene.picture, -1))
    with RealTagCamera("camera", config(address=emulator.address, rotate=90)) as camera:
        found = posed(MODEL, camera.capture().detections, BUNDLE)
    np.testing.assert_allclose(found.pose, pose, atol=2e-3)


def test_it_is_described_open_or_closed_alike_with_its_camera():
    bent = (0.1, -0.05, 0.001, 0.002, 0.0)
    said = RealTagCamera("camera", config(centre=(300.0, 250.0), distortion=bent)).describe()
    assert json.loads(json.dumps(asdict(said)))["extra"] == said.extra
    model = CameraModel.from_dict(said.extra["camera"])
    np.testing.assert_array_equal(model.K, [[700.0, 0, 300], [0, 700, 250], [0, 0, 1]])
    np.testing.assert_array_equal(model.distortion, bent)
    np.testing.assert_allclose(model.X_WC, MODEL.X_WC)
    assert (said.kind, said.backend, said.extra["family"]) == ("tag_camera", "real", "tag36h11")


def test_a_whole_pose_takes_the_place_of_position_and_look_at():
    told = config(X_WC=MODEL.X_WC.tolist(), focal=700.0)
    np.testing.assert_allclose(told.model.X_WC, MODEL.X_WC)
    np.testing.assert_allclose(told.position, PLACE["position"])
    assert isinstance(told, TagCameraConfig)
    # what was resolved and written is read again
    again = RealTagCameraConfig.model_validate(told.model_dump(mode="json"))
    np.testing.assert_allclose(again.model.X_WC, MODEL.X_WC)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"X_WC": np.eye(4).tolist(), **PLACE}, "says twice"),
        ({"X_WC": [[1, 2], [3, 4]]}, "4 x 4"),
        ({"X_WC": (2 * np.eye(4)).tolist()}, "rotation"),
        ({"X_WC": "somewhere"}, "X_WC"),
        ({"look_at": PLACE["position"]}, "view"),
        ({"focal": 0}, "focal"),
        ({"family": "tag99"}, "family"),
        ({"distortion": (0.1,)}, "distortion"),
    ],
)
def test_what_the_station_file_says_wrongly_is_refused_with_the_reason(fields, said):
    with pytest.raises((ValidationError, Refusal), match=said):
        config(**fields)


def test_a_station_file_names_it_by_its_driver():
    told = {"backend": "real", "kind": "tag_camera", "driver": "tag_camera", "address": "usb:0"}
    for place in (PLACE, {"X_WC": MODEL.X_WC.tolist()}):
        station = StationConfig.model_validate({"name": "lab", "devices": {"camera": {**told, **place}}})
        assert isinstance(DRIVER.make("camera", station.devices["camera"]), RealTagCamera)


def test_a_camera_that_changes_its_resolution_is_a_fault(emulator, camera):
    camera.latest()
    emulator.fault = "smaller"
    with pytest.raises(DeviceFault, match="320 × 240, not 640 × 480"):
        while True:
            camera.latest()


def test_a_damaged_picture_shows_no_tags_but_an_error(scene, emulator, camera):
    scene.show((BUNDLE, (0.0, 0.2, 0.0)))
    camera.capture()
    emulator.fault = "damaged"
    with pytest.raises(ProtocolError):
        while True:
            assert {tag.id for tag in camera.latest().detections} in ({3, 5, 7}, set())


def test_a_missing_package_names_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    camera = RealTagCamera("camera", config(address="realsense:0123"))
    with pytest.raises(NotConnected, match=r"^camera: connect to realsense:0123: the package pyrealsense2 is missing"):
        camera.connect()
    with pytest.raises(NotConnected, match=r"pip install 'extrinsic\[realsense\]'"):
        camera.connect()
