"""A Soft Bubble's depth camera: Intel's own library plays back recordings that it made of a camera in software."""

import json
import sys
import threading
import time
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.config import StationConfig
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, NotConnected
from drivers.real import depth_stream
from drivers.real.realsense_bubble import DRIVER, RealSenseBubbleConfig
from drivers.sim.bubble_geometry import DOME, camera_of
from estimation.deformation import Deformation, DepthReader
from estimation.tactile_pose import FingerModel
from mechanics.camera import CameraModel
from mechanics.readings import Status
from mechanics.yaml_input import Refusal
from tests.drivers.real.bubbles import (
    COUNT,
    HEIGHT,
    LENS,
    MISSING,
    RATE,
    SERIAL,
    WIDTH,
    Ports,
    bubble,
    bubble_playback,
    entry,
    numbered,
    reading_after,
    record,
    trouble,
)


@pytest.fixture(autouse=True)
def no_thread_is_left_running():
    yield
    left = [t.name for t in threading.enumerate() if "reader" in t.name.split()]
    assert not left


@pytest.fixture
def ports(rs, monkeypatch):
    ports = Ports()
    monkeypatch.setattr(depth_stream, "library", lambda *_: ports)
    yield ports
    ports.unplug()


def played(**fields):
    """The readings of a numbers, from its first frame to its end, and the finger, closed."""
    heard, finger = [], bubble(**fields)
    finger.listen(heard.append)
    with finger:
        trouble(finger, DeviceTimeout)
    return heard, finger


# -- what it reads -----------------------------------------------------------------------------------------------------


def test_every_frame_comes_with_its_depths_and_its_number(numbers):
    heard, finger = played(recording=str(numbers))
    recorded = [n for n in range(1, COUNT + 1) if n not in MISSING]
    assert [reading.stamp.sequence for reading in heard] == [n - 1 for n in recorded]
    assert finger.gaps == len(MISSING)
    for number, reading in zip(recorded, heard, strict=True):
        np.testing.assert_array_equal(reading.image, numbered(number))
    assert {(r.encoding, r.image.dtype.name, r.stamp.status, r.stamp.frame) for r in heard} == {
        ("16UC1", "uint16", Status.OK, "finger_left")
    }


def test_capture_times_rise_by_the_cameras_own_time_whatever_the_way_took(numbers):
    before = time.time_ns()
    heard, _ = played(recording=str(numbers))
    stamps = [reading.stamp for reading in heard]
    assert before < stamps[0].capture_ns and stamps[-1].receive_ns < time.time_ns()
    assert all(a.capture_ns < b.capture_ns for a, b in pairwise(stamps))
    assert all(s.capture_ns <= s.receive_ns for s in stamps)
    periods = [(b.capture_ns - a.capture_ns) / (b.sequence - a.sequence) for a, b in pairwise(stamps)]
    assert np.median(periods) == pytest.approx(1e9 / RATE, rel=1e-4)


def test_a_capture_was_exposed_at_or_after_the_call(still):
    with bubble(recording=str(still), loop=True) as finger:
        for _ in range(3):
            asked = time.time_ns()
            assert finger.capture().stamp.capture_ns >= asked


@pytest.mark.parametrize("unit", [1e-3, 1e-4, 2.5e-5])
def test_depths_are_tenths_of_a_millimetre_whatever_the_cameras_unit(rs, tmp_path, unit):
    depth = np.zeros((HEIGHT, WIDTH), np.uint16)
    depth[1, :7] = 1, 4, 100, 6553, 6554, 40000, 65535
    file = record(tmp_path / "unit.db3", [depth] * 3, unit=unit)
    heard, _ = played(recording=str(file))
    found = heard[0].image[1, :7]
    expected = depth[1, :7] * np.float32(unit) * 1e4
    expected[expected > 65535] = 0  # beyond what can be said there is none
    assert np.abs(found - expected).max() <= 0.501
    assert not heard[0].image[0].any()  # a hole stays one


def test_a_picture_is_made_of_the_cameras_pixels_and_never_of_their_means(numbers):
    crop = (40, 8, 225, 171)
    heard, _ = played(recording=str(numbers), crop=crop, width=75, height=57)
    whole = numbered(1)[8:179, 40:265]
    np.testing.assert_array_equal(heard[0].image, whole[1::3, 1::3])
    heard, _ = played(recording=str(numbers), width=224, height=171)
    rows, columns = (np.floor((np.arange(n) + 0.5) * of / n).astype(int) for n, of in ((171, HEIGHT), (224, WIDTH)))
    np.testing.assert_array_equal(heard[0].image, numbered(1)[np.ix_(rows, columns)])


