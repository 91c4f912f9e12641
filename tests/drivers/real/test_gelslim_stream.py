"""A GelSlim behind an MJPEG stream: what it reads, its reference, its cut of the picture, and what goes wrong."""

import json
import threading
import time
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from drivers.config import StationConfig, TactileConfig
from drivers.emulators.mjpeg_camera import MjpegCamera
from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, DriverError, NotConnected, ProtocolError
from drivers.real.gelslim_stream import DRIVER, GelSlim, GelSlimConfig
from drivers.sim.gel_optics import GelSlimOptics
from estimation.tactile_pose import FingerModel
from mechanics.camera import CameraModel
from mechanics.yaml_input import Refusal
from tests.drivers.real.cameras import HEIGHT, WIDTH, counting, number_of, numbered

NOISE = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
GEL = np.asarray(cv2.GaussianBlur(NOISE, (0, 0), 4), np.uint8)


@pytest.fixture(autouse=True)
def no_thread_is_left_running():
    yield
    left = [t.name for t in threading.enumerate() if {"frames", "reader", "mjpeg"} & set(t.name.split())]
    assert not left


def told(**fields):
    usual = {"kind": "tactile", "backend": "real", "driver": "gelslim_stream", "finger": "left"}
    return {**usual, "address": "http://127.0.0.1:1/x", "width": WIDTH, "height": HEIGHT, **fields}


def config(**fields):
    return GelSlimConfig.model_validate(told(**fields))


@pytest.fixture
def camera():
    with MjpegCamera(counting(), 60) as camera:
        yield camera


@pytest.fixture
def finger(camera):
    with GelSlim("finger_left", config(address=camera.address, rate=60.0, silence=0.5)) as finger:
        yield finger


