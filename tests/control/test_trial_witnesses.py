"""What a trial learns besides the errors: where the go is touched, and what the sensor under the table says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from control.closed_loop import ClosedLoop
from control.open_loop import OpenLoop
from control.settings import TrialSettings
from control.trial import TrialResult
from experiments import setup
from experiments.calibrate.store import Calibrations
from mechanics import se2

from .test_trial import STEPS, Station


class Roles:
    """The devices of a `Station` by their roles."""

    def __init__(self, station: Station):
        self._devices = station.devices
        self.arm, self.camera = station.arm, self._devices["camera"]

    def force_torque(self, mount):
        return self._devices[f"{mount}_ft"]


def whole_observer(station: Station):
    known = setup.believed(station.resolved, Calibrations())
    return setup.observer(station.resolved, Roles(station), TrialSettings(), known)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pressed() -> tuple[Station, TrialResult, list]:
    """A closed-loop trial that has run, and the plant's truth at its waypoints."""
    station, truths = Station(), []

    class Waypoints(list):
        def append(self, record):
            super().append(record)
            truths.append(station.world.truth())

    station.waypoints = Waypoints()
    result = station.run(ClosedLoop, observer=whole_observer(station))
    return station, result, truths


def test_where_the_object_is_touched_is_recorded_at_every_waypoint(pressed):
    _, result, truths = pressed
    assert result.status == "completed", result.reason
    assert len(result.waypoints) == len(truths) == STEPS
    for waypoint, truth in zip(result.waypoints, truths, strict=True):
        [touch] = [contact for contact in truth.contacts if contact.on == "go"]
        assert waypoint.contact is not None and waypoint.contact.point is not None
        assert waypoint.contact.point == pytest.approx(se2.transform(se2.inverse(truth.go), touch.point), abs=1e-4)


def test_the_table_bears_what_the_wrist_says(pressed):
    station, result, _ = pressed
    assert len(result.witness) == STEPS
    for found in result.witness:
        assert found.agrees and np.hypot(*found.difference) < 0.01
    assert [event for event in station.events if event[0] == "warning"] == []


def test_a_wrist_that_is_wrong_is_told_of_once_and_the_trial_goes_on():
    station = Station()
    wrist = station.devices["wrist_ft"]
    read = wrist._read
    wrong = np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])

    def reading():
        true = read()
        return replace(true, wrench=true.wrench + wrong) if station.phases[-1:] == ["trajectory"] else true

    wrist._read = reading
    result = station.run(observer=whole_observer(station))
    assert result.status == "completed", result.reason
    assert [found.agrees for found in result.witness] == [False] * STEPS
    [warning] = [text for level, text in station.events if level == "warning"]
    assert "under the table" in warning and "waypoint 0" in warning


def test_a_silent_sensor_under_the_table_is_no_witness_and_no_failure():
    station = Station()
    station.devices["table_ft"].since = lambda _capture_ns: []
    result = station.run(observer=whole_observer(station))
    assert result.status == "completed", result.reason
    assert result.witness == []


# -- the whole state ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [OpenLoop, ClosedLoop])
def test_the_state_is_estimated_at_every_waypoint_under_any_law_and_takes_no_picture_more(law):
    station, truths, pictures = Station(), [], []
    camera = station.devices["camera"]
    capture = camera.capture
    camera.capture = lambda *given: pictures.append(1) or capture(*given)

    class Waypoints(list):
        def append(self, record):
            super().append(record)
            truths.append(station.world.truth())

    station.waypoints = Waypoints()
    station.run(law, observer=whole_observer(station))
    for waypoint, truth in zip(station.waypoints, truths, strict=True):
        told = waypoint.estimated
        assert told is not None
        assert told.ee == pytest.approx(truth.ee, abs=1e-5)
        assert told.go == pytest.approx(truth.go, abs=1e-4)
        assert told.wrench == pytest.approx(truth.wrench, abs=0.02)
    # table and object before the start, the object before touch-down, and one look for each measurement
    looks = {OpenLoop: STEPS, ClosedLoop: 2 * STEPS}[law]
    in_air = len(pictures) - looks - 2
    assert in_air == 0 if law is OpenLoop else 0 < in_air <= TrialSettings().air_corrections


# -- how the object lies in the fingers --------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [OpenLoop, ClosedLoop])
def test_an_object_that_slips_in_the_fingers_is_told_by_how_far_under_any_law(law, tmp_path):
    weak = tmp_path / "weak.yaml"
    weak.write_text("fingers: {force_limit: 2, torque_limit: 1}")
    station = Station(f"world.profile={weak}")
    result = station.run(law, observer=whole_observer(station), on_deviation="record")
    plant = station.world.plant()
    last = result.drifts[STEPS - 1]
    assert plant.finger_slip > 1e-3
    assert last.slipped and last.size_mm == pytest.approx(plant.finger_slip * 1e3, rel=0.1)
    told = [text for level, text in station.events if level == "warning" and "slipped in the fingers" in text]
    assert len(told) == 1 and told[0].startswith(result.finger_slip) and "grip it harder" in told[0]


def test_what_the_fingers_tell_is_published_under_open_loop_and_is_the_wrench():
    station = Station()
    result = station.run(observer=whole_observer(station))
    assert result.finger_slip == "" and not any(drift.slipped for drift in result.drifts.values())
    assert sorted(result.drifts) == list(range(STEPS)) and len(station.felt) == STEPS
    for felt, waypoint in zip(station.felt, station.waypoints, strict=True):
        assert felt[:2] == pytest.approx(waypoint.measured.wrench[:2], abs=0.1)


def test_a_wrist_sensor_that_reads_too_little_is_contradicted_by_what_the_fingers_tell():
    station = Station()
    wrist = station.devices["wrist_ft"]
    read = wrist._read
    wrist._read = lambda: replace(reading := read(), wrench=reading.wrench * 0.5)
    result = station.run(observer=whole_observer(station))
    # the sensor under the table sides with the fingers: nothing has slipped
    assert result.finger_slip == "" and any(drift.slipped for drift in result.drifts.values())
    for felt, waypoint in zip(station.felt, station.waypoints, strict=True):
        assert abs(felt[1]) > 1.5 * abs(waypoint.measured.wrench[1])
