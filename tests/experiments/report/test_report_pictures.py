"""Which pictures of a log stand in the report, and what their grey values say."""

import base64

import cv2
import numpy as np
import pytest
from plotly.colors import sequential

from drivers.wire import messages
from drivers.wire.codec import encode_compressed, encode_reading
from drivers.wire.log_reader import Logged
from experiments.report import render
from experiments.report.pictures import Pictures, carried, colours
from mechanics.readings import ImageReading, Stamp

FINGER, CAMERA = "sim/finger_left/image", "sim/camera/image"


def picture(topic, t_ns, image, encoding="16UC1"):
    reading = ImageReading(Stamp(t_ns, t_ns, 0, "camera"), image, encoding)
    if encoding == "16UC1":
        return Logged(topic, messages.IMAGE, encode_reading(reading), 0, t_ns, t_ns)
    return Logged(topic, messages.COMPRESSED_IMAGE, encode_compressed(reading), 0, t_ns, t_ns)


def depth(mm, shape=(48, 64)):
    return np.full(shape, round(10 * mm), np.uint16)  # a step is 0.1 mm


def grey(shot):
    picture = cv2.imdecode(np.frombuffer(shot[2], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def test_a_waypoint_has_the_newest_picture_before_it_and_one_without_has_none():
    seen = Pictures()
    strips = seen.begin()
    for t, mm in ((1, 90), (2, 88)):
        seen.take(picture(FINGER, t, depth(mm)))
    seen.settle(0)
    seen.settle(1)
    seen.take(picture(FINGER, 3, depth(85)))
    seen.settle(2)
    assert [shot[:2] for shot in strips["finger_left"].shots] == [(0, 2), (2, 3)]


def test_what_came_before_the_trial_or_after_it_is_none_of_its_pictures():
    seen = Pictures()
    seen.take(picture(FINGER, 1, depth(90)))
    strips = seen.begin()
    seen.settle(0)
    seen.end()
    seen.take(picture(FINGER, 2, depth(90)))
    seen.settle(1)
    assert strips == {}


def test_grey_values_are_what_the_membrane_moved_from_the_untouched_finger():
    seen = Pictures()
    seen.take(picture("sim/finger_left/reference", 0, depth(100)))
    strips = seen.begin()
    pressed = depth(100)
    pressed[:, 32:] = 880  # 12 mm nearer to the camera
    pressed[:, :8] = 1030  # 3 mm farther
    seen.take(picture(FINGER, 1, pressed))
    seen.settle(0)
    strip = strips["finger_left"]
    shown, told = grey(strip.shots[0]), carried([{"pictures": [strip.json(0)]}])
    assert (strip.kind, strip.against, shown.shape) == ("deformation", "the untouched finger", (48, 64))
    mm = (shown.astype(float) - told["zero"]) * told["unit"]
    assert mm[24, [2, 20, 60]] == pytest.approx([-3.0, 0.0, 12.0], abs=0.3)
    assert strip.reach == pytest.approx(12.0, abs=0.05)


def test_without_an_untouched_finger_it_is_the_change_since_the_first_picture():
    seen = Pictures()
    strips = seen.begin()
    for step, mm in enumerate((90, 88)):
        seen.take(picture(FINGER, step, depth(mm)))
        seen.settle(step)
    strip = strips["finger_left"]
    assert strip.against == "the first picture of the trial"
    assert [int(grey(shot)[24, 32]) for shot in strip.shots] == [50, 70]


def test_pixels_that_saw_nothing_have_not_moved():
    seen = Pictures()
    seen.take(picture("sim/finger_left/reference", 0, depth(100)))
    strips = seen.begin()
    holed = depth(100)
    holed[10:20, 10:20] = 0
    seen.take(picture(FINGER, 1, holed))
    seen.settle(0)
    assert np.abs(grey(strips["finger_left"].shots[0]).astype(int) - 50).max() <= 2


def test_a_large_colour_picture_stays_one_and_gets_small():
    seen = Pictures()
    strips = seen.begin()
    seen.take(picture(CAMERA, 1, np.full((1024, 1280, 3), (200, 100, 0), np.uint8), "bgr8"))
    seen.settle(0)
    strip = strips["camera"]
    assert (strip.kind, strip.width, strip.height) == ("picture", 256, 205)
    assert grey(strip.shots[0])[100, 100].tolist() == pytest.approx([200, 100, 0], abs=4)
    assert len(strip.shots[0][2]) < 10_000


def test_damaged_pictures_are_left_out():
    seen = Pictures()
    strips = seen.begin()
    seen.take(Logged(CAMERA, messages.COMPRESSED_IMAGE, b"\x00\x01\x00\x00 garbage", 0, 1, 1))
    seen.settle(0)
    assert strips == {}


def test_more_pictures_than_there_is_room_for_are_thinned_evenly_over_all_trials():
    rng = np.random.default_rng(0)
    seen = Pictures(room=60_000)
    trials = []
    for _ in range(3):
        trials.append(seen.begin())
        for step in range(40):
            noise = rng.integers(0, 255, (120, 160), np.uint8)
            seen.take(picture(CAMERA, step, noise, "mono8"))
            seen.settle(step)
        seen.end()
    steps = [[shot[0] for shot in strips["camera"].shots] for strips in trials]
    assert steps[0] == steps[1] == steps[2]
    assert len({b - a for a, b in zip(steps[0], steps[0][1:], strict=False)}) <= 1
    assert sum(len(shot[2]) for strips in trials for shot in strips["camera"].shots) <= 60_000
    assert steps[0][0] == 0


def test_all_fingers_of_a_trial_have_one_scale_and_stand_before_the_camera():
    strips = [
        {"device": name, "kind": kind, "against": "", "reach": reach, "width": 1, "height": 1, "shots": [[0.0, 0, ""]]}
        for name, kind, reach in (("a", "picture", 0), ("b", "deformation", 3.1), ("c", "deformation", 7.2))
    ]
    [found] = carried([{"pictures": strips}])["trials"]
    assert [(strip["device"], strip["reach"]) for strip in found] == [("b", 7.5), ("c", 7.5), ("a", 0.0)]
    [found] = carried([{"pictures": strips}], ["c", "a"])["trials"]
    assert [strip["device"] for strip in found] == ["c", "a", "b"]


def test_the_colours_are_those_of_viridis():
    ours, theirs = colours(10), sequential.Viridis
    channels = [[[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in which] for which in (ours, theirs)]
    assert np.abs(np.array(channels[0]) - channels[1]).max() <= 4


def test_a_page_without_pictures_carries_none(grasped, extrinsic):
    assert 'id="pictures-data"' not in render(grasped)
    assert 'id="pictures-data"' in render(extrinsic)


def test_forty_waypoints_of_two_fingers_and_a_camera_stay_under_8_mb(make_run, make_trial):
    trial, noise = make_trial(steps=40, eo=True), np.random.default_rng(0)
    made = []
    for device, shape in (("finger_left", (120, 160)), ("finger_right", (120, 160)), ("camera", (205, 256))):
        shots = []
        for step, t in enumerate(trial["waypoints"]["t"]):
            image = noise.integers(0, 255, shape, np.uint8)  # no picture is larger than noise
            data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()[:11_000]
            shots.append([t, step, base64.b64encode(data).decode()])
        made.append({"device": device, "kind": "picture", "against": "", "reach": 0.0, "width": shape[1],
                     "height": shape[0], "shots": shots})  # fmt: skip
    trial["pictures"] = made
    assert len(render(make_run([trial], eo=True)).encode()) < 8e6
