"""The contract of the devices: every backend of a kind keeps it."""

from __future__ import annotations

import json
import math
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np
import pytest
from scipy.stats import theilslopes

from drivers.errors import CommandRefused, DeviceTimeout, NotConnected
from mechanics.readings import Status
from tests.conformance.lab import about, in_lockstep, live, replayed

pytestmark = pytest.mark.alone  # with `test_arm`, so that there is one table

KINDS = ("arm", "gripper", "force_torque", "tag_camera", "tactile")
STREAMING = KINDS[:3]

every_kind = pytest.mark.parametrize("kind", KINDS)
every_stream = pytest.mark.parametrize("kind", STREAMING)

# -- every device ------------------------------------------------------------------------------------------------------


@every_kind
def test_describes_itself_open_or_closed(lab, kind):
    device = lab.of(kind)
    open_one = device.describe()
    device.close()
    closed_one = device.describe()
    assert open_one == closed_one
    assert (open_one.name, open_one.kind) == (lab.names[kind], kind)
    assert open_one.model and open_one.backend and open_one.serial and open_one.frame
    assert json.loads(json.dumps(asdict(open_one)))["extra"] == open_one.extra


@every_kind
def test_connect_is_idempotent(lab, kind):
    device = lab.of(kind)
    device.connect()
    device.connect()
    assert device.connected


@every_kind
def test_closing_twice_is_harmless_and_opening_again_works(lab, kind):
    device = lab.of(kind)
    device.close()
    device.close()
    assert not device.connected
    with device as opened:
        assert opened is device and device.connected
    assert not device.connected


@every_kind
def test_reading_a_closed_device_raises_not_connected(lab, kind):
    device = lab.of(kind)
    device.close()
    for read in (lambda: device.latest(0.1), lambda: device.since(0)):
        with pytest.raises(NotConnected) as caught:
            read()
        assert caught.value.device == lab.names[kind]


@every_kind
def test_waiting_for_a_first_reading_ends_in_a_timeout(lab, kind):
    device = lab.of(kind)
    with unheard(lab, device), pytest.raises(DeviceTimeout) as caught:
        device.latest(timeout=0.05)
    assert caught.value.device == lab.names[kind]


@contextmanager
def unheard(lab, device):
    """The device is open, and nothing has come of it yet."""
    if lab.simulation is not None:  # it was reset a moment ago
        yield
        return
    with lab.losing(device):
        device._forget()
        yield


# -- streams -----------------------------------------------------------------------------------------------------------