def test_a_picture_without_any_depth_is_invalid(rs, tmp_path):
    file = record(tmp_path / "dark.db3", [np.zeros((HEIGHT, WIDTH), np.uint16)] * 3)
    heard, _ = played(recording=str(file))
    assert {reading.stamp.status for reading in heard} == {Status.INVALID}


# -- what it says of itself --------------------------------------------------------------------------------------------


def test_it_is_described_open_or_closed_alike_as_the_simulated_finger_is():
    finger = bubble(camera_size=[640, 480], width=640, height=480, lens=None)
    said = finger.describe()
    assert json.loads(json.dumps(asdict(said)))["extra"] == said.extra
    assert (said.kind, said.backend, said.frame, said.rate) == ("tactile", "real", "finger_left", 30.0)
    model, simulated = CameraModel.from_dict(said.extra["camera"]), camera_of(640, 480).model_in_finger()
    np.testing.assert_allclose(model.K, simulated.K)
    np.testing.assert_allclose(model.X_WC, simulated.X_WC)
    assert said.extra["dome"] == {"a": DOME.a, "b": DOME.b, "height": DOME.top, "apex_depth": 0.1}
    assert said.range == (0.059, 0.1) and said.resolution == (1e-4,)
    assert {key: said.extra[key] for key in ("sensor", "finger", "encoding", "depth_unit", "indentation_mm")} == {
        "sensor": "soft_bubble",
        "finger": "left",
        "encoding": "16UC1",
        "depth_unit": 1e-4,
        "indentation_mm": 12.0,
    }


def test_the_description_is_the_same_while_it_is_open(still):
    finger = bubble(recording=str(still), loop=True)
    closed = finger.describe()
    with finger:
        assert finger.describe() == closed
    assert closed.serial == "still.db3"
    assert bubble(serial=SERIAL).describe().serial == SERIAL


@pytest.mark.parametrize(("factor", "width", "height"), [(1, 300, 220), (3, 100, 73), (2, 150, 110)])
def test_the_camera_of_a_cut_picture_sees_a_ray_where_its_pixel_lies(factor, width, height):
    crop = (11, 6, factor * width, factor * height)
    config = RealSenseBubbleConfig.model_validate(entry(crop=crop, width=width, height=height))
    rows, columns = config.pixels
    K = config.optics.K
    np.testing.assert_allclose((columns - LENS["cx"]) / LENS["fx"], (np.arange(width) - K[0, 2]) / K[0, 0], atol=1e-12)
    np.testing.assert_allclose((rows - LENS["cy"]) / LENS["fy"], (np.arange(height) - K[1, 2]) / K[1, 1], atol=1e-12)


def test_the_camera_of_a_picture_that_is_scaled_is_right_to_half_a_pixel_of_the_camera():
    config = RealSenseBubbleConfig.model_validate(entry(width=224, height=171))
    rows, columns = config.pixels
    K = config.optics.K
    for taken, size, f, c, fs, cs in (
        (columns, 224, LENS["fx"], LENS["cx"], K[0, 0], K[0, 2]),
        (rows, 171, LENS["fy"], LENS["cy"], K[1, 1], K[1, 2]),
    ):
        off = (taken - c) - f * (np.arange(size) - cs) / fs
        assert np.abs(off).max() <= 0.51 and abs(off.mean()) < 1e-9


def test_estimation_finds_the_face_that_presses_on_it(rs, tmp_path):
    with bubble(**bubble_playback(tmp_path)) as finger:
        model = FingerModel.of(finger.describe().extra, finger.reference())
        reading = finger.capture()
    assert reading.image.shape == (171, 224)
    np.minimum(reading.image, 880, out=reading.image)  # a wide face, 12 mm deep
    field = DepthReader(model).read(reading)
    assert isinstance(field, Deformation)
    np.testing.assert_allclose(field.plane, [0.012, 0, 0], atol=3e-4)
    assert field.inward[field.valid].max() == pytest.approx(0.012, abs=3e-4)


def test_a_calibrated_camera_is_described_as_it_is():
    calibrated = CameraModel(64, 48, np.diag([70.0, 71.0, 1.0]), np.full(5, 0.01), np.eye(4))
    finger = bubble(width=64, height=48, camera=calibrated.as_dict())
    assert finger.describe().extra["camera"] == calibrated.as_dict()


