"""The bring-up of a device that looks: cameras and tactile fingers, well and not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from drivers.config import StationConfig
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.tags import tag_bitmap
from experiments.calibrate import store
from experiments.calibrate.models import CameraCalibration, Origin
from experiments.check_device.checklist import exit_code
from experiments.check_device.findings import Verdict
from experiments.exit_codes import ExitCode
from mechanics.camera import CameraModel
from tests.experiments.check_devices import Hand, findings, noisy, station
from tests.experiments.check_devices import found as look

TABLE = [{"id": i, "size": 0.04, "pose": [x, 0.1, 0], "height": 0.03} for i, x in enumerate((-0.1, 0.0, 0.1))]
FOCAL, DISTANCE = 600.0, 0.5


# -- cameras -----------------------------------------------------------------------------------------------------------


def wall_of_tags(ids=(0, 1, 2), aside: float = 0.0) -> np.ndarray:
    """What a pinhole camera sees that faces the tags of `TABLE` from `DISTANCE` before them, (480, 640).

    It stands ``aside`` [m] to the left of where the station file has it.
    """
    picture = np.full((480, 640), 128, np.uint8)
    scale = FOCAL / DISTANCE
    for mount in TABLE:
        if mount["id"] in ids:
            size = round(mount["size"] * scale)
            tag = cv2.resize(tag_bitmap(mount["id"]), None, fx=size / 8, fy=size / 8, interpolation=cv2.INTER_NEAREST)
            # pixel centres lie at integers, so a tag of an even number of pixels is centred between two
            left = round(319.5 + (mount["pose"][0] + aside) * scale - (tag.shape[1] - 1) / 2)
            top = round(239.5 - (tag.shape[0] - 1) / 2)
            picture[top : top + tag.shape[0], left : left + tag.shape[1]] = tag
    return picture


@contextmanager
def tag_camera(picture) -> Iterator[StationConfig]:
    with MjpegCamera(picture, 10.0) as camera:
        device = {
            "kind": "tag_camera",
            "driver": "tag_camera",
            "address": camera.address,
            "rate": 10,
            "width": 640,
            "height": 480,
            "focal": FOCAL,
            "position": [0, -DISTANCE - 0.03, 0.1],
            "look_at": [0, 0, 0.1],
        }
        yield station("camera", device, table_tags=TABLE)


def test_a_camera_that_sees_the_table_where_it_is_passes():
    with tag_camera(noisy(wall_of_tags())) as config:
        found = findings(config, "camera")
    assert exit_code([finding.verdict for finding in found.values()]) is ExitCode.DONE, found
    assert "640 × 480" in found["picture"].measured
    assert found["tags"].figures["tags"] == [0, 1, 2]
    assert max(found["reprojection"].figures["off_px"].values()) < 1.0


def test_a_camera_that_stands_elsewhere_is_told_by_how_many_pixels():
    with tag_camera(noisy(wall_of_tags(aside=0.01))) as config:
        found = look("reprojection", config, "camera")
    assert found.verdict is Verdict.SHORT
    for off in found.figures["off_px"].values():
        assert off == pytest.approx(0.01 * FOCAL / DISTANCE, abs=0.7)


def test_a_camera_that_was_calibrated_is_held_against_that(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with tag_camera(noisy(wall_of_tags(aside=0.01))) as config:
        of = config.devices["camera"]
        place = CameraModel.looking_at((-0.01, -DISTANCE - 0.03, 0.1), (-0.01, 0, 0.1), FOCAL, 640, 480)
        for serial, verdict, told in (
            (of.serial, Verdict.GOOD, "as calibrated on"),
            ("another", Verdict.SHORT, "file"),
        ):
            origin = Origin(made=datetime.now(UTC), station=config.name, devices={"camera": serial})
            made = CameraCalibration(
                origin=origin, device="camera", camera=place.as_dict(), focal_deviation=1.0, residual_px=0.2, views=9
            )
            store.save(store.FOLDER / config.name, made)
            found = look("reprojection", config, "camera")
            assert (found.verdict, told in found.measured) == (verdict, True), found
        (store.FOLDER / config.name / "camera.yaml").write_text("kind: camera\n")
        assert look("reprojection", config, "camera").verdict is Verdict.SHORT


def test_a_tag_that_is_out_of_view_is_named():
    with tag_camera(noisy(wall_of_tags(ids=(0, 2)))) as config:
        found = look("tags", config, "camera")
    assert found.verdict is Verdict.SHORT
    assert "missing 1" in found.measured


def test_a_camera_in_the_dark_and_one_out_of_focus_fall_short():
    sharp = wall_of_tags()
    with tag_camera(noisy(sharp // 16)) as config:
        dark = look("picture", config, "camera")
    blurred = cv2.GaussianBlur(sharp, (0, 0), 8)
    with tag_camera(lambda: blurred) as config:
        soft = look("picture", config, "camera")
    assert dark.verdict is soft.verdict is Verdict.SHORT
    assert "light" in dark.remedy
    assert "Focus" in soft.remedy


def test_a_picture_that_never_changes_is_stuck():
    still = wall_of_tags()
    with tag_camera(lambda: still) as config:
        assert look("values", config, "camera").verdict is Verdict.SHORT


# -- tactile -----------------------------------------------------------------------------------------------------------


class Gel:
    """A gel's camera, with a fingertip on it where ``touch`` (column, row) [px] says."""

    def __init__(self) -> None:
        self.touch: tuple[int, int] | None = None
        self._view = noisy(np.full((120, 160, 3), 110, np.uint8))

    def __call__(self) -> np.ndarray:
        picture = self._view()
        return picture if self.touch is None else cv2.circle(picture, self.touch, 12, (200, 180, 160), -1)