@every_stream
@in_lockstep
def test_streams_at_its_declared_rate(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(1.0)
    assert len(device.since(0)) == pytest.approx(device.describe().rate, abs=1)


@every_stream
def test_a_stream_keeps_its_declared_rate(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(0.3)
    times, sequences = [], []  # what was lost counts, too: it is told elsewhere
    for _ in range(100):
        times.append(own_time(lab, kind))
        sequences.append(device.latest().stamp.sequence)
        lab.clock.sleep(0.02)
    # a machine that is busy for a moment delivers late then, which is another figure: hence no mere first and last
    rate, *_ = theilslopes(sequences, times)
    assert rate == pytest.approx(device.describe().rate, rel=0.1)
    if lab.simulation is not None:
        told = (sequences[-1] - sequences[0]) / (times[-1] - times[0])
        assert told == pytest.approx(device.describe().rate, rel=0.1)


def own_time(lab, kind):
    return lab.clock.now_ns() * 1e-9 if lab.simulation is not None else lab.own_time(kind)


@every_stream
def test_stamps_rise_and_what_is_missing_is_counted(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(0.3)
    known, begin = device.gaps, device.latest().stamp.capture_ns
    lab.clock.sleep(1.0)
    stamps, gaps = [reading.stamp for reading in device.since(begin - 1)], device.gaps
    assert len(stamps) > 5
    assert np.all(np.diff([stamp.capture_ns for stamp in stamps]) > 0)
    skipped = np.diff([stamp.sequence for stamp in stamps]) - 1
    assert (skipped >= 0).all()
    if lab.simulation is not None:
        assert skipped.sum() == 0 and gaps == known == 0
    assert skipped.sum() <= gaps - known <= skipped.sum() + 10  # of what came after the look, some may be missing, too
    assert all(stamp.receive_ns >= stamp.capture_ns for stamp in stamps)
    assert {stamp.frame for stamp in stamps} == {device.describe().frame}


@every_stream
@in_lockstep
def test_after_a_sleep_everything_captured_until_then_is_here(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(0.5)
    assert device.gaps == 0
    assert lab.clock.now_ns() - device.since(0)[-1].stamp.capture_ns < 1e9 / device.describe().rate


@every_stream
def test_latest_is_the_last_of_since(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(0.3)
    before = device.since(0)[-1].stamp
    latest = device.latest().stamp
    after = device.since(0)[-1].stamp
    assert before.sequence <= latest.sequence <= after.sequence
    lab.clock.sleep(0.3)
    assert all(reading.stamp.capture_ns > latest.capture_ns for reading in device.since(latest.capture_ns))


@every_stream
def test_lost_readings_are_counted(lab, kind):
    device = lab.of(kind)
    lab.clock.sleep(0.3)
    before, known = device.latest().stamp.sequence, device.gaps
    with lab.losing(device):
        lab.clock.sleep(0.3)
    lab.clock.sleep(0.3)
    gaps, sequences = device.gaps, [reading.stamp.sequence for reading in device.since(0)]
    missing = set(range(before, sequences[-1])) - set(sequences)
    assert missing
    assert gaps - known == len(missing)


@every_stream
def test_listeners_get_every_reading_until_they_stop(lab, kind):
    device = lab.of(kind)
    heard = []
    stop = device.listen(heard.append)
    lab.clock.sleep(0.3)
    stop()
    lab.clock.sleep(0.1)  # one that was under way when it stopped may still come
    count = len(heard)
    lab.clock.sleep(0.3)
    assert count > 0 and len(heard) == count
    first = heard[0].stamp.sequence
    assert [r.stamp for r in heard] == [r.stamp for r in device.since(0) if r.stamp.sequence >= first][:count]


@every_stream
@in_lockstep
def test_reset_starts_the_stream_again(lab, kind, scene):
    device = lab.of(kind)
    lab.clock.sleep(0.3)
    lab.world.reset(1, scene)
    lab.clock.sleep(0.2)
    readings = device.since(0)
    assert readings[0].stamp.sequence == 0
    assert readings[-1].stamp.capture_ns <= 200_000_000
    assert device.gaps == 0


@every_stream
def test_two_clients_see_the_same_readings(lab, kind):
    with lab.join() as other:
        lab.clock.sleep(0.3 if lab.simulation is not None else 1.0)
        begun_within = lab.clock.now_ns()
        # each client knows its own sleeps to be complete, so the second takes one as well
        other.clock.sleep(0.1)
        theirs = {r.stamp.sequence: r for r in other.of(kind).since(0)}
        mine = lab.of(kind).since(0)
        common = [reading for reading in mine if reading.stamp.sequence in theirs]
        if lab.simulation is not None:
            assert len(common) >= len([r for r in mine if r.stamp.capture_ns <= begun_within]) > 0
        assert len(common) > 2
        for reading in common:
            their = theirs[reading.stamp.sequence]
            assert their.stamp.capture_ns == reading.stamp.capture_ns
            for field in ("pose", "wrench", "width"):
                np.testing.assert_array_equal(getattr(reading, field, None), getattr(their, field, None))


# -- the others --------------------------------------------------------------------------------------------------------


@about("force_torque")
@in_lockstep
def test_the_wrist_feels_the_weight_of_what_is_held(lab):
    wrist = lab.of("force_torque")
    lab.clock.sleep(0.2)
    assert np.linalg.norm(wrist.latest().wrench[:3]) == pytest.approx(0.981, rel=0.02)


@about("force_torque")
def test_tare_zeroes_the_load(lab):
    wrist = lab.of("force_torque")
    lab.clock.sleep(0.2)
    assert np.linalg.norm(wrist.latest().wrench[:3]) > 0.5
    wrist.tare()
    now = lab.clock.now_ns()
    lab.clock.sleep(0.3)
    mean = np.mean([reading.wrench for reading in wrist.since(now)], axis=0)
    np.testing.assert_allclose(mean, 0.0, atol=0.01)


@about("gripper")
@live
def test_gripper_grasps_and_releases(lab):
    gripper = lab.of("gripper")
    gripper.grasp(20.0)
    lab.clock.sleep(0.4)
    held = gripper.latest()
    assert held.holding and held.force == pytest.approx(20.0, abs=1.0)
    gripper.release()
    lab.clock.sleep(0.4)
    assert not gripper.latest().holding
    assert gripper.latest().width > held.width


@about("gripper")
@live
@pytest.mark.parametrize("force", [math.nan, -1.0, 1e6])
def test_gripper_refuses_a_force_without_meaning(lab, force):
    with pytest.raises(CommandRefused):
        lab.of("gripper").grasp(force)


@about("gripper")
@replayed
def test_a_recorded_gripper_refuses_to_move(lab):
    gripper = lab.of("gripper")
    for move in (lambda: gripper.grasp(20.0), gripper.release):
        with pytest.raises(CommandRefused, match="a recording does not move"):
            move()


@about("tag_camera")
@in_lockstep
def test_camera_captures_at_the_present_instant(lab):
    camera = lab.of("tag_camera")
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
def test_camera_captures_a_frame_that_was_exposed_after_it_was_asked(lab):
    camera = lab.of("tag_camera")
    lab.clock.sleep(0.3)
    asked = lab.clock.now_ns()
    first = camera.capture()
    assert first.stamp.capture_ns >= asked
    assert [tag.id for tag in first.detections] == [3]
    asked = lab.clock.now_ns()
    second = camera.capture()
    assert second.stamp.capture_ns >= asked
    assert second.stamp.sequence > first.stamp.sequence


@about("tag_camera")
def test_camera_keeps_the_picture_behind_its_reading(lab):
    camera = lab.of("tag_camera")
    lab.clock.sleep(0.1)
    reading = camera.capture()
    picture = camera.image()
    assert picture.image.shape == (480, 640)
    assert picture.stamp.capture_ns >= reading.stamp.capture_ns
    if lab.simulation is not None:
        assert (picture.stamp.sequence, picture.stamp.capture_ns) == (
            reading.stamp.sequence,
            reading.stamp.capture_ns,
        )
    assert describes_its_camera(camera)


def describes_its_camera(camera) -> bool:
    from mechanics.camera import CameraModel

    model = CameraModel.from_dict(camera.describe().extra["camera"])
    return (model.width, model.height) == (640, 480)


#: both tactile sensors, with what their pictures are
FINGERS = {"bubble": ((171, 224), np.uint16, "16UC1"), "gel": ((120, 160, 3), np.uint8, "bgr8")}
every_finger = pytest.mark.parametrize("name", FINGERS)


@about("tactile")
@in_lockstep
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
@in_lockstep
@every_finger
def test_finger_takes_no_frame_unless_asked(lab, name):
    finger = lab.devices[name]
    lab.clock.sleep(0.3)
    assert finger.since(0) == []


@about("tactile")
@in_lockstep
@every_finger
def test_finger_feels_what_it_holds(lab, name):
    finger = lab.devices[name]
    lab.clock.sleep(0.1)
    reference = finger.reference()
    assert reference.shape == FINGERS[name][0] and reference.dtype == FINGERS[name][1]
    held = finger.capture()
    assert held.stamp.status is Status.OK
    lab.of("gripper").release()
    lab.clock.sleep(0.1)
    empty = finger.capture()
    assert empty.stamp.status is Status.NO_CONTACT

    def differs(picture):
        return np.abs(picture.astype(int) - reference).mean()

    assert differs(held.image) > 3 * (differs(empty.image) + 0.5)


@about("tactile")
@in_lockstep
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


@about("tactile")
@every_finger
def test_finger_captures_a_frame_that_was_exposed_after_it_was_asked(lab, name):
    finger = lab.named(name)
    lab.clock.sleep(0.3)
    for _ in range(2):
        asked = lab.clock.now_ns()
        frame = finger.capture()
        assert frame.stamp.capture_ns >= asked
        assert frame.stamp.frame == finger.describe().frame
        assert frame.image.shape == finger.reference().shape
