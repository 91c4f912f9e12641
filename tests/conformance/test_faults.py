"""What goes wrong with a device shows as the error or the status that the interface promises, on every backend."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import CommandRefused, DeviceFault, DeviceTimeout, NotConnected, ProtocolError
from mechanics.readings import Status

from .fault_cases import (
    LEAST,
    NAMES,
    PICTURES,
    STREAMS,
    become,
    befalls,
    content,
    inject,
    move,
    read,
    statuses,
    wait_until_gone,
)

pytestmark = pytest.mark.backends("sim in process", "sim over zenoh")


@pytest.fixture(autouse=True)
def mended(request):
    """Leave every device as the next claim expects it."""
    if "lab" not in request.fixturenames:
        yield
        return
    lab = request.getfixturevalue("lab")
    yield
    lab.simulation.clear_faults()
    for device in lab.devices.values():
        device.close()
        device.connect()


# -- drop --------------------------------------------------------------------------------------------------------------


@befalls("drop", *STREAMS)
def test_dropped_readings_are_counted_exactly(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.3)
    inject(lab, fault, kind, value=0.3)
    lab.clock.sleep(1.0)
    lab.simulation.clear_faults()
    lab.clock.sleep(0.2)
    sequences = [reading.stamp.sequence for reading in device.since(0)]
    missing = set(range(sequences[0], sequences[-1])) - set(sequences)
    assert device.gaps == len(missing)
    # 0.3 of the second's readings, within four sigma of the binomial
    expected = device.describe().rate * 0.3
    assert len(missing) == pytest.approx(expected, abs=4 * np.sqrt(expected * 0.7))


@befalls("drop", "force_torque")
def test_the_same_readings_are_dropped_for_the_same_seed(lab, fault, kind, scene):
    def kept():
        lab.simulation.reset(7, scene)
        inject(lab, fault, kind, value=0.5)
        lab.clock.sleep(0.2)
        return [reading.stamp.sequence for reading in lab.devices["wrist_ft"].since(0)]

    first = kept()
    assert kept() == first
    assert 0 < len(first) < 199


@befalls("drop", *PICTURES)
def test_a_dropped_frame_is_a_timeout_and_a_gap(lab, fault, kind):
    camera = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.1)
    first = camera.capture().stamp.sequence
    inject(lab, fault, kind, value=1.0)
    with pytest.raises(DeviceTimeout) as caught:
        camera.capture()
    assert caught.value.device == NAMES[kind]
    lab.simulation.clear_faults()
    assert camera.capture().stamp.sequence == first + 2
    assert camera.gaps == 1


# -- freeze ------------------------------------------------------------------------------------------------------------


@befalls("freeze", *NAMES)
def test_a_silent_device_gives_no_old_reading_as_new(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    read(device)
    inject(lab, fault, kind)
    lab.clock.sleep(0.3)
    with pytest.raises(DeviceTimeout) as caught:
        read(device)
    assert caught.value.device == NAMES[kind]
    lab.simulation.clear_faults()
    lab.clock.sleep(0.1)
    assert lab.clock.now_ns() - read(device).stamp.capture_ns <= 5e7
    assert device.gaps == 0


@befalls("freeze", *STREAMS)
def test_a_reading_may_be_as_old_as_its_max_age(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    newest = device.latest().stamp
    inject(lab, fault, kind)
    assert device.max_age == max(5 / device.describe().rate, 0.1)
    lab.clock.sleep(device.max_age - 0.05)
    assert device.latest().stamp == newest
    assert device.latest().stamp == newest  # a clock that stands still ages nothing
    lab.clock.sleep(0.06)
    with pytest.raises(DeviceTimeout):
        device.latest()


@befalls("freeze", "arm", "gripper", "force_torque")
def test_commands_to_a_silent_device_time_out(lab, fault, kind):
    lab.clock.sleep(0.1)
    arm = lab.devices["arm"]
    arm.acquire("test")
    inject(lab, fault, kind)
    commands = {
        "arm": lambda: move(arm, 0.02),
        "gripper": lambda: lab.devices["gripper"].grasp(10.0),
        "force_torque": lab.devices["wrist_ft"].tare,
    }
    with pytest.raises(DeviceTimeout) as caught:
        commands[kind]()
    assert caught.value.device == NAMES[kind]
    lab.simulation.clear_faults()
    arm.release()


@befalls("freeze", "arm")
def test_an_arm_that_falls_silent_rests(lab, fault, kind):
    arm = lab.devices["arm"]
    lab.clock.sleep(0.1)
    with arm.lease("test"):
        move(arm, 0.02)
        lab.clock.sleep(0.25)
        inject(lab, fault, kind)
        lab.clock.sleep(0.6)
        lab.simulation.clear_faults()
        lab.clock.sleep(0.05)
        assert 0.005 < arm.latest().pose[0] < 0.015


# -- stuck -------------------------------------------------------------------------------------------------------------


@befalls("stuck", "force_torque")
def test_a_stuck_value_is_stale_where_noise_would_move_it(lab, fault, kind, scene):
    become(lab, scene, "lab")
    lab.clock.sleep(0.3)
    assert statuses(lab.devices["wrist_ft"], 0) == {Status.OK}
    inject(lab, fault, kind)
    lab.clock.sleep(0.3)
    newest = lab.devices["wrist_ft"].latest()
    assert newest.stamp.status is Status.STALE
    assert lab.clock.now_ns() - newest.stamp.capture_ns < 2e7  # stamps advance
    lab.simulation.clear_faults()
    lab.clock.sleep(0.1)
    assert lab.devices["wrist_ft"].latest().stamp.status is Status.OK
    become(lab, scene, "ideal")


@befalls("stuck", *PICTURES)
def test_a_stuck_picture_is_stale_where_noise_would_move_it(lab, fault, kind, scene):
    become(lab, scene, "lab")
    camera = lab.devices[NAMES[kind]]
    assert camera.capture().stamp.status is Status.OK
    inject(lab, fault, kind)
    held = camera.capture()
    lab.clock.sleep(0.1)
    again = camera.capture()
    assert again.stamp.status is Status.STALE
    assert again.stamp.sequence == held.stamp.sequence + 1
    assert again.stamp.capture_ns == held.stamp.capture_ns + 100_000_000  # stamps advance
    np.testing.assert_array_equal(content(again), content(held))
    lab.simulation.clear_faults()
    assert camera.capture().stamp.status is Status.OK
    become(lab, scene, "ideal")


@befalls("stuck", "arm")
def test_a_stuck_pose_is_stale_once_the_arm_should_have_moved(lab, fault, kind):
    arm = lab.devices["arm"]
    lab.clock.sleep(0.1)
    with arm.lease("test"):
        inject(lab, fault, kind)
        lab.clock.sleep(0.1)
        assert arm.latest().stamp.status is Status.OK  # at rest the stuck pose is the true one
        move(arm, 0.02)
        lab.clock.sleep(0.6)
        assert arm.latest().stamp.status is Status.STALE
        lab.simulation.clear_faults()
        lab.clock.sleep(0.1)
        assert arm.latest().stamp.status is Status.OK
        np.testing.assert_allclose(arm.latest().pose, [0.02, 0.25, 0.1], atol=1e-6)


@befalls("stuck", "gripper")
def test_a_stuck_gripper_is_stale_once_it_was_told_to_open(lab, fault, kind):
    gripper = lab.devices["gripper"]
    lab.clock.sleep(0.2)
    inject(lab, fault, kind)
    lab.clock.sleep(0.1)
    gripper.release()
    lab.clock.sleep(0.6)
    assert gripper.latest().stamp.status is Status.STALE


# -- delay -------------------------------------------------------------------------------------------------------------


@befalls("delay", *STREAMS)
def test_a_delay_shows_in_the_age_and_keeps_order(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    inject(lab, fault, kind, value=0.06)
    lab.clock.sleep(0.5)
    age = (lab.clock.now_ns() - device.latest().stamp.capture_ns) * 1e-9
    assert 0.06 <= age < 0.06 + 1 / device.describe().rate
    lab.simulation.clear_faults()
    lab.clock.sleep(0.3)
    stamps = [reading.stamp for reading in device.since(0)]
    assert np.all(np.diff([stamp.sequence for stamp in stamps]) == 1)
    assert np.all(np.diff([stamp.capture_ns for stamp in stamps]) > 0)
    assert device.gaps == 0


@befalls("delay", *NAMES)
def test_a_delay_beyond_what_is_bearable_is_a_timeout(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    inject(lab, fault, kind, value=3.0)
    lab.clock.sleep(0.5)
    with pytest.raises(DeviceTimeout) as caught:
        read(device)
    assert caught.value.device == NAMES[kind]


# -- bias --------------------------------------------------------------------------------------------------------------


@befalls("bias", "arm", "gripper", "force_torque")
def test_a_jump_is_invalid_until_it_is_taken_back(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    before = lab.clock.now_ns()
    assert statuses(device, 0) == {Status.OK}
    inject(lab, fault, kind, value={"arm": 0.05, "gripper": 0.02, "force_torque": 0.5}[kind])
    lab.clock.sleep(1.0)
    assert statuses(device, before) == {Status.INVALID}
    lab.simulation.clear_faults()
    after = lab.clock.now_ns()
    lab.clock.sleep(0.2)
    assert statuses(device, after) == {Status.OK}


# -- saturate ----------------------------------------------------------------------------------------------------------


@befalls("saturate", "force_torque")
def test_a_saturated_reading_is_clipped_and_says_so(lab, fault, kind):
    wrist = lab.devices["wrist_ft"]
    lab.clock.sleep(0.2)
    assert np.abs(wrist.latest().wrench).max() == pytest.approx(0.981, rel=0.02)  # the weight of 100 g
    inject(lab, fault, kind, value=0.4)
    lab.clock.sleep(0.1)
    assert wrist.latest().stamp.status is Status.SATURATED
    assert np.abs(wrist.latest().wrench).max() == 0.4


@befalls("saturate", "gelslim")
def test_a_picture_with_too_much_light_is_white_where_it_was_bright_and_says_so(lab, fault, kind):
    finger = lab.devices[NAMES[kind]]
    good = finger.capture()
    assert good.stamp.status is Status.OK
    assert (good.image == 255).mean() < 0.01
    limit = float(np.median(good.image))
    inject(lab, fault, kind, value=limit)
    spoiled = finger.capture()
    assert spoiled.stamp.status is Status.SATURATED
    assert (spoiled.image > 250).mean() > 0.4
    # over the bus a picture comes as JPEG, which is a few levels off
    assert np.abs(spoiled.image - np.minimum(good.image * (255 / limit), 255)).mean() < 4
    lab.simulation.clear_faults()
    healed = finger.capture()
    assert healed.stamp.status is Status.OK
    np.testing.assert_array_equal(healed.image, good.image)


@befalls("saturate", "soft_bubble")
def test_a_depth_beyond_the_range_is_the_end_of_the_range_and_says_so(lab, fault, kind):
    finger = lab.devices[NAMES[kind]]
    good = finger.capture()
    assert good.stamp.status is Status.OK
    limit = int(np.median(good.image))
    inject(lab, fault, kind, value=limit)
    spoiled = finger.capture()
    assert spoiled.stamp.status is Status.SATURATED
    np.testing.assert_allclose(spoiled.image, np.minimum(good.image, limit), rtol=0, atol=LEAST)
    assert spoiled.image.max() == limit
    lab.simulation.clear_faults()
    assert finger.capture().stamp.status is Status.OK


@befalls("saturate", "tag_camera")
def test_tags_seen_with_too_much_light_are_marked_whatever_was_found(lab, fault, kind):
    camera = lab.devices[NAMES[kind]]
    assert camera.capture().stamp.status is Status.OK
    inject(lab, fault, kind, value=15.0)  # less than the print's black: all is white, no tag is seen
    blind = camera.capture()
    assert (blind.stamp.status, blind.detections) == (Status.SATURATED, ())
    assert camera.image().image.min() == 255
    lab.simulation.clear_faults()
    inject(lab, fault, kind, value=150.0)  # only what is white is too bright: the tag is seen, and not to be trusted
    glaring = camera.capture()
    assert glaring.stamp.status is Status.SATURATED
    assert [tag.id for tag in glaring.detections] == [3]
    lab.simulation.clear_faults()
    assert camera.capture().stamp.status is Status.OK


@befalls("saturate", *PICTURES)
def test_a_picture_within_the_range_is_not_saturated(lab, fault, kind):
    camera = lab.devices[NAMES[kind]]
    good = content(camera.capture())
    inject(lab, fault, kind, value=65535.0)
    reading = camera.capture()
    assert reading.stamp.status is Status.OK
    np.testing.assert_allclose(content(reading), good, rtol=0, atol=LEAST)


# -- garbage -----------------------------------------------------------------------------------------------------------


@befalls("garbage", *STREAMS)
def test_garbage_is_a_protocol_error_counted_and_survived(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.5)
    good = len(device.since(0))
    inject(lab, fault, kind)
    lab.clock.sleep(0.5)
    with pytest.raises(ProtocolError) as caught:
        device.latest()
    assert caught.value.device == NAMES[kind]
    assert device.corrupt == pytest.approx(device.describe().rate * 0.5, abs=1)
    assert len(device.since(0)) == good
    lab.simulation.clear_faults()
    lab.clock.sleep(0.1)
    assert device.latest().stamp.status is Status.OK
    assert device.gaps == 0


@befalls("garbage", *PICTURES)
def test_a_garbled_frame_is_a_protocol_error_and_the_next_is_whole(lab, fault, kind):
    camera = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.1)
    whole = content(camera.capture())
    inject(lab, fault, kind)
    for use in (camera.capture, camera.latest):
        with pytest.raises(ProtocolError) as caught:
            use()
        assert caught.value.device == NAMES[kind]
    assert camera.corrupt == 1
    lab.simulation.clear_faults()
    np.testing.assert_allclose(content(camera.capture()), whole, rtol=0, atol=LEAST)


# -- disconnect --------------------------------------------------------------------------------------------------------


@befalls("disconnect", *NAMES)
def test_a_device_that_goes_is_a_fault_until_it_is_connected_again(lab, fault, kind):
    device = lab.devices[NAMES[kind]]
    lab.clock.sleep(0.3)
    inject(lab, fault, kind, duration=0.5)
    wait_until_gone(device)
    for use in (lambda: read(device), lambda: device.since(0)):
        with pytest.raises(DeviceFault) as caught:
            use()
        assert caught.value.device == NAMES[kind]
    device.close()
    with pytest.raises(NotConnected):
        device.connect(timeout=0.2)
    lab.clock.sleep(0.6)
    device.connect()
    lab.clock.sleep(0.3)
    assert lab.clock.now_ns() - read(device).stamp.capture_ns <= 5e7


@befalls("disconnect", "arm")
def test_commands_to_an_arm_that_has_gone_are_faults_and_it_rests(lab, fault, kind):
    arm = lab.devices["arm"]
    lab.clock.sleep(0.1)
    arm.acquire("test")
    move(arm, 0.02)
    lab.clock.sleep(0.25)
    inject(lab, fault, kind, duration=0.5)
    wait_until_gone(arm)
    with pytest.raises(DeviceFault) as caught:
        move(arm, 0.02)
    assert caught.value.device == "arm"
    arm.close()
    lab.clock.sleep(1.0)
    arm.connect()
    lab.clock.sleep(0.1)
    assert 0.005 < arm.latest().pose[0] < 0.015
    with arm.lease("test"):
        move(arm, 0.0)


@befalls("drop", "force_torque")
def test_a_reset_ends_what_was_injected(lab, fault, kind, scene):
    inject(lab, fault, kind, value=1.0)
    lab.simulation.reset(0, scene)
    lab.clock.sleep(0.1)
    assert len(lab.devices["wrist_ft"].since(0)) == 100


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"kind": "freeze", "device": "wirst_ft"}, "wrist_ft"),
        ({"kind": "freese", "device": "arm"}, "freeze"),
        ({"kind": "drop", "device": "arm"}, "share of readings"),
        ({"kind": "bias", "device": "camera", "value": 1.0}, "means nothing"),
        ({"kind": "saturate", "device": "arm", "value": 1.0}, "means nothing"),
        ({"kind": "saturate", "device": "bubble"}, "end of the range"),
    ],
)
def test_a_fault_that_cannot_be_is_refused(lab, wrong, says):
    with pytest.raises(CommandRefused, match=says):
        lab.simulation.inject(wrong)