# -- a recording's end, and its beginning ------------------------------------------------------------------------------


def test_a_recording_that_ends_says_so_and_is_played_again_when_it_is_opened_again(numbers):
    finger = bubble(recording=str(numbers))
    for _ in range(2):
        heard = []
        stop = finger.listen(heard.append)
        with finger:
            error = trouble(finger, DeviceTimeout)
            assert str(error).startswith(f"finger_left: read {numbers}: the recording has ended. ")
            assert finger.reconnections == 0
        stop()
        assert [heard[0].stamp.sequence, heard[-1].stamp.sequence] == [0, COUNT - 1]


def test_a_recording_that_loops_goes_on_without_a_gap(still):
    with bubble(recording=str(still), loop=True) as finger:
        before = finger.latest()
        after = reading_after(finger, 90)  # two and a half times through
        assert finger.gaps == 0
        stamps = [reading.stamp for reading in finger.since(before.stamp.capture_ns)]
    assert np.all(np.diff([s.sequence for s in stamps]) == 1) and after.stamp.sequence > 90
    assert np.all(np.diff([s.capture_ns for s in stamps]) > 0)


# -- live cameras ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("serial", ["", SERIAL])
def test_a_camera_that_is_plugged_in_is_read(ports, still, serial):
    ports.plug(still)
    with bubble(serial=serial) as finger:
        assert np.count_nonzero(finger.capture().image) > 1000


def test_without_any_camera_nothing_is_started(ports):
    with pytest.raises(NotConnected, match=r"^finger_left: connect to RealSense: no RealSense.*Cameras here: none$"):
        bubble().connect()
    assert ports.started == 0  # what is started without a camera stands still for fifteen seconds


def test_a_camera_with_another_number_is_not_taken(ports, still):
    ports.plug(still)
    with pytest.raises(NotConnected, match=rf"^finger_left: .*no RealSense 999\. .*Cameras here: {SERIAL}$"):
        bubble(serial="999").connect()
    assert ports.started == 0


@pytest.mark.parametrize("fields", [{"rate": 60}, {"camera_size": [640, 480]}, {"camera_size": [848, 480]}])
@pytest.mark.parametrize("live", [True, False])
def test_a_stream_that_it_has_not_is_named_beside_those_that_it_has(rs, request, still, fields, live):
    if live:
        request.getfixturevalue("ports").plug(still)
    with pytest.raises(NotConnected, match=rf"`camera_size` and `rate`: it has depth of {WIDTH} × {HEIGHT} at 30 Hz"):
        bubble(**fields, **({} if live else {"recording": str(still)})).connect()


def test_a_camera_that_is_unplugged_is_told_and_found_again_when_it_is_plugged_in(ports, numbers):
    heard, finger = [], bubble(silence=0.3)
    finger.listen(heard.append)
    ports.plug(numbers)
    with finger:
        finger.latest()
        ports.unplug()
        assert "no frame for 0.3 s" in str(trouble(finger, DeviceTimeout))
        deadline = time.monotonic() + 20
        while not isinstance(finger.trouble, NotConnected) and time.monotonic() < deadline:
            with pytest.raises(DriverError):
                finger.latest(0.1)
        assert "Cameras here: none" in str(finger.trouble)
        last = heard[-1].stamp
        ports.plug(numbers)
        reading_after(finger, last.sequence)
        assert finger.reconnections == 1
    again = next(reading.stamp for reading in heard if reading.stamp.sequence > last.sequence)
    away = (again.capture_ns - last.capture_ns) * 1e-9
    assert away > 0.3 and again.sequence - last.sequence == pytest.approx(away * RATE, abs=0.51)
    assert finger.gaps >= again.sequence - last.sequence - 1


# -- what does not fit the station file --------------------------------------------------------------------------------


def test_another_lens_is_refused_with_the_line_that_mends_it(still):
    with pytest.raises(NotConnected, match=r"Write `lens: \{") as caught:
        bubble(recording=str(still), lens={**LENS, "fx": 215.0}).connect()
    from ruamel.yaml import YAML

    line = caught.value.remedy.split("`")[1]
    lens = YAML(typ="safe").load(line)["lens"]
    assert lens == pytest.approx(LENS)
    with bubble(recording=str(still), lens=lens) as finger:
        finger.latest()


def test_a_recording_of_another_camera_is_refused(still):
    with pytest.raises(NotConnected, match=rf"it is {SERIAL}, not 999"):
        bubble(recording=str(still), serial="999").connect()