@contextmanager
def finger(gel: Gel, **more) -> Iterator[StationConfig]:
    with MjpegCamera(gel, 30.0) as camera:
        device = {
            "kind": "tactile",
            "driver": "gelslim_stream",
            "sensor": "gelslim",
            "finger": "left",
            "address": camera.address,
            "rate": 30,
            "width": 160,
            "height": 120,
            "reference": "take",
        }
        yield station("gel", device | more)


def touching(gel: Gel, places: dict[str, tuple[int, int]]) -> Hand:
    def press(request: str) -> bool:
        for words, place in places.items():
            if words in request:
                gel.touch = place
                return True
        return False

    return Hand(press)


PLACES = {"toward the wrist": (80, 25), "W's +x": (130, 60)}  # as the left finger looks: up is up, right is right


def test_a_finger_shows_a_touch_where_it_was_touched():
    gel = Gel()
    with finger(gel) as config:
        found = look("touch", config, "gel", touching(gel, PLACES))
    assert found.verdict is Verdict.GOOD, found
    upper, right = (part.partition(": ")[2] for part in found.measured.split("; "))
    assert "upper" in upper
    assert "right" in right


@pytest.mark.parametrize("wrong", [{"flip": True}, {"rotate": 180}, {"finger": "right"}])
def test_a_finger_whose_picture_is_turned_or_flipped_falls_short(wrong):
    gel = Gel()
    with finger(gel, **wrong) as config:
        assert look("touch", config, "gel", touching(gel, PLACES)).verdict is Verdict.SHORT


def test_a_reference_is_taken_into_the_file_that_is_named_and_never_overwritten(tmp_path):
    gel, file = Gel(), tmp_path / "untouched.png"
    with finger(gel, reference="") as config:
        taken = look("reference", config, "gel", reference=file)
        image = cv2.imread(str(file))
        again = look("reference", config, "gel", reference=file)
    assert taken.verdict is Verdict.GOOD
    assert image is not None
    assert image.shape == (120, 160, 3)
    assert abs(float(image.mean()) - 110) < 2
    assert again.verdict is Verdict.SHORT


def test_a_finger_without_a_reference_says_how_to_take_one():
    with finger(Gel(), reference="") as config:
        found = look("reference", config, "gel")
    assert found.verdict is Verdict.SHORT
    assert "check-device" in found.remedy
