"""What a log says of its devices, held against messages whose faults were put there one by one."""

import pytest

from drivers.interfaces import Description
from drivers.log_health import LogHealth, Worst
from drivers.wire import messages
from drivers.wire.log_reader import Logged
from mechanics.readings import Status

MS = 1_000_000


def device(name, kind, rate):
    return Description(name, kind, "a model", "sim", "1", name, rate)


DEVICES = {"ft": device("ft", "force_torque", 1000.0), "cam": device("cam", "tag_camera", 10.0)}


def reading(sequence, t_ms, topic="sim/ft/wrench", late_ms=0, status=Status.OK):
    return Logged(topic, messages.WRENCH, b"", sequence, t_ms * MS, (t_ms + late_ms) * MS, int(status))


def fared(*files, lockstep=False):
    health = LogHealth()
    for file in files:
        for logged in file:
            health.take(logged)
        health.end_file()
    return health.streams(DEVICES, lockstep=lockstep)


def assert_worst(found, value, at_ns):
    assert found is not None
    assert (found.value, found.at_ns) == (pytest.approx(value), at_ns)


def test_rate_is_the_mean_over_the_time_between_first_and_last():
    [ft] = fared([reading(i, 2 * i) for i in range(101)])
    assert (ft.messages, ft.declared, ft.lost) == (101, 1000.0, 0)
    assert ft.rate == pytest.approx(500.0)


def test_the_longest_silence_and_the_largest_gap_are_told_with_their_time():
    [ft] = fared([reading(0, 0), reading(1, 1), reading(4, 40), reading(5, 41), reading(7, 43)])
    assert (ft.lost, ft.gaps, ft.gap) == (3, 2, Worst(2, 1 * MS))
    assert_worst(ft.silence, 0.039, 1 * MS)


def test_a_device_that_falls_silent_is_silent_until_the_log_ends():
    [cam, ft] = fared([reading(0, 0), reading(1, 1), reading(0, 5000, "sim/cam/detections")])
    assert_worst(ft.silence, 4.999, 1 * MS)
    assert cam.silence == Worst(0.0, 5000 * MS)


def test_a_count_that_begins_anew_is_no_gap():
    [ft] = fared([reading(900, 0), reading(901, 1), reading(0, 2), reading(1, 3)])
    assert (ft.lost, ft.gaps, ft.gap) == (0, 0, None)


def test_between_two_files_of_a_run_nothing_is_missed():
    [ft] = fared([reading(0, 0), reading(1, 1)], [reading(700, 60_000), reading(701, 60_001)])
    assert (ft.lost, ft.messages) == (0, 4)
    assert_worst(ft.silence, 0.001, 0)
    assert ft.rate == pytest.approx(1000.0)


def test_the_oldest_reading_on_arrival_is_told_with_its_time():
    [ft] = fared([reading(0, 0, late_ms=1), reading(1, 1, late_ms=30), reading(2, 2, late_ms=2)])
    assert_worst(ft.age, 0.030, 1 * MS)


def test_in_lockstep_nothing_has_an_age_and_cameras_are_asked():
    [cam, ft] = fared([reading(0, 0), reading(1, 1), reading(0, 5000, "sim/cam/detections")], lockstep=True)
    assert ft.age is None and ft.silence is not None and not ft.on_request
    assert (cam.on_request, cam.rate, cam.silence, cam.declared) == (True, None, None, None)


def test_readings_that_were_not_ok_are_counted_from_their_first():
    bad = [reading(i, i, status=Status.SATURATED if 3 <= i < 8 else Status.OK) for i in range(10)]
    [ft] = fared([*bad, reading(10, 10, status=Status.STALE)])
    assert ft.conditions == {Status.SATURATED: (5, 3 * MS), Status.STALE: (1, 10 * MS)}


def test_a_device_that_never_spoke_is_told_and_in_lockstep_a_camera_may_not_have_been_asked():
    health = LogHealth()
    health.take(reading(0, 0, "sim/arm/pose"))
    assert health.silent(DEVICES, lockstep=False) == {"ft": False, "cam": False}
    assert health.silent(DEVICES, lockstep=True) == {"ft": False, "cam": True}


@pytest.mark.parametrize(
    "topic",
    ["run/waypoint", "sim/world/truth", "sim/arm/target", "sim/estimator/wrench", "sim/finger/reference", "odd"],
)
def test_what_is_no_reading_of_a_device_is_left_out(topic):
    assert fared([reading(0, 0, topic)]) == []


def diagnostics(t_ms, level, said, **counts):
    pairs = [
        messages.message("diagnostic_msgs/msg/KeyValue", key=key.replace("_", " "), value=str(value))
        for key, value in counts.items()
    ]
    part = messages.message(
        "diagnostic_msgs/msg/DiagnosticStatus", level=level, name="arm", message=said, hardware_id="arm", values=pairs
    )
    whole = messages.message(messages.DIAGNOSTICS, header=messages.header(t_ms * MS, "world"), status=[part])
    return Logged("sim/arm/safety", messages.DIAGNOSTICS, messages.encode(whole), 0, t_ms * MS, t_ms * MS)


def test_what_the_gates_of_an_arm_refused_is_told_as_they_said_it_last():
    health = LogHealth()
    health.take(diagnostics(0, 0, "ok", accepted=0))
    health.take(diagnostics(5, 1, "too fast", accepted=7, refused_by_speed=1))
    health.take(diagnostics(6, 1, "too fast", accepted=7, refused_by_speed=2))
    health.take(diagnostics(9, 2, "stopped: a button", accepted=9, refused_by_speed=2, refused_by_force=0))
    health.take(Logged("sim/arm/safety", messages.DIAGNOSTICS, b"\x00garbage", 0, 10 * MS, 10 * MS))
    [arm] = health.gates()
    assert (arm.device, arm.accepted, arm.refused) == ("arm", 9, {"speed": 2})
    assert arm.troubles == ((5 * MS, "too fast"), (9 * MS, "stopped: a button"))