@pytest.mark.parametrize(("unit", "told"), [(None, "does not say what a step of its depth is"), (0.0, "depth is 0 m")])
def test_a_recording_that_tells_no_unit_of_depth_is_refused(rs, tmp_path, unit, told):
    file = record(tmp_path / "unitless.db3", [numbered(n) for n in range(3)], unit=unit)
    with pytest.raises(NotConnected, match=told):
        bubble(recording=str(file)).connect()


def test_a_recording_without_depth_is_refused(rs, tmp_path):
    file = record(tmp_path / "infrared.db3", [numbered(n) for n in range(3)], stream="infrared")
    with pytest.raises(NotConnected, match="It has no depth stream"):
        bubble(recording=str(file)).connect()


NOISE = np.random.default_rng(1).bytes(5000)


@pytest.mark.parametrize("name", ["x.db3", "x.bag"])
@pytest.mark.parametrize("damage", [b"", NOISE, b"#ROSBAG V2.0\n" + NOISE, None, "folder", 0.5])
def test_a_damaged_recording_is_not_connected(rs, numbers, tmp_path, name, damage):
    file = tmp_path / name
    if damage == "folder":
        file.mkdir()
    elif isinstance(damage, float):
        whole = numbers.read_bytes()
        file.write_bytes(whole[: int(damage * len(whole))])
    elif damage is not None:
        file.write_bytes(damage)
    with pytest.raises(NotConnected, match=rf"^finger_left: connect to {file}: "):
        bubble(recording=str(file)).connect()


def test_a_missing_package_names_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(
        NotConnected, match=r"^finger_left: connect to RealSense: .*pip install 'extrinsic\[realsense\]'"
    ):
        bubble().connect()


def test_a_missing_libusb_is_told(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(NotConnected, match=r"libusb-1\.0\.so\.0: .*apt install libusb-1\.0-0"):
        bubble().connect()


def test_frames_of_another_size_are_a_fault(still):
    class Odd:
        """A frame, but for its picture."""

        def __init__(self, frame):
            self.frame = frame

        def __getattr__(self, name):
            return getattr(self.frame, name)

        def as_frameset(self):
            return self

        def get_depth_frame(self):
            return Odd(self.frame.as_frameset().get_depth_frame())

        def get_data(self):
            return np.zeros((48, 64), np.uint16)

    with bubble(recording=str(still), loop=True) as finger:
        fetch = finger._stream._fetch
        assert fetch is not None

        def changed(timeout):
            got, frame = fetch(timeout)
            return got, frame and Odd(frame)

        finger._stream._fetch = changed
        error = trouble(finger, DeviceFault)
    assert isinstance(error, DeviceFault) and error.recoverable and "(48, 64)" in str(error)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"rate": 29.97}, "no 29.97 Hz"),
        ({"loop": True}, "no recording to play again"),
        ({"recording": "a.mp4"}, "a.mp4 is no recording"),
        ({"recording": "a.db3", "preset": "Hand"}, "as it was made"),
        ({"recording": "a.db3", "laser_power": 0.0}, "as it was made"),
        ({"crop": [300, 0, 40, 40]}, "not within 320 × 240"),
        ({"crop": [-1, 0, 40, 40]}, "not within 320 × 240"),
        ({"crop": [0, 0, 100, 100]}, "no 320 × 240 pixels are left of 100 × 100"),
        ({"camera_size": [0, 240]}, "is no size"),
        ({"dome": [0.05, 0.04, 0.2]}, "is no dome"),
        ({"indentation": 0.03, "dome": [0.05, 0.04, 0.025]}, "deeper than the dome"),
        ({"camera": {"width": 3}}, "camera model"),
        ({"camera": CameraModel(64, 48, np.eye(3)).as_dict()}, "one of 64 × 48 pixels"),
    ],
)
def test_what_no_finger_can_be_is_refused(fields, told):
    with pytest.raises(ValidationError) as caught:
        RealSenseBubbleConfig.model_validate(entry(**fields))
    (error,) = caught.value.errors()
    refusal = error.get("ctx", {})["error"]
    assert isinstance(refusal, Refusal) and told in str(refusal)


def test_a_station_file_can_name_it():
    station = StationConfig.model_validate({"name": "lab", "devices": {"finger_left": entry(serial=SERIAL)}})
    device = station.devices["finger_left"]
    assert isinstance(device, DRIVER.config)
    assert DRIVER.make("finger_left", device).describe().serial == SERIAL