def reading_after(finger, sequence, patience=10.0):
    """The first reading after ``sequence`` that anybody gets, through trouble and back."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            reading = finger.latest(1.0)
        except DriverError:
            continue
        if reading.stamp.sequence > sequence:
            return reading
    raise AssertionError("no reading")


def trouble(finger, kind):
    """The error that reading ends in, sooner or later."""
    with pytest.raises(kind) as caught:
        while True:
            finger.latest(1.0)
    return caught.value


# -- what it reads -----------------------------------------------------------------------------------------------------


def test_readings_are_the_cameras_pictures_in_order(finger):
    heard, enough = [], threading.Event()
    finger.listen(lambda reading: (heard.append(reading), len(heard) >= 20 and enough.set()))
    assert enough.wait(20)
    assert {(r.encoding, r.image.shape, r.image.dtype.name) for r in heard} == {("bgr8", (HEIGHT, WIDTH, 3), "uint8")}
    shown = [number_of(r.image) for r in heard]
    assert shown == sorted(set(shown)) and shown[0] > 0
    stamps = [r.stamp for r in heard]
    assert all(a.capture_ns < b.capture_ns and a.sequence < b.sequence for a, b in pairwise(stamps))
    assert {s.frame for s in stamps} == {"finger_left"}
    missing = stamps[-1].sequence - stamps[0].sequence + 1 - len(stamps)
    assert finger.gaps >= missing


def test_a_capture_was_exposed_at_or_after_the_call(finger):
    for _ in range(5):
        asked = time.time_ns()
        assert finger.capture().stamp.capture_ns >= asked


def test_a_capture_that_does_not_come_is_a_time_out(finger, camera):
    camera.fault = "silence"
    with pytest.raises(DeviceTimeout, match="finger_left"):
        finger.capture(0.2)


def test_it_is_described_open_or_closed_alike_with_what_estimation_needs():
    finger = GelSlim("finger_left", config())
    said = finger.describe()
    assert json.loads(json.dumps(asdict(said)))["extra"] == said.extra
    assert (said.kind, said.backend, said.frame, said.rate) == ("tactile", "real", "finger_left", 30.0)
    assert said.serial == "http://127.0.0.1:1/x"  # a stream tells no number
    model = FingerModel.of(said.extra, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    optics = GelSlimOptics().camera(WIDTH, HEIGHT)  # the simulated finger's, whose optics are a GelSlim 3.0's
    np.testing.assert_allclose(model.camera.K, optics.K)
    np.testing.assert_allclose(model.camera.X_WC, optics.X_WC)
    assert said.extra["mm_per_px"] == pytest.approx(45.2 / WIDTH)
    assert said.extra["marker_pitch_mm"] == pytest.approx(2.3)
    assert said.extra["indentation_mm"] == pytest.approx(0.8)
    assert (said.extra["sensor"], said.extra["finger"], said.extra["encoding"]) == ("gelslim", "left", "bgr8")


def test_a_calibrated_camera_takes_the_place_of_the_usual_optics():
    calibrated = GelSlimOptics(distance=0.05).camera(WIDTH, HEIGHT)
    said = GelSlim("f", config(camera=calibrated.as_dict())).describe().extra
    np.testing.assert_array_equal(CameraModel.from_dict(said["camera"]).K, calibrated.K)
    assert said["mm_per_px"] == pytest.approx(45.2 / WIDTH)  # farther away, with a longer lens


def test_a_password_is_not_told():
    finger = GelSlim("f", config(address="http://me:secret@10.0.0.7/x"))
    assert "secret" not in json.dumps(asdict(finger.describe()))


# -- the picture's cut -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_picture_is_turned_flipped_cropped_and_scaled_in_that_order(degrees):
    turns = degrees // 90
    width, height = (HEIGHT, WIDTH) if turns % 2 else (WIDTH, HEIGHT)
    expected = np.rot90(GEL, turns)[:, ::-1][8 : height - 4, 16 : width - 12]
    halved = expected.reshape(expected.shape[0] // 2, 2, expected.shape[1] // 2, 2, 3).mean(axis=(1, 3))
    shape = {"rotate": degrees, "flip": True, "camera_size": (WIDTH, HEIGHT), "crop": (16, 8, width - 28, height - 12)}
    whole = config(**shape, width=width - 28, height=height - 12).shaped(GEL)
    np.testing.assert_array_equal(whole, expected)
    half = config(**shape, width=(width - 28) // 2, height=(height - 12) // 2, scale=True).shaped(GEL)
    np.testing.assert_allclose(half, halved, atol=1)


def test_a_cropped_stream_gives_the_size_that_the_station_file_promises(camera):
    cut = config(address=camera.address, camera_size=(WIDTH, HEIGHT), crop=(0, 40, WIDTH, 160), height=160)
    with GelSlim("f", cut) as finger:
        image = finger.latest().image
    assert image.shape == (160, WIDTH, 3) and number_of(image) > 0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"crop": (0, 0, 10, 10)}, "camera_size"),
        ({"scale": True}, "camera_size"),
        ({"camera_size": (640, 480)}, "what is left is 640 × 480, not 320 × 240"),
        ({"camera_size": (640, 480), "crop": (400, 0, 320, 240)}, "not within 640 × 480"),
        ({"camera_size": (640, 480), "rotate": 90, "crop": (170, 0, 320, 240)}, "not within 480 × 640"),
        ({"camera_size": (0, 480), "scale": True}, "is no size"),
        ({"address": "ftp://x"}, "no camera's address"),
        ({"camera": {"width": 3}}, "camera model"),
        ({"camera": GelSlimOptics().camera(64, 48).as_dict()}, "64 × 48"),
        ({"finger": "middle"}, "finger"),
        ({"sensor": "soft_bubble"}, "sensor"),
        ({"adress": "usb:0"}, "adress"),
        ({"rate": 0}, "rate"),
    ],
)
def test_what_the_station_file_says_wrongly_is_refused_with_the_reason(fields, said):
    with pytest.raises((ValidationError, Refusal), match=said):
        config(**fields)


def test_a_station_file_names_it_by_its_driver():
    station = StationConfig.model_validate({"name": "lab", "devices": {"finger_left": told()}})
    found = station.devices["finger_left"]
    assert isinstance(found, GelSlimConfig) and isinstance(found, TactileConfig)
    assert isinstance(DRIVER.make("finger_left", found), GelSlim)


# -- the reference -----------------------------------------------------------------------------------------------------


def test_without_a_reference_it_says_how_to_get_one(finger):
    with pytest.raises(CommandRefused, match=r"^finger_left: give its reference picture: refused: there is none\."):
        finger.reference()


@pytest.fixture
def noisy():
    rng = np.random.default_rng(3)
    with MjpegCamera(lambda: np.clip(GEL + rng.normal(0, 6, GEL.shape), 0, 255).astype(np.uint8), 60, quality=98) as it:
        yield it


def test_a_reference_is_the_mean_of_many_frames(noisy, tmp_path):
    file = tmp_path / "lab" / "reference.png"
    with GelSlim("f", config(address=noisy.address, rate=60.0)) as finger:
        one = finger.capture().image
        mean = finger.take_reference(frames=40, file=file)
        np.testing.assert_array_equal(finger.reference(), mean)
    spread = {name: np.std(picture.astype(float) - GEL) for name, picture in (("one", one), ("mean", mean))}
    assert spread["mean"] < spread["one"] / 3
    with GelSlim("f", config(address=noisy.address, reference=str(file))) as finger:
        np.testing.assert_array_equal(finger.reference(), mean)


def test_it_can_be_told_to_take_the_reference_when_it_is_asked_for(noisy):
    with GelSlim("f", config(address=noisy.address, rate=60.0, reference="take")) as finger:
        assert finger.describe().extra["reference"]
        first = finger.reference()
        np.testing.assert_array_equal(finger.reference(), first)
    np.testing.assert_allclose(first.mean(), GEL.mean(), atol=1)


def test_a_finger_that_is_being_touched_gives_no_reference():
    pictures = counting()

    def changing():
        return np.full((HEIGHT, WIDTH, 3), 2 * number_of(pictures()) % 200, np.uint8)

    with MjpegCamera(changing, 60) as camera, GelSlim("f", config(address=camera.address, rate=60.0)) as finger:
        with pytest.raises(CommandRefused, match="the picture changes"):
            finger.take_reference(frames=20)
        with pytest.raises(CommandRefused, match="there is none"):
            finger.reference()


@pytest.mark.parametrize(
    ("made", "said"), [(None, "no file"), (b"no png", "no picture"), (numbered(1, 160, 120), "160 × 120 pixels")]
)
def test_a_reference_file_that_does_not_serve_is_refused_with_its_name(camera, tmp_path, made, said):
    file = tmp_path / "reference.png"
    if isinstance(made, bytes):
        file.write_bytes(made)
    elif made is not None:
        cv2.imwrite(str(file), made)
    other = GelSlim("f", config(address=camera.address, reference=str(file)))
    with other, pytest.raises(CommandRefused, match=said) as caught:
        other.reference()
    assert str(file) in str(caught.value)


def test_a_closed_finger_has_no_reference():
    with pytest.raises(NotConnected):
        GelSlim("f", config(reference="take")).reference()


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_a_camera_that_changes_its_resolution_is_a_fault_until_it_is_set_back(finger, camera):
    before = finger.latest().stamp.sequence
    camera.fault = "smaller"
    error = trouble(finger, DeviceFault)
    assert "160 × 120, not 320 × 240" in str(error) and "camera_size" in error.remedy
    assert all(r.image.shape == (HEIGHT, WIDTH, 3) for r in finger._readings)
    camera.fault = None
    assert reading_after(finger, before).image.shape == (HEIGHT, WIDTH, 3)
    assert finger.reconnections >= 1


def test_a_camera_of_another_resolution_is_a_fault_on_connecting(camera):
    finger = GelSlim("f", config(address=camera.address, width=640, height=480))
    with pytest.raises(DeviceFault, match="320 × 240, not 640 × 480"):
        finger.connect(2.0)
    assert not finger.connected


def test_a_stream_that_stops_in_mid_frame_is_told_and_sought_again(finger, camera):
    before = finger.latest().stamp.sequence
    camera.fault = "cut"
    assert camera.address in str(trouble(finger, DeviceFault))
    camera.fault = None
    reading = reading_after(finger, before)
    assert finger.gaps > 0 and number_of(reading.image) > 0


def test_damaged_pictures_are_counted_and_the_next_one_mends_it(finger, camera):
    before = finger.latest().stamp.sequence
    camera.fault = "damaged"
    trouble(finger, ProtocolError)
    camera.fault = None
    reading_after(finger, before + finger.corrupt)
    assert finger.corrupt > 0 and finger.reconnections == 0


def test_a_camera_that_was_switched_off_is_found_again():
    camera = MjpegCamera(counting(), 60)
    with camera:
        address = camera.address
        finger = GelSlim("f", config(address=address, rate=60.0, silence=0.5))
        finger.connect()
        before = finger.latest().stamp.sequence
    assert address in str(trouble(finger, DriverError))
    with camera:
        reading_after(finger, before)
        finger.close()


def test_a_camera_that_is_not_there_is_not_connected_and_names_what_to_do():
    with MjpegCamera(counting()) as camera:
        address = camera.address
    finger = GelSlim("f", config(address=address))
    with pytest.raises(NotConnected, match=f"^f: connect to {address}: connection refused. See"):
        finger.connect(1.0)
    finger.close()


def test_two_clients_read_one_camera(camera):
    one, two = (GelSlim(name, config(address=camera.address, rate=60.0)) for name in ("one", "two"))
    with one, two:
        assert number_of(one.capture().image) > 0 and number_of(two.capture().image) > 0


def test_opening_and_closing_again_counts_anew(camera):
    finger = GelSlim("f", config(address=camera.address))
    for _ in range(2):
        with finger:
            assert finger.latest().stamp.sequence < 10 and finger.gaps < 10
        finger.close()
        with pytest.raises(NotConnected):
            finger.latest()


def test_its_file_in_the_station_may_lie_at_home(monkeypatch, camera, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    cv2.imwrite(str(tmp_path / "reference.png"), GEL)
    with GelSlim("f", config(address=camera.address, reference="~/reference.png")) as finger:
        np.testing.assert_array_equal(finger.reference(), GEL)
    assert Path("~/reference.png").expanduser().parent == tmp_path
