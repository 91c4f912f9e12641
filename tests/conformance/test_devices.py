"""The contract of the devices: every backend of a kind keeps it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import pytest

from drivers.errors import CommandRefused, DeviceTimeout, NotConnected
from drivers.interfaces import ArmTarget
from mechanics.readings import Status

#: name in the station of one device per kind
NAMES = {"arm": "arm", "gripper": "gripper", "force_torque": "wrist_ft", "tag_camera": "camera", "tactile": "bubble"}
STREAMING = [kind for kind in NAMES if kind not in ("tag_camera", "tactile")]

every_kind = pytest.mark.parametrize("kind", NAMES)
every_stream = pytest.mark.parametrize("kind", STREAMING)


def about(kind: str) -> Callable:
    """Mark a claim as one about a kind, for the table."""

    def mark(test):
        test.kind = kind
        return test

    return mark


def target(x: float, y: float, theta: float, duration: float = 0.5) -> ArmTarget:
    return ArmTarget(np.array([x, y, theta]), np.zeros(3), duration)


# -- every device ------------------------------------------------------------------------------------------------------


@every_kind
def test_describes_itself_open_or_closed(lab, kind):
    device = lab.devices[NAMES[kind]]
    open_one = device.describe()
    device.close()
    closed_one = device.describe()
    assert open_one == closed_one
    assert (open_one.name, open_one.kind) == (NAMES[kind], kind)
    assert open_one.model and open_one.backend and open_one.serial and open_one.frame
    assert json.loads(json.dumps(asdict(open_one)))["extra"] == open_one.extra


@every_kind
def test_connect_is_idempotent(lab, kind):
    device = lab.devices[NAMES[kind]]
    device.connect()
    device.connect()
    assert device.connected


@every_kind
def test_closing_twice_is_harmless_and_opening_again_works(lab, kind):
    device = lab.devices[NAMES[kind]]
    device.close()
    device.close()
    assert not device.connected
    with device as opened:
        assert opened is device and device.connected
    assert not device.connected


@every_kind
def test_reading_a_closed_device_raises_not_connected(lab, kind):
    device = lab.devices[NAMES[kind]]
    device.close()
    for read in (lambda: device.latest(0.1), lambda: device.since(0)):
        with pytest.raises(NotConnected) as caught:
            read()
        assert caught.value.device == NAMES[kind]


@every_kind
def test_waiting_for_a_first_reading_ends_in_a_timeout(lab, kind):
    device = lab.devices[NAMES[kind]]
    with pytest.raises(DeviceTimeout) as caught:
        device.latest(timeout=0.05)
    assert caught.value.device == NAMES[kind]


# -- streams -----------------------------------------------------------------------------------------------------------


@every_stream
def test_streams_at_its_declared_rate(lab, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(1.0)
    assert len(device.since(0)) == pytest.approx(device.describe().rate, abs=1)


@every_stream
def test_stamps_rise_and_sequence_has_no_gaps(lab, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    stamps = [reading.stamp for reading in device.since(0)]
    assert len(stamps) > 5
    assert np.all(np.diff([stamp.capture_ns for stamp in stamps]) > 0)
    assert np.all(np.diff([stamp.sequence for stamp in stamps]) == 1)
    assert all(stamp.receive_ns >= stamp.capture_ns for stamp in stamps)
    assert {stamp.frame for stamp in stamps} == {device.describe().frame}
    assert device.gaps == 0
    # after a sleep, everything captured until now is here
    assert lab.clock.now_ns() - stamps[-1].capture_ns < 1e9 / device.describe().rate


@every_stream
def test_latest_is_the_last_of_since(lab, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.3)
    latest = device.latest()
    before = latest.stamp.capture_ns
    lab.clock.sleep(0.3)
    newer = device.since(before)
    assert all(reading.stamp.capture_ns > before for reading in newer)
    assert newer[-1].stamp == device.latest().stamp


@every_stream
def test_lost_readings_are_counted(lab, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.2)
    before = device.latest().stamp.sequence
    with lab.losing(device):
        lab.clock.sleep(0.2)
    lab.clock.sleep(0.2)
    sequences = [reading.stamp.sequence for reading in device.since(0)]
    missing = set(range(before, sequences[-1])) - set(sequences)
    assert missing
    assert device.gaps == len(missing)


@every_stream
def test_listeners_get_every_reading_until_they_stop(lab, kind):
    device = lab.devices[NAMES[kind]]
    heard = []
    stop = device.listen(heard.append)
    lab.clock.sleep(0.2)
    stop()
    count = len(heard)
    lab.clock.sleep(0.2)
    assert count > 0 and len(heard) == count
    assert [r.stamp for r in heard] == [r.stamp for r in device.since(0)][:count]


@every_stream
def test_reset_starts_the_stream_again(lab, kind, scene):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.3)
    lab.simulation.reset(1, scene)
    lab.clock.sleep(0.2)
    readings = device.since(0)
    assert readings[0].stamp.sequence == 0
    assert readings[-1].stamp.capture_ns <= 200_000_000
    assert device.gaps == 0


@every_stream
def test_two_clients_see_the_same_readings(lab, kind):
    with lab.join() as other:
        lab.clock.sleep(0.3)
        # each client knows its own sleeps to be complete, so the second takes one as well
        other.clock.sleep(0.1)
        theirs = {r.stamp.sequence: r for r in other.devices[NAMES[kind]].since(0)}
        mine = lab.devices[NAMES[kind]].since(0)
        common = [reading for reading in mine if reading.stamp.sequence in theirs]
        assert len(common) >= len([r for r in mine if r.stamp.capture_ns <= 300_000_000]) > 0
        for reading in common:
            their = theirs[reading.stamp.sequence]
            assert their.stamp.capture_ns == reading.stamp.capture_ns
            for field in ("pose", "wrench", "width"):
                np.testing.assert_array_equal(getattr(reading, field, None), getattr(their, field, None))


# -- the arm -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def arm(lab):
    return lab.devices["arm"]


@about("arm")
def test_arm_goes_to_its_target(lab, arm):
    with arm.lease("test"):
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.6)
        np.testing.assert_allclose(arm.latest().pose, [0.02, 0.26, 0.2], atol=1e-6)


@about("arm")
def test_command_without_the_lease_is_refused(lab, arm):
    with pytest.raises(CommandRefused) as caught:
        arm.command(target(0.02, 0.26, 0.2))
    assert caught.value.device == "arm" and "lease" in caught.value.reason
    lab.clock.sleep(0.6)
    np.testing.assert_allclose(arm.latest().pose, [0.0, 0.25, 0.1], atol=1e-9)


@about("arm")
def test_second_commander_is_refused(lab, arm):
    with arm.lease("first"), lab.join() as other, pytest.raises(CommandRefused):
        other.devices["arm"].acquire("second")
    with lab.join() as other, other.devices["arm"].lease("second"):
        pass


@about("arm")
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", ["pose", "twist", "duration"])
def test_not_finite_is_refused_and_changes_nothing(lab, arm, bad, place):
    parts = {"pose": np.array([0.02, 0.26, 0.2]), "twist": np.zeros(3), "duration": 0.5}
    broken = {"pose": np.array([0.0, bad, 0.0]), "twist": np.array([0.0, 0.0, bad]), "duration": bad}
    with arm.lease("test"):
        arm.command(ArmTarget(**parts))
        with pytest.raises(CommandRefused):
            arm.command(ArmTarget(**(parts | {place: broken[place]})))
        lab.clock.sleep(0.6)
        np.testing.assert_allclose(arm.latest().pose, parts["pose"], atol=1e-6)


def stays(lab, arm) -> bool:
    """Whether the arm rests, away from both ends of the motion it was on."""
    lab.clock.sleep(0.1)
    here = arm.latest().pose
    lab.clock.sleep(0.6)
    return 0.001 < here[0] < 0.019 and bool(np.abs(arm.latest().pose - here).max() < 1e-9)


@about("arm")
def test_stop_latches_until_recover(lab, arm):
    with arm.lease("test"):
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.25)
        arm.stop()
        assert stays(lab, arm)
        with pytest.raises(CommandRefused):
            arm.command(target(0.02, 0.26, 0.2))
        arm.recover()
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.6)
        np.testing.assert_allclose(arm.latest().pose, [0.02, 0.26, 0.2], atol=1e-6)


@about("arm")
@pytest.mark.parametrize("verb", ["stop", "hold"])
def test_stop_and_hold_need_no_lease(lab, arm, verb):
    with lab.join() as other, arm.lease("test"):
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.25)
        getattr(other.devices["arm"], verb)()
        assert stays(lab, arm)


@about("arm")
def test_hold_lets_the_next_command_pass(lab, arm):
    with arm.lease("test"):
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.25)
        arm.hold()
        assert stays(lab, arm)
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.6)
        np.testing.assert_allclose(arm.latest().pose, [0.02, 0.26, 0.2], atol=1e-6)


@about("arm")
def test_end_of_the_lease_holds_the_arm(lab, arm):
    with arm.lease("test"):
        arm.command(target(0.02, 0.26, 0.2))
        lab.clock.sleep(0.25)
    assert stays(lab, arm)


@about("arm")
def test_closing_leaves_the_arm_held(lab, arm):
    arm.acquire("test")
    arm.command(target(0.02, 0.26, 0.2))
    lab.clock.sleep(0.25)
    arm.close()
    arm.close()
    lab.clock.sleep(0.1)
    arm.connect()
    assert stays(lab, arm)
    with arm.lease("another"):
        pass


# -- the others --------------------------------------------------------------------------------------------------------


@about("force_torque")
def test_tare_zeroes_the_load(lab):
    wrist = lab.devices["wrist_ft"]
    lab.clock.sleep(0.2)
    assert np.linalg.norm(wrist.latest().wrench[:3]) == pytest.approx(0.981, rel=0.02)
    wrist.tare()
    now = lab.clock.now_ns()
    lab.clock.sleep(0.2)
    mean = np.mean([reading.wrench for reading in wrist.since(now)], axis=0)
    np.testing.assert_allclose(mean, 0.0, atol=0.01)


@about("gripper")
def test_gripper_grasps_and_releases(lab):
    gripper = lab.devices["gripper"]
    gripper.grasp(20.0)
    lab.clock.sleep(0.2)
    held = gripper.latest()
    assert held.holding and held.force == pytest.approx(20.0, abs=1.0)
    gripper.release()
    lab.clock.sleep(0.2)
    assert not gripper.latest().holding
    assert gripper.latest().width > held.width


@about("gripper")
@pytest.mark.parametrize("force", [math.nan, -1.0, 1e6])
def test_gripper_refuses_a_force_without_meaning(lab, force):
    with pytest.raises(CommandRefused):
        lab.devices["gripper"].grasp(force)


@about("tag_camera")
def test_camera_captures_at_the_present_instant(lab):
    camera = lab.devices["camera"]
    lab.clock.sleep(0.1)
    first = camera.capture()
    assert first.stamp.capture_ns == lab.clock.now_ns() == 100_000_000
    assert [tag.id for tag in first.detections] == [3]
    lab.clock.sleep(0.1)
    second = camera.capture()
    assert second.stamp.sequence == first.stamp.sequence + 1
    assert camera.latest().stamp == second.stamp
    assert camera.gaps == 0


@about("tag_camera")
def test_camera_keeps_the_picture_behind_its_reading(lab):
    camera = lab.devices["camera"]
    lab.clock.sleep(0.1)
    reading = camera.capture()
    picture = camera.image()
    assert picture.image.shape == (480, 640)
    assert picture.stamp.sequence == reading.stamp.sequence
    assert describes_its_camera(camera)


def describes_its_camera(camera) -> bool:
    from mechanics.camera import CameraModel

    model = CameraModel.from_dict(camera.describe().extra["camera"])
    return (model.width, model.height) == (640, 480)


#: both tactile sensors, with what their pictures are
FINGERS = {"bubble": ((171, 224), np.uint16, "16UC1"), "gel": ((120, 160, 3), np.uint8, "bgr8")}
every_finger = pytest.mark.parametrize("name", FINGERS)


@about("tactile")
@every_finger
def test_finger_captures_at_the_present_instant(lab, name):
    finger, (shape, dtype, encoding) = lab.devices[name], FINGERS[name]
    lab.clock.sleep(0.1)
    first = finger.capture()
    assert first.stamp.capture_ns == lab.clock.now_ns() == 100_000_000
    assert (first.image.shape, first.image.dtype, first.encoding) == (shape, dtype, encoding)
    assert first.stamp.frame == finger.describe().frame
    lab.clock.sleep(0.1)
    second = finger.capture()
    assert second.stamp.sequence == first.stamp.sequence + 1
    assert finger.latest().stamp == second.stamp
    assert [reading.stamp for reading in finger.since(0)] == [first.stamp, second.stamp]
    assert finger.gaps == 0


@about("tactile")
@every_finger
def test_finger_takes_no_frame_unless_asked(lab, name):
    finger = lab.devices[name]
    lab.clock.sleep(0.3)
    assert finger.since(0) == []


@about("tactile")
@every_finger
def test_finger_feels_what_it_holds(lab, name):
    finger = lab.devices[name]
    lab.clock.sleep(0.1)
    reference = finger.reference()
    assert reference.shape == FINGERS[name][0] and reference.dtype == FINGERS[name][1]
    held = finger.capture()
    assert held.stamp.status is Status.OK
    lab.devices["gripper"].release()
    lab.clock.sleep(0.1)
    empty = finger.capture()
    assert empty.stamp.status is Status.NO_CONTACT

    def differs(picture):
        return np.abs(picture.astype(int) - reference).mean()

    assert differs(held.image) > 3 * (differs(empty.image) + 0.5)


@about("tactile")
@every_finger
def test_finger_says_which_it_is(lab, name):
    from mechanics.camera import CameraModel

    said, (shape, _, encoding) = lab.devices[name].describe(), FINGERS[name]
    assert said.extra["sensor"] == {"bubble": "soft_bubble", "gel": "gelslim"}[name]
    assert said.extra["finger"] == {"bubble": "left", "gel": "right"}[name]
    assert said.extra["encoding"] == encoding
    camera = CameraModel.from_dict(said.extra["camera"])
    assert (camera.height, camera.width) == shape[:2]
    assert np.array(said.extra["X_ee_finger"]).shape == (4, 4)
